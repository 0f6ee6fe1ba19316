"""The frame of :class:`._turning.TurningInversion` as loops over cells for :mod:`ohmskin.common.compiled`.

The loops do what the array operations do, in the same order. The loops of each question are beside its array
operations: :mod:`._turns`, :mod:`._takeover`, :mod:`._earlier`, :mod:`._doubts` and :mod:`._limits`. The two matrix
products of a frame stay with NumPy.
"""

from __future__ import annotations

import math

from ...common.compiled import FlagRows, Places, Row, Rows, SpacedRows, loop
from ..estimation import FAR, PRESSURE, STD, VARIANCE
from ._doubts import begin_anew_each
from ._earlier import sign_before_of
from ._limits import LOWEST_KPA, PULLED_KPA, USUAL_KPA, correct_each, limit_each
from ._still import STILL_X2, STILL_X3
from ._sway import begin_each
from ._takeover import take_over_of
from ._turning_rows import (
    CONFIRMED,
    EARLIER_KPA,
    FORGOTTEN_KPA,
    LEFT,
    LOOKS_AT_REST,
    MAY_BEAR_KPA,
    RECOVERY_IN_FORCE,
    RECOVERY_KPA,
    RECOVERY_X3,
    RISING_IN_FORCE,
    RISING_KPA,
    RISING_X3,
    SETTLED,
    SIGN,
    STATE_END,
    X2,
    take_each,
    take_gains_each,
)
from ._turns import begin_at_refuted_of, confirm_of, look_of, refuted_of

UNCONFIRMED, PULLED, BEYOND = 1, 2, 4
"""bits of what a frame has found: a turn is or was unconfirmed; a pressure is negative, so that the memory may have to
be corrected; a pressure is beyond its limits"""
PER_E2, PER_E3, EU1_KPA, ETAU2_KPA, E1_KPA = range(5)
"""places of the model's constants that :func:`hold_lags_each` takes; the first two are reciprocals"""


@loop
def step(memory: SpacedRows, after: Rows, numbers: Row) -> bool:
    """Write the hypotheses ``after`` (6, m) the step; return whether a pressure is beyond its limits."""
    beyond = False
    for row in range(after.shape[0]):
        for i in range(after.shape[1]):
            memory[RISING_KPA + row, i] = after[row, i]
    for i in range(after.shape[1]):
        beyond |= min(after[0, i], after[1, i]) < numbers[LOWEST_KPA]
        beyond |= max(after[0, i], after[1, i]) > numbers[USUAL_KPA]
    return beyond


@loop
def take_turns(memory: SpacedRows, taken: Rows, by_model: Rows, of: Rows, flags: FlagRows, numbers: Row) -> int:
    """Take over the other hypothesis where the pressure has turned, and confirm earlier turns.

    Readings are ``taken`` (4, m).

    Returns:
        UNCONFIRMED if a turn is or was unconfirmed, and PULLED if a pressure is negative, combined by "or".
    """
    found = 0
    rising_fade, recovery_fade = math.sqrt(by_model[2, 0]), math.sqrt(by_model[2, 1])
    for i in range(memory.shape[1]):
        std = taken[STD, i]
        memory[EARLIER_KPA, i] *= recovery_fade if sign_before_of(memory, i) > 0.0 else rising_fade
        turned = look_of(memory, i, std, of, numbers)
        unconfirmed, rises, refuted = memory[LEFT, i] < FAR, memory[SIGN, i] > 0.0, False
        if (unconfirmed or turned) and unconfirmed == rises:
            refuted = refuted_of(memory, i, std, by_model, numbers)
            if refuted:
                turned = rises
        if unconfirmed or turned:
            found |= UNCONFIRMED
        if turned:
            take_over_of(memory, i, std, by_model, of, numbers)
            look_of(memory, i, std, of, numbers)
        if refuted:
            begin_at_refuted_of(memory, i, of)
        flags[CONFIRMED, i] = memory[LEFT, i] < FAR and confirm_of(memory, i, of, numbers)
        if memory[PRESSURE, i] < numbers[PULLED_KPA]:
            found |= PULLED
    return found


@loop
def step_and_turn(
    memory: SpacedRows,
    after: Rows,
    taken: Rows,
    by_model: Rows,
    of: Rows,
    flags: FlagRows,
    numbers: Row,
    limited: bool,
) -> int:
    """:func:`step`, unless its pressures are ``limited`` already, and :func:`take_turns`.

    Returns:
        As :func:`take_turns`, or BEYOND if pressures must be limited first.
    """
    if not limited and step(memory, after, numbers):
        return BEYOND
    return take_turns(memory, taken, by_model, of, flags, numbers)


@loop
def hold_lags_each(memory: SpacedRows, places: Places, gone: Rows, numbers: Row) -> None:
    """Step the lags of cells at ``places`` (k,) over a gap in which they forget the shares ``gone`` (4, k)."""
    for k in range(places.size):
        i = places[k]
        rising, recovery = memory[RISING_KPA, i], memory[RECOVERY_KPA, i]
        memory[SETTLED, i] += (rising - memory[SETTLED, i]) * gone[0, k]
        memory[X2, i] += (recovery * numbers[PER_E2] - memory[X2, i]) * gone[1, k]
        memory[RISING_X3, i] += (rising * numbers[PER_E3] - memory[RISING_X3, i]) * gone[2, k]
        memory[RECOVERY_X3, i] += (recovery * numbers[PER_E3] - memory[RECOVERY_X3, i]) * gone[3, k]
        if memory[SIGN, i] > 0.0:
            r = rising / numbers[EU1_KPA] + (rising - memory[SETTLED, i]) / numbers[ETAU2_KPA]
        else:
            r = recovery / numbers[E1_KPA] + memory[X2, i] + memory[RECOVERY_X3, i]
        memory[STATE_END - 1, i] = r


@loop
def hold_each(memory: SpacedRows, places: Places, gone: Rows, change: Rows) -> None:
    """The rest of the memory of cells at ``places`` (k,) after :func:`hold_lags_each`.

    ``change`` (6, k) is the change by which each hypothesis begins anew where the other one is.
    """
    for k in range(places.size):
        i = places[k]
        apart = memory[RISING_KPA, i] != memory[RECOVERY_KPA, i]
        of_rising = 0.0 if apart else memory[RECOVERY_IN_FORCE, i]
        of_recovery = 0.0 if apart else memory[RISING_IN_FORCE, i]
        for row in range(0, 6, 2):
            memory[RISING_KPA + row, i] += change[row, k] * of_rising
            memory[RECOVERY_KPA + row, i] += change[row + 1, k] * of_recovery
        memory[STILL_X2, i] *= 1.0 - gone[1, k]
        memory[STILL_X3, i] *= 1.0 - gone[2, k]
        memory[FORGOTTEN_KPA, i] = 0.0
        memory[VARIANCE, i] -= memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        for row in range(MAY_BEAR_KPA, LOOKS_AT_REST + 1):
            memory[row, i] = 0.0
    begin_each(memory, places)


ALL = hold_lags_each, hold_each, take_each, take_gains_each, step_and_turn, limit_each, correct_each, begin_anew_each
