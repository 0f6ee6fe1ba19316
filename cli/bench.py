"""``ohmskin bench``: speed against error, all methods and their peers on the same arrays in one run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any

import click

from .. import bench
from ..bench import _driver as of_drivers
from ..bench import _emulator as of_boards
from ..bench import _estimators as of_cells
from ..bench import _fingers as of_fingers
from ..bench import _freshness as of_skins
from ..bench import _hard_cases as of_hard_cases
from ..bench import _honesty as of_deviations
from ..bench import _light_taps as of_light_taps
from ..bench import _rest as of_rests
from ..bench import _taps as of_taps
from ..bench import _view as of_pages
from ..bench import _worst_frames as of_events
from ..bench import judges
from ..common import tables
from . import arguments
from ._bar import progress_bar
from ._json import json_text


class _ManyValues(click.Command):
    """Lets an option that may be repeated take several values at once: ``--size 8 16 32``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        spread: list[str] = []
        option: str | None = None
        names = {name for part in self.params if getattr(part, "multiple", False) for name in part.opts}
        for word in args:
            if word.startswith("-"):
                option = word if word in names else None
                if option is None:
                    spread.append(word)
            elif option is not None:
                spread += [option, word]
            else:
                spread.append(word)
        return super().parse_args(ctx, spread)


@click.command(
    cls=_ManyValues,
    epilog=arguments.example("ohmskin bench --size 8 16 32 --segment 1.0", "ohmskin bench --estimators --json"),
)
@click.option("--size", "sizes", type=int, multiple=True, default=(8, 16, 32, 64), metavar="N ...", show_default=True)
@click.option("--segment", "segments", type=float, multiple=True, default=(1.0,), metavar="R ...", show_default=True)
@click.option("--memory/--no-memory", default=True, show_default=True, help="Measure memory, each in a new process.")
@click.option("--peers/--no-peers", default=True, show_default=True, help="Measure other programs and libraries, too.")
@click.option("--wait", "patient", is_flag=True, help="Wait for slow peers, too: ngspice takes 20 s for 64 x 64.")
@click.option("--picture", type=click.Path(path_type=Path), metavar="OUT.svg", help="Draw error against time.")
@click.option("--estimators", is_flag=True, help="Measure the pressure estimators instead, on a material of their own.")
@click.option("--emulator", "of_emulator", is_flag=True, help="Measure the virtual board instead, at these sizes.")
@click.option(
    "--driver", "of_driver", is_flag=True, help="Measure the live path instead, bytes to kPa, at these sizes."
)
@click.option(
    "--contacts",
    "of_contacts",
    is_flag=True,
    help="Measure contacts instead: short taps found, fingers followed, false contacts.",
)
@click.option(
    "--judges", "of_judges", is_flag=True, help="Judge an estimator by the scenes and gates of judges.toml instead."
)
@click.option("--only", default="", metavar="PATTERN", help="Of the judges: rows whose name or gate contains it.")
@click.option("--quick", is_flag=True, help="Of the judges: a selection of about 20 s.")
@click.option(
    "--estimator", metavar="NAME", help="Of the judges: what is judged; also module:function(cell, shape). [cell's own]"
)
@click.option("--freeze", is_flag=True, help="Of the judges: write the figures into the table as today's.")
@click.option("--view", "of_page", is_flag=True, help="Measure the page of `ohmskin view` instead, in Chromium.")
@arguments.as_json("the measurements")
def command(
    sizes: tuple[int, ...],
    segments: tuple[float, ...],
    memory: bool,
    peers: bool,
    patient: bool,
    picture: Path | None,
    estimators: bool,
    of_emulator: bool,
    of_driver: bool,
    of_contacts: bool,
    of_judges: bool,
    only: str,
    quick: bool,
    estimator: str | None,
    freeze: bool,
    of_page: bool,
    as_json: bool,
) -> None:
    """Measure N x N arrays of 10 kohm to 1 Mohm with R ohm per line segment and lead: time per frame, true error,
    certified bound and memory of every method. Set OPENBLAS_NUM_THREADS=1 to compare on one thread.
    """
    if of_judges:
        _judge(only, quick, estimator, freeze, as_json)
        return
    if estimators:
        judged = of_cells.estimators()
        click.echo(_as_json(judged) if as_json else of_cells.table(judged))
        if not as_json:
            click.echo("\n" + of_hard_cases.hard_table(of_hard_cases.hard_cases()))
            click.echo("\n" + of_rests.table(of_rests.rests()))
            click.echo("\n" + of_light_taps.table(of_light_taps.light_taps()))
            click.echo("\n" + of_deviations.table(of_deviations.honesty()))
            click.echo("\n" + of_deviations.summary(of_deviations.elsewhere()))
        return
    if of_emulator:
        boards = list(of_boards.emulator(sizes))
        click.echo(_as_json(boards) if as_json else of_boards.table(boards))
        return
    if of_driver:
        _live_path(sizes, as_json, picture)
        return
    if of_contacts:
        tapped, moved = of_taps.taps_and_faults(sizes), of_fingers.fingers(sizes)
        if as_json:
            click.echo(_as_json([*tapped, *moved]))
        else:
            for line in chain(of_taps.table(tapped), [""], of_fingers.table(moved)):
                click.echo(line)
        return
    if of_page:
        shown = list(of_pages.view(sizes))
        click.echo(_as_json(shown) if as_json else of_pages.table(shown))
        return
    arrays = [(size, segment) for size in sizes for segment in segments]
    rows = []
    with progress_bar("measuring") as progress:
        for row in bench.measure(sizes, segments, memory=memory, peers=peers, patient=patient):
            rows.append(row)
            progress(arrays.index((row.size, row.segment)), len(arrays), f"{row.size} x {row.size}, {row.method}")
    if picture is not None:
        tables.write_text(picture, bench.picture(rows))
    click.echo(_as_json(rows) if as_json else bench.table(rows), nl=as_json)


def _judge(only: str, quick: bool, estimator: str | None, freeze: bool, as_json: bool) -> None:
    """Print today's and the measured figures of each row, and whether its gate holds."""
    chosen, make = judges.rows(only, quick=quick), judges.maker(estimator)
    verdicts = []
    if not as_json:
        click.echo(judges.HEADER)
    with progress_bar("judging") as progress:
        for done, row in enumerate(chosen):
            progress(done, len(chosen), row.name)
            for verdict in judges.judge([row], make):
                verdicts.append(verdict)
                if not as_json:
                    click.echo(judges.line(verdict))
    if freeze:
        judges.freeze(verdicts)
    records = [judges.record(verdict) for verdict in verdicts]
    click.echo(json_text(records, indent=1) if as_json else "\n" + judges.summary(verdicts))


def _as_json(rows: Iterable[Any]) -> str:
    """Measurements, which are dataclasses, as a JSON list."""
    return json_text([asdict(row) for row in rows], indent=1)


def _kept(rows: Iterator[of_events.WorstFrames], kept: list[of_events.WorstFrames]) -> Iterator[of_events.WorstFrames]:
    """The rows, while they come, and a list of them."""
    for row in rows:
        kept.append(row)
        yield row


def _live_path(sizes: tuple[int, ...], as_json: bool, picture: Path | None) -> None:
    """Boards, estimators and a whole skin; the JSON is one list of all rows."""
    boards = list(of_drivers.driver(sizes))
    if not as_json:
        click.echo(of_drivers.table(boards) + "\n")
    hard: list[of_events.WorstFrames] = []
    for line in of_events.worst_table(_kept(of_events.worst_frames(sizes), hard)):
        if not as_json:
            click.echo(line)
    if not as_json:
        click.echo()
    judged = list(of_drivers.live_estimators(sizes))
    if picture is not None:
        tables.write_text(picture, of_drivers.live_picture(judged))
    if not as_json:
        click.echo(of_drivers.estimator_table(judged) + "\n")
    skins = list(of_skins.freshness(sizes))
    if as_json:
        click.echo(_as_json([*boards, *judged, *hard, *skins]))
    else:
        click.echo(of_skins.freshness_table(skins))
