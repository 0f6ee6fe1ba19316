"""What parts bear at the operating points of a scan, a quantity for each kind of rating; leakage of idle lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...circuits import Design, Requirement
from .._box import Box
from .._dut import DesignUnderTest
from .._judging import Searched, percent
from .._outcome import DoesNotApply, NotRun
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._whole_board import LeakageTarget, OperatingTarget, driven_line, sensed_line

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


def _leaks(dut: DesignUnderTest, requirement: Requirement) -> LeakageTarget:
    if not dut.design.drive.idle_leakage:
        raise NotRun("missing: drive.idle_leakage")
    return LeakageTarget(amperes=dut.design.drive.idle_leakage)


def _of_driver(design: Design) -> float:
    return design.requirements.driver_current


def _of_output(design: Design) -> float:
    return design.requirements.output_current


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
        shipped=(Shipped(24, "A driver can deliver the current of its line.", max=_of_driver),),
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
        shipped=(Shipped(23, "Amplifiers can deliver their currents.", max=_of_output),),
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
    Quantity(
        name="leakage_error",
        title="Error by leakage of idle switches",
        unit="%",
        says="Largest change of a reading by the leakage of the switches of all idle driven lines, % of that reading.",
        compute=Searched(_leaks, "%", percent),
        methods=SEARCHED,
        shipped=(
            Shipped(
                25,
                "Idle switches do not shift readings.",
                max=lambda design: design.requirements.reading_error_percent / 5,
                applies=lambda design: bool(design.drive.idle_leakage),
            ),
        ),
        mended_by=(("drive.idle_leakage", DOWN), ("array.row_lead", DOWN)),
    ),
)
