"""Options of the commands that read measured files: columns, units, circuit and clocks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import click

from ..cell import Layout, Role
from . import arguments


class _Column(click.ParamType):  # type: ignore[type-arg]  # generic in later versions only
    """ROLE=NAME or ROLE=NAME:UNIT."""

    name = "role=name"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, str]:
        role, sign, name = str(value).partition("=")
        if not sign or not name or role not in get_args(Role):
            self.fail(f"'{value}' is not ROLE=NAME with a role of {', '.join(get_args(Role))}", param, ctx)
        return role, name


def options(*, load: bool) -> Callable[[Any], Any]:
    """The options; those of the load only where a command reads loads."""
    made = [
        click.option(
            "--column",
            "columns",
            metavar="ROLE=NAME[:UNIT]",
            type=_Column(),
            multiple=True,
            help=f"Column, by name or number, of time, {'load, ' if load else ''}reading or cell; may be repeated.",
        ),
        click.option("--only", metavar="VALUE", help="Rows of this cell, of --column cell=NAME."),
        click.option("--divider", metavar="OHM", type=arguments.positive, help="Resistor from the output to ground."),
        click.option("--supply", metavar="V", type=arguments.positive, help="Voltage across cell and divider."),
        click.option("--counts", metavar="N", type=arguments.positive, help="Counts of the converter at the supply."),
        click.option("--as-guessed", is_flag=True, help="Take columns and units that were guessed."),
    ]
    if load:
        made += [
            click.option("--area", metavar="MM2", type=arguments.positive, help="Area that a force presses on."),
            click.option("--align", is_flag=True, help="Shift clocks of load and readings that are apart."),
        ]

    def decorated(command: Any) -> Any:
        for option in reversed(made):
            command = option(command)
        return command

    return decorated


def layout(given: dict[str, Any]) -> Layout:
    """What the options say."""
    return Layout(
        columns=dict(given["columns"]),
        area_mm2=given.get("area"),
        divider_ohm=given["divider"],
        supply_v=given["supply"],
        counts=given["counts"],
        only=given["only"],
        align=given.get("align", False),
        as_guessed=given["as_guessed"],
    )
