"""``ohmskin netlist``: one scan step for any SPICE simulator."""

from __future__ import annotations

from pathlib import Path

import click

from ..circuits import Design
from ..circuits.spice import netlist
from ..common import tables
from ..common.config import read_toml
from ..kicad import parts_list, to_netlist
from . import arguments


@click.command(
    epilog=arguments.example(
        "ohmskin netlist design.toml --cells cells.csv --row 0 -o step.cir",
        "ohmskin netlist design.toml --kicad -o board.net",
    )
)
@arguments.design_file
@click.option("--cells", metavar="CELLS.csv", help="N lines of M resistances in ohm; inf = open, 0 = short.")
@click.option("--row", type=int, metavar="I", help="The selected row, counted from 0.")
@click.option("--kicad", is_flag=True, help="Write a netlist of KiCad, and with -o the list of parts beside it.")
@click.option("-o", "--output", metavar="FILE", help="Write here instead of to standard output.")
def command(design_file: Path, cells: str | None, row: int | None, kicad: bool, output: str | None) -> None:
    """Write the SPICE netlist of the scan step in which row I is selected; runs as it is by `ngspice -b`.

    With --kicad, write the readout as a netlist for KiCad, which `ohmskin import` reads back as the same design.
    """
    if kicad:
        given = read_toml(design_file)
        Design.load(design_file)
        text = to_netlist(given)
        if output is not None:
            tables.write_text(Path(output).with_suffix(".parts.csv"), parts_list(given))
    elif cells is None or row is None:
        raise click.UsageError("--cells and --row are missing; expected both, or --kicad")
    else:
        design = Design.load(design_file)
        text = netlist(design, tables.read_cells(cells, design.array.shape), row)
    if output is None:
        click.echo(text, nl=False)
    else:
        tables.write_text(output, text)
