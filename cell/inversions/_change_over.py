"""A step of the load in which a branch changes between charging and discharging, solved by Newton's method.

As long as no branch changes over, a step is the root of a quadratic equation (:mod:`._inverse`). Where one does,
Newton's method goes on from there within a bracket, and bisection takes a step where it would leave the bracket.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.arrays import FloatArray

ACCURACY = 1e-11
"""of full scale: accuracy of a step with a change-over"""
EVALUATIONS = 16
"""largest number of evaluations of the model in a step with a change-over, which bounds the cost of a frame. Newton's
method needs two or three at high sample rates, six where a step is many time constants long; otherwise bisection halves
the bracket"""


@dataclass(frozen=True)
class ChangeOver:
    """A step of n cells in which a branch may change between charging and discharging; arrays (2, n) are by branch."""

    lead: FloatArray
    """(2, n) targets less branches at the start"""
    target: FloatArray
    """(2, n) targets at the start"""
    alpha: FloatArray
    """(2, 1) targets over load"""
    first_s: FloatArray
    """(2, n) time constants at the start"""
    second_s: FloatArray
    """(2, n) time constants after a change-over"""
    dt_s: float
    kept: FloatArray
    """(2, n) branches at the end, without change-over, if the load stayed"""
    follows: FloatArray
    """(2, n) change of that per unit step of the load"""

    def branches(self, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Branches (2, n) at the end of a step (n,) of the load, and their derivatives by the step.

        With v = alpha step/dt and q = -lead/(v T1), a branch changes over after T1 log(1 + q). At the end it is behind
        its target by v T2 (1 - exp(-(time left)/T2)). The result and its first derivative are continuous. The second
        derivative is (1/T2 - 1/T1)/step times a factor between 0 and alpha dt.
        """
        speed = self.alpha * step / self.dt_s
        turns = self.lead * speed < 0
        since = np.divide(self.lead, speed, out=np.zeros_like(self.lead), where=turns)
        ratio = -since / self.first_s
        left = self.dt_s - self.first_s * np.log1p(ratio)
        turns &= left > 0
        done = -np.expm1(-np.maximum(left, 0) / self.second_s)
        lags = self.second_s * done
        ends = np.where(turns, self.target + self.alpha * step - speed * lags, self.kept + self.follows * step)
        rates = self.alpha * (1 - (lags - (1 - done) * since / (1 + ratio)) / self.dt_s)
        return ends, np.where(turns, rates, self.follows)

    def solved(
        self, change: FloatArray, slope: FloatArray, b: float, step: FloatArray, end: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Solve slope step + b step^2 + branches - kept = change.

        The left side rises with the step and is zero at zero, so that the root lies between zero and the end of the
        range of loads. If the root lies beyond that end, the end is the answer.

        Args:
            change: (n,) r that the step has to explain.
            slope: (n,) dr/ds without the branches.
            b: of the model.
            step: (n,) where to begin.
            end: (n,) the largest step, of the sign of ``change``.

        Returns:
            (n,) steps, and (2, n) branches after them.
        """
        kept, bend = self.kept[0] + self.kept[1], self._bend()
        low, high = np.minimum(end, 0.0), np.maximum(end, 0.0)
        step = np.clip(step, low, high)
        tried = step == end
        for _ in range(EVALUATIONS - 1):
            ends, rates = self.branches(step)
            rate = slope + 2 * b * step + rates[0] + rates[1]
            excess = (slope + b * step) * step + ends[0] + ends[1] - kept - change
            low, high = np.where(excess > 0, low, step), np.where(excess > 0, step, high)
            rises = rate > 1e-6
            move = np.divide(-excess, rate, out=np.zeros_like(rate), where=rises)
            newton = np.clip(step + move, low, high)
            # The error after a Newton step is the next term of the Taylor series.
            next_term = (bend + np.abs(b * step)) * move**2
            small = (next_term <= ACCURACY * rate * np.abs(step)) | (np.abs(move) <= ACCURACY)
            solved = (rises & small) | (low == high)
            if solved.all():
                return newton, ends + rates * (newton - step)
            inside = solved | (rises & (low < newton) & (newton < high))
            to_end = rises & (newton == end) & ~tried
            step = np.where(inside | to_end, newton, 0.5 * (low + high))
            tried |= to_end
        return step, self.branches(step)[0]

    def _bend(self) -> FloatArray:
        """Bound of the sum of both branches' second derivatives by the step, times the step."""
        bend: FloatArray = (self.alpha * self.dt_s * np.abs(1 / self.first_s - 1 / self.second_s)).sum(axis=0)
        return bend
