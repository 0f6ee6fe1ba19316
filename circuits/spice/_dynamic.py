"""A SPICE netlist in time: capacitors, amplifiers with their swing, noise sources, and the loop gain of a column.

The netlist of :mod:`._netlist` is for the settled answer, exactly. This one has the real parts, as an engineer would
draw them: the reference resistor and its capacitor, the column's capacitance, an operational amplifier of one pole with
its swing, offset and bias current, and the converter's switch and sampling capacitor. Where the design names a maker's
macro-model (``readout.amplifier_model``), that model takes the place of the one-pole amplifier with its swing, offset,
bias current and noise. ngspice runs the file as it is: lines that begin with ``*#`` are commands to it (``op``,
``tran``, ``noise``, ``ac``). Other simulators take those for comments, and find the transient analysis as a card.

Noise of an amplifier is that of a resistor at the same temperature behind a source of gain 1: its density is
``4 k T R`` (Vladimirescu, The SPICE Book, 5.4).

The loop gain of one column is found with its loop closed, by Middlebrook's double injection (Int. J. Electronics 38,
1975): a voltage source in series with the inverting input gives the voltage loop gain Tv = -Vy/Vx, a current source
into that node the current loop gain Ti = Iy/Ix, and ``T = (Tv Ti - 1)/(Tv + Ti + 2)``.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from math import inf, isfinite, isinf, nan, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...common.constants import BOLTZMANN, ZERO_CELSIUS
from ...common.text import printable
from ...errors import InputError, SolverError
from .._amplifier_model import AmplifierModel
from .._board import Board
from .._design import Design
from .._sections import LEAST_REFERENCE_OHM
from .._tuning import POINTS_PER_DECADE, SHARPEST_EDGE_S
from ._ngspice import simulate

LARGEST_GAIN = 1e7
"""An infinite open-loop gain is written as this."""
ANALYSES = ("transient", "noise", "loop gain")


def dynamic_netlist(
    design: Design,
    resistance: ArrayLike,
    row: int,
    *,
    column: int = 0,
    period: float | None = None,
    analyses: Collection[str] = ANALYSES,
) -> str:
    """The netlist of the step in which ``row`` is selected at t = 0, all outputs having settled without a signal.

    It prints, for each column J in V: ``rest_J`` before the selection, ``sampled_J`` at the end of ``period``, and
    ``settled_J``, the operating point while the row stays selected. ``noise_rms`` is the noise in V rms at the
    converter of ``column``; ``crossover`` in Hz and ``phase_margin`` in degrees are those of its amplifier, and not
    printed if its loop gain is below 1 throughout.

    Rows here are the lines that the circuit drives, and columns those that it senses, by the array's own numbers.

    Args:
        design: amplifiers of finite gain-bandwidth on all sensed lines of a sliced sheet without faults.
        resistance: (rows, columns) ohm.
        row: number of the driven line that is selected.
        column: number of the sensed line whose noise and loop gain are found.
        period: s until the sample, from the middle of the edge; None: twenty time constants of the slowest amplifier.
        analyses: which of :data:`ANALYSES`.

    Raises:
        InputError: another circuit, a continuous sheet, faults, an infinite gain-bandwidth, or no such line.

    """
    board = design.board
    if not board.virtual_grounds:
        modelled = "amplifiers that hold all sensed lines"
        raise InputError(f'readout.circuit = "{board.circuit.name}": dynamics are modelled for {modelled}')
    if board.continuous or board.faults:
        raise InputError("a netlist in time is for a sliced sheet without faults")
    if not isfinite(design.readout.gain_bandwidth):
        raise InputError("readout.gain_bandwidth is infinite: nothing takes time")
    cells = board.transpose(design.resistance(resistance))
    if not 0 <= row < board.shape[0] or not 0 <= column < board.shape[1]:
        driven, sensed = board.line_kinds
        raise InputError(f"{driven} {row}, {sensed} {column}: outside the array")
    return _Writer(board, cells, board.driven_line(row), board.sensed_line(column), period).text(analyses)


class DynamicReading(NamedTuple):
    """What ngspice makes of one scan step in time."""

    sampled: FloatArray
    """(sensed lines,) V at the end of the period; NaN without a transient analysis, like what follows"""
    settled: FloatArray
    """(sensed lines,) V long after"""
    noise: float
    """V rms of one column at its converter, without quantisation"""
    crossover: float
    """Hz at which the loop gain of that column's amplifier falls below 1; NaN if it never does"""
    phase_margin: float
    """degrees, at the crossover"""
    dropped: tuple[str, ...] = ()
    """parameters of the macro-model that ngspice does not know: the numbers are those of a model without them"""


def dynamic_reading(
    design: Design,
    resistance: ArrayLike,
    row: int,
    *,
    column: int = 0,
    period: float | None = None,
    analyses: Collection[str] = ANALYSES,
) -> DynamicReading:
    """Run :func:`dynamic_netlist` by the ngspice command.

    Raises:
        InputError: as :func:`dynamic_netlist`.
        MissingExtra: the command is not installed.
        SolverError: ngspice gave no result for one of the analyses; the message holds its reason.

    """
    model = design.readout.amplifier_model
    text = dynamic_netlist(design, resistance, row, column=column, period=period, analyses=analyses)
    run = simulate(text, pspice=model is not None)  # the dialect of most makers
    lines = range(design.board.shape[1])
    wanted = [f"{name}_{j}" for name in ("sampled", "settled") for j in lines] if "transient" in analyses else []
    wanted += ["noise_rms"] if "noise" in analyses else []
    if any(name not in run.printed for name in wanted):
        raise SolverError(run.complaints or f"ngspice printed only {', '.join(run.printed)}")
    sampled, settled = (
        np.array([run.printed.get(f"{name}_{j}", nan) for j in lines]) for name in ("sampled", "settled")
    )
    silently = ("T_ABS",) if model is not None and re.search(r"\bt_abs\s*=", model.text, re.IGNORECASE) else ()
    return DynamicReading(
        sampled,
        settled,
        noise=run.printed.get("noise_rms", nan),
        crossover=run.printed.get("crossover", nan),
        phase_margin=run.printed.get("phase_margin", nan),
        dropped=(*silently, *run.dropped),
    )


class _Writer:
    """Writes one netlist. Rows and columns are in line coordinates (:mod:`.._parts`)."""

    def __init__(self, board: Board, cells: FloatArray, row: int, column: int, period: float | None) -> None:
        self.board, self.cells = board, cells
        self.row, self.column = row, column
        self.rows, self.columns = board.shape
        self.slow = 20.0 * self._slowest()
        self.period = self.slow if period is None else period

    def _slowest(self) -> float:
        """s: an upper estimate of the largest time constant."""
        readout, adc = self.board.readout, self.board.adc
        reference = float(self.board.reference.max())
        gain = 1.0 + reference * float((1.0 / self.cells).sum(axis=0).max())
        sampling = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0
        # A ringing column decays with twice its own time constant.
        ringing = 2 * reference * (readout.feedback_capacitance + readout.column_capacitance)
        return gain / (2 * pi * readout.gain_bandwidth) + ringing + sampling

    @property
    def rise(self) -> float:
        """s of the edge by which the row is selected."""
        sharpest = 0.0 if self.board.readout.amplifier_model is None else SHARPEST_EDGE_S
        return max(min(self.period, self.slow) * 1e-6, sharpest)

    def text(self, analyses: Collection[str]) -> str:
        cards = [*self._head(), *self._grid()]
        for column in range(self.columns):
            cards += [*self._feedback(column), *self._amplifier(column), *self._sample(column)]
        return "\n".join([*cards, *self._analyses(analyses), ".end", ""])

    def _head(self) -> Iterator[str]:
        readout = self.board.readout
        kelvin = readout.temperature or 300.0
        driven, sensed = self.board.line_kinds
        selected, judged = self.board.driven_line(self.row), self.board.sensed_line(self.column)
        yield f"* ohmskin: {self.rows} driven x {self.columns} sensed lines, {driven} {selected} selected at t = 0"
        yield f"* noise and phase margin are those of {sensed} {judged}"
        yield "* ngspice -b FILE runs all analyses; LTspice opens the file"
        yield f".temp {kelvin - ZERO_CELSIUS!r}"
        model = readout.amplifier_model
        # The transistors and limiters of macro-models converge to SPICE's usual tolerances, and not far below.
        yield ".options reltol=1e-6 abstol=1e-15 vntol=1e-9" if model is None else ".options reltol=1e-4"
        if model is not None:
            yield from self._model_cards(model)
        yield f"Vreference ref 0 DC {readout.reference_voltage!r}"
        final = readout.reference_voltage + self.board.drive
        rise = self.rise
        yield (
            f"Vdrive drive 0 DC {readout.reference_voltage!r} AC 1 "
            f"PULSE({readout.reference_voltage!r} {final!r} 0 {rise!r} {rise!r} {1e3 * self.slow + self.period!r})"
        )

    def _model_cards(self, model: AmplifierModel) -> Iterator[str]:
        yield f"* {printable(model.file.name)}: {model.subcircuit} in place of the one-pole amplifier"
        yield "* A model in PSpice's dialect needs ngspice -D ngbehavior=psa, and .control blocks in place of *#"
        low, high = self.rails
        if "v-" in model.pins:
            yield f"Vlow rail_low 0 DC {low!r}"
        if "v+" in model.pins:
            yield f"Vhigh rail_high 0 DC {high!r}"
        yield from model.text.split("\n")

    @property
    def rails(self) -> tuple[float, float]:
        """V that the macro-model is supplied with. Raises InputError where neither model nor design says."""
        model = self.board.readout.amplifier_model
        assert model is not None
        low, high = model.rails or self.board.readout.supply
        if ("v-" in model.pins and isinf(low)) or ("v+" in model.pins and isinf(high)):
            raise InputError("readout.amplifier_model.rails: not given, and readout.supply has no finite limits")
        return low, high

    def _grid(self) -> Iterator[str]:
        board = self.board
        for i in range(self.rows):
            source = "drive" if i == self.row else "ref"
            if i == self.row or not board.floating:
                yield f"Rrow{i} {source} r{i}_0 {_wire(board.row_ohms[i, 0])!r}"
            if board.pulled:
                yield f"Rpull{i} r{i}_0 ref {board.pull!r}"
            for j in range(1, self.columns):
                yield f"Rrs{i}_{j} r{i}_{j - 1} r{i}_{j} {_wire(board.row_ohms[i, j])!r}"
        for j in range(self.columns):
            for i in range(1, self.rows):
                yield f"Rcs{i}_{j} c{i - 1}_{j} c{i}_{j} {_wire(board.column_ohms[i, j])!r}"
            yield f"Rcol{j} c{self.rows - 1}_{j} minus{j} {_wire(board.column_lead[j])!r}"
        for (i, j), ohm in np.ndenumerate(self.cells):
            if isfinite(ohm):
                yield f"Rcell{i}_{j} r{i}_{j} c{i}_{j} {_wire(ohm)!r}"

    def _feedback(self, j: int) -> Iterator[str]:
        """What is around the amplifier, and in the judged column the sources that its loop gain is found with."""
        readout = self.board.readout
        yield f"* column {j}"
        yield f"Rref{j} minus{j} out{j} {float(self.board.reference[j])!r}"
        if readout.feedback_capacitance:
            yield f"Cf{j} minus{j} out{j} {readout.feedback_capacitance!r}"
        if readout.column_capacitance:
            yield f"Cc{j} minus{j} 0 {readout.column_capacitance!r}"
        if j == self.column:
            yield f"Vloop minus{j} {self._input(j)} DC 0 AC 0"
            yield f"Iloop 0 {self._input(j)} DC 0 AC 0"

    def _input(self, j: int) -> str:
        """Node of the amplifier's inverting input."""
        return f"input{j}" if j == self.column else f"minus{j}"

    def _amplifier(self, j: int) -> Iterator[str]:
        readout = self.board.readout
        if readout.amplifier_model is not None:
            yield self._macro_model(readout.amplifier_model, j)
            return
        board = self.board
        gain, offset = min(float(board.gain[j]), LARGEST_GAIN), float(board.offset[j])
        yield f"Ibias{j} minus{j} 0 DC {float(board.bias[j])!r}"
        plus = "ref"
        if offset:
            yield f"Voffset{j} plus{j} ref DC {offset!r}"
            plus = f"plus{j}"
        yield from self._noise(j, plus)
        # The pole: 1 ohm and a capacitor, driven by a current of gain times the input.
        yield f"Gpole{j} 0 pole{j} quiet{j} {self._input(j)} {gain!r}"
        yield f"Rpole{j} pole{j} 0 1"
        yield f"Cpole{j} pole{j} 0 {gain / (2 * pi * readout.gain_bandwidth)!r}"
        low, high = readout.supply
        law = f"v(pole{j})"
        if high < inf:
            law = f"min({law},{high!r})"
        if low > -inf:
            law = f"max({law},{low!r})"
        yield f"Bout{j} out{j} 0 V={law}" if (low, high) != (-inf, inf) else f"Eout{j} out{j} 0 pole{j} 0 1"

    def _macro_model(self, model: AmplifierModel, j: int) -> str:
        nodes = {
            "in+": "ref",
            "in-": self._input(j),
            "v+": "rail_high",
            "v-": "rail_low",
            "out": f"out{j}",
            "ground": "0",
        }
        pins = [nodes.get(pin, f"open{j}_{number}") for number, pin in enumerate(model.pins)]
        return f"Xamplifier{j} {' '.join(pins)} {model.subcircuit}"

    def _sample(self, j: int) -> Iterator[str]:
        adc = self.board.adc
        if adc and adc.sampling_capacitance:
            yield f"Rswitch{j} out{j} sample{j} {max(adc.switch_resistance, LEAST_REFERENCE_OHM)!r}"
            yield f"Csample{j} sample{j} 0 {adc.sampling_capacitance!r}"
        else:
            yield f"Rsample{j} out{j} sample{j} {LEAST_REFERENCE_OHM!r}"

    def _noise(self, j: int, plus: str) -> Iterator[str]:
        """The amplifier's noise voltage in series with its input, and its noise current into the column."""
        readout = self.board.readout
        thermal = 4.0 * BOLTZMANN * (readout.temperature or 300.0)
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

    def _analyses(self, analyses: Collection[str]) -> Iterator[str]:
        """The transient analysis as a card; all as commands of ngspice, which LTspice takes for comments."""
        stop = self.period + self.rise
        longest = min(self.period, self.slow) / 200
        if self.board.readout.amplifier_model is not None:
            longest = self.period / 200  # its own time constants are not known; ngspice controls the step
        transient = f"tran {self.period / 200!r} {stop!r} 0 {longest!r}"
        outputs = [(j, self.board.sensed_line(j)) for j in range(self.columns)]
        measured = [
            f"meas tran sampled_{line} FIND v(sample{j}) AT={self.period + self.rise / 2!r}" for j, line in outputs
        ]
        noise = f"noise v(sample{self.column}) Vdrive dec 100 1 {1e4 * self.board.readout.gain_bandwidth!r}"
        yield f".{transient}"
        yield from (f".{line}" for line in measured)
        yield f"* For LTspice, in place of .tran: .{noise}"
        yield "*# set numdgt=16"
        if "transient" in analyses:
            yield from self._operating_point("rest")
            yield f"*# {transient}"
            for line in measured:
                yield f"*# {line}"
                yield f"*# print {line.split()[2]}"
        yield f"*# alter vdrive dc = {self.board.readout.reference_voltage + self.board.drive!r}"
        if "transient" in analyses:
            yield from self._operating_point("settled")
        if "noise" in analyses:
            # ngspice's own onoise_total is now and then no number: its integration divides by zero for some slopes.
            yield from (f"*# {noise}", "*# setplot previous", "*# let density = onoise_spectrum*onoise_spectrum")
            yield from ("*# let variance = integ(density)", "*# let noise_rms = sqrt(variance[length(variance)-1])")
            yield "*# print noise_rms"
        if "loop gain" in analyses:
            yield from (f"*# {line}" for line in self._loop_gain())
        yield "*# quit"

    def _operating_point(self, name: str) -> Iterator[str]:
        yield "*# op"
        for j in range(self.columns):
            line = self.board.sensed_line(j)
            yield f"*# let {name}_{line} = v(sample{j})"
            yield f"*# print {name}_{line}"

    def _loop_gain(self) -> Iterator[str]:
        """ngspice's commands for Middlebrook's double injection, at the operating point of the selected row."""
        width = self.board.readout.gain_bandwidth
        sweep = f"ac dec {POINTS_PER_DECADE} {1e-5 * width!r} {1e3 * width!r}"
        source = f"v({self._input(self.column)})"
        yield from ("alter vdrive ac = 0", "alter vloop ac = 1", sweep, "set voltage_run = $curplot")
        yield f"let voltage_gain = -v(minus{self.column})/{source}"
        yield from ("alter vloop ac = 0", "alter iloop ac = 1", sweep)
        # Written so that an input that takes no current, where Ti is infinite, divides by nothing.
        yield from ("let back = -i(vloop)", "let forward = 1 - back", "let tv = {$voltage_run}.voltage_gain")
        yield "let loop_gain = (tv*back - forward)/((tv + 2)*forward + back)"
        yield from ("let gain_db = db(loop_gain)", "let angle = 180/pi*cph(loop_gain)")
        yield from ("let start_db = gain_db[0]", "print start_db")  # also where there is no crossover
        yield "meas ac crossover WHEN gain_db=0 FALL=LAST"
        yield "meas ac angle_there FIND angle WHEN gain_db=0 FALL=LAST"
        yield from ("let phase_margin = 180 + angle_there", "print crossover", "print phase_margin")


def _wire(ohm: float) -> float:
    """Ohm of a part in the netlist, where none has less than a reference resistor may have."""
    return max(float(ohm), LEAST_REFERENCE_OHM)
