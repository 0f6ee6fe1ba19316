"""``ohmskin estimate``: a recording of resistance to the pressure that caused it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from ..cell import Cell, check_resistances, estimate_recording, read_files
from ..common.arrays import FloatArray
from ..common.tables import write_columns
from ..errors import InputError
from . import _measured, arguments


@click.command(epilog=arguments.example("ohmskin estimate run.csv --cell cell.toml -o out.csv"))
@click.argument("recording", metavar="IN.csv", type=click.Path(path_type=Path))
@click.option("--cell", "cell_file", metavar="CELL.toml", required=True, type=click.Path(path_type=Path))
@click.option("-o", "output", metavar="OUT.csv", required=True, type=click.Path(path_type=Path))
@click.option("--estimator", metavar="NAME", help="static, paper, inverse or distilled [the cell's choice].")
@_measured.options(load=False)
def command(recording: Path, cell_file: Path, output: Path, estimator: str | None, **given: Any) -> None:
    """Estimate pressure from the columns time_s,resistance_ohm of IN.csv, causally, sample by sample.

    Other columns are read as by ohmskin fit.
    """
    columns = read_files([recording], _measured.layout(given), roles=("time", "reading"), note=arguments.note)
    time, resistance = columns["time_s"], columns["resistance_ohm"]
    check_resistances(resistance, str(recording))
    cell = Cell.load(cell_file)
    pressure, std = estimate_recording(cell.estimator((), estimator), time, resistance)
    if not np.isfinite(pressure).any():
        raise InputError(f"{recording}: {_why_none(cell, resistance)}")
    found = {"time_s": time, "pressure_kpa": pressure}
    write_columns(output, found if std is None else found | {"std_kpa": std})


def _why_none(cell: Cell, resistance_ohm: FloatArray) -> str:
    """Why not one of the resistances (n,) gave a pressure."""
    read = resistance_ohm[np.isfinite(resistance_ohm)]
    if not read.size:
        return "resistance_ohm has no reading"
    return (
        f"no load of this cell explains resistance_ohm, which is about {np.median(read):.3g}; the cell at rest has "
        f"{cell.rest_resistance_ohm:.3g} ohm: is the column in another unit, or of another cell?"
    )
