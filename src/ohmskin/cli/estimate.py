"""``ohmskin estimate``."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("recording", metavar="IN.csv", type=click.Path(path_type=Path))
@click.option("--cell", "cell_file", metavar="CELL.toml", required=True, type=click.Path(path_type=Path))
@click.option("-o", "output", metavar="OUT.csv", required=True, type=click.Path(path_type=Path))
@click.option("--estimator", metavar="NAME", help="static, paper, inverse, play or distilled [the cell's choice].")
def command(recording: Path, cell_file: Path, output: Path, estimator: str | None) -> None:
    """Estimate pressure from the columns time_s,resistance_ohm of IN.csv, causally, sample by sample."""
    from ..cell import Cell
    from ..cell.calibration import estimate_file

    estimate_file(recording, Cell.load(cell_file), output, estimator)
