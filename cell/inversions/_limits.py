"""Limits (saturation, anti-windup) of the memory of both hypotheses about the paper's cell: errors cannot add up.

Pressures stay within :data:`..estimation.LOADS`, and the memory follows the limited pressure. While the memory is
uncertain, a pressure beyond the usual load is an error of the memory rather than a load. No load is negative either: a
memory that would need a negative pressure (a pull) is corrected to the one that the reading implies at no load.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray, columns
from ...common.compiled import Row, Rows, SpacedRows, loop
from ..estimation import (
    DOUBT,
    HIDDEN,
    LOADS,
    PRESSURE,
    READING,
    SIGMAS,
    SMOOTHED,
    STD,
    UNKNOWN,
    USUAL,
    VARIANCE,
)
from ..estimation import NOISE as READING_NOISE
from ..materials import PaperModel
from ._paper_steps import TurnWeights
from ._turning_rows import (
    EXTREME,
    RECOVERY,
    RECOVERY_KPA,
    RECOVERY_X3,
    REFUTED,
    RISING,
    RISING_IN_FORCE,
    RISING_KPA,
    SETTLED,
    SIGN,
    STATE,
    STATE_END,
    SURE,
    TURNED,
    X2,
    MemoryRows,
)

NEAR = 1e-3
"""of full scale: a smaller pressure counts as none"""
MOST_LOST = 1.0
"""of full scale: largest standard deviation stated for what the memory may have lost"""
PULL_SIGMAS = 0.7
"""standard deviations of the reading: a pressure below none by more is an error of the memory. These standard
deviations include changes that the smoothing has not noticed yet: its line overshoots for a moment where a fast release
ends"""

LOWEST_KPA, USUAL_KPA, HIGHEST_KPA, PULLED_KPA, DOUBT_KPA2, UNKNOWN_KPA2, MOST_LOST_KPA2 = range(7)
"""places of the constants: the least pressure allowed, the largest while the memory is uncertain, and the largest; the
pressure below which the memory may have to be corrected; and variances: from which a memory counts as uncertain, of a
load of which nothing is known but that it is no more than usual, and of :data:`MOST_LOST`"""
SETTLED_PER_KPA, ETAU2_KPA, E1_KPA = range(7, 10)
"""places of the model's constants: 1 + etau2/Eu1, by which a pressure enters the settled state of the rising model
where this model begins; etau2; and E1 of recovery"""

_CHANGED = *range(STATE.start, STATE.stop), TURNED, EXTREME
"""rows that :func:`limit` changes"""
_ZERO = np.array(0.0)


def numbers_of(model: PaperModel, full_scale_kpa: float) -> dict[int, float]:
    """Constants of the places above."""
    return {
        LOWEST_KPA: LOADS[0] * full_scale_kpa,
        USUAL_KPA: USUAL * full_scale_kpa,
        HIGHEST_KPA: LOADS[1] * full_scale_kpa,
        PULLED_KPA: -NEAR * full_scale_kpa,
        DOUBT_KPA2: (DOUBT * full_scale_kpa) ** 2,
        UNKNOWN_KPA2: (UNKNOWN * full_scale_kpa) ** 2,
        MOST_LOST_KPA2: (MOST_LOST * full_scale_kpa) ** 2,
        SETTLED_PER_KPA: 1 + model.etau2_kpa / model.eu1_kpa,
        ETAU2_KPA: model.etau2_kpa,
        E1_KPA: model.e1_kpa,
    }


def limit(of: MemoryRows, weights: TurnWeights, numbers: tuple[FloatArray, ...]) -> None:
    """Keep pressures, and the memory with them, within the limits; changes the state of few cells."""
    both, lowest, usual = of.pressures, numbers[LOWEST_KPA].item(), numbers[USUAL_KPA].item()
    if both.item(both.argmin()) < lowest or both.item(both.argmax()) > usual:
        limit_some(of.memory, weights, numbers)


def limit_some(memory: FloatArray, weights: TurnWeights, numbers: tuple[FloatArray, ...]) -> None:
    """:func:`limit` where a pressure of the ``memory`` (rows, m) is beyond the usual; changes that."""
    pressures = memory[STATE][:2]
    beyond = (pressures < numbers[LOWEST_KPA]) | (pressures > numbers[USUAL_KPA])
    some = np.flatnonzero(beyond.any(axis=0))
    of = MemoryRows(columns(memory, some))
    _limit_each(of, weights, numbers)
    for row in _CHANGED:  # one by one: NumPy takes far longer for all at once where there are many cells
        memory[row, some] = of.memory[row]


def _limit_each(of: MemoryRows, weights: TurnWeights, numbers: tuple[FloatArray, ...]) -> None:
    """:func:`limit_some` for cells that all have a pressure beyond the usual."""
    state, r, p = of.state, of.r, numbers[USUAL_KPA]
    excess = np.clip(of.pressures, numbers[LOWEST_KPA], numbers[HIGHEST_KPA]) - of.pressures
    state[:6] += weights.ramp[:, None] * np.tile(excess, (3, 1))
    beyond = (of.variance > numbers[DOUBT_KPA2]) & (of.pressures > p)
    if not beyond.any():
        return
    np.minimum(of.pressures, p, where=beyond, out=of.pressures)
    np.maximum(of.doubt, numbers[UNKNOWN_KPA2], where=(beyond & (of.in_force > 0)).any(axis=0), out=of.doubt)
    # The reading falls more slowly than a rising or held load allows: the recovery model explains it.
    refuted = beyond[RISING] & ~beyond[RECOVERY] & (of.in_force[RISING] > 0)
    np.copyto(of.extreme, REFUTED, where=refuted)
    np.copyto(state[2], p * numbers[SETTLED_PER_KPA] - numbers[ETAU2_KPA] * r, where=beyond[RISING])
    np.copyto(state[3], r - p / numbers[E1_KPA] - state[5], where=beyond[RECOVERY])


def correct(
    of: MemoryRows, std: FloatArray, doubt: FloatArray, weights: TurnWeights, numbers: tuple[FloatArray, ...]
) -> None:
    """Where the hypothesis in force needs a negative pressure (a pull), correct its memory instead; changes ``of``.

    In recovery a pull of up to :data:`SURE` standard deviations of the smoothed noise is allowed.

    No load leaves a resistance below that at rest. If a reading is lower nevertheless (a bad line, a cell that has
    become warm), the correction leaves a memory that no load has made, and a later reading at rest shows a load. What
    the reading lacks therefore counts as standard deviation.

    Args:
        of: the cells.
        std: (m,) standard deviation of the smoothed reading by noise.
        doubt: (m,) the same, with changes that the smoothing may not have noticed yet.
        weights: of the time step.
        numbers: as above.
    """
    allowed = -PULL_SIGMAS * weights.by_model[0, RECOVERY] * doubt + numbers[PULLED_KPA]
    by_noise = weights.by_model[0, RECOVERY] * std * -SURE
    allowed = np.where(of.sign < _ZERO, np.minimum(allowed, by_noise), allowed)
    pulled = (of.pressure < allowed).nonzero()[0]
    if not pulled.size:
        return
    p = allowed[pulled]
    state, r, rising = of.state, of.r[pulled], of.in_force[RISING, pulled] > 0
    of.pressure[pulled] = p
    state[np.where(rising, 0, 1), pulled] = p
    state[2, pulled[rising]] = (p * numbers[SETTLED_PER_KPA] - numbers[ETAU2_KPA] * r)[rising]
    state[3, pulled[~rising]] = (r - p / numbers[E1_KPA] - state[5, pulled])[~rising]
    missing = np.maximum((p / numbers[E1_KPA] - r) * weights.by_model[0, RISING], _ZERO)
    doubt = of.doubt[pulled]
    more = np.maximum(np.minimum(missing * missing, numbers[MOST_LOST_KPA2]), doubt) - doubt
    of.doubt[pulled] += more
    of.variance[pulled] += more


@loop
def limit_each(memory: SpacedRows, ramp: Row, numbers: Row) -> None:
    """:func:`limit` as a loop over cells, with the ``ramp`` of the time step's weights."""
    lowest, usual, highest = numbers[LOWEST_KPA], numbers[USUAL_KPA], numbers[HIGHEST_KPA]
    for i in range(memory.shape[1]):
        rising, recovery = memory[RISING_KPA, i], memory[RECOVERY_KPA, i]
        if not (min(rising, recovery) < lowest or max(rising, recovery) > usual):
            continue
        rising, recovery = min(max(rising, lowest), highest) - rising, min(max(recovery, lowest), highest) - recovery
        for row in range(0, 6, 2):
            memory[RISING_KPA + row, i] += ramp[row] * rising
            memory[RECOVERY_KPA + row, i] += ramp[row + 1] * recovery
        if not memory[VARIANCE, i] > numbers[DOUBT_KPA2]:
            continue
        r, rises = memory[STATE_END - 1, i], memory[RISING_IN_FORCE, i] > 0.0
        rising_beyond, recovery_beyond = memory[RISING_KPA, i] > usual, memory[RECOVERY_KPA, i] > usual
        if rising_beyond if rises else recovery_beyond:
            memory[TURNED, i] = max(memory[TURNED, i], numbers[UNKNOWN_KPA2])
        if rising_beyond:
            memory[RISING_KPA, i] = usual
            memory[SETTLED, i] = usual * numbers[SETTLED_PER_KPA] - numbers[ETAU2_KPA] * r
            if rises and not recovery_beyond:
                memory[EXTREME, i] = REFUTED
        if recovery_beyond:
            memory[RECOVERY_KPA, i] = usual
            memory[X2, i] = r - usual / numbers[E1_KPA] - memory[RECOVERY_X3, i]


@loop
def correct_each(memory: SpacedRows, taken: Rows, by_model: Rows, numbers: Row) -> None:
    """:func:`correct` as a loop over cells, for readings ``taken`` (4, m)."""
    pull = -PULL_SIGMAS * by_model[0, 1]
    for i in range(memory.shape[1]):
        off = abs(taken[READING, i] - taken[SMOOTHED, i]) + taken[READING_NOISE, i] * HIDDEN
        doubt = max(off * (1.0 / SIGMAS), taken[STD, i])
        allowed = pull * doubt + numbers[PULLED_KPA]
        if memory[SIGN, i] < 0.0:
            allowed = min(allowed, by_model[0, 1] * taken[STD, i] * -SURE)
        if not memory[PRESSURE, i] < allowed:
            continue
        r = memory[STATE_END - 1, i]
        memory[PRESSURE, i] = allowed
        if memory[RISING_IN_FORCE, i] > 0.0:
            memory[RISING_KPA, i] = allowed
            memory[SETTLED, i] = allowed * numbers[SETTLED_PER_KPA] - numbers[ETAU2_KPA] * r
        else:
            memory[RECOVERY_KPA, i] = allowed
            memory[X2, i] = r - allowed / numbers[E1_KPA] - memory[RECOVERY_X3, i]
        missing = (allowed / numbers[E1_KPA] - r) * by_model[0, 0]
        if missing > 0.0:
            doubt = memory[TURNED, i]
            memory[TURNED, i] = max(min(missing * missing, numbers[MOST_LOST_KPA2]), doubt)
            memory[VARIANCE, i] += memory[TURNED, i] - doubt
