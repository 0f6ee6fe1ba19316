"""Noise of a reading, by its origins."""

from __future__ import annotations

import numpy as np

from ...circuits import Noise, Requirement
from ...circuits import noise as noise_of_readings
from ...common.arrays import FloatArray
from ...errors import InputError
from .._dut import DesignUnderTest, once
from .._hardware import Readings
from .._outcome import Measurement, NotRun
from .._quantity import DOWN, NOMINAL, SPICE, UP, Quantity
from .._units import engineering

QUIET = (
    ("readout.voltage_noise", DOWN),
    ("readout.current_noise", DOWN),
    ("readout.feedback_capacitance", UP),
    ("readout.gain_bandwidth", DOWN),
    ("adc.sampling_capacitance", UP),
    ("adc.bits", UP),
)
"""parts that make readings quieter"""


@once
def noise_of(dut: DesignUnderTest) -> list[tuple[str, FloatArray, Noise]]:
    """Noise of the readings with all cells at rest, and with all pressed, at the hottest ambient temperature.

    Raises:
        NotRun: the design names no source of noise but the converter, or nothing limits its bandwidth.
    """
    design = dut.hot
    if design.board.circuit.has_amplifiers and not design.board.circuit.virtual_ground:
        raise NotRun(f'noise is modelled for amplifiers that hold all sensed lines, not for "{design.readout.circuit}"')
    found = []
    for state, ohms in (("at rest", dut.rest), ("at full scale", dut.pressed)):
        cells = np.full(design.array.shape, ohms)
        try:
            noise = noise_of_readings(design, cells)
        except InputError as error:
            raise NotRun(str(error)) from error
        if not noise.before_adc.any():
            keys = ["readout.temperature, or operation.temperature_range"]
            keys += ["readout.voltage_noise"] if design.board.circuit.has_amplifiers else ["adc.sampling_capacitance"]
            raise NotRun(f"missing: {', '.join(keys)}")
        found.append((state, cells, noise))
    return found


def reading_noise(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    worst, where, parts = 0.0, "", {}
    for state, _, found in noise_of(dut):
        place = np.unravel_index(np.argmax(found.volts), found.shape)
        if found.volts[place] > worst:
            worst, where = float(found.volts[place]), f"cell {tuple(map(int, place))}, {state}"
            parts = {name: float(part[place]) for name, part in found.parts.items()}
    return Measurement(worst, "V", where=where, confidence="Lyapunov equation of the readout", contributions=parts)


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    scatter = readings.volts.std(axis=0, ddof=1)
    place = np.unravel_index(int(np.argmax(scatter)), scatter.shape)
    try:
        asked = Requirement(id="noise", quantity="noise")
        simulated = [f"Simulated: {engineering(reading_noise(dut, asked, NOMINAL).value, 'V')}."]
    except NotRun as missing:
        simulated = [f"Not simulated: {missing}."]
    sigma = float(scatter[place])
    frames = len(readings.volts)  # one standard error of a standard deviation
    where = f"cell {tuple(map(int, place))}"
    return Measurement(sigma, "V", where=where, text=simulated, resolution=sigma / (2.0 * (frames - 1)) ** 0.5)


QUANTITY = Quantity(
    name="noise",
    title="Noise of a reading",
    unit="V",
    says="Standard deviation of one reading, quantisation included, V.",
    compute=reading_noise,
    methods=(NOMINAL, SPICE),
    mended_by=(*QUIET, ("readout.reference_resistance", DOWN)),
    analysis="noise",
    measured=_measured,
)
