"""The exact inverse of a cell with asymmetric branches: it switches itself, and has no thresholds.

Where the resistance of a step rises with the load at its end, whatever the step (``margin`` positive), a reading
has exactly one load, and the inverse is as exact as the model. Real carbon-black silicone that answers unloading
with a rise of resistance has no such cell; there the inverse is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..errors import InputError
from . import _lag as lag
from ._estimators import CERTAIN, LOADS, Doubt, Estimator, Memory
from ._forward import as_m10
from ._models import AsymmetricModel, M10Model
from ._smoothing import Smoother

ACCURACY = 1e-11
"""of full scale, to which a step with a change-over is solved"""
NEWTON_STEPS = 12
"""two or three do at high sample rates, six where a step is many time constants long"""


def margin(model: AsymmetricModel | M10Model, full_scale_kpa: float) -> float:
    """Least slope dr/ds of a fast step, over the slope at equilibrium; positive where the inverse is unique.

    A fast unloading step leaves the branches where they are and breaks chains: a + 2 b s - k.
    """
    m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
    settled = max(m.a + m.b + m.alpha1 + m.alpha2, 1e-9)
    return (m.a + min(0.0, 2 * m.b) - m.k) / settled


@dataclass(frozen=True)
class _ChangeOver:
    """A step of n cells of which a branch may change between charging and discharging; (2, n) are by branch."""

    lead: FloatArray
    """(2, n) by which the branches were behind their targets at first"""
    target: FloatArray
    """(2, n) what they followed at first"""
    alpha: FloatArray
    """(2, 1) targets over load"""
    first_s: FloatArray
    """(2, n) time constants at first"""
    second_s: FloatArray
    """(2, n) and after a change-over"""
    dt_s: FloatArray | float
    kept: FloatArray
    """(2, n) where the branches would end without change-over if the load stayed"""
    follows: FloatArray
    """(2, n) and how much further per step of load"""

    def branches(self, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Branches (2, n) at the end of a step (n,) of load, and their derivatives by it.

        With v = alpha step/dt and q = -lead/(v T1), a branch changes over after T1 log(1 + q), and at the end is
        behind by v T2 (1 - exp(-(time left)/T2)). All is continuous up to the first derivative; the second one is
        (1/T2 - 1/T1)/step times something not negative and at most alpha dt.
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


class InverseEstimator(Estimator):
    """Solves each step of :class:`~.forward.M10Forward` for its load.

    As long as no branch changes between charging and discharging within the step, that is a quadratic equation. A
    branch that does change over is, in terms of the load, convex if it rises faster than it falls, concave else
    (see :class:`_ChangeOver`): Newton's method, from the answer without any change-over, then comes ever closer from
    one side. Where b or opposite branches spoil that, what is left is bracketed.
    """

    def __init__(
        self,
        model: AsymmetricModel | M10Model,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        doubt: Doubt = CERTAIN,
    ) -> None:
        found = margin(model, full_scale_kpa)
        if not found > 0:
            raise InputError(
                "the exact inverse of this cell has more than one answer: the resistance also rises while unloading "
                f"(a + 2 b s - k falls to {found:.2g} of the slope at equilibrium); use another estimator"
            )
        self.model = m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
        self.full_scale_kpa, self._smoother = full_scale_kpa, Smoother(doubt.noise)
        self._alpha = np.array([[m.alpha1], [m.alpha2]])
        self._rise_s, self._fall_s = np.array([[m.rise1_s], [m.rise2_s]]), np.array([[m.fall1_s], [m.fall2_s]])
        steepest = m.a + 2 * max(m.b, 0.0) * LOADS[1] + m.alpha1 + m.alpha2 + m.k
        self._credible = (LOADS[0] * steepest, LOADS[1] * steepest)
        self._constants_s = np.concatenate([self._rise_s, self._fall_s, [[m.tau_s]]])
        super().__init__(shape, rest_resistance_ohm, doubt)

    def _begin(self, r: FloatArray) -> Memory:
        m = self.model
        s = _root(m.b, np.full_like(r, m.a + m.alpha1 + m.alpha2), r)
        return self._memory_of(r, s, self._alpha * s, np.zeros_like(s)) | self._smoother.begin(r)

    def _memory_of(self, r: FloatArray, s: FloatArray, branches: FloatArray, broken: FloatArray) -> Memory:
        found = {"r": r, "pressure_kpa": s * self.full_scale_kpa, "load": s, "branches": branches, "broken": broken}
        return found | self._std()

    def _advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        smoother, r = self._smoother.advance(memory, dt_s, r)
        m, alpha, s0, x = self.model, self._alpha, memory["load"], memory["branches"]
        gone, ramp = lag.weights(dt_s, self._constants_s)  # (5, 1) or (5, n)
        target = alpha * s0
        lead = target - x
        free = memory["broken"] * (1 - gone[4])
        breaking = m.k * (1 - ramp[4])
        ahead = lead > 0
        kept = x + lead * np.where(ahead, gone[:2], gone[2:4])
        slope = m.a + 2 * m.b * s0
        change = r - (m.a + m.b * s0) * s0 - free - kept[0] - kept[1]
        up = change > 0  # r rises with the load, so that this is also the sign of the step
        charging = ahead | ((lead == 0) & up)
        follows = np.where(charging, alpha * ramp[:2], alpha * ramp[2:4])
        slope = slope + np.where(up, breaking, -breaking)
        step = _root(m.b, slope + follows[0] + follows[1], change)
        branches = kept + follows * step
        crossed = np.flatnonzero(((target + alpha * step - branches) * lead < 0).any(axis=0))
        if crossed.size:
            part = {name: memory[name][..., crossed] for name in ("load", "branches", "broken")}
            dt = np.broadcast_to(dt_s, r.shape)[crossed]
            part_dt = dt_s if np.ndim(dt_s) == 0 else dt
            discharging = lead[:, crossed] < 0
            change_over = _ChangeOver(
                lead=lead[:, crossed],
                target=target[:, crossed],
                alpha=alpha,
                first_s=np.where(discharging, self._fall_s, self._rise_s),
                second_s=np.where(discharging, self._rise_s, self._fall_s),
                dt_s=part_dt,
                kept=kept[:, crossed],
                follows=follows[:, crossed],
            )
            bend = (alpha * part_dt * np.abs(1 / self._rise_s - 1 / self._fall_s)).sum(axis=0)
            sums = change[crossed] + kept[0, crossed] + kept[1, crossed]
            found, ends, solved = self._newton(change_over, bend, slope[crossed], sums, step[crossed])
            if not solved.all():
                left = ~solved
                rest = {name: value[..., left] for name, value in part.items()}
                s = self._bracketed(rest, dt[left], r[crossed[left]], rest["load"] + step[crossed[left]])
                found[left] = s - rest["load"]
                ends[:, left] = self._branches(rest, dt[left], s)
            step[crossed], branches[:, crossed] = found, ends
        return self._memory_of(r, s0 + step, branches, free + breaking * np.abs(step)) | smoother

    def _newton(
        self, change_over: _ChangeOver, bend: FloatArray, slope: FloatArray, sums: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Steps of load (n,), branches (2, n) after them, and (n,) whether they have been found.

        Solves slope step + b step^2 + branches = ``sums``, from ``step``. ``bend`` bounds the second derivative of
        the branches times the step.
        """
        b, ends, solved = self.model.b, change_over.kept, np.zeros(step.shape, dtype=bool)
        for _ in range(NEWTON_STEPS):
            ends, rates = change_over.branches(step)
            rate = slope + 2 * b * step + rates[0] + rates[1]
            excess = (slope + b * step) * step + ends[0] + ends[1] - sums
            rises = rate > 1e-6
            move = np.divide(-excess, rate, out=np.zeros_like(rate), where=rises)
            # What a step of Newton's leaves is the next term of Taylor's series.
            solved = rises & ((bend + np.abs(b * step)) * move**2 <= ACCURACY * rate * np.abs(step))
            step, ends = step + move, ends + rates * move
            if solved.all():
                break
        return step, ends, solved

    def _branches(self, memory: Memory, dt_s: FloatArray, s: FloatArray) -> FloatArray:
        """Branches (2, n) after a step to load ``s``, through any change-over."""
        before, after = self._alpha * memory["load"], self._alpha * s
        return lag.asymmetric(memory["branches"], before, after, dt_s, self._rise_s, self._fall_s)

    def _bracketed(self, memory: Memory, dt_s: FloatArray, r: FloatArray, guess: FloatArray) -> FloatArray:
        """Illinois' false position on the step function, which rises with the load."""
        m, s0 = self.model, memory["load"]
        gone, ramp = lag.weights(dt_s, m.tau_s)

        def excess(s: FloatArray) -> FloatArray:
            broken = memory["broken"] * (1 - gone) + m.k * np.abs(s - s0) * (1 - ramp)
            above: FloatArray = (m.a + m.b * s) * s + self._branches(memory, dt_s, s).sum(axis=0) + broken - r
            return above

        # Beyond the top of the curve is no load; readings above it are answered by the top.
        top = -(m.a - m.k) / (2 * m.b) if m.b < 0 else np.inf
        guess = np.minimum(guess, top)
        width = np.maximum(np.abs(guess - s0), 1e-3)
        low, high = guess - width, np.minimum(guess + width, top)
        f_low, f_high = excess(low), excess(high)
        for _ in range(40):
            outside = (f_low > 0) | (f_high < 0)
            if not outside.any():
                break
            width = 2 * width
            low, high = np.where(f_low > 0, low - width, low), np.where(f_high < 0, np.minimum(high + width, top), high)
            f_low, f_high = excess(low), excess(high)
        s, f = guess, excess(guess)
        for _ in range(60):
            if np.abs(f).max() < ACCURACY:
                break
            above = f > 0
            f_low, f_high = np.where(above, 0.5 * f_low, f), np.where(above, f, 0.5 * f_high)
            low, high = np.where(above, low, s), np.where(above, s, high)
            share = np.divide(f_low, f_low - f_high, out=np.full_like(s, 0.5), where=f_low != f_high)
            s = low + (high - low) * np.clip(share, 0, 1)
            f = excess(s)
        return s


def _root(b: float, slope: FloatArray, change: FloatArray) -> FloatArray:
    """The small root of b x^2 + slope x = change; where there is none, the top of the parabola."""
    if b:
        change = np.minimum(change, slope**2 / (-4 * b)) if b < 0 else np.maximum(change, slope**2 / (-4 * b))
    root: FloatArray = 2 * change / (slope + np.sqrt(np.maximum(slope**2 + 4 * b * change, 0)))
    return root
