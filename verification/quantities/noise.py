"""Noise of a reading by its origins, and the pressure that one standard deviation of it stands for."""

from __future__ import annotations

import numpy as np

from ...circuits import Design, Noise, Requirement, apparent_resistance
from ...circuits import noise as noise_of_readings
from ...common.arrays import FloatArray
from ...errors import InputError
from .._dut import DesignUnderTest, once
from .._hardware import Readings
from .._judging import worst_cell
from .._outcome import Measurement, NotRun
from .._quantity import AVERAGING, DOWN, NOMINAL, SPICE, UP, Quantity, Shipped
from .._units import engineering

SHARE = 0.01
"""of full scale, that noise may be"""
USUAL_KPA = 15.5
"""full scale of a design that does not state it"""
NEAR = 0.01
"""of full scale: how far from either end, and over how much, the slope of pressure against resistance is taken"""
_QUIET = (
    ("readout.voltage_noise", DOWN),
    ("readout.current_noise", DOWN),
    ("readout.feedback_capacitance", UP),
    ("readout.gain_bandwidth", DOWN),
    ("adc.sampling_capacitance", UP),
    ("adc.bits", UP),
)
"""parts that make readings quieter"""


def ohms_per_volt(design: Design, volts: FloatArray, small: float) -> FloatArray:
    """|dR/dV| of the ideal circuit's law at readings (..., N, M), by a difference of ``small`` V to either side."""
    change = apparent_resistance(design, volts + small) - apparent_resistance(design, volts - small)
    slope: FloatArray = np.abs(change) / (2 * small)
    return slope


@once
def noise_of(dut: DesignUnderTest) -> dict[str, Noise]:
    """Noise of the readings with all cells at rest, and with all pressed, at the hottest ambient temperature.

    Raises:
        NotRun: the design names no source of noise but the converter, or nothing limits its bandwidth.
    """
    design = dut.hot
    if design.board.circuit.has_amplifiers and not design.board.circuit.virtual_ground:
        raise NotRun(f'noise is modelled for amplifiers that hold all sensed lines, not for "{design.readout.circuit}"')
    try:
        found = {state: noise_of_readings(design, cells) for state, cells in dut.uniform.items()}
    except InputError as error:
        raise NotRun(str(error)) from error
    if not all(noise.before_adc.any() for noise in found.values()):
        keys = ["readout.temperature, or operation.temperature_range"]
        keys += ["readout.voltage_noise"] if design.board.circuit.has_amplifiers else ["adc.sampling_capacitance"]
        raise NotRun(f"missing: {', '.join(keys)}")
    return found


def reading_noise(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    found = noise_of(dut)
    worst, place, where = worst_cell({state: noise.volts for state, noise in found.items()})
    parts = max(found.values(), key=lambda noise: float(noise.volts.max())).parts
    shares = {name: float(part[place]) for name, part in parts.items()}
    return Measurement(worst, "V", where=where, confidence="Lyapunov equation of the readout", contributions=shares)


def pressure_resolution(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    if not dut.knows_pressure:
        raise NotRun("missing: cells.full_scale_kpa")
    found = {}
    for (state, noise), load in zip(noise_of(dut).items(), (NEAR, 1.0 - NEAR), strict=True):
        volts = dut.nominal[state]
        light, heavy = dut.cell.equilibrium_ohm(np.array([(1.0 - NEAR) * load, load]))
        ohms_per_kpa = abs(float(heavy - light)) / (NEAR * load * dut.full_scale_kpa)
        small = 1e-6 * max(float(np.abs(volts - dut.design.readout.reference_voltage).max()), 1e-12)
        with np.errstate(divide="ignore"):  # a curve that is flat there says nothing of pressure
            found[state] = noise.volts * ohms_per_volt(dut.design, volts, small) / ohms_per_kpa
    kpa, _, where = worst_cell(found)
    return Measurement(kpa, "kPa", where=where, confidence="one standard deviation of one reading")


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    sigma, _, where = worst_cell(readings.volts.std(axis=0, ddof=1))
    try:
        asked = Requirement(id="noise", quantity="noise")
        simulated = [f"Simulated: {engineering(reading_noise(dut, asked, NOMINAL).value, 'V')}."]
    except NotRun as missing:
        simulated = [f"Not simulated: {missing}."]
    frames = len(readings.volts)  # one standard error of a standard deviation
    return Measurement(sigma, "V", where=where, text=simulated, resolution=sigma / (2.0 * (frames - 1)) ** 0.5)


def _limit(design: Design) -> float:
    full = design.cells.full_scale_kpa if design.cells is not None else None
    return SHARE * (full or USUAL_KPA)


QUANTITIES = (
    Quantity(
        name="noise",
        title="Noise of a reading",
        unit="V",
        says="Standard deviation of one reading, quantisation included, V.",
        compute=reading_noise,
        methods=(NOMINAL, SPICE),
        mended_by=(*_QUIET, ("readout.reference_resistance", DOWN)),
        analysis="noise",
        measured=_measured,
    ),
    Quantity(
        name="pressure_resolution",
        title="Pressure resolution",
        unit="kPa",
        says="Standard deviation of the pressure that one settled reading stands for, at the least favourable load, "
        "kPa.",
        compute=pressure_resolution,
        methods=(NOMINAL,),
        shipped=(Shipped(7, "Noise is small beside the load.", max=_limit),),
        mended_by=(*_QUIET, ("readout.reference_resistance", UP), ("drive.voltage", UP), (AVERAGING, UP)),
    ),
)
