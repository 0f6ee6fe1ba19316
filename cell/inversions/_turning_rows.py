"""The memory of :class:`._turning.TurningInversion`: its rows by number and by name, and work arrays of a frame.

Rows that only one of :mod:`._sway`, :mod:`._still`, :mod:`._onset` and :mod:`._recovery` uses are named there.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Rows, SpacedRows, loop
from ..estimation import FAR, GAIN, PRESSURE, SMOOTHED
from ._paper_steps import TurnWeights

LAST, BEFORE_LAST, THIRD_LAST, TURNED, SIGN, EXTREME, PEAK, LEFT = range(3, 11)
"""rows: the pressures of the last three frames; the variance in kPa^2 that turns at uncertain times have left in the
memory, which fades; the sign, 1 rising and -1 in recovery; the largest sign times pressure since the last turn, less
some standard deviations of noise (extreme) and less one (peak); and the extreme that was left at an unconfirmed turn,
else :data:`FAR`"""
RISING_IN_FORCE, RECOVERY_IN_FORCE = 11, 12
RISING_KPA, RECOVERY_KPA, SETTLED, X2, RISING_X3, RECOVERY_X3, STATE_END = 13, 14, 15, 16, 17, 18, 20
"""rows of the state: it begins with the pressures of the two hypotheses, and ends with the reading"""
DRIFT_KPA, DRIFT_END_KPA, TAKEN_OFF_KPA = 22, 23, 24
"""rows of :mod:`._recovery`, beside two of :mod:`..estimation._loops`: by how much an error of the memory that fades
may make the pressure seem to turn, by now and in the end; and the pressure that was subtracted since the release"""
EARLIER_KPA, EARLIER_LEAST_KPA, EARLIER_FROM_KPA = 25, 26, 27
"""rows of :mod:`._earlier`: by how much the other hypothesis would be further back if the load had turned earlier; and,
both times the sign before that turn, the least pressure of this third hypothesis since it began, and the pressure in
force when it began, plus what the pressure went in frames in which the third hypothesis seemed to rise"""
RECENT_EXTREME = 33
"""row behind those of :mod:`._still`: an extreme that fades as fast as an error of the memory may"""
FORGOTTEN_KPA = 34
"""row of :mod:`._earlier`: by how much the other hypothesis would be further back if it had not begun anew in the last
frames in which the pressure went back"""
UNDITHERED = 35
"""row of :mod:`._turns`: share of the quantisation error that noise does not make random (does not dither)"""
MAY_BEAR_KPA, LOOKS_AT_REST = 36, 37
"""first rows of :mod:`._onset`: standard deviation by a load that may have begun to rise while the cell recovers; and
the number of looks since the recovering cell was taken for one at rest, negative where such a load was taken over"""
RELEASED_KPA, TAKEN_BEFORE_KPA2 = 133, 134
"""rows of :mod:`._recovery` behind those of :mod:`._sway`: the pressure from which a recovering cell has fallen; and
the square of the pressure that earlier rests have subtracted"""
HIGHEST_MEAN_KPA, FALLEN = 135, 136
"""rows of :mod:`._released`: the largest pressure of late by means of readings; and the statistic of Page's test, the
sum of the standard deviations by which means have been below it"""

IN_FORCE, STATE = slice(RISING_IN_FORCE, RECOVERY_IN_FORCE + 1), slice(RISING_KPA, STATE_END)
"""rows of which one is 1, that of the hypothesis in force; rows of the state of both hypotheses, :data:`HYPOTHESES`"""
RISING, RECOVERY = 0, 1
HYPOTHESES = ("rising_pressure", "recovery_pressure", "settled", "x2", "rising_x3", "recovery_x3", "r")
"""pressure, own state and slow branch, each of the rising and then of the recovery model; the reading of both"""

UNSURE, THRESHOLD, SPARE, NOISE, AHEAD, NEARBY = range(6)
NOT_RISING, NOT_RECOVERY, CONFIRMING_SIGMAS, CONFIRMING_TURNS = range(6, 10)
GAIN_IN_FORCE, OTHER_GAIN, FADE = range(10, 13)
BESIDE = 13
"""rows beside the memory. First intermediate results; then two rows of which one is 1, that of the hypothesis not in
force; then how far this hypothesis must have gone back to confirm a turn, in standard deviations and in turns of
exactly known pressures; then weights of the hypothesis in force. Last, the number of rows"""
WHERE, HELD, CONFIRMED, FLAGS = range(4)
"""rows of flags, and their number"""

REFUTED = 0.5 * FAR
"""kPa: marks the extreme of a hypothesis that the readings refute. It is beyond all pressures, so that any pressure
makes a turn, and below :data:`FAR`, which means "none", so that the turn counts as confirmed"""
SURE = 3.0
"""standard deviations, by the noise of the smoothed readings, by which a pressure must have gone back for a turn"""
CONFIRMED_RISE, CONFIRMED_FALL = 2.0, 1.0
"""turns by which the pressure of the model that was left must have gone back, too, to confirm a rise and a fall. Until
then the turn may prove to be a false alarm. A rise must show more: a cell that seems to be pressed again while it
recovers more likely bears no load"""

_CONFIRMED = np.array([CONFIRMED_FALL, CONFIRMED_RISE])
_ZERO, _SURE = np.array(0.0), np.array(SURE)


def by_steps(memory: FloatArray, steps: float | FloatArray) -> FloatArray:
    """(m,) standard deviation of r by steps of the ADC, which make ``steps`` of r at rest."""
    scale = memory[STATE_END - 1] + 1.0
    found: FloatArray = scale * scale * steps
    return found


@loop
def by_steps_of(memory: SpacedRows, i: int, steps: float) -> float:
    """:func:`by_steps` of cell ``i``."""
    scale: float = memory[STATE_END - 1, i] + 1.0
    return scale * scale * steps


class Beside:
    """Work arrays of the loops beside one ``memory`` (rows, m)."""

    def __init__(self, memory: FloatArray) -> None:
        cells = memory.shape[1]
        self.memory, self.state = memory, memory[STATE]
        self.change = np.empty((6, cells))
        self.rows, self.flags = np.empty((BESIDE, cells)), np.empty((FLAGS, cells), dtype=np.bool_)
        self.weights: TurnWeights | None = None
        """weights with which ``rows`` were written; None: not written yet"""

    def __reduce__(self) -> tuple[type[Beside], tuple[FloatArray]]:
        """For pickle and copy: ``state`` is a view of the memory, and would become an array of its own."""
        return type(self), (self.memory,)


class MemoryRows:
    """The rows of one ``memory`` (rows, m) by name, and work arrays."""

    def __init__(self, memory: FloatArray) -> None:
        self.memory = memory
        cells = memory.shape[1]
        self.pressure, self.gain, self.variance, self.last = memory[: LAST + 1]
        self.before, self.until_before = memory[BEFORE_LAST : THIRD_LAST + 1], memory[LAST : BEFORE_LAST + 1]
        self.third_last = memory[THIRD_LAST]
        self.doubt, self.sign, self.extreme, self.peak, self.left = memory[TURNED : LEFT + 1]
        self.in_force, self.drift = memory[IN_FORCE], memory[DRIFT_KPA]
        self.earlier, self.earlier_least, self.earlier_from = memory[EARLIER_KPA : EARLIER_FROM_KPA + 1]
        self.recent_extreme, self.forgotten, self.undithered = memory[RECENT_EXTREME : UNDITHERED + 1]
        self.may_bear, self.fallen = memory[MAY_BEAR_KPA], memory[FALLEN]
        self.state = memory[STATE]
        self.hypotheses, self.pressures, self.r = self.state[:6], self.state[:2], self.state[6]
        self.change = np.empty((6, cells))
        self.changes_by_model = self.change[:2], self.change[2:4], self.change[4:]
        self.share = np.empty((2, cells))
        self.rising_share, self.recovery_share = self.share
        self.rising_kpa, self.recovery_kpa = self.pressures
        self.beside = np.empty((BESIDE, cells))
        self.unsure, self.threshold, self.spare, self.noise, self.ahead, self.nearby = self.beside[: NEARBY + 1]
        self.not_in_force, self.of_model = self.beside[NOT_RISING : NOT_RECOVERY + 1], self.beside[GAIN_IN_FORCE:]
        self.not_rising, self.not_recovery = self.not_in_force
        self.confirming_sigmas, self.confirming_turns = self.beside[CONFIRMING_SIGMAS : CONFIRMING_TURNS + 1]
        self._gain, self.other_gain, self.fade = self.of_model
        self.flags = np.empty((FLAGS, cells), dtype=np.bool_)
        self.rises = memory[RISING_IN_FORCE]
        """1 where the rising model is in force, else 0"""
        self.where, self.held, self.confirmed = self.flags
        self.none = np.zeros(cells, dtype=np.bool_)
        self._weights: TurnWeights | None = None

    def __reduce__(self) -> tuple[type[MemoryRows], tuple[FloatArray]]:
        """For pickle and copy: the rows are views of the memory, and would become arrays of their own."""
        return type(self), (self.memory,)

    def take(self, r: FloatArray) -> None:
        """Keep the pressures of the last frames, and take the readings ``r`` (m,)."""
        self.before[...] = self.until_before
        self.last[...] = self.pressure
        self.r[...] = r

    def take_gains(self, weights: TurnWeights, *, anew: bool = False) -> None:
        """Take the weights of the hypothesis in force; ``anew``: it may be another one than in the last frame."""
        if weights is self._weights and not anew:
            return
        weights.by_model.dot(self.in_force, self.of_model)
        self.gain[...] = self._gain
        if anew or self._weights is None:
            self.not_in_force[...] = self.in_force[::-1]
            self.confirming_turns[...] = _CONFIRMED.take(self.sign > _ZERO)
            np.multiply(self.confirming_turns, _SURE, self.confirming_sigmas)
        self._weights = weights


@loop
def take_each(memory: SpacedRows, taken: Rows) -> None:
    """:meth:`MemoryRows.take` as a loop over cells, for readings ``taken`` (4, m)."""
    for i in range(memory.shape[1]):
        memory[THIRD_LAST, i] = memory[BEFORE_LAST, i]
        memory[BEFORE_LAST, i] = memory[LAST, i]
        memory[LAST, i] = memory[PRESSURE, i]
        memory[STATE_END - 1, i] = taken[SMOOTHED, i]


@loop
def take_gains_of(memory: SpacedRows, i: int, by_model: Rows, of: Rows) -> None:
    """Write into ``of`` (BESIDE, m), for cell ``i``, what depends on its hypothesis in force and on the time step."""
    rising, recovery = memory[RISING_IN_FORCE, i], memory[RECOVERY_IN_FORCE, i]
    memory[GAIN, i] = by_model[0, 0] * rising + by_model[0, 1] * recovery
    of[OTHER_GAIN, i] = by_model[1, 0] * rising + by_model[1, 1] * recovery
    of[FADE, i] = by_model[2, 0] * rising + by_model[2, 1] * recovery
    of[NOT_RISING, i], of[NOT_RECOVERY, i] = recovery, rising
    turns = CONFIRMED_RISE if memory[SIGN, i] > 0.0 else CONFIRMED_FALL
    of[CONFIRMING_SIGMAS, i], of[CONFIRMING_TURNS, i] = turns * SURE, turns


@loop
def take_gains_each(memory: SpacedRows, by_model: Rows, of: Rows) -> None:
    """:meth:`MemoryRows.take_gains` as a loop over cells."""
    for i in range(memory.shape[1]):
        take_gains_of(memory, i, by_model, of)
