"""A SPICE netlist in time: capacitors, one-pole amplifiers with their swing, and noise sources.

The netlist of :mod:`._netlist` is for the settled answer, exactly. This one has the real parts, as an engineer would
draw them: the reference resistor and its capacitor, the column's capacitance, an operational amplifier of one pole with
its swing, offset and bias current, and the converter's switch and sampling capacitor. ngspice runs the file as it is:
lines that begin with ``*#`` are commands to it (``op``, ``tran``, ``noise``). Other simulators take those for comments,
and find the transient analysis as a card.

Noise of an amplifier is that of a resistor at the same temperature behind a source of gain 1: its density is
``4 k T R`` (Vladimirescu, The SPICE Book, 5.4).
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf, isfinite, isinf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.constants import Boltzmann

from ...arrays import FloatArray
from ...errors import InputError, SolverError
from .._design import Design
from ._ngspice import run_control

LARGEST_GAIN = 1e7
"""An infinite open-loop gain is written as this."""
LEAST_OHM = 1e-6
"""Wires without resistance are written as this."""
_KELVIN_AT_ZERO_CELSIUS = 273.15


def dynamic_netlist(
    design: Design, resistance: ArrayLike, row: int, *, column: int = 0, period: float | None = None
) -> str:
    """The netlist of the step in which ``row`` is selected at t = 0, all outputs having settled without a signal.

    It prints, for each column J in V: ``rest_J`` before the selection, ``sampled_J`` at the end of ``period``, and
    ``settled_J`` long after. ``onoise_total`` is the noise in V rms at the converter of ``column``.

    Args:
        design: inverting amplifiers of finite gain-bandwidth over a sliced sheet without faults.
        resistance: (rows, columns) ohm.
        row: that is selected.
        column: whose noise is found.
        period: s until the sample; None: twenty time constants of the slowest amplifier.

    Raises:
        InputError: another circuit, a continuous sheet, faults, an infinite gain-bandwidth, or no such row.

    """
    if not (design.board.circuit.virtual_ground and design.board.circuit.senses == "columns"):
        raise InputError(f'readout.circuit = "{design.readout.circuit}": dynamics are those of "inverting-amplifier"')
    if design.array.sheet != "sliced" or design.fault:
        raise InputError("a netlist in time is for a sliced sheet without faults")
    if not isfinite(design.readout.gain_bandwidth):
        raise InputError("readout.gain_bandwidth is infinite: nothing takes time")
    cells = design.resistance(resistance)
    if not 0 <= row < design.array.rows or not 0 <= column < design.array.columns:
        raise InputError(f"row {row}, column {column}: outside the array")
    return _Writer(design, cells, row, column, period).text()


class DynamicReading(NamedTuple):
    """What ngspice makes of one scan step in time."""

    sampled: FloatArray
    """(columns,) V at the end of the period"""
    settled: FloatArray
    """(columns,) V long after"""
    noise: float
    """V rms of one column at its converter, without quantisation"""


def dynamic_reading(
    design: Design, resistance: ArrayLike, row: int, *, column: int = 0, period: float | None = None
) -> DynamicReading:
    """Run :func:`dynamic_netlist` by the ngspice command.

    Raises:
        InputError: as :func:`dynamic_netlist`.
        MissingExtra: the command is not installed.
        SolverError: ngspice gave no result.

    """
    found = run_control(dynamic_netlist(design, resistance, row, column=column, period=period))
    columns = range(design.array.columns)
    try:
        sampled = [found[f"sampled_{j}"] for j in columns]
        settled = [found[f"settled_{j}"] for j in columns]
        return DynamicReading(np.array(sampled), np.array(settled), found["onoise_total"])
    except KeyError as error:
        raise SolverError(f"ngspice gave no {error} in its transient or noise analysis") from error


class _Writer:
    def __init__(self, design: Design, cells: FloatArray, row: int, column: int, period: float | None) -> None:
        self.design, self.cells, self.row, self.column = design, cells, row, column
        self.rows, self.columns = design.array.shape
        self.slow = 20.0 * self._slowest()
        self.period = self.slow if period is None else period

    def _slowest(self) -> float:
        """s: an upper estimate of the largest time constant."""
        readout, adc = self.design.readout, self.design.adc
        gain = 1.0 + float(np.max(readout.reference_resistance)) * float((1.0 / self.cells).sum(axis=0).max())
        feedback = float(np.max(readout.reference_resistance)) * readout.feedback_capacitance
        sampling = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0
        return gain / (2 * pi * readout.gain_bandwidth) + feedback + sampling

    def text(self) -> str:
        cards = [*self._head(), *self._grid()]
        for column in range(self.columns):
            cards += self._amplifier(column)
        return "\n".join([*cards, *self._analyses(), ".end", ""])

    def _head(self) -> Iterator[str]:
        readout = self.design.readout
        kelvin = readout.temperature or 300.0
        yield f"* ohmskin: {self.rows} x {self.columns} cells, row {self.row} selected at t = 0"
        yield "* ngspice -b FILE runs all analyses; LTspice opens the file"
        yield f".temp {kelvin - _KELVIN_AT_ZERO_CELSIUS!r}"
        yield ".options reltol=1e-6 abstol=1e-15 vntol=1e-9"
        yield f"Vreference ref 0 DC {readout.reference_voltage!r}"
        final = readout.reference_voltage + self.design.drive.voltage
        rise = min(self.period, self.slow) * 1e-6
        yield (
            f"Vdrive drive 0 DC {readout.reference_voltage!r} AC 1 "
            f"PULSE({readout.reference_voltage!r} {final!r} 0 {rise!r} {rise!r} {1e3 * self.slow + self.period!r})"
        )

    def _grid(self) -> Iterator[str]:
        array = self.design.array
        row_lead, row_segment = (self._each(v, self.rows) for v in (array.row_lead, array.row_segment))
        column_lead, column_segment = (self._each(v, self.columns) for v in (array.column_lead, array.column_segment))
        idle_open = self.design.drive.idle_rows == "float"
        for i in range(self.rows):
            source = "drive" if i == self.row else "ref"
            if i == self.row or not idle_open:
                yield f"Rrow{i} {source} r{i}_0 {max(row_lead[i], LEAST_OHM)!r}"
            for j in range(1, self.columns):
                yield f"Rrs{i}_{j} r{i}_{j - 1} r{i}_{j} {max(row_segment[i], LEAST_OHM)!r}"
        for j in range(self.columns):
            for i in range(1, self.rows):
                yield f"Rcs{i}_{j} c{i - 1}_{j} c{i}_{j} {max(column_segment[j], LEAST_OHM)!r}"
            yield f"Rcol{j} c{self.rows - 1}_{j} minus{j} {max(column_lead[j], LEAST_OHM)!r}"
        for (i, j), ohm in np.ndenumerate(self.cells):
            if isfinite(ohm):
                yield f"Rcell{i}_{j} r{i}_{j} c{i}_{j} {max(float(ohm), LEAST_OHM)!r}"

    def _amplifier(self, j: int) -> Iterator[str]:
        readout, adc = self.design.readout, self.design.adc
        reference, gain, offset, bias = (
            self._each(getattr(readout, name), self.columns)[j]
            for name in ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")
        )
        gain = LARGEST_GAIN if isinf(gain) else gain
        yield f"* column {j}"
        yield f"Rref{j} minus{j} out{j} {reference!r}"
        if readout.feedback_capacitance:
            yield f"Cf{j} minus{j} out{j} {readout.feedback_capacitance!r}"
        if readout.column_capacitance:
            yield f"Cc{j} minus{j} 0 {readout.column_capacitance!r}"
        yield f"Ibias{j} minus{j} 0 DC {bias!r}"
        plus = "ref"
        if offset:
            yield f"Voffset{j} plus{j} ref DC {offset!r}"
            plus = f"plus{j}"
        yield from self._noise(j, plus)
        # The pole: 1 ohm and a capacitor, driven by a current of gain times the input.
        yield f"Gpole{j} 0 pole{j} quiet{j} minus{j} {gain!r}"
        yield f"Rpole{j} pole{j} 0 1"
        yield f"Cpole{j} pole{j} 0 {gain / (2 * pi * readout.gain_bandwidth)!r}"
        low, high = readout.supply
        law = f"v(pole{j})"
        if high < inf:
            law = f"min({law},{high!r})"
        if low > -inf:
            law = f"max({law},{low!r})"
        yield f"Bout{j} out{j} 0 V={law}" if (low, high) != (-inf, inf) else f"Eout{j} out{j} 0 pole{j} 0 1"
        if adc and adc.sampling_capacitance:
            yield f"Rswitch{j} out{j} sample{j} {max(adc.switch_resistance, LEAST_OHM)!r}"
            yield f"Csample{j} sample{j} 0 {adc.sampling_capacitance!r}"
        else:
            yield f"Rsample{j} out{j} sample{j} {LEAST_OHM!r}"

    def _noise(self, j: int, plus: str) -> Iterator[str]:
        """The amplifier's noise voltage in series with its input, and its noise current into the column."""
        readout = self.design.readout
        thermal = 4.0 * Boltzmann * (readout.temperature or 300.0)
        if readout.voltage_noise:
            yield f"Rnv{j} nv{j} 0 {readout.voltage_noise**2 / thermal!r}"
            yield f"Env{j} quiet{j} {plus} nv{j} 0 1"
        else:
            yield f"Vnv{j} quiet{j} {plus} DC 0"
        if readout.current_noise:
            ohm = 1e6
            density = (thermal * ohm) ** 0.5
            yield f"Rni{j} ni{j} 0 {ohm!r}"
            yield f"Gni{j} 0 minus{j} ni{j} 0 {readout.current_noise / density!r}"

    def _analyses(self) -> Iterator[str]:
        """The transient analysis as a card; all three as commands of ngspice, which LTspice takes for comments."""
        stop = self.slow + self.period
        transient = f"tran {self.period / 200!r} {stop!r} 0 {min(self.period, self.slow) / 200!r}"
        measured = [
            f"meas tran {name}_{j} FIND v(sample{j}) AT={at!r}"
            for j in range(self.columns)
            for name, at in (("sampled", self.period), ("settled", 0.999 * stop))
        ]
        noise = f"noise v(sample{self.column}) Vdrive dec 50 1 {1e4 * self.design.readout.gain_bandwidth!r}"
        yield f".{transient}"
        yield from (f".{line}" for line in measured)
        yield f"* For LTspice, in place of .tran: .{noise}"
        yield from ("*# set numdgt=16", "*# op")
        for j in range(self.columns):
            yield f"*# let rest_{j} = v(sample{j})"
            yield f"*# print rest_{j}"
        yield f"*# {transient}"
        for line in measured:
            yield f"*# {line}"
            yield f"*# print {line.split()[2]}"
        final = self.design.readout.reference_voltage + self.design.drive.voltage
        yield f"*# alter vdrive dc = {final!r}"
        yield from (f"*# {noise}", "*# setplot noise2", "*# print onoise_total", "*# quit")

    @staticmethod
    def _each(value: float | tuple[float, ...], count: int) -> list[float]:
        return np.full(count, value, dtype=np.float64).tolist()
