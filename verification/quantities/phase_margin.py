"""Phase margin of an amplifier on its line."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import Searched, negative
from .._outcome import DoesNotApply, Measurement, NotRun
from .._quantity import DOWN, SEARCHED, SPICE, UP, Quantity, Shipped
from .._search import WorstCase
from .._whole_board import PhaseMarginTarget, sensed_line


def _target(dut: DesignUnderTest, requirement: Requirement) -> PhaseMarginTarget:
    design = dut.design
    if not design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{design.readout.circuit}' has no feedback loop")
    if not design.board.virtual_grounds:
        here = f'"{design.readout.circuit}"'
        here += ' with readout.columns = "multiplexed"' if design.board.multiplexed else ""
        raise NotRun(f"stability is modelled for an amplifier on each line, not for {here}")
    if np.isinf(design.readout.gain_bandwidth):
        raise NotRun("missing: readout.gain_bandwidth")
    return PhaseMarginTarget()


def _detail(dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement) -> Measurement:
    if not np.isfinite(found.value):
        raise NotRun("the loop gain is below 1 throughout: there is no crossover")
    return measurement


QUANTITY = Quantity(
    name="phase_margin",
    title="Phase margin",
    unit="°",
    says="Smallest phase margin of an amplifier on its column, degrees; further poles take some of it away.",
    compute=Searched(_target, "°", negative, sensed_line, _detail),
    methods=(*SEARCHED, SPICE),
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
