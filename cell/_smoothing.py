"""Noise taken out of readings without lag: a straight line through the recent ones, begun afresh when they leave it.

A low-pass would answer late, and an inverse turns lateness into error. Here the newest point of a line fitted to the
readings of the last seconds (older ones count less) stands for the reading: ramps pass without lag, and a change of
direction is noticed by the reading itself, or by the sum of what it and those before it were off in one direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray

Memory = dict[str, FloatArray]

JUMP = 4.0
"""standard deviations of a single reading that begin a new line"""
ALLOWED = 0.75
"""standard deviations that a reading may be off without adding to the sum"""
SUM = 4.0
"""standard deviations of the sum that begin a new line"""
STEADY_S = 0.1
"""in which a reading usually changes by less than its noise: a line through few readings is held flat by that"""
NAMES = ("level", "slope", "std", "count", "age", "age2", "total", "first", "up", "down")


@dataclass(frozen=True)
class Smoother:
    """Of normalised resistance r whose readings have noise of ``noise`` (1 + r); without any they pass as they are."""

    noise: float
    seconds: float = 1.0
    """in which the weight of a reading falls to 1/e"""

    def begin(self, r: FloatArray) -> Memory:
        """The memory of cells that have always read ``r``."""
        zero = np.zeros_like(r)
        if not self.noise:
            return {"std": zero}
        return {name: zero for name in NAMES} | {"level": r, "count": np.ones_like(r)}

    def advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> tuple[Memory, FloatArray]:
        """The memory after the next reading, with the standard deviation "std" of the other: what to take for it."""
        if not self.noise:
            return {"std": memory["std"]}, r
        sigma = self.noise * (1 + np.maximum(memory["level"], 0))
        moved = memory["slope"] * dt_s
        expected = memory["level"] + moved
        off = r - expected
        up = np.maximum(memory["up"] + off / sigma - ALLOWED, 0)
        down = np.maximum(memory["down"] - off / sigma - ALLOWED, 0)
        fresh = (np.abs(off) > JUMP * sigma) | (up > SUM) | (down > SUM)
        keep = np.where(fresh, 0.0, np.exp(-np.asarray(dt_s) / self.seconds))
        # Weighted sums over the readings so far of 1, age, age^2, reading and age times reading; readings relative to
        # what was expected, so that nothing cancels.
        count, age, age2 = memory["count"], memory["age"], memory["age2"]
        total, first = memory["total"] - moved * count, memory["first"] - moved * age
        age2 = keep * (age2 + dt_s * (2 * age + dt_s * count))
        age = keep * (age + dt_s * count)
        first = keep * (first + dt_s * total)
        total = keep * total + off
        count = keep * count + 1
        spread = (age2 + STEADY_S**2) * count - age**2
        slope = (age * total - count * first) / spread
        shift = (total + slope * age) / count
        found = {
            "level": expected + shift,
            "slope": slope,
            "std": sigma * np.sqrt((1 + age**2 / spread) / count),
            "count": count,
            "age": age,
            "age2": age2,
            "total": total - shift * count,
            "first": first - shift * age,
            "up": np.where(fresh, 0.0, up),
            "down": np.where(fresh, 0.0, down),
        }
        return found, found["level"]
