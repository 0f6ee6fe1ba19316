"""``ohmskin record``: a skin to an MCAP file."""

from __future__ import annotations

import time
from math import inf, isfinite
from pathlib import Path

import click

from ..common.json_text import json_text
from ..common.text import one_line
from ..driver import LinkStatistics, Skin
from ..errors import InputError, LinkEnded, LinkTimeout
from . import arguments
from ._bar import progress_bar
from ._skin_options import QUEUE, SkinOptions, skin_options


@click.command(
    epilog=arguments.example(
        "ohmskin record /dev/ttyACM0 -o press.mcap --duration 60",
        "ohmskin record /dev/ttyACM0 -o press.mcap --calibration left-arm.toml",
    )
)
@click.argument("what", metavar="PORT|SCENE.toml...", nargs=-1, required=True)
@click.option("-o", "output", required=True, type=click.Path(path_type=Path), metavar="FILE.mcap")
@click.option("--duration", type=arguments.positive, default=inf, metavar="S", help="Stop after S seconds.")
@skin_options()
@click.option("--overwrite", is_flag=True, help="Replace FILE.mcap if it is there already.")
@arguments.as_json("what was recorded")
def command(
    what: tuple[str, ...], output: Path, duration: float, options: SkinOptions, overwrite: bool, as_json: bool
) -> None:
    """Record the skin at PORT, or the emulated one of SCENE.toml. Of several boards each gets a file: FILE-1.mcap ...

    The file holds every byte, decoded frames for viewers, the board's description, calibration, events.

    Ends after the duration, at the end of an emulation, or with Ctrl-C. What was recorded until then can be read,
    whatever ends the command.
    """
    if output.suffix.lower() != ".mcap":
        raise InputError(f"{output}: is no name of a recording; expected FILE.mcap")
    with options.open(what, delivery="every", queue=QUEUE, record=output, overwrite=overwrite) as skin:
        try:
            _take_frames(skin, duration)
        except KeyboardInterrupt:  # the usual end of a recording without a duration
            _tell(output, skin.stats(), as_json)
            raise
        stats = skin.stats()
    _tell(output, stats, as_json)


def _take_frames(skin: Skin, duration_s: float) -> None:
    """Take frames until the duration is over or no frame follows; InputError where they cannot be written."""
    start = time.monotonic()
    with progress_bar("recording") as tell:
        while (elapsed := time.monotonic() - start) < duration_s:
            for recorder in (board.recorder for board in skin.boards):
                if recorder is not None and recorder.error is not None:
                    raise recorder.error
            try:
                skin.read(min(0.5, max(duration_s - elapsed, 0.001)))
            except LinkTimeout:
                pass
            except LinkEnded:
                break
            if isfinite(duration_s):
                tell(round(1000 * elapsed), round(1000 * duration_s), f"{skin.stats().frames} frames")


def _tell(output: Path, stats: LinkStatistics, as_json: bool) -> None:
    if as_json:
        click.echo(json_text(_summary(output, stats)))
        return
    lost = "unknown" if stats.lost is None else str(stats.lost)
    counts = f"{stats.frames} frames, {lost} lost, {stats.reconnects} reconnects"
    click.echo(f"{one_line(str(output))}: {counts}", err=True)


def _summary(output: Path, stats: LinkStatistics) -> dict[str, object]:
    return {
        "file": str(output),
        "frames": stats.frames,
        "lost": stats.lost,
        "reconnects": stats.reconnects,
        "reboots": stats.reboots,
    }
