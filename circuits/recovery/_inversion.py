"""The numerics of :mod:`._recover`: conductances that give the readings, and how far off they can be.

What is compared is the conductance that equation (10) makes of a reading, after the model's own offsets are taken
out of it. On a good board that is the cell's own but for a small crosstalk, so that correcting each cell by what its
own reading still lacks gains a digit or more each time and needs no derivatives. Where it gains less, the derivatives
of all readings by all cells (:mod:`._sensitivity`) are factored once, and kept as long as they serve: over the
iterations of a frame, and over the frames of a stream.

How far the cells can be off is what the readings are off, amplified. Of a factorisation at hand the amplification of
each cell is estimated from its answers to random signs: their mean square is the sum of the squares of the cell's row
of the inverse, and 16 of them tell it to a quarter. Where nothing was factored, corrections shrank by a factor rho in
each iteration, so that they add up to 1 / (1 - rho) of what a cell's own reading asks for. On boards whose readings may
be far from their own cells a fast start says little of the slowest error: there the derivatives are factored at once
or, where there are none, the slowest error is looked for by power iteration.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgWarning, lu_factor, lu_solve

from ...arrays import BoolArray, FloatArray
from ...errors import SolverError
from .._board import Board
from .._design import Design
from .._exact import read_exactly
from .._sensitivity import LARGEST, board_sensitivity
from ..solvers import ULP

# By number of cells: error that may be left of each iteration's before the derivatives are factored (anew), and most
# iterations. A factorisation costs as much as 5 evaluations of an 8 x 8, 30 of a 32 x 32 and 300 of a 64 x 64.
_PATIENCE = ((16 * 16, 0.03, 40), (32 * 32, 0.5, 60), (LARGEST, 0.9, 200))
_MOST = 200  # iterations without derivatives
_FEW = 15  # iterations from one frame to a similar one
_NOTHING = 1e-13  # of the largest apparent conductance: smaller ones are rounding
_ROUNDING = 1e-8  # residual below which progress may end by rounding alone, not by a bad direction
_LEAST_STRIDE = 1e-3  # along a path of readings
_LEAST = 1e-300  # S
_LEAST_CHANGE = 1e-6  # relative, of a correction that may still be halved
_PROBES = 6  # evaluations for the slowest error
_PROBE = 1e-4  # relative size of a probe
_SIGNS = 16  # vectors of random signs
_DOUBT = 1e-3  # relative error of cells that are not to be called read for a reason that has no number
_TOO_FAR = 0.1  # relative error over which the derivatives may have changed
_TRIFLE = 1e-6  # relative error that derivatives are good for, whatever happens elsewhere
_SINGULAR = 1e7  # amplification that derivatives in doubles may as well have from their rounding
_CAUTION = 4.0  # by which an estimated amplification is multiplied: errors need not be independent


class Found(NamedTuple):
    """Conductances that give the readings. Arrays are (N, M)."""

    conductance: FloatArray
    """S"""
    target: FloatArray
    """S: apparent conductances, the model's offsets taken out"""
    error: FloatArray
    """S by which the residual and the rounding of the readings can move them; inf where they say nothing"""
    clamped: BoolArray
    """open cells whose reading no conductance gives"""
    residual: float
    iterations: int
    factored: int


class Model:
    """Readings as a function of conductances: the part that the drive makes, and the rest (reference, offsets)."""

    def __init__(self, design: Design) -> None:
        """``design``: outputs at its supply limits are for :meth:`limited` only."""
        self.limited_board = design.board
        unlimited = design.replace(readout={"supply": (-inf, inf)})
        self.board = board = unlimited.board
        self.circuit = board.circuit
        self.has_derivatives = not board.continuous and board.shape[0] * board.shape[1] <= LARGEST
        self.couples = board.circuit.mixes_cells or board.floating or not board.plain or bool(board.shorts)
        """whether readings may be far from their own cells, however light the lines are"""
        self.level, self.drive = board.level, board.drive
        ends = None if board.floating else board.circuit.ends(board)
        self._ends = ends if ends is not None and np.ptp(ends.source) == 0 else None
        self._turned_drive = unlimited.replace(drive={"voltage": -self.drive}).board
        self._has_rest = board.circuit.has_amplifiers and bool(
            board.offset.any() or board.bias.any() or (self.level and np.isfinite(board.gain).any())
        )

    def split(self, conductance: FloatArray) -> tuple[FloatArray, FloatArray | float]:
        """V that the drive makes, and what is there without it; no output has a limit."""
        with np.errstate(divide="ignore"):
            cells = 1.0 / conductance
        volts = read_exactly(self.board, cells)[0].volts
        if not self._has_rest:
            return volts - self.level, self.level
        if self._ends is None:
            other = read_exactly(self._turned_drive, cells)[0].volts
            return (volts - other) / 2, (volts + other) / 2
        # In its own step a cell gets the drive, and in every step all cells of a column get the same source.
        above, source = volts - self._ends.output, float(self._ends.source[0])
        signal = above + source * (above.sum(axis=0) / (self.drive - len(volts) * source))
        return signal, volts - signal

    def limited(self, conductance: FloatArray, volts: FloatArray) -> FloatArray:
        """V of the outputs within their supply, given those that have no limit."""
        low, high = self.limited_board.supply
        if (volts >= low).all() and (volts <= high).all():
            return volts
        with np.errstate(divide="ignore"):
            return read_exactly(self.limited_board, 1.0 / conductance)[0].volts

    def apparent(self, signal: FloatArray) -> FloatArray:
        """Conductance in S that the ideal circuit would need for a signal (N, M) in V; 0 where there is none."""
        return self.circuit.apparent_conductance(self.board, signal)

    def slope(self, signal: FloatArray) -> FloatArray:
        """d(apparent conductance)/d(signal), S/V."""
        return self.circuit.conductance_slope(self.board, signal)

    def log_slope(self, signal: FloatArray) -> FloatArray:
        """d(log apparent conductance)/d(signal), 1/V; 0 where there is no signal."""
        return self.circuit.log_conductance_slope(self.board, signal)


class Factor:
    """Derivatives of all readings by all cells, each in units of its own, factored; cells may be kept out of it."""

    def __init__(
        self, board: Board, conductance: FloatArray, unit: FloatArray, per_volt: FloatArray, live: BoolArray
    ) -> None:
        """Work them out; all arrays are (N, M).

        Args:
            board: without limits, or standing at them.
            conductance: S.
            unit: S of each cell.
            per_volt: units of each reading.
            live: cells that take part.

        """
        with np.errstate(divide="ignore"):
            found = board_sensitivity(board, 1.0 / conductance)
        used = live.ravel()
        self.shape = live.shape
        jacobian = (found.cell_conductance * unit * per_volt[..., None, None]).reshape(used.size, used.size)
        jacobian[~used] = 0.0
        jacobian[:, ~used] = 0.0
        jacobian[~used, ~used] = 1.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)  # singular: solve() finds out
            self._lu = lu_factor(jacobian, overwrite_a=True, check_finite=False)

    def solve(self, off: FloatArray, live: BoolArray) -> FloatArray:
        """Change (N, M) of the live cells for differences ``off`` of the readings."""
        step = self._answers(off.ravel()).reshape(off.shape)
        if not np.isfinite(step).all():
            raise SolverError("the readings do not determine the cells: other resistances would give the same ones")
        return np.where(live, step, 0.0)

    def inverse(self) -> FloatArray:
        """(NM, NM); inf where there is none."""
        inverse = self._answers(np.eye(len(self._lu[0])))
        return np.where(np.isfinite(inverse), inverse, inf)

    def spread(self, errors: FloatArray) -> FloatArray:
        """(K, N, M): about what independent errors of the readings make of the cells, for each of K kinds (K, N, M) of
        them, see the top of this module.
        """
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(errors), _SIGNS, len(self._lu[0])))
        right = (signs * errors.reshape(len(errors), 1, -1)).reshape(-1, len(self._lu[0])).T
        size: FloatArray = np.sqrt((self._answers(right).reshape(-1, len(errors), _SIGNS) ** 2).mean(axis=-1))
        return np.where(np.isfinite(size), size, inf).T.reshape(errors.shape)

    def _answers(self, right: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            answers: FloatArray = lu_solve(self._lu, right, check_finite=False)
        return answers


class Held(NamedTuple):
    """Cells whose conductance is given instead of their reading. Arrays are (N, M)."""

    cells: BoolArray
    conductance: FloatArray
    """S; of the others of no meaning"""

    def put_into(self, conductance: FloatArray) -> FloatArray:
        """``conductance`` with these cells at theirs."""
        return np.where(self.cells, self.conductance, conductance)


class _Solution(NamedTuple):
    conductance: FloatArray
    """S (N, M)"""
    target: FloatArray
    """S (N, M): what the readings say"""
    signal: FloatArray
    """V (N, M): what the model says"""
    rounded: FloatArray
    """V (N, M) that carry the rounding of the readings"""
    residual: float
    """relative, of readings that tell of their cells"""
    clamped: BoolArray
    """(N, M) open cells whose reading no conductance gives"""
    below: float
    """S by which it is off at most"""
    iterations: int
    factored: int


class _Comparison(NamedTuple):
    """The model's readings beside the measured ones, as apparent conductances. Arrays are (N, M)."""

    conductance: FloatArray
    """S, of the cells in the model"""
    signal: FloatArray
    """V that the drive makes"""
    rest: FloatArray | float
    """V that is there without it"""
    reading: FloatArray
    """S, what the model reads"""
    target: FloatArray
    """S, what was measured"""
    error: float
    """largest relative difference of readings that tell of their cells"""

    @property
    def missing(self) -> FloatArray:
        """S that each reading lacks."""
        return self.target - self.reading

    @property
    def live(self) -> BoolArray:
        """Cells that conduct and are read."""
        return np.asarray((self.conductance > 0) & (self.reading > 0))


class _Correction(NamedTuple):
    """Conductances and the relative change that each is to have. Arrays are (N, M)."""

    base: FloatArray
    """S"""
    change: FloatArray

    def halved(self) -> _Correction:
        return _Correction(self.base, self.change / 2)

    def result(self) -> FloatArray:
        """S (N, M)"""
        return self.base * (1.0 + self.change)


@dataclass
class _Progress:
    """How the error of an iteration goes down."""

    last: float = inf
    """error from which the last full correction was made"""
    best: float = inf
    rate: float = 0.0
    """largest ratio of an error to the one before, since the derivatives were factored"""
    _without_gain: int = 0

    def see(self, error: float, *, after_new_factor: bool) -> None:
        """Take the next error."""
        self._without_gain = self._without_gain + 1 if error > 0.95 * self.best else 0
        if self.last < inf and not after_new_factor and not (error > 0.5 * self.last and error <= _ROUNDING):
            self.rate = max(self.rate, error / self.last)
        self.best = min(self.best, error)

    @property
    def stalled(self) -> bool:
        """Whether more than three corrections gained nothing."""
        return self._without_gain > 3


class Inverter:
    """Readings to conductances, frame after frame: starts from the frame before and keeps its factorisation."""

    def __init__(self, model: Model, unread: BoolArray, accuracy: float) -> None:
        """``unread`` (N, M): cells that no reading tells of."""
        self._model, self._unread, self._accuracy = model, unread, accuracy
        patience = (limits[1:] for limits in _PATIENCE if unread.size <= limits[0] and model.has_derivatives)
        self._slow, self._most = next(patience, (inf, _MOST))
        self._start: FloatArray | None = None
        self._held: BoolArray | None = None  # the cells that were held then
        self._factor: Factor | None = None
        self._tried = False  # whether a path of readings has been gone in vain
        self._rate = 0.0  # at which errors shrink with it, at worst
        self._singular = self._probed = False
        self._amplified: FloatArray | None = None  # S (3, N, M): what errors of the readings of size 1 become

    def __call__(self, measured: FloatArray) -> Found:
        """Directly or, where that leads nowhere, along a path of readings from a known frame to the measured one.

        Raises:
            SolverError: nothing was found.

        """
        model, start = self._model, self._start
        apparent = np.where(self._unread, 0.0, model.apparent(measured - model.level))
        found = self._follow(measured, apparent if start is None else start, self._accuracy, self._most)
        if found is None and start is not None:
            self._factor = None
            found = self._follow(measured, apparent, self._accuracy, self._most)
        clamped = found is not None and found.below > 1e3 * self._accuracy * found.target.max()
        if found is None or (clamped and not self._tried):
            self._tried = True
            along = self._along_a_path(measured, apparent)
            if along is not None and (found is None or along.below < found.below):
                found = along
        if found is None:
            self._start = self._factor = None
            raise SolverError(
                "no cell resistances were found that give these readings; check that the design is that of the board, "
                "and that its circuit determines the cells"
            )
        self._start = found.conductance
        # What a cell adds to its own reading must stand out from what the model is uncertain by.
        seen = found.conductance > 10 * max(found.residual, self._accuracy) * found.target
        return Found(
            conductance=np.where(seen, found.conductance, 0.0),
            target=found.target,
            error=self._error(found),
            clamped=found.clamped & (found.below > 1e3 * self._accuracy * found.target.max()),
            residual=found.residual,
            iterations=found.iterations,
            factored=found.factored,
        )

    def _along_a_path(self, measured: FloatArray, apparent: FloatArray) -> _Solution | None:
        """From the readings that the conductances ``apparent`` would give, step by step."""
        signal, rest = self._model.split(apparent)
        origin, here, done, stride, iterations, factored = signal + rest, apparent, 0.0, 0.25, 0, 0
        found: _Solution | None = None
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
        return found and found._replace(iterations=iterations, factored=factored)

    def beside(self, measured: FloatArray, held: Held, start: FloatArray) -> FloatArray | None:
        """The conductances that give the readings of all cells but those ``held``; None if none were found.

        Args:
            measured: (N, M) V.
            held: outputs in their rows may stand at a supply limit.
            start: (N, M) S where to look first, unless a frame before says better.

        """
        if self._held is None or not np.array_equal(self._held, held.cells):
            self._held, self._start, self._factor = held.cells, None, None
        for first in (start,) if self._start is None else (self._start, start):
            try:
                found = self._follow(measured, held.put_into(first), self._accuracy, _FEW, held)
            except SolverError:  # singular on the way
                found = None
            if found is not None:
                self._start = found.conductance
                return found.conductance
            self._start = self._factor = None
        return None

    def _follow(
        self, measured: FloatArray, conductance: FloatArray, accuracy: float, most: int, held: Held | None = None
    ) -> _Solution | None:
        """Correct ``conductance`` until its readings are the measured ones; None if it does not come to that.

        A correction takes what each cell's own reading lacks or, where that gains too little, Newton's step with the
        factored derivatives. A full Newton step that makes things worse is halved until it does not.
        """
        model, factor = self._model, self._factor
        slow = self._slow if held is None or conductance.size <= _PATIENCE[0][0] else inf
        at_once = model.couples and slow < inf
        blind = self._unread if held is None else self._unread | held.cells
        progress, factored, is_new = _Progress(), 0, False
        correction = _Correction(conductance, np.zeros_like(conductance))
        for iteration in range(1, most + 1):
            at = self._compare(measured, conductance, blind, held)
            progress.see(at.error, after_new_factor=is_new)
            if at.error <= accuracy or (progress.stalled and at.error <= _ROUNDING):
                self._keep(factor, progress.rate)
                return self._solution(measured, at, blind, iteration, factored)
            if is_new and at.error > progress.last and np.abs(correction.change).max() > _LEAST_CHANGE:
                correction = correction.halved()
            else:
                is_new = (at.error > slow * progress.last and at.error > _ROUNDING) or (
                    iteration == 1 and factor is None and at_once
                )
                if is_new:
                    board = model.board if held is None else model.limited_board
                    factor = Factor(board, conductance, conductance, model.log_slope(at.signal), at.live)
                    factored, progress.rate = factored + 1, 0.0
                correction = self._correction(at, factor, beside_held=held is not None)
                progress.last = at.error
            conductance = correction.result()
            conductance = conductance if held is None else held.put_into(conductance)
        return None

    def _compare(
        self, measured: FloatArray, conductance: FloatArray, blind: BoolArray, held: Held | None
    ) -> _Comparison:
        """The model's readings beside the measured ones; ``blind`` (N, M): readings that tell nothing of their cell."""
        model = self._model
        signal, rest = model.split(conductance)
        if held is not None:
            signal = model.limited(conductance, signal + rest) - rest
        reading, target = model.apparent(signal), model.apparent(measured - rest)
        reading[blind] = target[blind] = 0.0
        largest = np.maximum(target, reading)
        missing = target - reading
        # What is below rounding of the largest reading tells nothing, and an open cell cannot give less than none:
        # beside held cells less than what others bring into its reading.
        more = target > 0 if held is None else missing > 0
        telling = (largest > _NOTHING * largest.max(initial=0.0)) & (more | (conductance > 0))
        off = np.divide(np.abs(missing), largest, out=np.zeros_like(missing), where=telling)
        return _Comparison(conductance, signal, rest, reading, target, float(off.max(initial=0.0)))

    def _correction(self, at: _Comparison, factor: Factor | None, *, beside_held: bool) -> _Correction:
        """By the derivatives or, without them, by what each cell's own reading lacks."""
        missing, reading, live = at.missing, at.reading, at.live
        if factor is None:
            change = np.divide(missing, np.minimum(at.conductance, reading), out=np.zeros_like(missing), where=live)
        else:
            change = factor.solve(np.divide(missing, reading, out=np.zeros_like(missing), where=live), live)
        change = np.clip(change, -0.9, 6.0)
        # Cells that give no current so far get what is missing; those that should give less than none, none.
        before = 2.0 * at.conductance if beside_held else 0.0
        base = np.where(live, at.conductance, before + np.maximum(missing, 0.0))
        base[(change <= -0.9) & (at.conductance < 1e-3 * at.target)] = 0.0
        base[at.target == 0] = 0.0
        return _Correction(base, change)

    def _keep(self, factor: Factor | None, rate: float) -> None:
        """Remember a factorisation for the frames that follow, and the worst rate of convergence seen with it."""
        if factor is not self._factor:
            self._factor, self._amplified, self._rate, self._singular = factor, None, 0.0, False
        self._rate = max(self._rate, min(rate, 0.999))

    def _solution(
        self, measured: FloatArray, at: _Comparison, blind: BoolArray, iterations: int, factored: int
    ) -> _Solution:
        lacking = self._model.slope(at.signal) * (measured - at.rest - at.signal)
        contradicted = np.where((at.conductance == 0) & ~blind, lacking, 0.0)
        return _Solution(
            conductance=at.conductance,
            target=at.target,
            signal=at.signal,
            rounded=np.abs(measured) + np.abs(at.rest),
            residual=at.error,
            clamped=contradicted != 0,
            below=float(np.abs(contradicted).max()),
            iterations=iterations,
            factored=factored,
        )

    def _error(self, found: _Solution) -> FloatArray:
        """:attr:`Found.error`, by what this inverter remembers."""
        model, conductance, below = self._model, found.conductance, found.below
        reading, slope = model.apparent(found.signal), model.slope(found.signal)
        rounded, largest = found.rounded * np.abs(slope), float(reading.max(initial=0.0)) or 1.0
        if self._factor is None:
            if model.couples and not self._probed:
                self._probed, self._rate = True, max(self._rate, self._probe(conductance, found.signal))
            off = np.maximum(found.residual * reading, 8 * ULP * rounded) + below * self._rate
            error = off * np.maximum(conductance / np.maximum(reading, _LEAST), 1.0)
        else:
            if self._amplified is None:
                unit = np.where(conductance > 0, conductance, np.maximum(reading, 1e-9 * largest))
                factor = Factor(model.board, conductance, unit, slope / unit, ~self._unread)
                kinds = np.array([reading, rounded, conductance == 0])
                spread = factor.spread(kinds / unit)
                self._amplified, self._singular = _CAUTION * unit * spread, bool(spread[0].max() > _SINGULAR)
            sizes = np.array([found.residual, 8 * ULP, below])
            with np.errstate(invalid="ignore"):
                error = np.nan_to_num(sizes[:, None, None] * self._amplified, posinf=inf).sum(axis=0)
        error = error / (1.0 - self._rate)
        # Readings that contradict each other may be of quite other cells, for all that was found. Noise does that, too.
        doubt = min(_CAUTION * below / largest, _DOUBT)
        if not model.has_derivatives and model.board.faults:  # which make couplings that no probe is sure to find
            doubt = _DOUBT
        error = error + doubt * conductance
        own = np.where(conductance > 0, conductance, largest)
        relative = error / own
        if self._singular:  # for all that doubles tell, some cells may be anything: what else would that move?
            relative = np.maximum(relative / (min(float(relative.max()), 1.0) or 1.0), _DOUBT)
        # Where the derivatives themselves do not hold over such an error, nothing is known of what it moves.
        void = (relative > _TRIFLE) & ((relative > _TOO_FAR).any() | (conductance == 0))
        return np.where(void, inf, relative * own)

    def _probe(self, conductance: FloatArray, signal: FloatArray) -> float:
        """At what rate errors of any kind shrink, by power iteration: those that the readings hardly show are not among
        what a solution has left, and where there are no derivatives nothing else tells of them.
        """
        model = self._model
        reading = model.apparent(signal)
        live = (conductance > 0) & (reading > 0)
        error = np.where(live, np.random.default_rng(0).choice([-1.0, 1.0], live.shape), 0.0)
        rate = 0.0
        for _ in range(_PROBES):
            moved, _ = model.split(conductance * (1.0 + _PROBE * error))
            change = (model.apparent(moved) - reading) / _PROBE
            error -= np.divide(change, np.minimum(conductance, reading), out=np.zeros_like(change), where=live)
            rate = float(np.abs(error).max())
            error /= rate or 1.0
        return min(rate, 0.999)
