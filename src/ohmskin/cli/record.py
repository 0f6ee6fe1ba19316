"""``ohmskin record``: a skin to an MCAP file."""

from __future__ import annotations

import time
from math import inf, isfinite
from pathlib import Path

import click

from ..driver import Skin
from ..errors import InputError, LinkEnded, LinkTimeout
from ..text import one_line
from ..wire import BOARDS
from . import arguments
from ._bar import progress_bar

QUEUE = 4096
"""frames that may wait while the disk is busy"""


@click.command(epilog=arguments.example("ohmskin record /dev/ttyACM0 -o press.mcap --duration 60"))
@click.argument("port", metavar="PORT")
@click.option("-o", "output", required=True, type=click.Path(path_type=Path), metavar="FILE.mcap")
@click.option("--duration", type=arguments.positive, default=inf, metavar="S", help="Stop after S seconds.")
@click.option(
    "--board",
    default="ohmskin",
    show_default=True,
    metavar="NAME",
    help=f"Family of the board: {', '.join(BOARDS)}.",
)
@arguments.calibration
@click.option("--overwrite", is_flag=True, help="Replace FILE.mcap if it is there already.")
def command(port: str, output: Path, duration: float, board: str, calibration: Path | None, overwrite: bool) -> None:
    """Record the skin at PORT: every byte, decoded frames for viewers, the board's description, tares and events.

    Ends after the duration, at the end of an emulation, or with Ctrl-C. What was recorded until then can be read,
    whatever ends the command.
    """
    if output.suffix.lower() != ".mcap":
        raise InputError(f"{output}: is no name of a recording; expected FILE.mcap")
    skin = Skin.open(
        port,
        board=board,
        delivery="every",
        queue=QUEUE,
        record=output,
        overwrite=overwrite,
        calibration=calibration,
    )
    with skin:
        start = time.monotonic()
        with progress_bar("recording") as tell:
            while (elapsed := time.monotonic() - start) < duration:
                recorder = skin.recorder
                if recorder is not None and recorder.error is not None:
                    raise recorder.error
                try:
                    skin.read(min(0.5, max(duration - elapsed, 0.001)))
                except LinkTimeout:
                    pass
                except LinkEnded:
                    break
                if isfinite(duration):
                    tell(round(1000 * elapsed), round(1000 * duration), f"{skin.stats().frames} frames")
        stats = skin.stats()
    lost = "unknown" if stats.lost is None else str(stats.lost)
    click.echo(f"{one_line(str(output))}: {stats.frames} frames, {lost} lost, {stats.reconnects} reconnects", err=True)
