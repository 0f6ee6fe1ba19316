"""``ohmskin bench``: speed against error, all methods and their peers on the same arrays in one run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import click

from ..common import tables
from ..common.json_text import json_text
from ..errors import InputError
from . import arguments
from ._bar import progress_bar


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


def _instead(what: str, measured: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """An option that measures something else than solvers."""
    return click.option(f"--{what}", "what", flag_value=what, help=f"Instead, measure {measured}.")


@click.command(
    cls=_ManyValues,
    epilog=arguments.example("ohmskin bench --size 8 16 32 --segment 1.0", "ohmskin bench --estimators --json"),
)
@click.option("--size", "sizes", type=int, multiple=True, default=(8, 16, 32, 64), metavar="N ...", show_default=True)
@click.option("--segment", "segments", type=float, multiple=True, default=(1.0,), metavar="R ...", show_default=True)
@click.option("--peers/--no-peers", default=True, show_default=True, help="Measure other programs and libraries, too.")
@click.option("--wait", "patient", is_flag=True, help="Wait for slow peers, too: ngspice takes 20 s for 64 x 64.")
@click.option(
    "--picture", type=click.Path(path_type=Path), metavar="OUT.svg", help="Of solvers: draw error against time."
)
@_instead("estimators", "the pressure estimators, on presses at random")
@_instead("emulator", "the virtual board, at these sizes")
@_instead("driver", "the live path, bytes to kPa, at these sizes")
@_instead("contacts", "contacts: short taps found, fingers followed, false contacts")
@_instead("scenarios", "an estimator on the regression scenarios, beside the gates of bench/scenarios.toml")
@click.option("--only", default="", metavar="PATTERN", help="Of the scenarios: rows whose name or gate contains it.")
@click.option("--quick", is_flag=True, help="Of the scenarios: a selection of about 5 s.")
@click.option(
    "--estimator", metavar="NAME", help="Of the scenarios: which one; also module:function(cell, shape). [cell's own]"
)
@click.option("--freeze", is_flag=True, help="Of the scenarios: write the figures into the table as today's.")
@arguments.as_json("the measurements")
def command(
    sizes: tuple[int, ...],
    segments: tuple[float, ...],
    peers: bool,
    patient: bool,
    picture: Path | None,
    what: str | None,
    only: str,
    quick: bool,
    estimator: str | None,
    freeze: bool,
    as_json: bool,
) -> None:
    """Measure N x N arrays of 10 kohm to 1 Mohm with R ohm per line segment and lead: time per frame, true error
    and certified bound of every method. Set OPENBLAS_NUM_THREADS=1 to compare on one thread.
    """
    if find_spec("ohmskin.bench") is None:
        raise InputError("measurements are part of the sources, not of the package; run this in a checkout")
    from .. import bench
    from ..bench import measurements

    if what == "scenarios":
        _judge(only, quick, estimator, freeze, as_json)
        return
    if what is not None:
        _show(measurements.TABLES[what](sizes), as_json)
        return
    arrays = [(size, segment) for size in sizes for segment in segments]
    rows = []
    with progress_bar("measuring") as progress:
        for row in bench.measure(sizes, segments, peers=peers, patient=patient):
            rows.append(row)
            progress(arrays.index((row.size, row.segment)), len(arrays), f"{row.size} x {row.size}, {row.method}")
    if picture is not None:
        tables.write_text(picture, bench.picture(rows))
    _show([("", rows)], as_json)


def _judge(only: str, quick: bool, estimator: str | None, freeze: bool, as_json: bool) -> None:
    """Print today's and the measured figures of each row, and whether its gate holds."""
    from ..bench import harness, scenarios

    chosen, make = scenarios.rows(only, quick=quick), scenarios.maker(estimator)
    verdicts: list[scenarios.Verdict] = []

    def lines() -> Iterator[scenarios.Line]:
        with progress_bar("judging") as progress:
            for done, row in enumerate(chosen):
                progress(done, len(chosen), row.name)
                for verdict in scenarios.judge([row], make):
                    verdicts.append(verdict)
                    yield scenarios.line(verdict)

    for text in harness.table(lines()):
        if not as_json:
            click.echo(text)
    if freeze:
        scenarios.freeze(verdicts)
    if as_json:
        click.echo(json_text([scenarios.record(verdict) for verdict in verdicts], indent=1))
    else:
        _show([("\n" * bool(verdicts), scenarios.summary(verdicts))], as_json=False)


def _show(measured: Sequence[tuple[str, Iterable[Any]]], as_json: bool) -> None:
    """Print measurements, which are dataclasses, as tables with a head each while they come, or as one JSON list."""
    from ..bench import harness

    if as_json:
        click.echo(json_text([asdict(row) for _, rows in measured for row in rows], indent=1))
        return
    for number, (head, rows) in enumerate(measured):
        for line in chain([""] * (number > 0), harness.table(rows, head)):
            click.echo(line)
