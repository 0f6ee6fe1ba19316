"""Headroom of the outputs: how far they stay from their supply limits."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import Searched, excursion_of, headroom, negative
from .._outcome import DoesNotApply, NotRun
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._readings import Excursion


def _target(dut: DesignUnderTest, requirement: Requirement) -> Excursion:
    if not dut.design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{dut.design.readout.circuit}' has no amplifier that could saturate")
    if (excursion := excursion_of(dut, "output")) is None:
        raise NotRun("missing: readout.supply")
    return excursion


QUANTITY = Quantity(
    name="output_headroom",
    title="Headroom of the outputs",
    unit="V",
    says="Smallest distance of an output from its supply limits, V; negative: it would go beyond.",
    compute=Searched(_target, "V", negative, detail=headroom),
    methods=SEARCHED,
    shipped=(Shipped(4, "No output reaches its supply.", min=0.0),),
    mended_by=(("readout.reference_resistance", DOWN), ("drive.voltage", DOWN)),
)
