"""Phase margin of an amplifier on its line."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import DoesNotApply, Measurement, NotRun
from .._quantity import DOWN, SPICE, UP, WORST, Quantity, Shipped
from .._whole_board import PhaseMarginTarget, sensed_line


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    design = dut.design
    if not design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{design.readout.circuit}' has no feedback loop")
    if not design.board.virtual_grounds:
        here = f'"{design.readout.circuit}"'
        here += ' with readout.columns = "multiplexed"' if design.board.multiplexed else ""
        raise NotRun(f"stability is modelled for an amplifier on each line, not for {here}")
    if np.isinf(design.readout.gain_bandwidth):
        raise NotRun("missing: readout.gain_bandwidth")
    found = worst_of(dut, PhaseMarginTarget())
    if not np.isfinite(found.value):
        raise NotRun("the loop gain is below 1 throughout: there is no crossover")
    where = f"{sensed_line(found.box, found.cell)}; {found.where}"
    return measured(found, -found.value, "°", where=where)


QUANTITY = Quantity(
    name="phase_margin",
    title="Phase margin",
    unit="°",
    says="Smallest phase margin of an amplifier on its column, degrees; further poles take some of it away.",
    compute=_compute,
    methods=(WORST, SPICE),
    shipped=(
        Shipped(10, "Amplifiers are stable on their columns.", min=45.0),
        Shipped(
            21,
            "The maker's model is stable on its column.",
            min=45.0,
            method=SPICE,
            applies=lambda design: design.readout.amplifier_model is not None,
        ),
    ),
    mended_by=(
        ("readout.feedback_capacitance", UP),
        ("readout.column_capacitance", DOWN),
        ("readout.reference_resistance", DOWN),
        ("readout.gain_bandwidth", DOWN),
    ),
    analysis="loop gain",
)
