"""The exact inverse of a cell with asymmetric branches: it switches itself, and has no thresholds.

Where the resistance of a step rises with the load at its end, whatever the step (``margin`` positive), a reading
has exactly one load, and the inverse is as exact as the model. Real carbon-black silicone that answers unloading
with a rise of resistance has no such cell; there the inverse is refused.
"""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from . import lag
from .estimators import Estimator, Memory
from .forward import as_m10
from .lag import FloatArray
from .models import AsymmetricModel, M10Model

ACCURACY = 1e-10
"""of r, to which a step with a change-over is solved"""


def margin(model: AsymmetricModel | M10Model, full_scale_kpa: float) -> float:
    """Least slope dr/ds of a fast step, over the slope at equilibrium; positive where the inverse is unique.

    A fast unloading step leaves the branches where they are and breaks chains: a + 2 b s - k.
    """
    m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
    settled = max(m.a + m.b + m.alpha1 + m.alpha2, 1e-9)
    return (m.a + min(0.0, 2 * m.b) - m.k) / settled


class InverseEstimator(Estimator):
    """Solves each step of :class:`~.forward.M10Forward` for its load.

    As long as no branch changes between charging and discharging within the step, that is a quadratic equation;
    for the cells where one does, the monotone step function is solved by bracketing.
    """

    def __init__(
        self,
        model: AsymmetricModel | M10Model,
        full_scale_kpa: float,
        shape: tuple[int, ...],
        rest_resistance_ohm: FloatArray,
        *,
        std_kpa: float | None = None,
    ) -> None:
        found = margin(model, full_scale_kpa)
        if not found > 0:
            raise InputError(
                "the exact inverse of this cell has more than one answer: the resistance also rises while unloading "
                f"(a + 2 b s - k falls to {found:.2g} of the slope at equilibrium); use another estimator"
            )
        self.model = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
        self.full_scale_kpa, self.std_kpa = full_scale_kpa, std_kpa
        super().__init__(shape, rest_resistance_ohm)

    def _begin(self, r: FloatArray) -> Memory:
        m = self.model
        slope = m.a + m.alpha1 + m.alpha2
        s = _root(m.b, np.full_like(r, slope), r)
        return self._memory_of(r, s, m.alpha1 * s, m.alpha2 * s, np.zeros_like(s))

    def _memory_of(self, r: FloatArray, s: FloatArray, x1: FloatArray, x2: FloatArray, broken: FloatArray) -> Memory:
        memory = {"r": r, "pressure_kpa": s * self.full_scale_kpa, "load": s, "x1": x1, "x2": x2, "broken": broken}
        if self.std_kpa is not None:
            memory["std_kpa"] = np.full(r.shape, self.std_kpa)
        return memory

    def _advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        m, s0 = self.model, memory["load"]
        gone, ramp = lag.weights(dt_s, m.tau_s)
        free = memory["broken"] * (1 - gone)
        breaking = m.k * (1 - ramp)
        held, slope = m.a * s0 + m.b * s0**2 + free, m.a + 2 * m.b * s0
        branches = []
        for x, alpha, rise, fall in (
            (memory["x1"], m.alpha1, m.rise1_s, m.fall1_s),
            (memory["x2"], m.alpha2, m.rise2_s, m.fall2_s),
        ):
            charging = alpha * s0 >= x
            up, up_ramp = lag.weights(dt_s, rise)
            down, down_ramp = lag.weights(dt_s, fall)
            follows = np.where(charging, up_ramp, down_ramp) * alpha
            kept = x + (alpha * s0 - x) * np.where(charging, up, down)
            held, slope = held + kept, slope + follows
            branches.append((alpha, charging, kept, follows))
        change = r - held
        step = _root(m.b, slope + np.sign(change) * breaking, change)
        s = s0 + step
        ends = [kept + follows * step for _, _, kept, follows in branches]
        crossed = np.zeros(r.shape, dtype=bool)
        for (alpha, charging, _, _), end in zip(branches, ends, strict=True):
            crossed |= (alpha * s >= end) != charging
        if crossed.any():
            dt = np.broadcast_to(dt_s, r.shape)[crossed]
            part = {name: value[crossed] for name, value in memory.items()}
            exact = self._bracketed(part, dt, r[crossed], s[crossed])
            x1, x2, broken = self._step(part, dt, exact)
            s, full_broken = s.copy(), free + breaking * np.abs(step)
            s[crossed], ends[0][crossed], ends[1][crossed], full_broken[crossed] = exact, x1, x2, broken
            return self._memory_of(r, s, ends[0], ends[1], full_broken)
        return self._memory_of(r, s, ends[0], ends[1], free + breaking * np.abs(step))

    def _step(self, memory: Memory, dt_s: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Branches and breakage after a step to load ``s``, through any change-over."""
        m, s0 = self.model, memory["load"]
        gone, ramp = lag.weights(dt_s, m.tau_s)
        return (
            lag.asymmetric(memory["x1"], m.alpha1 * s0, m.alpha1 * s, dt_s, m.rise1_s, m.fall1_s),
            lag.asymmetric(memory["x2"], m.alpha2 * s0, m.alpha2 * s, dt_s, m.rise2_s, m.fall2_s),
            memory["broken"] * (1 - gone) + m.k * np.abs(s - s0) * (1 - ramp),
        )

    def _bracketed(self, memory: Memory, dt_s: FloatArray, r: FloatArray, guess: FloatArray) -> FloatArray:
        """Illinois' false position on the step function, which rises with the load."""
        m = self.model

        def excess(s: FloatArray) -> FloatArray:
            return m.a * s + m.b * s**2 + sum(self._step(memory, dt_s, s), np.zeros_like(s)) - r

        width = np.maximum(np.abs(guess - memory["load"]), 1e-3)
        low, high = guess - width, guess + width
        f_low, f_high = excess(low), excess(high)
        for _ in range(40):
            outside = (f_low > 0) | (f_high < 0)
            if not outside.any():
                break
            width = 2 * width
            low, high = np.where(f_low > 0, low - width, low), np.where(f_high < 0, high + width, high)
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
    root: FloatArray = 2 * change / (slope + np.sqrt(np.maximum(slope**2 + 4 * b * change, 0)))
    return root
