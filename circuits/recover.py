"""Turning the scan round: the cells' true resistances from the readings, by inverting the whole circuit model.

Strategy
--------
What is compared is the conductance that equation (10) makes of a reading, after the model's own offsets are taken
out of it. On a good board that is the cell's own but for a small crosstalk, so that correcting each cell by what its
own reading still lacks gains a digit or more each time and needs no derivatives. Where it gains less, the derivatives
of all readings by all cells (:mod:`.sensitivity`) are factored once, and kept as long as they serve: over the
iterations of a frame, and over the frames of a stream.

Without resistance in the row lines the columns are independent of each other and there is a closed form: of a column
whose outputs are known, so are the potentials at its cells, and what is left is linear.

A reading at a limit says that a resistance lies beyond something, not what it is: such a cell is marked and NaN. In the
model it stands at that limit, and cells that it can disturb are marked too. A reading without signal is an open cell.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from enum import IntEnum
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import LinAlgWarning, lu_factor, lu_solve

from ..errors import InputError, SolverError
from .design import Design
from .exact import read_exactly
from .grid import is_plain
from .parts import Parts, lines, series_faults, siemens
from .readout import amplifier_ends
from .sensitivity import LARGEST, sensitivity

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# By number of cells: error that may be left of each iteration's before the derivatives are factored (anew), and most
# iterations. A factorisation costs as much as 5 evaluations of an 8 x 8, 30 of a 32 x 32 and 300 of a 64 x 64.
_PATIENCE = ((16 * 16, 0.03, 40), (32 * 32, 0.5, 60), (LARGEST, 0.9, 200))
_NOTHING = 1e-13  # of the largest apparent conductance: smaller ones are rounding
_ROUNDING = 1e-8  # residual below which progress may end by rounding alone, not by a bad direction
_LEAST_STRIDE = 1e-3  # along a path of readings
_LEAST_SHARE = 1e-9  # of a place's current that a cell beside a known short must carry
# Error that may be left of each iteration's before the derivatives are factored (anew), by number of cells: they cost
# as much as 5 evaluations of an 8 x 8, 30 of a 32 x 32 and 300 of a 64 x 64.
_SLOW = ((16 * 16, 0.03), (32 * 32, 0.5), (LARGEST, 0.9))


class Status(IntEnum):
    """What a recovered cell is."""

    READ = 0
    OPEN = 1
    """no current; the resistance is given as inf"""
    SATURATED = 2
    """the output or the converter is at a limit, so the resistance is not known: NaN"""
    DISTURBED = 3
    """not to be trusted, since it depends on cells that are not known (with amplifiers: on its own row or column)"""
    HIDDEN = 4
    """behind a fault of the design, so that no reading tells of it: NaN"""


@dataclass(frozen=True)
class Recovery:
    """Cells recovered from one frame. Arrays are (rows, columns)."""

    resistance: FloatArray
    """ohm"""
    status: NDArray[np.int8]
    """a :class:`Status` each"""
    residual: float
    """largest relative difference that is left between a reading and the model's, in apparent conductance"""
    iterations: int
    """evaluations of the model on the way that led there; 0 for the closed form"""
    factored: int
    """how often the derivatives were computed"""


@dataclass(frozen=True)
class Conditioning:
    """How errors of the readings become errors of the recovered resistances."""

    inverse: FloatArray
    """(NM, NM): relative change of each cell's resistance per relative change of each reading's apparent one"""
    volts_to_relative: FloatArray
    """(N, M) 1/V: relative change of an apparent resistance per volt of its reading, as a magnitude"""
    resistance: FloatArray
    """(N, M) ohm at which this holds; NaN and inf are cells that were left out"""

    @property
    def amplification(self) -> FloatArray:
        """(N, M): relative error of a cell if all readings have independent errors of relative size 1. An ideal board
        has 1 everywhere; left-out cells are NaN.
        """
        total = np.sqrt((self.inverse**2).sum(axis=1)).reshape(self.resistance.shape)
        return np.where(np.isfinite(self.resistance), total, np.nan)

    def resistance_std(self, volts_std: ArrayLike) -> FloatArray:
        """(N, M) ohm for independent errors of standard deviation ``volts_std`` (V, a number or (N, M))."""
        relative = self.volts_to_relative * np.asarray(volts_std, dtype=np.float64)
        variance = self.inverse**2 @ relative.ravel() ** 2
        std: FloatArray = self.resistance * np.sqrt(variance).reshape(self.resistance.shape)
        return std


def recover(design: Design, volts: ArrayLike, *, accuracy: float = 1e-11, clipped: ArrayLike | None = None) -> Recovery:
    """The cells that a design's readings come from. For a stream of frames use a :class:`Recoverer`.

    Args:
        design: with its lines, faults, gains, offsets and bias currents as they are.
        volts: (rows, columns) V, as :func:`.scan` gives them.
        accuracy: largest relative difference from the readings, in apparent conductance, to stop at.
        clipped: (rows, columns) True where the reading is at a limit of the converter. Outputs at a supply limit are
            found without.

    Raises:
        InputError: wrong shape, or NaN.
        SolverError: no cells give these readings, or the design does not determine them.

    """
    return Recoverer(design, accuracy=accuracy)(volts, clipped=clipped)


class _Found(NamedTuple):
    conductance: FloatArray
    """(N, M) S"""
    target: FloatArray
    """(N, M) S: apparent conductances, the model's offsets taken out"""
    residual: float
    iterations: int
    factored: int


class Recoverer:
    """:func:`recover` for a stream of frames: starts from the frame before and keeps its factorisation."""

    def __init__(self, design: Design, *, accuracy: float = 1e-11) -> None:
        self._design, self._accuracy = design, accuracy
        self._series, self._cut_off = series_faults(design, "open-cell"), _cut_off(design)
        # Faults of cells change what is sought, but for a complete short: there nothing is left to be sought.
        faults = tuple(
            fault
            for fault in design.fault
            if fault.kind not in {"open-cell", "shorted-cell"} or (fault.kind == "shorted-cell" and fault.ohms == 0)
        )
        self._unread = self._cut_off.copy()
        for fault in faults:
            if fault.kind == "shorted-cell":
                self._unread[fault.place] = True
        self._model = _Model(
            design.model_copy(
                update={
                    "readout": design.readout.model_copy(update={"supply": (-inf, inf)}),
                    "fault": faults,
                }
            )
        )
        self._by_columns = _columns_are_independent(design)
        cells = design.array.rows * design.array.columns
        patience = (limits[1:] for limits in _PATIENCE if cells <= limits[0] and self._model.has_derivatives)
        self._slow, self._most = next(patience, (inf, 200))
        self._start: FloatArray | None = None
        self._factor: _Factor | None = None

    def __call__(self, volts: ArrayLike, *, clipped: ArrayLike | None = None) -> Recovery:
        """As :func:`recover`."""
        measured = _checked(self._design, volts)
        at_limit = self._at_limit(measured)
        if clipped is not None:
            at_limit = at_limit | np.asarray(clipped, dtype=np.bool_)
        if self._by_columns:
            conductance = _column_conductance(self._design, measured)
            unknown = np.isnan(conductance)
            conductance[unknown] = 0.0
            found = _Found(conductance, conductance, 0.0, 0, 0)
        else:
            found, unknown = self._iterate(measured), np.zeros(measured.shape, dtype=np.bool_)
        # At a limit without any signal stands the output of an open cell, on a board that reads down to its reference.
        signal = np.abs(measured - self._design.readout.reference_voltage) > 1e-9 * abs(self._design.drive.voltage)
        return self._result(found, (at_limit & (signal | (found.conductance > 0))) | unknown)

    def _at_limit(self, measured: FloatArray) -> BoolArray:
        if self._design.readout.circuit == "voltage-divider":  # no amplifier, no limit
            return np.zeros(measured.shape, dtype=np.bool_)
        low, high = self._design.readout.supply
        at_limit: BoolArray = (measured <= low) | (measured >= high)
        return at_limit

    def _iterate(self, measured: FloatArray) -> _Found:
        """Directly or, where that leads nowhere, along a path of readings from a known frame to the measured one."""
        model, start = self._model, self._start
        apparent = np.where(self._unread, 0.0, model.apparent(measured - model.level))
        found = self._follow(measured, apparent if start is None else start, self._accuracy, self._most)
        if found is None and start is not None:
            self._factor = None
            found = self._follow(measured, apparent, self._accuracy, self._most)
        if found is None:
            signal, rest = model.split(apparent)
            origin, here, done, stride, iterations, factored = signal + rest, apparent, 0.0, 0.25, 0, 0
            while stride > _LEAST_STRIDE and done < 1:
                goal = min(1.0, done + stride)
                last = goal == 1
                between = measured if last else origin + goal * (measured - origin)
                found = self._follow(between, here, self._accuracy if last else 1e-4, 12)
                if found is None:
                    stride /= 2
                else:
                    here, done, stride = found.conductance, goal, 1.5 * stride
                    iterations, factored = iterations + found.iterations, factored + found.factored
            found = found and found._replace(iterations=iterations, factored=factored)
        if found is None:
            self._start = self._factor = None
            raise SolverError(
                "no cell resistances were found that give these readings; check that the design is that of the board, "
                "and that its circuit determines the cells"
            )
        self._start = found.conductance
        # What a cell adds to its own reading must stand out from what the model is uncertain by.
        seen = found.conductance > 10 * max(found.residual, self._accuracy) * found.target
        return found._replace(conductance=np.where(seen, found.conductance, 0.0))

    def _follow(self, measured: FloatArray, conductance: FloatArray, accuracy: float, most: int) -> _Found | None:
        """Correct ``conductance`` until its readings are the measured ones; None if it does not come to that."""
        model, kept = self._model, self._factor
        slow = self._slow
        at_once = not model.amplified and slow < inf  # a divider's readings are far from its cells
        base, change = conductance, np.zeros_like(conductance)
        factored, last, best, stalled, fresh = 0, inf, inf, 0, False
        for iteration in range(1, most + 1):
            signal, rest = model.split(conductance)
            reading, target = model.apparent(signal), model.apparent(measured - rest)
            reading[self._unread] = target[self._unread] = 0.0  # whatever these are, it does not tell of a cell
            largest = np.maximum(target, reading)
            missing = target - reading
            # What is below rounding of the largest reading tells nothing, and an open cell cannot give less than none.
            telling = (largest > _NOTHING * largest.max(initial=0.0)) & ((target > 0) | (conductance > 0))
            off = np.divide(np.abs(missing), largest, out=np.zeros_like(missing), where=telling)
            error = float(off.max(initial=0.0))
            stalled = stalled + 1 if error > 0.95 * best else 0
            best = min(best, error)
            if error <= accuracy or (stalled > 3 and error <= _ROUNDING):
                self._factor = kept
                return _Found(conductance, target, error, iteration, factored)
            if error > last and fresh and np.abs(change).max() > 1e-6:
                change = change / 2  # a full step of Newton's method went too far
                conductance = base * (1.0 + change)
                continue
            fresh = False
            if (error > slow * last and error > _ROUNDING) or (iteration == 1 and kept is None and at_once):
                kept, factored, fresh = _Factor.of(model, conductance), factored + 1, True
            live = (conductance > 0) & (reading > 0)
            if kept is None:
                change = np.divide(missing, np.minimum(conductance, reading), out=np.zeros_like(missing), where=live)
            else:
                change = kept.solve(np.divide(missing, reading, out=np.zeros_like(missing), where=live), live)
            change = np.clip(change, -0.9, 6.0)
            # Cells that give no current so far get what is missing; those that should give less than none, none.
            base = np.where(live, conductance, np.maximum(missing, 0.0))
            base[(change <= -0.9) & (conductance < 1e-3 * target)] = 0.0
            base[target == 0] = 0.0
            conductance, last = base * (1.0 + change), error
        return None

    def _result(self, found: _Found, lost: BoolArray) -> Recovery:
        """``lost``: whose readings do not tell their resistance."""
        conductance = own = found.conductance
        for fault in self._design.fault:
            if fault.kind == "shorted-cell" and fault.ohms > 0:
                own = own.copy()
                own[fault.place] -= siemens(fault.ohms)
        with np.errstate(divide="ignore"):
            resistance = np.where(own > 0, 1.0 / own, inf)
        joined = np.isfinite(self._series)
        resistance = np.where(joined, np.maximum(resistance - np.where(joined, self._series, 0.0), 0.0), inf)
        status = np.where(np.isinf(resistance), Status.OPEN, Status.READ).astype(np.int8)
        # Beside a short that carries nearly all of the current, a cell is not to be seen.
        status[~joined | (own < _LEAST_SHARE * conductance) | self._unread] = Status.HIDDEN
        status[lost] = Status.SATURATED
        disturbed = self._disturbed(lost | self._cut_off) & (status == Status.READ)
        status = np.where(disturbed, Status.DISTURBED, status).astype(np.int8)
        resistance[np.isin(status, (Status.SATURATED, Status.HIDDEN))] = np.nan
        return Recovery(resistance, status, found.residual, found.iterations, found.factored)

    def _disturbed(self, unknown: BoolArray) -> BoolArray:
        """Cells whose readings depend on cells that conduct but are not known."""
        in_column: BoolArray = np.logical_or(unknown.any(axis=0, keepdims=True), np.zeros_like(unknown))
        if self._by_columns:
            return in_column
        if not self._model.amplified or self._design.drive.idle_rows == "float":
            return np.full_like(unknown, unknown.any())
        return np.logical_or(in_column, unknown.any(axis=1, keepdims=True))


def _cut_off(design: Design) -> BoolArray:
    """Cells (rows, columns) beyond a complete break of their line: they conduct, but no reading is theirs."""
    cut = np.zeros(design.array.shape, dtype=np.bool_)
    for fault in design.fault:
        row, column = fault.place
        if fault.kind == "broken-row" and fault.ohms == inf:
            cut[row, column:] = True
        elif fault.kind == "broken-column" and fault.ohms == inf:
            cut[: row + 1, column] = True
    return cut


def conditioning(design: Design, resistance: ArrayLike) -> Conditioning:
    """How much worse than the readings the recovered cells are.

    Args:
        design: with a sliced sheet, of at most 64 x 64 cells.
        resistance: (rows, columns) ohm, such as :attr:`Recovery.resistance`; cells that are NaN or inf are left out.

    Raises:
        InputError: as :func:`.sensitivity`, or a cell is shorted.

    """
    cells = np.asarray(resistance, dtype=np.float64)
    cells = design.resistance(np.where(np.isnan(cells), inf, cells))
    unlimited = design.readout.model_copy(update={"supply": (-inf, inf)})
    model = _Model(design.model_copy(update={"readout": unlimited}))
    with np.errstate(divide="ignore"):
        conductance = 1.0 / cells
    if np.isinf(conductance).any():
        raise InputError("a shorted cell (0 ohm) has no relative error; leave it out as nan")
    signal, _ = model.split(conductance)
    live = (conductance > 0) & (signal != 0)
    per_volt = np.abs(model.log_slope(np.where(live, signal, model.drive / 2)))
    return Conditioning(
        inverse=_Factor.of(model, conductance).inverse(),
        volts_to_relative=np.where(live, per_volt, 0.0),
        resistance=np.where(live, cells, np.where(np.isnan(resistance), np.nan, cells)),
    )


class _Model:
    """Readings as a function of conductances: the part that the drive makes, and the rest (reference, offsets)."""

    def __init__(self, design: Design) -> None:
        self.design = design
        self.amplified = design.readout.circuit == "inverting-amplifier"
        self.has_derivatives = design.array.sheet == "sliced"
        self.level, self.drive = design.readout.reference_voltage, design.drive.voltage
        self._parts = parts = Parts.of(design)
        ends = amplifier_ends(design)
        alike = self.amplified and design.drive.idle_rows == "ground" and np.ptp(ends.source) == 0
        self._output, self._source = ends.output, float(ends.source[0]) if alike else None
        self._turned = design.model_copy(update={"drive": design.drive.model_copy(update={"voltage": -self.drive})})
        self._has_rest = (
            bool(parts.offset.any() or parts.bias.any() or (self.level and np.isfinite(parts.gain).any()))
            and design.readout.circuit != "voltage-divider"
        )

    def split(self, conductance: FloatArray) -> tuple[FloatArray, FloatArray | float]:
        """V that the drive makes, and what is there without it."""
        with np.errstate(divide="ignore"):
            cells = 1.0 / conductance
        volts = read_exactly(self.design, cells)[0].volts
        if not self._has_rest:
            return volts - self.level, self.level
        if self._source is None:
            other = read_exactly(self._turned, cells)[0].volts
            return (volts - other) / 2, (volts + other) / 2
        # In its own step a cell gets the drive, and in every step all cells of a column get the same source.
        above = volts - self._output
        signal = above + self._source * (above.sum(axis=0) / (self.drive - len(volts) * self._source))
        return signal, volts - signal

    def apparent(self, signal: FloatArray) -> FloatArray:
        """Conductance in S that the ideal circuit would need for a signal (N, M) in V; 0 where there is none."""
        ratio = signal / self.drive
        if self.amplified:
            ratio = -ratio
        floor = 4 * np.finfo(np.float64).eps * (abs(self.level / self.drive) + 1e-12)
        conductance: FloatArray = np.where(ratio > floor, ratio, 0.0) / self._parts.reference
        return conductance if self.amplified else conductance / (1.0 - np.minimum(ratio, 1 - 1e-9))

    def log_slope(self, signal: FloatArray) -> FloatArray:
        """d(log apparent conductance)/d(signal), 1/V."""
        if self.amplified:
            return 1.0 / signal
        return 1.0 / (signal * (1.0 - signal / self.drive))


@dataclass(frozen=True)
class _Factor:
    """d(log apparent conductance)/d(log conductance), factored; cells without current are kept out of it."""

    lu: tuple[FloatArray, NDArray[np.int32]]

    @classmethod
    def of(cls, model: _Model, conductance: FloatArray) -> _Factor:
        with np.errstate(divide="ignore"):
            found = sensitivity(model.design, 1.0 / conductance)
        signal, _ = model.split(conductance)
        live = ((conductance > 0) & (signal != 0)).ravel()
        slope = model.log_slope(np.where(signal == 0, model.drive / 2, signal))
        jacobian = (found.cell_conductance * conductance * slope[..., None, None]).reshape(live.size, live.size)
        jacobian[~live] = 0.0
        jacobian[:, ~live] = 0.0
        jacobian[~live, ~live] = 1.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)  # singular: solve() finds out
            return cls(lu_factor(jacobian, overwrite_a=True, check_finite=False))

    def solve(self, off: FloatArray, live: BoolArray) -> FloatArray:
        """Relative change (N, M) of the live cells for relative differences ``off`` of the readings."""
        with np.errstate(divide="ignore", invalid="ignore"):
            step = lu_solve(self.lu, off.ravel(), check_finite=False).reshape(off.shape)
        if not np.isfinite(step).all():
            raise SolverError("the readings do not determine the cells: other resistances would give the same ones")
        return np.where(live, step, 0.0)

    def inverse(self) -> FloatArray:
        """(NM, NM); inf where there is none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = lu_solve(self.lu, np.eye(len(self.lu[0])), check_finite=False)
        return np.where(np.isfinite(inverse), inverse, inf)


def _columns_are_independent(design: Design) -> bool:
    """Whether rows have no resistance of their own and columns none between their cells."""
    if design.readout.circuit != "inverting-amplifier" or design.drive.idle_rows != "ground" or not is_plain(design):
        return False
    line = lines(design)
    return bool(np.isinf(line.row).all() and np.isinf(line.column[1:]).all())


def _column_conductance(design: Design, measured: FloatArray) -> FloatArray:
    """Conductances (N, M) in S where columns are independent, 0 where no current is left for a cell, NaN in columns
    whose readings do not determine them.

    An output gives its column's current i and the potential w that its cells end at. With the selected row at the
    drive and the others at the reference, ``i = G drive - w sum(G)``; the sum follows from the sum over the rows.
    """
    parts, level, drive = Parts.of(design), design.readout.reference_voltage, design.drive.voltage
    share = 1.0 / (1.0 + 1.0 / parts.gain)
    current = (level + parts.offset) / parts.reference + parts.bias - measured / (share * parts.reference)
    input_at = parts.offset - measured / parts.gain
    broken = np.isinf(parts.column_lead)
    column = input_at + np.where(broken, 0.0, parts.column_lead) * current
    left = drive - column.sum(axis=0)
    # A short holds its column at the drive: then nothing is left that would tell of the column's cells.
    left[np.abs(left) <= 1e-9 * (abs(drive) + np.abs(column).sum(axis=0))] = np.nan
    total = current.sum(axis=0) / left
    conductance: FloatArray = (current + total * column) / drive
    noise = np.abs(measured) + np.abs(level) + np.abs(parts.offset) + np.abs(parts.reference * parts.bias)
    floor = 8 * np.finfo(np.float64).eps * noise / (parts.reference * abs(drive))
    conductance[(conductance <= floor) | broken] = 0.0
    return conductance


def _checked(design: Design, volts: ArrayLike) -> FloatArray:
    try:
        measured = np.asarray(volts, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"readings are not numbers: {error}") from error
    if measured.shape != design.array.shape:
        raise InputError(f"readings have shape {measured.shape}, expected {design.array.shape} (rows, columns)")
    if not np.isfinite(measured).all():
        row, column = np.argwhere(~np.isfinite(measured))[0]
        raise InputError(f"reading at row {row}, column {column} is {measured[row, column]}; expected finite volts")
    return measured
