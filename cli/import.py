"""``ohmskin import``: the netlist of a board drawn in KiCad to a design."""

from __future__ import annotations

from pathlib import Path

import click

from ..circuits import Design
from ..common import tables
from ..errors import InputError
from ..kicad import differences, import_design, read_netlist
from . import arguments

_file = click.Path(path_type=Path)


@click.command(
    epilog=arguments.example(
        "ohmskin import board.net -o design.toml", "ohmskin import board.net --against design.toml"
    )
)
@click.argument("netlist", metavar="NETLIST", type=_file)
@click.option("-o", "--output", type=_file, metavar="DESIGN.toml", help="Write here instead of to standard output.")
@click.option(
    "--against", type=_file, metavar="DESIGN.toml", help="Only print the values that differ from this design."
)
def command(netlist: Path, output: Path | None, against: Path | None) -> int:
    """Read a netlist that KiCad exported (s-expressions or XML), and write the design of its array's readout.

    Rows and columns are found by the field Ohmskin.role of connectors (rows, columns) or of parts (cell), else by what
    drives and loads the lines. Each value has a comment that says from which part it is. What a netlist cannot tell is
    asked for, in the file and on standard error. With --against the exit code is 1 where values differ.
    """
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
        rows, columns = design.array.shape
        arguments.note(f"{output}: {rows} x {columns}, {design.readout.circuit}")
    for number, ((table, key), question) in enumerate(found.questions.items(), start=1):
        arguments.note(f"question {number}, {table}.{key}: {question}")
    return 0
