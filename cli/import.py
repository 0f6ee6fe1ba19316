"""``ohmskin import``: the netlist of a board drawn in KiCad to a design."""

from __future__ import annotations

from pathlib import Path

import click

from ..circuits import Design
from ..common import tables
from ..errors import InputError
from ..kicad import COLUMNS, ROWS, differences, import_design, read_netlist, shape_of_layout
from . import arguments

_file = click.Path(path_type=Path)


@click.command(
    epilog=arguments.example(
        "ohmskin import board.net -o design.toml",
        "ohmskin import board.net --against design.toml",
        "ohmskin import board.kicad_pcb --shape -o shape.csv",
    )
)
@click.argument("netlist", metavar="NETLIST", type=_file)
@click.option("-o", "--output", type=_file, metavar="DESIGN.toml", help="Write here instead of to standard output.")
@click.option(
    "--against", type=_file, metavar="DESIGN.toml", help="Only print the values that differ from this design."
)
@click.option("--shape", is_flag=True, help="Read a layout (.kicad_pcb), and write where its cells are (SHAPE.csv).")
@click.option("--rows", default=ROWS, metavar="REGEX", help=f"Nets of rows in a layout [{ROWS}].")
@click.option("--columns", default=COLUMNS, metavar="REGEX", help=f"Nets of columns in a layout [{COLUMNS}].")
def command(netlist: Path, output: Path | None, against: Path | None, shape: bool, rows: str, columns: str) -> int:
    """Read a netlist that KiCad exported (s-expressions or XML), and write the design of its array's readout.

    Rows and columns are found by the field Ohmskin.role of connectors (rows, columns) or of parts (cell), else by what
    drives and loads the lines. Each value has a comment that says from which part it is. What a netlist cannot tell is
    asked for, in the file and on standard error. With --against the exit code is 1 where values differ. With --shape
    the file is a layout, whose footprints between a row's and a column's net are the cells.
    """
    if shape:
        return _shape(netlist, output, rows, columns)
    drawn = read_netlist(netlist)
    try:
        found = import_design(drawn)
        design = found.design()
    except InputError as error:
        raise InputError(f"{netlist}: {error}") from error
    if against is not None:
        lines = differences(design, Design.load(against))
        click.echo("\n".join(lines) if lines else f"no value differs from {against}")
        return 1 if lines else 0
    if output is None:
        click.echo(found.toml(), nl=False)
    else:
        tables.write_text(output, found.toml())
        arguments.note("{}: {} x {}, {}".format(output, *design.array.shape, design.readout.circuit))
    for number, ((table, key), question) in enumerate(found.questions.items(), start=1):
        arguments.note(f"question {number}, {table}.{key}: {question}")
    return 0


def _shape(layout: Path, output: Path | None, rows: str, columns: str) -> int:
    found = shape_of_layout(layout, rows=rows, columns=columns)
    if output is None:
        click.echo(found.text(), nl=False)
    else:
        found.save(output)
        array = f"{max(found.row) + 1} x {max(found.column) + 1}"
        arguments.note(f"{output}: {len(found.row)} cells of an array of {array}")
    return 0
