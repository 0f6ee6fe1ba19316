"""Headroom of the outputs: how far they stay from their supply limits."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import excursion_of, headroom
from .._outcome import DoesNotApply, Measurement, NotRun
from .._quantity import DOWN, Quantity, Shipped


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    if not dut.design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{dut.design.readout.circuit}' has no amplifier that could saturate")
    if (excursion := excursion_of(dut, "output")) is None:
        raise NotRun("missing: readout.supply")
    return headroom(dut, excursion, "Outputs range", "the supply allows")


QUANTITY = Quantity(
    name="output_headroom",
    title="Headroom of the outputs",
    unit="V",
    says="Smallest distance of an output from its supply limits, V; negative: it would go beyond.",
    compute=_compute,
    shipped=(Shipped(4, "No output reaches its supply.", min=0.0),),
    mended_by=(("readout.reference_resistance", DOWN), ("drive.voltage", DOWN)),
)
