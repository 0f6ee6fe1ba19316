"""The turns of a frame of :class:`._turning.TurningInversion` as loops over cells for :mod:`ohmskin.compiled`.

The loops do what the array operations do, in the same order. Those of each idea are beside its array operations:
:mod:`._turns`, :mod:`._takeover`, :mod:`._earlier`, :mod:`._doubts` and :mod:`._limits`. Between them come two matrix
products, which NumPy does, and the limits of few cells, which stay array operations.
"""

from __future__ import annotations

import math

from ...compiled import FlagRows, Row, Rows, SpacedRows, loop
from ..estimation import FAR, PRESSURE, STD
from ._doubts import begin_anew_each
from ._earlier import sign_before_of
from ._limits import LOWEST_KPA, PULLED_KPA, USUAL_KPA, correct_each, limit_each
from ._takeover import take_over_of
from ._turning_rows import (
    CONFIRMED,
    EARLIER_KPA,
    LEFT,
    RISING_KPA,
    SIGN,
    take_each,
    take_gains_each,
)
from ._turns import begin_at_refuted_of, confirm_of, look_of, refuted_of

UNCONFIRMED, PULLED, BEYOND = 1, 2, 4
"""what a frame has found: turns that are or were unconfirmed; pressures that may need a pull; some beyond limits"""


@loop
def step(memory: SpacedRows, after: Rows, numbers: Row) -> bool:
    """Take hypotheses ``after`` (6, m) the step; whether a pressure is beyond its limits."""
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
        Sum of UNCONFIRMED if a cell had turned unconfirmed, and of PULLED if one needs a pull.
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
        What the latter does, or BEYOND where pressures are to be limited before.
    """
    if not limited and step(memory, after, numbers):
        return BEYOND
    return take_turns(memory, taken, by_model, of, flags, numbers)


ALL = take_each, take_gains_each, step_and_turn, limit_each, correct_each, begin_anew_each
