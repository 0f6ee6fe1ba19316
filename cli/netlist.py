"""``ohmskin netlist``: one scan step for any SPICE simulator."""

from __future__ import annotations

from pathlib import Path

import click

from ..circuits import Design
from ..circuits.spice import netlist
from ..common import tables
from . import arguments


@click.command(epilog=arguments.example("ohmskin netlist design.toml --cells cells.csv --row 0 -o step.cir"))
@arguments.design_file
@arguments.cells
@click.option("--row", required=True, type=int, metavar="I", help="The selected row, counted from 0.")
@click.option("-o", "--output", metavar="FILE.cir", help="Write here instead of to standard output.")
def command(design_file: Path, cells: str, row: int, output: str | None) -> None:
    """Write the SPICE netlist of the scan step in which row I is selected; runs as it is by `ngspice -b`."""
    design = Design.load(design_file)
    text = netlist(design, tables.read_cells(cells, design.array.shape), row)
    if output is None:
        click.echo(text, nl=False)
    else:
        tables.write_text(output, text)
