"""``ohmskin score``: a client's recording against the emulator's truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from .. import emulator
from ..common.json_text import json_text
from ..driver import stack
from . import arguments
from ._recording import played_frames


@click.command(epilog=arguments.example("ohmskin score press.mcap truth.npz --json"))
@click.argument("recording", type=click.Path(path_type=Path), metavar="RECORDING")
@click.argument("truth", type=click.Path(path_type=Path), metavar="TRUTH")
@click.option("--pitch", type=arguments.positive, metavar="MM", help="From cell to cell; else what TRUTH says.")
@click.option("--full-scale", type=arguments.positive, metavar="KPA", help="Of the percentages; else what TRUTH says.")
@click.option("--json", "as_json", is_flag=True, help="Print the score as JSON.")
def command(recording: Path, truth: Path, pitch: float | None, full_scale: float | None, as_json: bool) -> None:
    """Compare RECORDING with TRUTH, an .npz file of `ohmskin emulate --truth`.

    RECORDING is an .mcap file of `ohmskin record`, played through the driver, or an .npz file such as `ohmskin export`
    writes.

    Prints errors of pressure, of the places of contacts, latency and lost frames.
    """
    taken = _load(recording)
    result = emulator.score(taken, emulator.Truth.load(truth), pitch_mm=pitch, full_scale_kpa=full_scale)
    if as_json:
        click.echo(json_text(asdict(result), indent=1))
    else:
        click.echo(emulator.score_text(result))


def _load(recording: Path) -> emulator.Recording:
    if recording.suffix.lower() != ".mcap":
        return emulator.Recording.load(recording)
    with played_frames([recording], "replaying") as (skin, frames):
        arrays = stack(frames, skin.shape)
    return emulator.Recording.of(arrays | {"time": arrays["host_time"]}, recording)
