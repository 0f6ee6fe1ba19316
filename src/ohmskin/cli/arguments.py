"""Arguments that several commands take."""

from __future__ import annotations

from pathlib import Path

import click

design_file = click.argument("design_file", metavar="DESIGN.toml", type=click.Path(path_type=Path))
cells = click.option(
    "--cells", required=True, metavar="CELLS.csv", help="N lines of M resistances in ohm; inf = open, 0 = short."
)
