"""What parts bear at the operating points of a scan: one quantity for each part and kind of rating."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...circuits import Requirement
from .._box import Box
from .._dut import DesignUnderTest
from .._judging import Searched
from .._outcome import DoesNotApply, NotRun
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._whole_board import OperatingTarget, driven_line, sensed_line

Refuse = Callable[[DesignUnderTest], None]
"""raises NotRun or DoesNotApply"""


def _needs_a_lead(dut: DesignUnderTest) -> None:
    lead = f"{dut.design.board.line_kinds[0]}_lead"
    if not np.any(getattr(dut.design.array, lead)):
        raise NotRun(f"missing: array.{lead}")


def _needs_an_amplifier(dut: DesignUnderTest) -> None:
    if not dut.design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{dut.design.readout.circuit}' has no amplifier that drives the array")


def _needs_a_resistor(dut: DesignUnderTest) -> None:
    if dut.design.column_end is not None:
        raise NotRun("[column_end] describes the line's end in place of readout.reference_resistance")


def _stress(
    name: str,
    title: str,
    says: str,
    *,
    of: str = "",
    rates: tuple[str, str],
    line: Callable[[Box, tuple[int, int]], str] | None = None,
    refuse: Refuse = lambda dut: None,
    **others: Any,
) -> Quantity:
    """The largest value of one field of an operating point, ``of`` or its own name, over all boards and presses."""
    unit = {"voltage": "V", "current": "A", "power": "W"}[rates[1]]
    target = OperatingTarget(of or name, name.replace("_", " "))

    def searched(dut: DesignUnderTest, requirement: Requirement) -> OperatingTarget:
        refuse(dut)
        return target

    return Quantity(
        name=name,
        title=title,
        unit=unit,
        says=f"{says}, {unit}.",
        compute=Searched(searched, unit, line=line),
        methods=SEARCHED,
        mended_by=others.pop("mended_by", (("drive.voltage", DOWN),)),
        rates=rates,
        **others,
    )


QUANTITIES = (
    _stress(
        "cell_voltage",
        "Voltage across a cell",
        "Largest voltage across a cell",
        rates=("cell", "voltage"),
    ),
    _stress(
        "cell_power",
        "Power in a cell",
        "Largest power in a cell while its row is selected",
        rates=("cell", "power"),
        shipped=(Shipped(11, "Cells do not heat themselves.", max=0.01),),
    ),
    _stress(
        "switch_current",
        "Current in a row switch",
        "Largest current through the switch of a driven line",
        of="driver_current",
        rates=("driver", "current"),
        line=driven_line,
        shipped=(
            Shipped(
                24,
                "A driver can deliver the current of its line.",
                max=lambda design: design.requirements.driver_current,
            ),
        ),
    ),
    _stress(
        "switch_power",
        "Power in a row switch",
        "Largest power in the switch and lead of a driven line",
        of="driver_power",
        rates=("driver", "power"),
        line=driven_line,
        refuse=_needs_a_lead,
        mended_by=(("drive.voltage", DOWN), ("array.row_lead", DOWN)),
    ),
    _stress(
        "output_current",
        "Current of an output",
        "Largest current that an amplifier's output delivers into the array",
        rates=("amplifier", "current"),
        line=sensed_line,
        refuse=_needs_an_amplifier,
        shipped=(
            Shipped(
                23, "Amplifiers can deliver their currents.", max=lambda design: design.requirements.output_current
            ),
        ),
    ),
    _stress(
        "reference_voltage",
        "Voltage across a reference resistor",
        "Largest voltage across the resistor of a sensed line: Rref, or the load of a divider",
        rates=("reference_resistor", "voltage"),
        line=sensed_line,
        refuse=_needs_a_resistor,
    ),
    _stress(
        "reference_power",
        "Power in a reference resistor",
        "Largest power in the resistor of a sensed line: Rref, or the load of a divider",
        rates=("reference_resistor", "power"),
        line=sensed_line,
        refuse=_needs_a_resistor,
    ),
)
