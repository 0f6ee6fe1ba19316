"""Nonlinear least squares from several starting points, with a weak prior and standard errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import least_squares

from ..arrays import FloatArray
from ._grid import Grid
from ._kinds import Kind

STARTS = 3
"""of the starts, those that are nearest to the recording, are followed to the end"""
PRIOR = 0.02
"""residual, over the range of r, that a parameter one width from its usual value counts as: what the recording does not
tell stays usual"""
PRIOR_LOG, PRIOR_PLAIN, PRIOR_REST = 1.5, 0.5, 0.1
"""those widths: of the logarithm of a positive parameter, over its bound for one of either sign, and of R0, relative"""
BEGUN = 0.5
"""how far each branch may be from its equilibrium as a recording begins under load, over the range of r"""
FLATTEST = 0.1
"""of the range of r: slope over full scale that the equilibrium curve of m10 should have everywhere"""


def solve(kind: Kind, grid: Grid, starts: list[tuple[float, ...]], lower: float) -> tuple[FloatArray, FloatArray]:
    """Least squares from every start; the best parameters (the offset last) and their covariance."""
    remembered = np.full(kind.begun, BEGUN * kind.size)
    low, high = np.array([*kind.low, *-remembered, -lower]), np.array([*kind.high, *remembered, 0.15])
    positive = low > 0
    fitted = slice(0, grid.fitted)
    load = kind.felt(grid.load[fitted])
    step = 1e-5

    def natural(q: FloatArray) -> FloatArray:
        return np.where(positive.reshape(-1, *(1,) * (q.ndim - 1)), np.exp(np.where(np.abs(q) < 700, q, 0)), q)

    def free(p: FloatArray) -> FloatArray:
        return np.where(positive, np.log(np.where(positive, p, 1.0)), p)

    def responses(q: FloatArray) -> FloatArray:
        p = natural(q)
        fit = kind.run(p[:-1], load, grid.dt_s) + p[-1]
        unusual = PRIOR * spread * (q - centre[:, None]) / width[:, None]
        return np.concatenate([fit, _falling(kind, p) * np.sqrt(grid.fitted) * 0.3, unusual])

    target = np.concatenate([grid.r[fitted], np.zeros(9 + len(low))])

    def residual(q: FloatArray) -> FloatArray:
        left: FloatArray = responses(q[:, None])[:, 0] - target
        return left

    def jacobian(q: FloatArray) -> FloatArray:
        tried = responses(np.column_stack([q, q[:, None] + step * np.eye(len(q))]))
        slopes: FloatArray = (tried[:, 1:] - tried[:, :1]) / step
        return slopes

    bounds = free(low), free(high)
    spread = float(np.ptp(grid.r[fitted]))
    centre = free(np.clip(_padded(kind.starts[0], len(low)), low, high))
    width = np.where(positive, PRIOR_LOG, PRIOR_PLAIN * np.abs(high))
    width[-1] = PRIOR_REST
    best: Any = None
    begins = []
    for start in starts:
        first = np.clip(_padded(start, len(low)), low, high)
        begins.append(np.clip(free(first), bounds[0] + 1e-6, bounds[1] - 1e-6))
    errors = ((responses(np.column_stack(begins)) - target[:, None]) ** 2).sum(axis=0)
    for place in np.argsort(errors)[:STARTS]:
        first = begins[place]
        found = least_squares(residual, first, jacobian, bounds=bounds, x_scale="jac", max_nfev=30)
        if best is None or found.cost < best.cost:
            best = found
    j = best.jac
    left = best.fun[: grid.fitted]
    scale = np.mean(left**2) * _correlation_length(left)
    covariance = np.linalg.pinv(j.T @ j) * scale
    value = natural(best.x)
    unit = np.where(positive, value, 1.0)
    return value, covariance * np.outer(unit, unit)


def _padded(start: tuple[float, ...], count: int) -> FloatArray:
    """Parameters followed by as many zeros as are missing."""
    return np.array([*start, *[0.0] * (count - len(start))])


def _correlation_length(left: FloatArray) -> float:
    """Samples per independent one: model error is not white, and standard errors that say so are wider."""
    around = left - left.mean()
    power = np.abs(np.fft.rfft(around, 2 * len(around))) ** 2
    correlation = np.fft.irfft(power)[: len(around)] / max(float(around @ around), 1e-300)
    until = int(np.argmax(correlation < 0.05)) or len(correlation)
    return float(1 + 2 * np.sum(correlation[1:until]))


def _falling(kind: Kind, p: FloatArray) -> FloatArray:
    """(9, m) how much the equilibrium curve falls short of rising: it is what the static answer rests on."""
    if kind.kind not in ("m10", "whole"):
        return np.zeros((9, p.shape[1]))
    names = dict(zip(kind.names, p, strict=False))
    load = np.linspace(0, 1, 9)[:, None]
    slope = names["a"] + 2 * names["b"] * load + names["alpha1"] + names["alpha2"]
    shortfall: FloatArray = np.minimum(slope - FLATTEST * kind.size, 0.0)
    return shortfall


def predict(kind: Kind, parameters: FloatArray, grid: Grid) -> FloatArray:
    load = kind.felt(grid.load)
    predicted: FloatArray = kind.run(parameters[:-1, None], load, grid.dt_s)[:, 0] + parameters[-1]
    return predicted
