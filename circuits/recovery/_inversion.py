"""Fixed-point iteration and Newton's method with a frozen Jacobian: conductances from readings, with error bounds.

This module is the numerical part of :mod:`._recover`.

Unknowns and equations
----------------------
Readings are compared as apparent conductances. The apparent conductance of a reading is the one from equation (10) of
the paper, after the offsets of the model are subtracted from the reading. On a good board the apparent conductance of
a cell equals its true conductance except for a small crosstalk.

Iteration
---------
1. Fixed-point iteration: each cell is corrected by the difference between its own measured and modelled apparent
   conductance. With small crosstalk each iteration gains at least one digit, and no derivatives are needed.
2. Newton's method with a frozen Jacobian (the chord or simplified Newton method; Kelley, "Iterative Methods for Linear
   and Nonlinear Equations", 1995, chapter 5): used where the fixed-point iteration converges too slowly. The
   derivatives of all readings by all cells come from the adjoint method (:mod:`.._sensitivity`). Their LU
   factorisation is kept while it converges fast enough, also over the following frames of a stream.
3. Homotopy (continuation in the readings): used where both methods fail. The readings move in steps from a solved
   frame to the measured one.

Error bounds
------------
The error of the cells is the error of the readings times an amplification.

With a factored Jacobian J, the amplification of a cell is the norm of its row of the inverse of J (:mod:`._jacobian`).

Without a Jacobian, let rho be the ratio of successive corrections. The remaining corrections then sum to at most
1 / (1 - rho) times the present one (geometric series).

On strongly coupled boards early convergence can hide one slow mode. We therefore factor the Jacobian at once. Where no
derivatives are available, we estimate the rate of the slow mode by power iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from .._sensitivity import LARGEST
from ..solvers import ULP
from ._frame_model import Model
from ._jacobian import Factor

# Each entry: largest number of cells, slowest accepted ratio of successive errors, largest number of iterations. Slower
# convergence leads to a new Jacobian. The ratio grows with the array, because a factorisation costs as much as 5 model
# evaluations of an 8 x 8 array, 30 of a 32 x 32 array and 300 of a 64 x 64 array.
_PATIENCE_BY_SIZE = ((16 * 16, 0.03, 40), (32 * 32, 0.5, 60), (LARGEST, 0.9, 200))
_MOST_FIXED_POINT = 200  # iterations where no derivatives are available
_MOST_BESIDE = 15  # iterations from one solution to a similar one
_ROUNDING_SHARE = 1e-13  # share of the largest apparent conductance below which a reading is rounding
_ROUNDING_RESIDUAL = 1e-8  # relative residual below which a stall counts as rounding, not as a bad direction
_LEAST_STRIDE = 1e-3  # smallest step of the homotopy, as a share of the whole path
_LEAST_CONDUCTANCE = 1e-300  # S: avoids a division by zero
_LEAST_CHANGE = 1e-6  # relative size below which a correction is not halved again
_PROBES = 6  # power iterations for the slowest mode
_PROBE = 1e-4  # relative change of the cells in a power iteration
_DOUBT = 1e-3  # relative error assigned to cells of unreliable solutions; too large for the status READ
_LINEAR_RANGE = 0.1  # relative error above which the linearisation is not trusted
_SURELY_LINEAR = 1e-6  # relative error below which the linearisation is always trusted
_SINGULAR = 1e7  # amplification above which rounding in double precision may hide a singular Jacobian
_CAUTION = 4.0  # safety factor on an estimated amplification, because errors need not be independent


class Found(NamedTuple):
    """Conductances that reproduce the readings, with error bounds. Arrays are (N, M)."""

    conductance: FloatArray
    """S"""
    target: FloatArray
    """S: measured apparent conductances, after subtraction of the model's offsets"""
    error: FloatArray
    """S: error bound from the residual and the rounding of the readings; inf where there is no bound"""
    clamped: BoolArray
    """cells set to zero although their reading asks for a negative conductance"""
    residual: float
    iterations: int
    factored: int


class Held(NamedTuple):
    """Cells with a prescribed conductance, whose readings are ignored. Arrays are (N, M)."""

    cells: BoolArray
    conductance: FloatArray
    """S; only the values of the held cells are used"""

    def put_into(self, conductance: FloatArray) -> FloatArray:
        """``conductance`` (N, M) in S with the prescribed values of the held cells."""
        return np.where(self.cells, self.conductance, conductance)


class _Solution(NamedTuple):
    conductance: FloatArray
    """S (N, M)"""
    target: FloatArray
    """S (N, M): measured apparent conductance"""
    signal: FloatArray
    """V (N, M): modelled signal"""
    rounded: FloatArray
    """V (N, M): sum of magnitudes that scales the rounding error of each reading"""
    residual: float
    """largest relative difference of the readings that determine their cells"""
    clamped: BoolArray
    """(N, M) cells at zero whose measured and modelled readings differ"""
    contradiction: float
    """S: largest such difference, as an apparent conductance"""
    iterations: int
    factored: int


class _Comparison(NamedTuple):
    """Modelled and measured readings as apparent conductances. Arrays are (N, M)."""

    conductance: FloatArray
    """S of the cells in the model"""
    signal: FloatArray
    """V: modelled part that is proportional to the drive"""
    rest: FloatArray | float
    """V: modelled part without the drive"""
    reading: FloatArray
    """S: modelled apparent conductance"""
    target: FloatArray
    """S: measured apparent conductance"""
    error: float
    """largest relative difference of the readings that determine their cells"""

    @property
    def missing(self) -> FloatArray:
        """Measured minus modelled apparent conductance in S."""
        return self.target - self.reading

    @property
    def live(self) -> BoolArray:
        """Cells that conduct and whose modelled reading is positive."""
        return np.asarray((self.conductance > 0) & (self.reading > 0))


class _Correction(NamedTuple):
    """A step of the iteration: conductances and their relative changes. Arrays are (N, M)."""

    base: FloatArray
    """S"""
    change: FloatArray

    def halved(self) -> _Correction:
        return _Correction(self.base, self.change / 2)

    def result(self) -> FloatArray:
        """Conductances in S (N, M) after the step."""
        return self.base * (1.0 + self.change)


@dataclass
class _Progress:
    """Convergence history of an iteration."""

    last: float = inf
    """error before the last full correction"""
    best: float = inf
    """smallest error so far"""
    rate: float = 0.0
    """largest ratio of successive errors since the Jacobian was factored"""
    _without_gain: int = 0

    def see(self, error: float, *, after_new_factor: bool) -> None:
        """Record the next error."""
        self._without_gain = self._without_gain + 1 if error > 0.95 * self.best else 0
        if self.last < inf and not after_new_factor and not (error > 0.5 * self.last and error <= _ROUNDING_RESIDUAL):
            self.rate = max(self.rate, error / self.last)
        self.best = min(self.best, error)

    @property
    def stalled(self) -> bool:
        """Whether more than three successive corrections reduced the best error by less than 5 %."""
        return self._without_gain > 3


class Inverter:
    """Solver for a stream of frames: starts from the previous solution and reuses its factored Jacobian."""

    def __init__(self, model: Model, unread: BoolArray, accuracy: float) -> None:
        """Prepare the solver.

        Args:
            model: the forward model.
            unread: (N, M), cells that no reading depends on.
            accuracy: relative residual at which the iteration stops.

        """
        self._model, self._unread, self._accuracy = model, unread, accuracy
        patience = (limits[1:] for limits in _PATIENCE_BY_SIZE if unread.size <= limits[0] and model.has_derivatives)
        self._slowest_rate, self._most_iterations = next(patience, (inf, _MOST_FIXED_POINT))
        self._start: FloatArray | None = None
        self._held: BoolArray | None = None  # held cells of that solution
        self._factor: Factor | None = None
        self._homotopy_tried = False  # whether the homotopy was tried before
        self._rate = 0.0  # largest ratio of successive errors with this factor
        self._singular = self._probed = False
        self._amplified: FloatArray | None = None  # S (3, N, M) per unit error of the readings, see _error()

    def __call__(self, measured: FloatArray) -> Found:
        """Solve for the conductances of one frame, by homotopy if the direct iteration fails.

        Args:
            measured: V (N, M).

        Raises:
            SolverError: no conductances were found that reproduce the readings.

        """
        model, start = self._model, self._start
        apparent = np.where(self._unread, 0.0, model.apparent(measured - model.level))
        found = self._iterate(measured, apparent if start is None else start, self._accuracy, self._most_iterations)
        if found is None and start is not None:
            self._factor = None
            found = self._iterate(measured, apparent, self._accuracy, self._most_iterations)
        clamped = found is not None and found.contradiction > 1e3 * self._accuracy * found.target.max()
        if found is None or (clamped and not self._homotopy_tried):
            self._homotopy_tried = True
            along = self._by_homotopy(measured, apparent)
            if along is not None and (found is None or along.contradiction < found.contradiction):
                found = along
        if found is None:
            self._start = self._factor = None
            raise SolverError(
                "no cell resistances were found that give these readings; check that the design is that of the board, "
                "and that its circuit determines the cells"
            )
        self._start = found.conductance
        # A conductance below the uncertainty of its own apparent conductance is set to zero.
        seen = found.conductance > 10 * max(found.residual, self._accuracy) * found.target
        return Found(
            conductance=np.where(seen, found.conductance, 0.0),
            target=found.target,
            error=self._error(found),
            clamped=found.clamped & (found.contradiction > 1e3 * self._accuracy * found.target.max()),
            residual=found.residual,
            iterations=found.iterations,
            factored=found.factored,
        )

    def _by_homotopy(self, measured: FloatArray, apparent: FloatArray) -> _Solution | None:
        """Homotopy: the readings move in steps from those of the conductances ``apparent`` to ``measured``.

        A step that fails is halved; the step after a success is 1.5 times as long.
        """
        signal, rest = self._model.split(apparent)
        origin, here, done, stride, iterations, factored = signal + rest, apparent, 0.0, 0.25, 0, 0
        found: _Solution | None = None
        while stride > _LEAST_STRIDE and done < 1:
            goal = min(1.0, done + stride)
            last = goal == 1
            between = measured if last else origin + goal * (measured - origin)
            found = self._iterate(between, here, self._accuracy if last else 1e-4, 12)
            if found is None:
                stride /= 2
            else:
                here, done, stride = found.conductance, goal, 1.5 * stride
                iterations, factored = iterations + found.iterations, factored + found.factored
        return found and found._replace(iterations=iterations, factored=factored)

    def beside(self, measured: FloatArray, held: Held, start: FloatArray) -> FloatArray | None:
        """Solve for the cells other than those ``held``, from their own readings.

        Args:
            measured: (N, M) V.
            held: cells with prescribed conductance. Outputs may be at a supply limit.
            start: (N, M) S, initial values. The previous solution with the same held cells is tried before.

        Returns:
            Conductances in S (N, M), or None if none were found.

        """
        if self._held is None or not np.array_equal(self._held, held.cells):
            self._held, self._start, self._factor = held.cells, None, None
        for first in (start,) if self._start is None else (self._start, start):
            try:
                found = self._iterate(measured, held.put_into(first), self._accuracy, _MOST_BESIDE, held)
            except SolverError:  # singular Jacobian
                found = None
            if found is not None:
                self._start = found.conductance
                return found.conductance
            self._start = self._factor = None
        return None

    def _iterate(
        self, measured: FloatArray, conductance: FloatArray, accuracy: float, most: int, held: Held | None = None
    ) -> _Solution | None:
        """Iterate from ``conductance`` until the modelled readings agree with the measured ones.

        Each iteration is a fixed-point correction or, if these converge too slowly, a Newton step with the factored
        Jacobian. The first step with a new Jacobian is damped: it is halved until the error no longer grows.

        Args:
            measured: V (N, M).
            conductance: S (N, M), initial values.
            accuracy: relative residual at which the iteration stops.
            most: largest number of iterations.
            held: cells with prescribed conductance.

        Returns:
            The solution, or None if the iteration did not converge.

        Raises:
            SolverError: the Jacobian is singular.

        """
        model, factor = self._model, self._factor
        slowest_rate = self._slowest_rate if held is None or conductance.size <= _PATIENCE_BY_SIZE[0][0] else inf
        at_once = model.couples and slowest_rate < inf
        ignored = self._unread if held is None else self._unread | held.cells
        progress, factored, is_new = _Progress(), 0, False
        correction = _Correction(conductance, np.zeros_like(conductance))
        for iteration in range(1, most + 1):
            at = self._compare(measured, conductance, ignored, held)
            progress.see(at.error, after_new_factor=is_new)
            if at.error <= accuracy or (progress.stalled and at.error <= _ROUNDING_RESIDUAL):
                self._keep(factor, progress.rate)
                return self._solution(measured, at, ignored, iteration, factored)
            if is_new and at.error > progress.last and np.abs(correction.change).max() > _LEAST_CHANGE:
                correction = correction.halved()
            else:
                is_new = (at.error > slowest_rate * progress.last and at.error > _ROUNDING_RESIDUAL) or (
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
        self, measured: FloatArray, conductance: FloatArray, ignored: BoolArray, held: Held | None
    ) -> _Comparison:
        """Compare modelled and measured readings, except at cells ``ignored`` (N, M)."""
        model = self._model
        signal, rest = model.split(conductance)
        if held is not None:
            signal = model.limited(conductance, signal + rest) - rest
        reading, target = model.apparent(signal), model.apparent(measured - rest)
        reading[ignored] = target[ignored] = 0.0
        largest = np.maximum(target, reading)
        missing = target - reading
        # Two kinds of readings do not count in the error: those that are rounding compared with the largest one, and
        # those of open cells that ask for a negative conductance. With held cells, an open cell may have a reading from
        # crosstalk alone, so the difference decides instead of the measured value.
        more = target > 0 if held is None else missing > 0
        telling = (largest > _ROUNDING_SHARE * largest.max(initial=0.0)) & (more | (conductance > 0))
        off = np.divide(np.abs(missing), largest, out=np.zeros_like(missing), where=telling)
        return _Comparison(conductance, signal, rest, reading, target, float(off.max(initial=0.0)))

    def _correction(self, at: _Comparison, factor: Factor | None, *, beside_held: bool) -> _Correction:
        """Newton step with ``factor``, or a fixed-point correction if ``factor`` is None."""
        missing, reading, live = at.missing, at.reading, at.live
        if factor is None:
            change = np.divide(missing, np.minimum(at.conductance, reading), out=np.zeros_like(missing), where=live)
        else:
            change = factor.solve(np.divide(missing, reading, out=np.zeros_like(missing), where=live), live)
        change = np.clip(change, -0.9, 6.0)
        # Cells without a modelled reading start at the missing conductance. Cells that would become negative get zero.
        before = 2.0 * at.conductance if beside_held else 0.0
        base = np.where(live, at.conductance, before + np.maximum(missing, 0.0))
        base[(change <= -0.9) & (at.conductance < 1e-3 * at.target)] = 0.0
        base[at.target == 0] = 0.0
        return _Correction(base, change)

    def _keep(self, factor: Factor | None, rate: float) -> None:
        """Keep the factorisation for the following frames, with its slowest rate of convergence."""
        if factor is not self._factor:
            self._factor, self._amplified, self._rate, self._singular = factor, None, 0.0, False
        self._rate = max(self._rate, min(rate, 0.999))

    def _solution(
        self, measured: FloatArray, at: _Comparison, ignored: BoolArray, iterations: int, factored: int
    ) -> _Solution:
        lacking = self._model.slope(at.signal) * (measured - at.rest - at.signal)
        contradicted = np.where((at.conductance == 0) & ~ignored, lacking, 0.0)
        return _Solution(
            conductance=at.conductance,
            target=at.target,
            signal=at.signal,
            rounded=np.abs(measured) + np.abs(at.rest),
            residual=at.error,
            clamped=contradicted != 0,
            contradiction=float(np.abs(contradicted).max()),
            iterations=iterations,
            factored=factored,
        )

    def _error(self, found: _Solution) -> FloatArray:
        """Error bounds in S (N, M) for :attr:`Found.error`, see the module docstring."""
        model, conductance, contradiction = self._model, found.conductance, found.contradiction
        reading, slope = model.apparent(found.signal), model.slope(found.signal)
        rounded, largest = found.rounded * np.abs(slope), float(reading.max(initial=0.0)) or 1.0
        if self._factor is None:
            if model.couples and not self._probed:
                self._probed, self._rate = True, max(self._rate, self._slowest_mode_rate(conductance, found.signal))
            off = np.maximum(found.residual * reading, 8 * ULP * rounded) + contradiction * self._rate
            error = off * np.maximum(conductance / np.maximum(reading, _LEAST_CONDUCTANCE), 1.0)
        else:
            if self._amplified is None:
                unit = np.where(conductance > 0, conductance, np.maximum(reading, 1e-9 * largest))
                factor = Factor(model.board, conductance, unit, slope / unit, ~self._unread)
                kinds = np.array([reading, rounded, conductance == 0])
                spread = factor.spread(kinds / unit)
                self._amplified, self._singular = _CAUTION * unit * spread, bool(spread[0].max() > _SINGULAR)
            sizes = np.array([found.residual, 8 * ULP, contradiction])
            with np.errstate(invalid="ignore"):
                error = np.nan_to_num(sizes[:, None, None] * self._amplified, posinf=inf).sum(axis=0)
        error = error / (1.0 - self._rate)
        # Readings that contradict each other may belong to a different solution. Noise can also cause a contradiction.
        doubt = min(_CAUTION * contradiction / largest, _DOUBT)
        if (
            not model.has_derivatives and model.board.faults
        ):  # faults can couple cells in ways that the power iteration may miss
            doubt = _DOUBT
        error = error + doubt * conductance
        own = np.where(conductance > 0, conductance, largest)
        relative = error / own
        if self._singular:  # a null vector within rounding: scale the errors so that the largest is 1
            relative = np.maximum(relative / (min(float(relative.max()), 1.0) or 1.0), _DOUBT)
        # The bounds are linear. If some error exceeds the range of the linearisation, only tiny bounds are kept.
        void = (relative > _SURELY_LINEAR) & ((relative > _LINEAR_RANGE).any() | (conductance == 0))
        return np.where(void, inf, relative * own)

    def _slowest_mode_rate(self, conductance: FloatArray, signal: FloatArray) -> float:
        """Convergence rate of the slowest mode of the fixed-point iteration, by power iteration.

        Readings hardly show the slowest mode, so the residual of a solution can be small while this mode is not. Where
        no derivatives are available, power iteration is the only way to find the mode.
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
