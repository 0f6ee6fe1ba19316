"""Least squares of one kind of model on a recording: bounds, a weak prior to usual values, several starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import BoolArray, FloatArray
from ._kinds import Kind

STARTS = 3
"""of the starts, those that are nearest to the recording, are followed to the end"""
PRIOR = 0.02
"""residual, over the range of r, that a parameter one width from its usual value counts as: what the recording does not
tell stays usual"""
PRIOR_LOG, PRIOR_PLAIN, PRIOR_REST = 1.5, 0.5, 0.1
"""those widths: of the logarithm of a positive parameter, over its bound for one of either sign, and of R0, relative"""
CURVE_POINTS, FALLING_WEIGHT = 9, 0.3
"""loads at which the equilibrium curve is asked to rise, and the weight of a shortfall beside all samples together"""
STEP = 1e-5
"""of a free parameter, for finite differences"""
BEGUN = 0.5
"""how far from its equilibrium each branch may be as a recording begins, over the range of r"""
FLATTEST = 0.1
"""of the range of r: slope over full scale that the equilibrium curve of m10 should have everywhere"""


@dataclass(frozen=True)
class Grid:
    """A recording on a uniform, thinned time grid, normalised. Arrays are (n,)."""

    dt_s: float
    load: FloatArray
    r: FloatArray
    read: BoolArray
    """where the resistance was read; elsewhere ``r`` is a straight line between readings, which says nothing"""
    fitted: int
    """samples that may count in the fit; the ones after it are predicted"""

    def left(self, predicted: FloatArray, start: int = 0) -> FloatArray:
        """What a prediction (n,) of ``r`` leaves of the readings from a sample on."""
        return np.asarray((predicted - self.r)[start:][self.read[start:]])


def solve(kind: Kind, grid: Grid, starts: list[tuple[float, ...]], lower: float) -> tuple[FloatArray, FloatArray]:
    """Least squares from several starts.

    Args:
        kind: of model.
        grid: the recording.
        starts: parameters to start from; the offset of R0 and what is remembered at first may be missing.
        lower: share by which R0 may be lower than what the recording is relative to.

    Returns:
        The best parameters, the offset of R0 last, and their covariance.
    """
    from scipy.optimize import least_squares

    problem = _Problem(kind, grid, lower)
    begins = problem.nearest(starts)
    best: Any = None
    for begin in begins:
        found = least_squares(
            problem.residual, begin, problem.jacobian, bounds=problem.bounds, x_scale="jac", max_nfev=30
        )
        if best is None or found.cost < best.cost:
            best = found
    left = best.fun[: np.count_nonzero(grid.read[: grid.fitted])]
    scale = np.mean(left**2) * _correlation_length(left)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * scale
    value = problem.natural(best.x)
    unit = np.where(problem.positive, value, 1.0)
    return value, covariance * np.outer(unit, unit)


class _Problem:
    """Residuals of a kind of model on a grid, and their Jacobian.

    Parameters (p,) are those of the kind, what is remembered as the recording begins, and the offset of R0. The solver
    sees them as *free* ones: of those that are positive the logarithm.
    """

    def __init__(self, kind: Kind, grid: Grid, lower: float) -> None:
        """``lower`` is as in :func:`solve`."""
        self._kind, self._dt_s = kind, grid.dt_s
        fitted = slice(0, grid.fitted)
        self._read = np.flatnonzero(grid.read[fitted])
        self._load, r = kind.felt(grid.load[fitted]), grid.r[self._read]
        remembered = np.full(kind.begun, BEGUN * kind.size)
        self._low, self._high = np.array([*kind.low, *-remembered, -lower]), np.array([*kind.high, *remembered, 0.15])
        self.positive = self._low > 0
        self.bounds = self._free(self._low), self._free(self._high)
        self._spread = float(np.ptp(r))
        self._usual = self._free(self._within(kind.starts[0]))
        self._width = np.where(self.positive, PRIOR_LOG, PRIOR_PLAIN * np.abs(self._high))
        self._width[-1] = PRIOR_REST
        self._target = np.concatenate([r, np.zeros(CURVE_POINTS + len(self._low))])

    def natural(self, q: FloatArray) -> FloatArray:
        """Parameters (p, ...) from free ones."""
        positive = self.positive.reshape(-1, *(1,) * (q.ndim - 1))
        return np.where(positive, np.exp(np.where(np.abs(q) < 700, q, 0)), q)

    def nearest(self, starts: list[tuple[float, ...]]) -> list[FloatArray]:
        """The :data:`STARTS` starts that fit best, as free parameters within the bounds."""
        low, high = self.bounds
        begins = [np.clip(self._free(self._within(start)), low + 1e-6, high - 1e-6) for start in starts]
        errors = ((self._responses(np.column_stack(begins)) - self._target[:, None]) ** 2).sum(axis=0)
        return [begins[place] for place in np.argsort(errors)[:STARTS]]

    def residual(self, q: FloatArray) -> FloatArray:
        """What free parameters (p,) leave: of the recording, of a rising equilibrium curve, of the usual values."""
        left: FloatArray = self._responses(q[:, None])[:, 0] - self._target
        return left

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Slopes of :meth:`residual` by finite differences, all parameters in one simulation."""
        tried = self._responses(np.column_stack([q, q[:, None] + STEP * np.eye(len(q))]))
        slopes: FloatArray = (tried[:, 1:] - tried[:, :1]) / STEP
        return slopes

    def _responses(self, q: FloatArray) -> FloatArray:
        """What is compared with the target, for free parameters (p, m)."""
        p = self.natural(q)
        fit = self._kind.run(p[:-1], self._load, self._dt_s)[self._read] + p[-1]
        unusual = PRIOR * self._spread * (q - self._usual[:, None]) / self._width[:, None]
        falling = _falling(self._kind, p) * np.sqrt(len(self._read)) * FALLING_WEIGHT
        return np.concatenate([fit, falling, unusual])

    def _free(self, p: FloatArray) -> FloatArray:
        return np.where(self.positive, np.log(np.where(self.positive, p, 1.0)), p)

    def _within(self, start: tuple[float, ...]) -> FloatArray:
        """Parameters within the bounds; those that are missing are zero."""
        padded = np.array([*start, *[0.0] * (len(self._low) - len(start))])
        clipped: FloatArray = np.clip(padded, self._low, self._high)
        return clipped


def predict(kind: Kind, parameters: FloatArray, grid: Grid) -> FloatArray:
    load = kind.felt(grid.load)
    predicted: FloatArray = kind.run(parameters[:-1, None], load, grid.dt_s)[:, 0] + parameters[-1]
    return predicted


def _correlation_length(left: FloatArray) -> float:
    """Samples per independent one: model error is not white, and standard errors that say so are wider."""
    around = left - left.mean()
    power = np.abs(np.fft.rfft(around, 2 * len(around))) ** 2
    correlation = np.fft.irfft(power)[: len(around)] / max(float(around @ around), 1e-300)
    until = int(np.argmax(correlation < 0.05)) or len(correlation)
    return float(1 + 2 * np.sum(correlation[1:until]))


def _falling(kind: Kind, p: FloatArray) -> FloatArray:
    """(:data:`CURVE_POINTS`, m) how much the equilibrium curve falls short of rising: the static answer rests on it."""
    if kind.kind not in ("m10", "whole"):
        return np.zeros((CURVE_POINTS, p.shape[1]))
    names = dict(zip(kind.names, p, strict=False))
    load = np.linspace(0, 1, CURVE_POINTS)[:, None]
    slope = names["a"] + 2 * names["b"] * load + names["alpha1"] + names["alpha2"]
    shortfall: FloatArray = np.minimum(slope - FLATTEST * kind.size, 0.0)
    return shortfall
