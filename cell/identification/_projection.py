"""Separable least squares by variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973).

A cell's r is linear in its gains once its time constants are given. The gains are therefore eliminated: for every set
of time constants they follow from non-negative linear least squares (Lawson and Hanson), and only the few time
constants are searched for, first on a coarse grid, so that the search does not end in the nearest valley, then by
Gauss-Newton steps from the best places of the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray

STARTS, STARTS_BEFORE_FOLDS = 3, 2
"""places of the grid from which the search goes on: in a fit to a whole recording, and before each fold"""
MOST_POINTS = 2000
"""readings that are compared; the simulation takes all steps of the load"""
OFFSETS = -0.7, 0.15
"""limits of the change of R0 against its reading, relative"""
PRIOR, PRIOR_LOG, PRIOR_REST = 0.02, 1.5, 0.1
"""residual, over the range of r, of a parameter that is one width off its usual value; and the widths: of the logarithm
of a time constant, and of R0 relative to its reading. A parameter that the recording does not determine thus keeps its
usual value"""
RIDGE = 1e-3
"""residual, over the range of r, of a gain that is as large as this range"""
STEP = 1e-4
"""step of the logarithm of a time constant, for finite differences"""


@dataclass(frozen=True)
class Grid:
    """A recording on a uniform time grid, normalised. Arrays are (n,)."""

    dt_s: float
    load: FloatArray
    r: FloatArray
    read: BoolArray
    """where the resistance was read; elsewhere ``r`` is interpolated between readings, and does not count"""

    def compared(self, start: int, end: int) -> IntArray:
        """Places of at most :data:`MOST_POINTS` readings from ``start`` to ``end``."""
        places = np.flatnonzero(self.read[start:end]) + start
        return places[:: max(1, -(-len(places) // MOST_POINTS))]


Columns = Callable[[FloatArray, FloatArray, float], FloatArray]
"""time constants (t, m), load (n,), dt_s -> responses (n, m, g) to unit gains"""


def _as_it_is(load: FloatArray) -> FloatArray:
    return load


@dataclass(frozen=True)
class Group:
    """Parts of a model that share time constants."""

    times: tuple[str, ...]
    grid: tuple[tuple[float, ...], ...]
    """values of each time constant that are tried first"""
    columns: Columns


@dataclass(frozen=True)
class Kind:
    """A model whose r is a sum of gains times responses, which depend on its time constants only."""

    name: str
    gains: tuple[str, ...]
    least: tuple[float, ...]
    """least gains, over the range of r"""
    fixed: Columns
    """responses without time constants"""
    groups: tuple[Group, ...]
    usual_s: tuple[float, ...]
    """usual time constants"""
    low_s: tuple[float, ...]
    high_s: tuple[float, ...]
    felt: Callable[[FloatArray], FloatArray] = _as_it_is
    """the load (n,) as the model takes it"""

    @property
    def times(self) -> tuple[str, ...]:
        """Names of the time constants."""
        return tuple(name for group in self.groups for name in group.times)


@dataclass(frozen=True)
class Solution:
    """The fit of a kind of model."""

    kind: Kind
    times_s: FloatArray
    gains: FloatArray
    free: FloatArray
    """coefficients of the free columns, see :func:`free_columns`; the offset of r comes first"""
    covariance: FloatArray
    """of the logarithms of the time constants, the gains and the free coefficients; empty unless asked for"""
    cost: float

    @property
    def offset(self) -> float:
        """Change of R0 against the R0 by which the recording was normalised, relative."""
        return float(self.free[0])


Free = Callable[[FloatArray], FloatArray]
"""time constants (t,) -> columns (n, f) with coefficients of either sign, of which the first is constant"""


def solve(
    kind: Kind, grid: Grid, until: int, free: Free, *, best: int = STARTS, starts: Sequence[FloatArray] = ()
) -> Solution:
    """Fit a kind to the first ``until`` samples of a recording.

    Args:
        kind: the kind of model.
        grid: the recording.
        until: number of samples.
        free: columns with coefficients of either sign.
        best: number of places of the grid to start from.
        starts: time constants to start from, too.
    """
    from scipy.optimize import least_squares

    problem = _Problem(kind, grid, until, free)
    low, high = np.log(kind.low_s), np.log(kind.high_s)
    begins = [*problem.best_of_grid(best), *(np.log(start) for start in starts)]
    least: Any = None
    for begin in begins:
        found = least_squares(
            problem.residual, begin.clip(low + 1e-9, high - 1e-9), bounds=(low, high), diff_step=[STEP], max_nfev=25
        )
        if least is None or found.cost < least.cost:
            least = found
    return problem.solution(np.exp(least.x))


def predict(solution: Solution, grid: Grid, free: Free, end: int) -> FloatArray:
    """r (end,) of a solution under the load of a recording, with its offset."""
    load = solution.kind.felt(grid.load[:end])
    columns = responses(solution.kind, solution.times_s[:, None], load, grid.dt_s)[:, 0]
    return np.asarray(columns @ solution.gains + free(solution.times_s)[:end] @ solution.free)


def responses(kind: Kind, times_s: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Responses (n, m, g) to unit gains for time constants (t, m)."""
    parts, start = [kind.fixed(times_s, load, dt_s)], 0
    for group in kind.groups:
        stop = start + len(group.times)
        parts.append(group.columns(times_s[start:stop], load, dt_s))
        start = stop
    return np.concatenate(parts, axis=2)


class _Problem:
    """Residuals of the readings up to a sample, with the gains eliminated."""

    def __init__(self, kind: Kind, grid: Grid, until: int, free: Free) -> None:
        self._kind, self._free, self._dt_s = kind, free, grid.dt_s
        self._places = grid.compared(0, until)
        self._load = kind.felt(grid.load[:until])
        self._r = grid.r[self._places]
        low, high = np.percentile(self._r, [0.5, 99.5]) if self._r.size else (0.0, 0.0)
        self._size = max(float(high - low), 1e-9)
        self._prior = PRIOR * self._size
        self._least = self._size * np.array(kind.least)

    def best_of_grid(self, count: int) -> list[FloatArray]:
        """Logarithms of the ``count`` best sets of time constants of the grid."""
        if not count:
            return []
        kind, places = self._kind, self._places
        nothing = np.zeros((0, 1))
        fixed = kind.fixed(nothing, self._load, self._dt_s)[places, 0]
        atoms, tables = [], []
        for group in kind.groups:
            times = np.array(list(product(*group.grid))).T
            atoms.append(times)
            tables.append(group.columns(times, self._load, self._dt_s)[places])
        usual = np.array(kind.usual_s)
        free = self._free(usual)[: len(self._load)][places]
        everything = np.concatenate(
            [free, fixed, *(table.reshape(len(places), -1) for table in tables), self._r[:, None]], axis=1
        )
        gram = everything.T @ everything
        begin = free.shape[1] + fixed.shape[1]
        offsets = np.cumsum([begin, *(table.shape[1] * table.shape[2] for table in tables)])
        found = []
        for choice in product(*(range(times.shape[1]) for times in atoms)):
            columns = list(range(begin))
            for place, table, offset in zip(choice, tables, offsets, strict=False):
                width = table.shape[2]
                columns += range(offset + place * width, offset + (place + 1) * width)
            cost = self._projected(gram[np.ix_(columns, columns)], gram[columns, -1], free.shape[1])[1]
            found.append((cost, choice))
        found.sort(key=lambda pair: pair[0])
        return [
            np.log(np.concatenate([times[:, place] for times, place in zip(atoms, choice, strict=True)]))
            for _, choice in found[:count]
        ]

    def _projected(self, gram: FloatArray, moments: FloatArray, free: int) -> tuple[FloatArray, float]:
        """Coefficients, the first ``free`` of either sign and the others above their limits; and the cost less r'r."""
        ridge = np.full(len(moments), RIDGE**2)
        ridge[0] = (self._prior / PRIOR_REST) ** 2
        gram = gram + np.diag(ridge)
        both = self._coefficients(gram, moments, free)
        if not OFFSETS[0] <= both[0] <= OFFSETS[1]:
            offset = float(np.clip(both[0], *OFFSETS))
            both[0] = offset
            both[1:] = self._coefficients(gram[1:, 1:], moments[1:] - offset * gram[1:, 0], free - 1)
        return both, float(both @ gram @ both - 2 * both @ moments)

    def _coefficients(self, gram: FloatArray, moments: FloatArray, free: int) -> FloatArray:
        """The coefficients by their normal equations."""
        from scipy.optimize import nnls

        moments = moments - gram[:, free:] @ self._least
        own = gram[:free, :free]
        eliminated = np.linalg.solve(own, np.column_stack([gram[:free, free:], moments[:free]]))
        rest = gram[free:, free:] - gram[free:, :free] @ eliminated[:, :-1]
        target = moments[free:] - gram[free:, :free] @ eliminated[:, -1]
        scale = np.sqrt(np.maximum(np.diag(rest), 1e-300))
        values, vectors = np.linalg.eigh(rest / np.outer(scale, scale))
        root = np.sqrt(np.maximum(values, 1e-12))
        gains, _ = nnls(root[:, None] * vectors.T, (vectors.T @ (target / scale)) / root)
        gains = gains / scale
        return np.concatenate([eliminated[:, -1] - eliminated[:, :-1] @ gains, gains + self._least])

    def _design(self, times_s: FloatArray) -> tuple[FloatArray, int]:
        """Columns of the readings, the free ones first, and how many are free."""
        free = self._free(times_s)[: len(self._load)][self._places]
        columns = responses(self._kind, times_s[:, None], self._load, self._dt_s)[self._places, 0]
        return np.concatenate([free, columns], axis=1), free.shape[1]

    def residual(self, log_times: FloatArray) -> FloatArray:
        """Residuals of the readings and of the prior, for the best gains."""
        design, free = self._design(np.exp(log_times))
        both, _ = self._projected(design.T @ design, design.T @ self._r, free)
        unusual = (log_times - np.log(self._kind.usual_s)) / PRIOR_LOG
        return np.concatenate([design @ both - self._r, self._prior * unusual, [self._prior / PRIOR_REST * both[0]]])

    def solution(self, times_s: FloatArray) -> Solution:
        """The solution for given time constants, with its covariance."""
        design, free = self._design(times_s)
        both, _ = self._projected(design.T @ design, design.T @ self._r, free)
        left = design @ both - self._r
        slopes = []
        for place in range(len(times_s)):
            other = times_s.copy()
            other[place] *= np.exp(STEP)
            slopes.append((self._design(other)[0] - design) @ both / STEP)
        jacobian = np.column_stack([*slopes, design[:, free:], design[:, :free]])
        weight = np.zeros(jacobian.shape[1])
        weight[: len(times_s)] = (self._prior / PRIOR_LOG) ** 2
        weight[len(times_s) :] = RIDGE**2
        noise = float(np.mean(left**2)) * correlation_length(left)
        covariance = np.linalg.pinv(jacobian.T @ jacobian + np.diag(weight), hermitian=True) * noise
        return Solution(self._kind, times_s, both[free:], both[:free], covariance, float(left @ left))


def correlation_length(left: FloatArray) -> float:
    """Number of samples per independent sample (integrated autocorrelation time) of residuals (n,).

    The model error is not white, so that standard errors for white residuals would be too small.
    """
    around = left - left.mean()
    power = np.abs(np.fft.rfft(around, 2 * len(around))) ** 2
    correlation = np.fft.irfft(power)[: len(around)] / max(float(around @ around), 1e-300)
    until = int(np.argmax(correlation < 0.05)) or len(correlation)
    return float(1 + 2 * np.sum(correlation[1:until]))
