"""Arguments and help texts that several commands share."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from ..common.text import one_line

design_file = click.argument("design_file", metavar="DESIGN.toml", type=click.Path(path_type=Path))
cells = click.option(
    "--cells", required=True, metavar="CELLS.csv", help="N lines of M resistances in ohm; inf = open, 0 = short."
)


class _Positive(click.ParamType):  # type: ignore[type-arg]  # generic in later versions only
    """A finite number above 0. click's own ranges let NaN pass."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not (0 < number < math.inf or value == math.inf):  # infinite only as a default
            self.fail(f"'{value}' is no positive number", param, ctx)
        return number


positive = _Positive()


def as_json(what: str) -> Callable[[Any], Any]:
    """The option ``--json``, for commands whose answer a program may read."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print {what} as JSON.")


def note(said: str) -> None:
    """Tell the user something that does not end the command."""
    click.echo(f"ohmskin: {one_line(said)}", err=True)


def example(*lines: str) -> str:
    """The end of a command's help: calls to copy, one on a line."""
    # click keeps the lines of a paragraph that begins with \b as they are.
    return "\n".join(["\b", "Examples:" if len(lines) > 1 else "Example:", *(f"  {line}" for line in lines)])
