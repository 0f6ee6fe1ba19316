"""``ohmskin score``: a client's recording against the emulator's truth."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import click

from .. import emulator
from ..errors import InputError
from . import arguments


@click.command(epilog=arguments.example("ohmskin score recording.npz truth.npz --json"))
@click.argument("recording", type=click.Path(path_type=Path), metavar="RECORDING")
@click.argument("truth", type=click.Path(path_type=Path), metavar="TRUTH")
@click.option(
    "--pitch",
    type=click.FloatRange(min=0, min_open=True),
    metavar="MM",
    help="From cell to cell; else what TRUTH says.",
)
@click.option(
    "--full-scale",
    type=click.FloatRange(min=0, min_open=True),
    metavar="KPA",
    help="Of the percentages; else what TRUTH says.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the score as JSON.")
def command(recording: Path, truth: Path, pitch: float | None, full_scale: float | None, as_json: bool) -> None:
    """Compare RECORDING, an .npz file of `ohmskin export`, with TRUTH, an .npz file of `ohmskin emulate --truth`.

    Prints errors of pressure, of the places of contacts, latency and lost frames.
    """
    if recording.suffix.lower() == ".mcap":
        raise InputError(f"{recording}: is an .mcap file; run `ohmskin export {recording} -o FILE.npz` first")
    result = emulator.score(
        emulator.Recording.load(recording), emulator.Truth.load(truth), pitch_mm=pitch, full_scale_kpa=full_scale
    )
    if as_json:
        fields = asdict(result).items()
        shown = {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in fields}
        click.echo(json.dumps(shown, indent=1, allow_nan=False))
    else:
        click.echo(emulator.score_text(result))
