"""Pressure resolution: the pressure that one standard deviation of a reading's noise stands for."""

from __future__ import annotations

import numpy as np

from ...circuits import Boards, Design, Requirement, apparent_resistance, scan_population
from ...common.arrays import FloatArray
from .._dut import DesignUnderTest
from .._outcome import Measurement, NotRun
from .._quantity import AVERAGING, NOMINAL, UP, Quantity, Shipped
from .noise import QUIET, noise_of

SHARE = 0.01
"""of full scale, that noise may be"""
USUAL_KPA = 15.5
"""full scale of a design that does not state it"""


def pressure_resolution(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    if not dut.knows_pressure:
        raise NotRun("missing: cells.full_scale_kpa")
    worst, where = 0.0, ""
    full = dut.full_scale_kpa
    for (state, cells, found), load in zip(noise_of(dut), (0.01, 0.99), strict=True):
        near = np.array([0.99 * load, load])  # shares of full scale
        light, heavy = dut.cell.equilibrium_ohm(near)
        ohms_per_kpa = abs(float(heavy - light)) / (0.01 * load * full)
        volts_per_ohm = _volts_per_ohm(dut.design, cells)
        with np.errstate(divide="ignore"):  # a curve that is flat there says nothing of pressure
            kpa = found.volts / (volts_per_ohm * ohms_per_kpa)
        place = np.unravel_index(np.argmax(kpa), kpa.shape)
        if not kpa[place] <= worst:
            worst, where = float(kpa[place]), f"cell {tuple(map(int, place))}, {state}"
    return Measurement(worst, "kPa", where=where, confidence="one standard deviation of one reading")


def _volts_per_ohm(design: Design, cells: FloatArray) -> FloatArray:
    """|dV/dR| (N, M) of the ideal circuit at the reading of each cell."""
    volts = scan_population(design, Boards.of(design), cells[None]).volts[0]
    small = 1e-6 * max(float(np.abs(volts - design.readout.reference_voltage).max()), 1e-12)
    change = apparent_resistance(design, volts + small) - apparent_resistance(design, volts - small)
    slope: FloatArray = 2 * small / np.abs(change)
    return slope


def _limit(design: Design) -> float:
    full = design.cells.full_scale_kpa if design.cells is not None else None
    return SHARE * (full or USUAL_KPA)


QUANTITY = Quantity(
    name="pressure_resolution",
    title="Pressure resolution",
    unit="kPa",
    says="Standard deviation of the pressure that one settled reading stands for, at the least favourable load, kPa.",
    compute=pressure_resolution,
    methods=(NOMINAL,),
    shipped=(Shipped(7, "Noise is small beside the load.", max=_limit),),
    mended_by=(*QUIET, ("readout.reference_resistance", UP), ("drive.voltage", UP), (AVERAGING, UP)),
)
