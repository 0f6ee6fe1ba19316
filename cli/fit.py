"""``ohmskin fit``: a recording of presses to an identified, calibrated cell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ..cell import (
    calibrate,
    calibration_figure,
    calibration_record,
    calibration_text,
    check_protocol,
    load_recording,
    protocol_text,
)
from ..common.files import check_writable
from ..common.json_text import json_text
from . import _measured, arguments
from ._bar import progress_bar


@click.command(
    epilog=arguments.example(
        "ohmskin fit --protocol",
        "ohmskin fit steps.csv -o cell.toml --plot fit.png",
        "ohmskin fit run.csv --column reading=A0:counts --divider 10e3 --supply 5 --area 78.5 -o cell.toml",
        "ohmskin fit gauge.csv board.csv --align --area 100 -o cell.toml",
    )
)
@click.argument("steps", metavar="[STEPS.csv [READINGS.csv]]", nargs=-1, type=click.Path(path_type=Path))
@_measured.options(load=True)
@click.option("-o", "output", metavar="CELL.toml", type=click.Path(path_type=Path), help="Where the cell goes.")
@click.option(
    "--full-scale", metavar="KPA", type=float, help="Full scale of the cell [the recording's largest pressure]."
)
@click.option("--protocol", is_flag=True, help="Print the presses to apply; with STEPS.csv, check that it has them.")
@click.option("--trust-units", is_flag=True, help="Take numbers that look like other units than s, kPa and ohm.")
@click.option("--plot", metavar="FILE.png", type=click.Path(path_type=Path), help="Model, residuals and estimate.")
@arguments.as_json("what was found")
def command(
    steps: tuple[Path, ...],
    output: Path | None,
    full_scale: float | None,
    protocol: bool,
    trust_units: bool,
    plot: Path | None,
    as_json: bool,
    **given: Any,
) -> None:
    """Identify a cell from a recording with the columns time_s,pressure_kpa,resistance_ohm.

    Other names are read by the units in their headers, such as "Load (lbf)", force_N, time_ms and "Resistance (kOhm)".
    What a header does not say is guessed, and --as-guessed takes it. Two files hold the load and the readings.

    Writes the model, the estimators and the choice among them to CELL.toml, and reports how certain they are.
    """
    if not steps:
        if not protocol:
            raise click.UsageError("expected STEPS.csv, or --protocol to print the presses to apply")
        click.echo(protocol_text())
        return
    check_writable(*(path for path in (output, plot) if path is not None))
    recording = load_recording(steps, _measured.layout(given), trust_units=trust_units, note=arguments.note)
    if protocol:
        for line in check_protocol(recording, full_scale):
            click.echo(line, err=as_json)
    with progress_bar("fitting") as progress:
        found = calibrate(recording, full_scale_kpa=full_scale, progress=progress)
    summary = calibration_text(found)
    if plot is not None:
        calibration_figure(found, plot)
    if output is not None:
        found.cell.save(output, comment=summary)
    click.echo(json_text(calibration_record(found)) if as_json else summary)
