"""Bounded nonlinear least squares (multi-start, weak Gaussian prior) of one kind of model on a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ._kinds import Kind

STARTS = 3
"""number of starts, those nearest to the recording, from which the optimisation runs"""
PRIOR = 0.02
"""residual, over the range of r, of a parameter that is one width off its usual value; parameters that the recording
does not determine thus keep their usual values"""
PRIOR_LOG, PRIOR_PLAIN, PRIOR_REST = 1.5, 0.5, 0.1
"""widths of the prior: of the logarithm of a positive parameter; of a parameter of either sign, over its upper bound;
and of R0, relative"""
CURVE_POINTS, FALLING_WEIGHT = 9, 0.3
"""number of loads at which the equilibrium curve should rise; weight of a shortfall relative to all samples together"""
STEP = 1e-5
"""step of a free parameter, for finite differences"""
BEGUN = 0.5
"""largest initial departure of a branch from its equilibrium, over the range of r"""
FLATTEST = 0.1
"""least slope dr/ds of the equilibrium curve of m10 that is desired at all loads s, over the range of r"""


@dataclass(frozen=True)
class Grid:
    """A recording on a uniform, thinned time grid, normalised. Arrays are (n,)."""

    dt_s: float
    load: FloatArray
    r: FloatArray
    read: BoolArray
    """where the resistance was read; elsewhere ``r`` is interpolated between readings, and does not count"""
    fitted: int
    """number of samples for the fit; later samples are predicted"""

    def left(self, predicted: FloatArray, start: int = 0) -> FloatArray:
        """Residuals of a prediction (n,) of ``r``, from sample ``start`` on, at samples that were read."""
        return np.asarray((predicted - self.r)[start:][self.read[start:]])


def solve(kind: Kind, grid: Grid, starts: list[tuple[float, ...]], lower: float) -> tuple[FloatArray, FloatArray]:
    """Least squares from several starts.

    Args:
        kind: the kind of model.
        grid: the recording.
        starts: parameters to start from; the initial memory and the offset of R0 may be missing.
        lower: fraction by which R0 may be lower than the R0 to which the recording is normalised.

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
    scale = np.mean(left**2) * correlation_length(left)
    covariance = np.linalg.pinv(best.jac.T @ best.jac) * scale
    value = problem.natural(best.x)
    unit = np.where(problem.positive, value, 1.0)
    return value, covariance * np.outer(unit, unit)


class _Problem:
    """Residuals of a kind of model on a grid, and their Jacobian.

    Parameters (p,) are the named ones of the kind, the initial memory, and the offset of R0. The solver works on *free*
    parameters: the logarithms of positive parameters, and the other parameters themselves.
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
        """Residuals for free parameters (p,): of the recording, of a rising equilibrium curve, and of the prior."""
        left: FloatArray = self._responses(q[:, None])[:, 0] - self._target
        return left

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian of :meth:`residual` by finite differences, all parameters in one simulation."""
        tried = self._responses(np.column_stack([q, q[:, None] + STEP * np.eye(len(q))]))
        slopes: FloatArray = (tried[:, 1:] - tried[:, :1]) / STEP
        return slopes

    def _responses(self, q: FloatArray) -> FloatArray:
        """The quantities that are compared with the target, for m sets of free parameters (p, m)."""
        p = self.natural(q)
        fit = self._kind.run(p[:-1], self._load, self._dt_s)[self._read] + p[-1]
        unusual = PRIOR * self._spread * (q - self._usual[:, None]) / self._width[:, None]
        falling = _falling(self._kind, p) * np.sqrt(len(self._read)) * FALLING_WEIGHT
        return np.concatenate([fit, falling, unusual])

    def _free(self, p: FloatArray) -> FloatArray:
        return np.where(self.positive, np.log(np.where(self.positive, p, 1.0)), p)

    def _within(self, start: tuple[float, ...]) -> FloatArray:
        """Parameters clipped to the bounds; missing ones are zero before clipping."""
        padded = np.array([*start, *[0.0] * (len(self._low) - len(start))])
        clipped: FloatArray = np.clip(padded, self._low, self._high)
        return clipped


def predict(kind: Kind, parameters: FloatArray, grid: Grid) -> FloatArray:
    load = kind.felt(grid.load)
    predicted: FloatArray = kind.run(parameters[:-1, None], load, grid.dt_s)[:, 0] + parameters[-1]
    return predicted


def correlation_length(left: FloatArray) -> float:
    """Number of samples per independent sample (integrated autocorrelation time) of residuals (n,).

    The model error is not white, so that standard errors for white residuals would be too small.
    """
    around = left - left.mean()
    power = np.abs(np.fft.rfft(around, 2 * len(around))) ** 2
    correlation = np.fft.irfft(power)[: len(around)] / max(float(around @ around), 1e-300)
    until = int(np.argmax(correlation < 0.05)) or len(correlation)
    return float(1 + 2 * np.sum(correlation[1:until]))


def _falling(kind: Kind, p: FloatArray) -> FloatArray:
    """(:data:`CURVE_POINTS`, m) shortfall of the equilibrium curve's slope below :data:`FLATTEST`; 0 or negative.

    The static inverse needs a rising curve.
    """
    if kind.kind not in ("m10", "whole"):
        return np.zeros((CURVE_POINTS, p.shape[1]))
    names = dict(zip(kind.names, p, strict=False))
    load = np.linspace(0, 1, CURVE_POINTS)[:, None]
    slope = names["a"] + 2 * names["b"] * load + names["alpha1"] + names["alpha2"]
    shortfall: FloatArray = np.minimum(slope - FLATTEST * kind.size, 0.0)
    return shortfall
