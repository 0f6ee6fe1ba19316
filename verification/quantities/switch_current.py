"""Largest current through the switch of a driven line, A."""

from __future__ import annotations

from .._judging import Searched
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._whole_board import OperatingTarget, driven_line

QUANTITY = Quantity(
    name="switch_current",
    title="Current in a row switch",
    unit="A",
    says="Largest current through the switch of a driven line, A.",
    compute=Searched(
        lambda dut, requirement: OperatingTarget("driver_current", "switch current"), "A", line=driven_line
    ),
    methods=SEARCHED,
    shipped=(
        Shipped(
            24, "A driver can deliver the current of its line.", max=lambda design: design.requirements.driver_current
        ),
    ),
    mended_by=(("drive.voltage", DOWN),),
    rates=("driver", "current"),
)
