"""Memory rows of :class:`._turning.TurningInversion` by name, and scratch arrays, so that a frame allocates few."""

from __future__ import annotations

import numpy as np

from ...arrays import FloatArray
from . import _turning_loops as loops
from ._paper_steps import TurnWeights
from ._turning_loops import (
    BEFORE_LAST,
    DRIFT_KPA,
    EARLIER_FROM_KPA,
    EARLIER_KPA,
    LAST,
    LEFT,
    MAY_BEAR_KPA,
    RECENT_EXTREME,
    THIRD_LAST,
    TURNED,
)

SURE = 3.0
"""standard deviations of the smoothed noise by which a pressure must have gone back for a turn"""
CONFIRMED_RISE, CONFIRMED_FALL = 2.0, 1.0
"""turns by which the model that was left must have gone back by its own account, too; until then the turn may yet be
found to have been noise. A cell that seems to be pressed again while it recovers more likely bears no load"""

IN_FORCE, STATE = slice(11, 13), slice(13, 20)
"""1 in the row of the hypothesis in force; the state of both hypotheses, :data:`HYPOTHESES`"""
RISING, RECOVERY = 0, 1
HYPOTHESES = ("rising_pressure", "recovery_pressure", "settled", "x2", "rising_x3", "recovery_x3", "r")
"""pressure, own state, and slow branch of the rising and of the recovery model in turn; the reading of both"""


_CONFIRMED = np.array([CONFIRMED_FALL, CONFIRMED_RISE])
_ZERO, _SURE = np.array(0.0), np.array(SURE)


class Beside:
    """What the loops write beside one ``memory`` (rows, m)."""

    def __init__(self, memory: FloatArray) -> None:
        cells = memory.shape[1]
        self.memory, self.state = memory, memory[STATE]
        self.change = np.empty((6, cells))
        self.rows, self.flags = np.empty((loops.ROWS, cells)), np.empty((loops.FLAGS, cells), dtype=np.bool_)
        self.weights: TurnWeights | None = None
        """that ``rows`` were made with; None: with none"""

    def __reduce__(self) -> tuple[type[Beside], tuple[FloatArray]]:
        """For pickle and copy: the state is a part of the memory, which would become an array of its own."""
        return type(self), (self.memory,)


class Rows:
    """The rows of one ``memory`` (rows, m) by name, and arrays for intermediate results."""

    def __init__(self, memory: FloatArray) -> None:
        self.memory = memory
        cells = memory.shape[1]
        self.pressure, self.gain, self.variance, self.last = memory[: LAST + 1]
        self.before, self.until_before = memory[BEFORE_LAST : THIRD_LAST + 1], memory[LAST : BEFORE_LAST + 1]
        self.third_last = memory[THIRD_LAST]
        self.doubt, self.sign, self.extreme, self.peak, self.left = memory[TURNED : LEFT + 1]
        self.in_force, self.drift = memory[IN_FORCE], memory[DRIFT_KPA]
        self.earlier, self.earlier_least, self.earlier_from = memory[EARLIER_KPA : EARLIER_FROM_KPA + 1]
        self.recent_extreme = memory[RECENT_EXTREME]
        self.may_bear = memory[MAY_BEAR_KPA]
        self.state = memory[STATE]
        self.hypotheses, self.pressures, self.r = self.state[:6], self.state[:2], self.state[6]
        self.both = self.pressures.reshape(-1)
        self.change = np.empty((6, cells))
        self.changes_by_model = self.change[:2], self.change[2:4], self.change[4:]
        self.share = np.empty((2, cells))
        self.rising_share, self.recovery_share = self.share
        self.rising_kpa, self.recovery_kpa = self.pressures
        self.beside = np.empty((loops.ROWS, cells))
        """what follows from the memory, rows as in :mod:`._turning_loops`"""
        self.unsure, self.threshold, self.spare, self.noise, self.ahead, self.nearby = self.beside[:6]
        self.not_in_force, self.of_model = self.beside[6:8], self.beside[10:]
        self.not_rising, self.not_recovery = self.not_in_force
        self.confirming_sigmas, self.confirming_turns = self.beside[8:10]
        """how far the model that was left must have gone back for a turn to be certain: standard deviations, and turns
        of pressures that are known exactly"""
        self._gain, self.other_gain, self.fade = self.of_model
        self.flags = np.empty((loops.FLAGS, cells), dtype=np.bool_)
        self.rises = memory[IN_FORCE.start + RISING]
        """1 where the rising model is in force, else none"""
        self.where, self.held, self.confirmed = self.flags
        self.none = np.zeros(cells, dtype=np.bool_)
        self._weights: TurnWeights | None = None

    def __reduce__(self) -> tuple[type[Rows], tuple[FloatArray]]:
        """For pickle and copy: rows of the memory are parts of it, which would become arrays of their own."""
        return type(self), (self.memory,)

    def take_gains(self, weights: TurnWeights, *, anew: bool = False) -> None:
        """What depends on the hypothesis in force; ``anew``: another one may be in force than in the last frame."""
        if weights is self._weights and not anew:
            return
        weights.by_model.dot(self.in_force, self.of_model)
        self.gain[...] = self._gain
        if anew or self._weights is None:
            self.not_in_force[...] = self.in_force[::-1]
            self.confirming_turns[...] = _CONFIRMED.take(self.sign > _ZERO)
            np.multiply(self.confirming_turns, _SURE, self.confirming_sigmas)
        self._weights = weights
