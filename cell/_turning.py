"""The inverse of the paper's cell without thresholds on dr/dt: it goes by the pressure that it finds.

The cell itself changes from one of its two models to the other where the *pressure* turns, not where the resistance
does, which also falls while a load is held. Whether the pressure turned can be asked of the model in force: its own
inverse goes back. That needs no slope, holds for slow ramps as for fast ones, and its one threshold is a pressure.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..arrays import FloatArray
from ._estimators import Memory, TwoModels
from ._smoothing import Smoother

TURN = 0.01
"""of full scale by which the pressure must have gone back"""
SURE = 3.0
"""standard deviations of noise by which it must have done so, and by which an extreme must be passed to count"""
STATES = ("r", "pressure_kpa", "rising", "settled_kpa", "x2", "x3")


class TurningEstimator(TwoModels):
    """The paper's two inverses, changed where the pressure found turns.

    When the pressure has gone back from its extreme by more than what noise and small errors of the model do, the
    estimator returns to the last sample near the extreme, hands over there as the cell did, and takes the time since
    in one step: the cell's states are then as if the turn had been noticed at once.
    """

    @cached_property
    def _smoother(self) -> Smoother:
        return Smoother(self.doubt.noise)

    def _begin(self, r: FloatArray) -> Memory:
        memory = super()._begin(r)
        turn = {f"turn_{name}": memory[name] for name in STATES}
        own = {"since_s": np.zeros_like(r), "extreme_kpa": memory["pressure_kpa"]}
        return memory | turn | own | self._smoother.begin(r)

    def _advance(self, memory: Memory, dt_s: FloatArray | float, r: FloatArray) -> Memory:
        m, turn_kpa = self.model, TURN * self.full_scale_kpa
        smoother, r = self._smoother.advance(memory, dt_s, r)
        rising = memory["rising"] > 0
        found = self._inverted(memory, dt_s, r, rising)
        since, extreme = memory["since_s"] + dt_s, memory["extreme_kpa"]
        unsure = SURE * smoother["std"] * np.where(rising, 1 / (1 / m.eu1_kpa + 1 / m.etau2_kpa), m.e1_kpa)
        sign = np.where(rising, 1.0, -1.0)
        back = sign * (extreme - found["pressure_kpa"])
        turns = back - unsure > turn_kpa
        if turns.any():
            turn = {name: memory[f"turn_{name}"] for name in STATES}
            again = self._inverted(turn, since, r, ~rising)
            found = {name: np.where(turns, again[name], value) for name, value in found.items()}
            sign = np.where(turns, -sign, sign)
        pressure = found["pressure_kpa"]
        further = turns | (sign * (pressure - extreme) > unsure)
        near = further | (back < 0.5 * turn_kpa)
        turn = {f"turn_{name}": np.where(near, found[name], memory[f"turn_{name}"]) for name in STATES}
        own = {
            "since_s": np.where(near, 0.0, since),
            "extreme_kpa": np.where(further, pressure - sign * unsure, extreme),
        }
        return found | turn | own | smoother
