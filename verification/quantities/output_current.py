"""Largest current that an amplifier's output delivers into the array, A."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import Searched
from .._outcome import DoesNotApply
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._whole_board import OperatingTarget, sensed_line


def _target(dut: DesignUnderTest, requirement: Requirement) -> OperatingTarget:
    if not dut.design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{dut.design.readout.circuit}' has no amplifier that drives the array")
    return OperatingTarget("output_current", "output current")


QUANTITY = Quantity(
    name="output_current",
    title="Current of an output",
    unit="A",
    says="Largest current that an amplifier's output delivers into the array, A.",
    compute=Searched(_target, "A", line=sensed_line),
    methods=SEARCHED,
    shipped=(
        Shipped(23, "Amplifiers can deliver their currents.", max=lambda design: design.requirements.output_current),
    ),
    mended_by=(("drive.voltage", DOWN),),
    rates=("amplifier", "current"),
)
