"""A steady drift of the rest resistance R0, fitted together with all parameters of a cell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import FloatArray
from . import _simulate as simulate
from ._grid import Task
from ._kinds import Kind
from ._least_squares import predict, solve

DRIFTS = 1.0
"""share of R0 up to which a drift over the recording is looked for, either way"""
NOISY = 0.1
"""of the variance of noise: squared error beyond noise that is too little for a drift to explain"""
Richer = Callable[[tuple[float, ...]], tuple[float, ...]]
"""a solution as one of the richer kind that is fitted next"""


@dataclass(frozen=True)
class Drift:
    """A steady change of R0 from the begin of a recording to its end, fitted with all the rest of a model."""

    share: float
    """of R0 at the begin"""
    std_error: float
    unexplained: float
    """squared error beyond noise that the model with the drift leaves, over that of the model without; 1 where the
    latter leaves hardly more than noise"""


def find_drift(models: Sequence[tuple[Kind, tuple[float, ...], Richer]], task: Task) -> Drift:
    """Fit a steady drift of R0 together with every parameter of the last, richest model.

    A drift changes the readings at rest and under load by the same share. Creep mostly does not. A slow branch can
    nevertheless take up much of a drift. Each model therefore begins from the simpler one's optimum with a drift, too.

    Args:
        models: each contains the one before: how it is fitted, its optimum without a drift, and that optimum as the
            parameters of the next one.
        task: what is fitted.
    """
    grid = task.grid(np.inf, np.inf)
    nested: list[tuple[float, ...]] = []
    for kind, found, richer in models:
        count = len(kind.names)
        drifting = _drifting(kind)
        starts = [drifting.starts[0], _with_drift(found, count, 0.0), *nested]
        fitted, covariance = solve(drifting, grid, starts, task.lower)
        noise = simulate.white_noise(grid.r) ** 2
        without = float(np.mean((predict(kind, np.array(found), grid) - grid.r) ** 2)) - noise
        left = float(np.mean((predict(drifting, fitted, grid) - grid.r) ** 2)) - noise
        unexplained = max(left, 0.0) / without if without > NOISY * noise else 1.0
        drift = Drift(float(fitted[count]), float(np.sqrt(covariance[count, count])), unexplained)
        plain = richer(tuple(np.delete(fitted, count).tolist()))
        nested = [_with_drift(plain, count + len(plain) - len(found), drift.share)]
    return drift


def _drifting(kind: Kind) -> Kind:
    """The same kind of cells with a drift of R0 as one more parameter, after those with names."""
    count = len(kind.names)

    def run(parameters: FloatArray, load: FloatArray, dt: float) -> FloatArray:
        r = kind.run(np.delete(parameters, count, axis=0), load, dt)
        return _drifted(parameters[count], r)

    return replace(
        kind,
        names=(*kind.names, "drift"),
        low=(*kind.low, -DRIFTS),
        high=(*kind.high, DRIFTS),
        starts=tuple((*start, 0.0) for start in kind.starts),
        run=run,
    )


def _with_drift(solution: tuple[float, ...], count: int, share: float) -> tuple[float, ...]:
    """A solution with a drift after its ``count`` parameters with names."""
    return *solution[:count], share, *solution[count:]


def _drifted(drift: FloatArray, r: FloatArray) -> FloatArray:
    """r (n, m), relative to R0 at the begin, of cells whose R0 changes steadily by a share ``drift`` (m,) of it."""
    return np.asarray((1 + r) * (1 + np.linspace(0, 1, len(r))[:, None] * drift) - 1)
