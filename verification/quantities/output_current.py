"""Largest current that an amplifier's output delivers into the array, A."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import DoesNotApply, Measurement
from .._quantity import DOWN, Quantity, Shipped
from .._whole_board import OperatingTarget, sensed_line


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    if not dut.design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{dut.design.readout.circuit}' has no amplifier that drives the array")
    found = worst_of(dut, OperatingTarget("output_current", "output current"))
    return measured(found, found.value, "A", where=f"{sensed_line(found.box, found.cell)}; {found.where}")


QUANTITY = Quantity(
    name="output_current",
    title="Current of an output",
    unit="A",
    says="Largest current that an amplifier's output delivers into the array, A.",
    compute=_compute,
    shipped=(
        Shipped(23, "Amplifiers can deliver their currents.", max=lambda design: design.requirements.output_current),
    ),
    mended_by=(("drive.voltage", DOWN),),
)
