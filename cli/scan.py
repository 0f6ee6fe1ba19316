"""``ohmskin scan``: one frame of cells through a readout design."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from .. import circuits
from ..circuits import CIRCUITS, METHODS, Design, scan
from ..common import tables
from ..common.json_text import json_text
from . import arguments


@click.command(
    epilog=arguments.example(
        "ohmskin scan design.toml --cells cells.csv",
        "ohmskin scan design.toml --cells cells.csv --tolerance 1e-6 --json",
    )
)
@arguments.design_file
@arguments.cells
@click.option(
    "--method", type=click.Choice(METHODS), help="Solve by this method instead of the cheapest sufficient one."
)
@click.option("--tolerance", type=float, metavar="REL", help="Largest error accepted, relative to the largest output.")
@click.option("--readout", type=click.Choice(CIRCUITS), help="Read with this circuit instead of the design's.")
@click.option("-o", "--output", metavar="OUT.csv", help="Write the N x M apparent resistances here.")
@click.option("--effects", is_flag=True, help="Print what was modelled and what was left out, with its size.")
@arguments.as_json("volts, resistance, method, error bound and time")
def command(
    design_file: Path,
    cells: str,
    method: str | None,
    tolerance: float | None,
    readout: str | None,
    output: str | None,
    effects: bool,
    as_json: bool,
) -> None:
    """Read one frame of cell resistances through the readout of DESIGN.toml."""
    design = Design.load(design_file)
    if readout is not None:
        design = design.with_circuit(readout)
    result = scan(design, tables.read_cells(cells, design.array.shape), tolerance=tolerance, method=method)
    if output is not None:
        tables.write_matrix(output, result.resistance)
    if result.saturated.any():
        places = ", ".join(f"({i}, {j})" for i, j in np.argwhere(result.saturated)[:5].tolist())
        more = "" if result.saturated.sum() <= 5 else ", ..."
        arguments.note(f"{result.saturated.sum()} outputs at a supply limit: {places}{more}")
    if as_json:
        values = {
            "volts": result.volts.tolist(),
            "resistance": result.resistance.tolist(),
            "method": result.method,
            "error_bound": result.error_bound,
            "saturated": result.saturated.tolist(),
            "seconds": result.seconds,
        }
        click.echo(json_text(values))
    elif effects:
        for effect in circuits.effects(design, result.cells):
            share = "" if effect.estimate is None else f"{100 * effect.estimate:.3g} % of a signal"
            state = "modelled" if effect.modelled else "left out"
            click.echo(f"{effect.name:<32} {state}  {share:<26} {effect.basis}".rstrip())
    elif output is None:
        click.echo(tables.format_matrix(result.resistance), nl=False)
