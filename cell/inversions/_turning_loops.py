"""The frame of :class:`._turning.TurningInversion` as loops over cells for :mod:`ohmskin.compiled`.

The loops do what the array operations of its ``advance`` do, in the same order. Between them come two matrix products,
which NumPy does, and the turns and limits of few cells, which stay array operations.
"""

from __future__ import annotations

import math

from ...compiled import FlagRows, Row, Rows, loop
from ..estimation import FAR, GAIN, PRESSURE, READING, REST_VARIANCE, RESTED, SMOOTHED, STD, VARIANCE
from ..estimation import NOISE as READING_NOISE

LAST, BEFORE_LAST, THIRD_LAST, TURNED, SIGN, EXTREME, PEAK, LEFT = range(3, 11)
"""rows: the pressures of the last three frames; variance from turns not known to the point, which fades; 1 rising, -1
in recovery; the largest sign times pressure since the last turn, less some standard deviations of noise and less one;
the extreme that was left at an unconfirmed turn, else :data:`FAR`"""
RISING_IN_FORCE, RECOVERY_IN_FORCE = 11, 12
RISING_KPA, RECOVERY_KPA, SETTLED, X2, RISING_X3, RECOVERY_X3, STATE_END = 13, 14, 15, 16, 17, 18, 20
"""rows of the state: it begins with the pressures of the two hypotheses, and ends with the reading"""
DRIFT_KPA, DRIFT_END_KPA, TAKEN_OFF_KPA = 22, 23, 24
EARLIER_KPA, EARLIER_LEAST_KPA, EARLIER_FROM_KPA = 41, 42, 43
"""rows behind those of :mod:`._sway`: by how much the other hypothesis would be further back if the load had turned
earlier; its least since then by that account, and the pressure when it began, both times the sign before that turn"""
RECENT_EXTREME = 49
"""row behind those of :mod:`._still`: the extreme, which fades as fast as an error of the memory may"""
"""rows of :mod:`._recovery`, beside two of :mod:`..estimation._loops`: by how much a fading error may let the pressure
seem to turn, now and at last; pressure that was subtracted since the release"""
MAY_BEAR_KPA, LOOKS_AT_REST, EARLIEST_KPA = 50, 51, 52
"""rows of :mod:`._onset`: standard deviation by a load that may have begun to rise while the cell recovers; looks since
the recovering cell was taken for one at rest, negative where such a load was taken over; the load if it began then"""
HIDDEN_SHARE, SETTLES = 0.7, 7.0
"""standard deviation over what a rise that was hidden would make; looks from which what a cell at rest remembers is
known: by then the smoothing has passed the release"""
UNSURE, THRESHOLD, SPARE, NOISE, AHEAD, NEARBY = range(6)
NOT_RISING, NOT_RECOVERY, CONFIRMING_SIGMAS, CONFIRMING_TURNS = range(6, 10)
GAIN_IN_FORCE, OTHER_GAIN, FADE = range(10, 13)
ROWS = 13
"""rows beside the memory: intermediate results; 1 in the row of the hypothesis that is not in force; how far that one
must have gone back for a turn to be certain; what depends on the hypothesis in force. Then the number of rows"""
WHERE, HELD, CONFIRMED, FLAGS = range(4)
"""rows of flags, and their number"""
LOWEST, USUAL, SURE, TURN_KPA, LEAST_KPA, PULLED_KPA = range(6)
FLAT_KPA, EXACT_KPA, AGAIN, LESS, EITHER, LEFT_OVER, CLEAR = range(6, 13)
JUST_BEGUN, BETWEEN, BEND, ROUND_KPA, MOST_KPA2, CONFIRMED_RISE, CONFIRMED_FALL, HALF = range(13, 21)
PULL, NEAR_KPA, SETTLED_PER_KPA, ETAU2_KPA, E1_KPA, LOST_SIGMAS, MOST_LOST_KPA2 = range(21, 28)
HIDDEN, PER_SIGMAS, FAST_KPA, LIGHT, PART, DRIFTS, MOST_RESTED_KPA2, LIGHT_KPA, TURN_SHARE = range(28, 37)
GOES_BACK, STEPS, STILL, FALL = range(37, 41)
RISE_R, FALL_R, SMOOTH_KPA, AWAY_KPA, MAY_BEND = range(41, 46)
SHARED, CLEAR_RISE_KPA, SHARED_FALL, CLEAR_FALL_KPA, FALLING = range(46, 51)
EARLIER, MIDWAY, GROWN_KPA, GROWN_SIGMAS, GROWN_ERRORS, FALLEN, BEND_RATIO, CREEPS, GROWN_RELEASED = range(51, 60)
"""places of the estimator's numbers: limits of pressures; standard deviations and kPa that make a turn; what is no turn
below; a pressure that needs a pull. kPa within which a pressure is near its extreme, and at it; share by which the
other hypothesis begins anew; standard deviations by which an extreme counts for less; standard deviation over the
difference of the hypotheses; share of a variance that a new beginning leaves, and in kPa^2 the least that counts. Then
those of ``_turn``, ``_correct`` and ``_keep`` of :class:`._turning.TurningInversion`, of :mod:`._recovery`, and how far
small pressures must go back for a turn; how far the peak goes down as an error of the memory fades; those of
``_doubt_falls`` and of ``_late``; of :func:`refutes`, of :func:`seeming_kpa`, and of :func:`earlier_kpa` and
:func:`follow_earlier_turn`; share of what a held pressure may seem to go back by in three frames that a recent extreme
fades by in one"""
REFUTED = 0.5 * FAR
"""kPa: stands for the extreme of a hypothesis that the reading refutes. It is beyond all pressures, so that any of them
is a turn, and below the extreme that means "none", so that the turn is certain"""
UNCONFIRMED, PULLED, BEYOND = 1, 2, 4


@loop
def take(memory: Rows, taken: Rows) -> None:
    """Keep the pressures of the last frames, and take readings ``taken`` (4, m)."""
    for i in range(memory.shape[1]):
        memory[THIRD_LAST, i] = memory[BEFORE_LAST, i]
        memory[BEFORE_LAST, i] = memory[LAST, i]
        memory[LAST, i] = memory[PRESSURE, i]
        memory[STATE_END - 1, i] = taken[SMOOTHED, i]


@loop
def step(memory: Rows, after: Rows, numbers: Row) -> bool:
    """Take hypotheses ``after`` (6, m) the step; whether a pressure is beyond its limits."""
    beyond = False
    for row in range(after.shape[0]):
        for i in range(after.shape[1]):
            memory[RISING_KPA + row, i] = after[row, i]
    for i in range(after.shape[1]):
        beyond |= min(after[0, i], after[1, i]) < numbers[LOWEST]
        beyond |= max(after[0, i], after[1, i]) > numbers[USUAL]
    return beyond


@loop
def take_gains_of(memory: Rows, i: int, by_model: Rows, of: Rows, numbers: Row) -> None:
    """Write into ``of`` (ROWS, m), for cell ``i``, what depends on its hypothesis in force and on the time step."""
    rising, recovery = memory[RISING_IN_FORCE, i], memory[RECOVERY_IN_FORCE, i]
    memory[GAIN, i] = by_model[0, 0] * rising + by_model[0, 1] * recovery
    of[OTHER_GAIN, i] = by_model[1, 0] * rising + by_model[1, 1] * recovery
    of[FADE, i] = by_model[2, 0] * rising + by_model[2, 1] * recovery
    of[NOT_RISING, i], of[NOT_RECOVERY, i] = recovery, rising
    turns = numbers[CONFIRMED_RISE] if memory[SIGN, i] > 0.0 else numbers[CONFIRMED_FALL]
    of[CONFIRMING_SIGMAS, i], of[CONFIRMING_TURNS, i] = turns * numbers[SURE], turns


@loop
def take_gains(memory: Rows, by_model: Rows, of: Rows, numbers: Row) -> None:
    """:func:`take_gains_of` all cells."""
    for i in range(memory.shape[1]):
        take_gains_of(memory, i, by_model, of, numbers)


@loop
def unseen_kpa(memory: Rows, i: int, pressure: float, gain: float, unsure: float, numbers: Row) -> float:
    """Standard deviation that turns between two frames leave in the ``pressure`` of cell ``i``."""
    last, before, third, sign = memory[LAST, i], memory[BEFORE_LAST, i], memory[THIRD_LAST, i], memory[SIGN, i]
    there = max(sign * (third - before), sign * (before - last), 0.0)
    way = min(numbers[JUST_BEGUN] * there, max(abs(pressure - last), numbers[HALF] * there))
    by_load = max(way - numbers[SURE] * unsure, 0.0)
    return float(numbers[BETWEEN] * by_load * numbers[BEND] * gain)


@loop
def late_kpa(memory: Rows, i: int, noise: float, numbers: Row) -> float:
    """By how much the pressure of the model that cell ``i`` leaves was off when it turned."""
    sign, extreme = memory[SIGN, i], memory[EXTREME, i]
    unsure = noise * memory[GAIN, i]
    if not (unsure < numbers[SMOOTH_KPA] and numbers[AWAY_KPA] < abs(extreme) and extreme < numbers[USUAL]):
        return 0.0
    top = extreme + unsure
    left, other = memory[RISING_KPA, i] * sign, memory[RECOVERY_KPA, i] * sign
    left_r, other_r = numbers[RISE_R], numbers[FALL_R]
    if sign < 0.0:
        left, other, left_r, other_r = other, left, other_r, left_r
    gone, way = max(top - left, numbers[EXACT_KPA]), top - other
    by_drift = way * other_r / left_r - gone
    if not by_drift > unsure * numbers[SURE]:
        return 0.0
    return float(min(by_drift * by_drift * (left_r + other_r) / (4.0 * other_r * gone), way))


@loop
def earlier_kpa(memory: Rows, i: int, unsure: float, fallen: float, numbers: Row) -> float:
    """By how much an earlier turn would make the pressure of cell ``i`` less, if it does not seem constant."""
    grown = max(memory[PEAK, i] - memory[EARLIER_FROM_KPA, i], fallen, 0.0)
    errors = numbers[GROWN_ERRORS]
    if memory[SIGN, i] < 0.0:
        if memory[RESTED, i] > 0.0:
            return 0.0
        errors = numbers[GROWN_RELEASED]
    errors *= math.sqrt(memory[TURNED, i])
    grown /= unsure * numbers[GROWN_SIGMAS] + errors + numbers[GROWN_KPA]
    grown *= grown
    return float(max(memory[EARLIER_KPA, i], 0.0) * (grown / (grown + 1.0)))


@loop
def sign_before(memory: Rows, i: int) -> float:
    """1 if the pressure of cell ``i`` rose before an unconfirmed turn, or does if there is none; else -1."""
    sign = memory[SIGN, i]
    return float(-sign if memory[LEFT, i] < FAR else sign)


@loop
def follow_earlier_turn(memory: Rows, i: int, forgotten_kpa: float, confirmed: bool, of: Rows, numbers: Row) -> None:
    """Follow the hypothesis that the load of cell ``i`` turned earlier.

    The other one began ``forgotten_kpa`` anew; a turn has just been ``confirmed``.
    """
    sign, ratio = sign_before(memory, i), numbers[BEND_RATIO]
    least = turn_from(memory[EXTREME, i], numbers)
    by_noise = of[UNSURE, i] * numbers[SURE]
    if sign > 0.0:
        other = most = memory[RECOVERY_KPA, i]
        by_noise *= ratio
    else:
        other, most = -memory[RISING_KPA, i], numbers[USUAL] - memory[RISING_KPA, i]
        by_noise /= ratio
        least /= ratio
    earlier = min(memory[EARLIER_KPA, i] + forgotten_kpa * sign, most)
    ahead = other - earlier
    memory[EARLIER_KPA, i] = earlier
    memory[EARLIER_LEAST_KPA, i] = min(memory[EARLIER_LEAST_KPA, i], ahead)
    ahead -= memory[EARLIER_LEAST_KPA, i] + by_noise
    if ahead > 0.0:
        memory[EARLIER_FROM_KPA, i] += (memory[PRESSURE, i] - memory[LAST, i]) * sign
    if confirmed or ahead > least:
        memory[EARLIER_KPA, i], memory[EARLIER_LEAST_KPA, i] = 0.0, other
        memory[EARLIER_FROM_KPA, i] = memory[PRESSURE, i] * sign


@loop
def hidden_kpa(memory: Rows, i: int, pressure: float, extreme: float, numbers: Row) -> float:
    """Standard deviation in kPa of cell ``i``, whose rise from ``-extreme`` to ``pressure`` may have begun earlier."""
    rise = pressure + extreme
    if memory[LOOKS_AT_REST, i] < SETTLES or rise <= 0.0:
        return 0.0
    shared = (memory[RECOVERY_KPA, i] + extreme) / rise * (numbers[FALL_R] / numbers[RISE_R])
    hidden = min(max(1.0 - shared, 0.0), 1.0)
    return float(hidden * hidden * max(memory[EARLIEST_KPA, i] - pressure, 0.0) * HIDDEN_SHARE)


@loop
def turn(memory: Rows, i: int, noise: float, by_model: Rows, of: Rows, numbers: Row) -> None:
    """Take over the other hypothesis in cell ``i``."""
    left, extreme = memory[LEFT, i], memory[EXTREME, i]
    late = late_kpa(memory, i, noise, numbers) if left >= FAR else 0.0
    earlier = 0.0
    if left >= FAR and memory[SIGN, i] > 0.0:
        earlier = earlier_kpa(memory, i, noise * memory[GAIN, i], 0.0, numbers) * numbers[MIDWAY]
    sign = -memory[SIGN, i]
    rising, recovery = memory[RECOVERY_IN_FORCE, i], memory[RISING_IN_FORCE, i]
    memory[SIGN, i], memory[RISING_IN_FORCE, i], memory[RECOVERY_IN_FORCE, i] = sign, rising, recovery
    take_gains_of(memory, i, by_model, of, numbers)
    gain = memory[GAIN, i]
    pressure = memory[RISING_KPA, i] * rising + memory[RECOVERY_KPA, i] * recovery
    unsure = noise * gain
    # When the pressure turned is as doubtful as it was in the last frame whether it had turned.
    before = memory[VARIANCE, i]
    if memory[RESTED, i] > 0.0:
        taken_off = memory[TAKEN_OFF_KPA, i]
        left_over = before * numbers[LIGHT] + taken_off * taken_off
        before = min(before, memory[REST_VARIANCE, i] + left_over)
    rounded = numbers[FAST_KPA] / max(abs(pressure - memory[LAST, i]), numbers[FAST_KPA]) * numbers[ROUND_KPA]
    unseen = unseen_kpa(memory, i, pressure, gain, unsure, numbers) + rounded
    if left >= FAR and extreme < REFUTED:
        if sign > 0.0:
            unseen += hidden_kpa(memory, i, pressure, extreme, numbers)
        else:
            memory[LOOKS_AT_REST, i] = 0.0
    memory[MAY_BEAR_KPA, i] = 0.0
    doubt = math.sqrt(before) + unseen
    by_noise = by_model[0, 1] * noise
    by_noise *= by_noise
    turned = min(doubt * doubt + by_noise, numbers[MOST_KPA2])
    memory[TURNED, i] = turned
    memory[VARIANCE, i] = turned  # the distance of the hypotheses is in it
    memory[RESTED, i], memory[DRIFT_KPA, i], memory[TAKEN_OFF_KPA, i] = 0.0, 0.0, 0.0
    rest_variance = max(turned - by_noise, 0.0) * numbers[PART] + min(by_noise, turned)
    memory[REST_VARIANCE, i] = rest_variance if turned < numbers[MOST_RESTED_KPA2] else 0.0
    memory[DRIFT_END_KPA, i] = math.sqrt(min(turned, numbers[MOST_RESTED_KPA2])) * numbers[DRIFTS]
    if max(late, earlier) > 0.0:
        doubt = math.sqrt(turned) + late * numbers[MAY_BEND]
        memory[TURNED, i] = memory[VARIANCE, i] = min(doubt * doubt, numbers[MOST_KPA2])
        late = max(late, earlier)
        memory[EARLIER_KPA, i] -= late
        pressure += sign * late
        memory[PRESSURE, i] = pressure
        if sign > 0.0:
            memory[RISING_KPA, i] = pressure
            memory[SETTLED, i] += late * numbers[SETTLED_PER_KPA]
        else:
            memory[RECOVERY_KPA, i] = pressure
            memory[X2, i] += late / numbers[E1_KPA]
    now = sign * max(pressure, 0.0)
    if left < FAR:
        memory[EXTREME, i], memory[PEAK, i], memory[LEFT, i] = left, left, FAR
    else:
        memory[EXTREME, i], memory[PEAK, i], memory[LEFT, i] = now - numbers[LESS] * unsure, now - unsure, extreme
    memory[RECENT_EXTREME, i] = memory[EXTREME, i]


@loop
def turn_from(extreme: float, numbers: Row) -> float:
    """How far an exact pressure in kPa must go back from ``extreme`` for a turn."""
    return float(min(abs(extreme) * numbers[TURN_SHARE] + numbers[LIGHT_KPA], numbers[TURN_KPA]))


@loop
def seeming_kpa(memory: Rows, i: int, unsure: float, numbers: Row) -> float:
    """By how much the pressure of cell ``i`` may seem to go back though the load has not turned.

    Its noise is ``unsure``.
    """
    drift = memory[DRIFT_KPA, i]
    if memory[SIGN, i] > 0.0:
        shared = memory[EXTREME, i] - memory[RECOVERY_KPA, i] - numbers[CLEAR_FALL_KPA]
        drift = min(drift, max(shared, 0.0) * numbers[SHARED_FALL])
        if memory[THIRD_LAST, i] - memory[PRESSURE, i] > unsure * numbers[FALLING]:
            drift = 0.0
    return float(drift)


@loop
def look(memory: Rows, i: int, std: float, of: Rows, numbers: Row) -> bool:
    """Look at the hypothesis in force in cell ``i``; whether it has turned, or an earlier turn was noise."""
    rising, recovery = memory[RISING_KPA, i], memory[RECOVERY_KPA, i]
    pressure = rising * memory[RISING_IN_FORCE, i] + recovery * memory[RECOVERY_IN_FORCE, i]
    sign = memory[SIGN, i]
    unsure = std * memory[GAIN, i]
    ahead = max(pressure, numbers[LEAST_KPA]) * sign
    other = rising * of[NOT_RISING, i] + recovery * of[NOT_RECOVERY, i]
    back = other * sign + memory[LEFT, i]
    noise = of[OTHER_GAIN, i] * std
    memory[PRESSURE, i] = pressure
    of[UNSURE, i], of[AHEAD, i], of[SPARE, i], of[NOISE, i] = unsure, ahead, back, noise
    seeming = seeming_kpa(memory, i, unsure, numbers)
    if numbers[STEPS] > 0.0 and sign > 0.0:
        scale = memory[STATE_END - 1, i] + 1.0
        by_steps = scale * scale * numbers[STEPS]
        if other > max(by_steps, std) * of[OTHER_GAIN, i] * numbers[STILL]:
            seeming += max(by_steps - std, 0.0) * memory[GAIN, i] * numbers[FALL]
    least = turn_from(memory[EXTREME, i], numbers) + unsure * numbers[SURE]
    gone_back = memory[EXTREME, i] - ahead > least + seeming
    least = numbers[LIGHT_KPA] + unsure * numbers[FALLING]
    if sign > 0.0:
        least += seeming
    gone_back |= memory[RECENT_EXTREME, i] - ahead > least
    return bool(gone_back or back < noise)


@loop
def refutes(memory: Rows, i: int, std: float, by_model: Rows, numbers: Row) -> bool:
    """Whether the recovery model did not share the rise of cell ``i``, which is taken over or is to be."""
    begun = memory[LEFT, i] if memory[LEFT, i] < FAR else memory[EXTREME, i]  # the pressure then, sign turned
    rise, shared = begun + memory[RISING_KPA, i], begun + memory[RECOVERY_KPA, i]
    clear = rise > numbers[CLEAR_RISE_KPA] + std * (numbers[SURE] * by_model[0, 0])
    return bool(clear and shared < rise * numbers[SHARED] + std * (numbers[LESS] * by_model[0, 1]))


@loop
def take_turns(memory: Rows, taken: Rows, by_model: Rows, of: Rows, flags: FlagRows, numbers: Row) -> int:
    """Take over the other hypothesis where the pressure has turned, and confirm earlier turns.

    Readings are ``taken`` (4, m).

    Returns:
        Sum of UNCONFIRMED if a cell had turned unconfirmed, and of PULLED if one needs a pull.
    """
    found = 0
    rising_fade, recovery_fade = math.sqrt(by_model[2, 0]), math.sqrt(by_model[2, 1])
    for i in range(memory.shape[1]):
        std = taken[STD, i]
        memory[EARLIER_KPA, i] *= recovery_fade if sign_before(memory, i) > 0.0 else rising_fade
        turned = look(memory, i, std, of, numbers)
        unconfirmed, rises, refuted = memory[LEFT, i] < FAR, memory[SIGN, i] > 0.0, False
        if (unconfirmed or turned) and unconfirmed == rises:
            refuted = refutes(memory, i, std, by_model, numbers)
            if refuted:
                turned = rises
        if unconfirmed or turned:
            found |= UNCONFIRMED
        if turned:
            turn(memory, i, std, by_model, of, numbers)
            look(memory, i, std, of, numbers)
        if refuted:
            memory[PEAK, i] = of[AHEAD, i] - of[UNSURE, i]
            memory[EXTREME, i] = of[AHEAD, i] - of[UNSURE, i] * numbers[LESS]
            memory[RECENT_EXTREME, i] = memory[EXTREME, i]
        # The pressure went back by what would be a turn in the model that was left, too: no noise does both.
        least = of[NOISE, i] * of[CONFIRMING_SIGMAS, i]
        least += turn_from(memory[LEFT, i], numbers) * of[CONFIRMING_TURNS, i]
        shared = (memory[LEFT, i] + memory[RISING_KPA, i]) * numbers[SHARED]
        shares = of[SPARE, i] >= shared or memory[SIGN, i] < 0.0
        confirmed = memory[LEFT, i] < FAR and of[SPARE, i] >= least and shares
        flags[CONFIRMED, i] = confirmed
        if confirmed:
            memory[LEFT, i] = FAR
        if memory[PRESSURE, i] < numbers[PULLED_KPA]:
            found |= PULLED
    return found


@loop
def step_and_turn(
    memory: Rows,
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


@loop
def correct(memory: Rows, taken: Rows, by_model: Rows, numbers: Row) -> None:
    """Let the hypothesis in force remember less where it needs a pull, for readings ``taken`` (4, m)."""
    pull = numbers[PULL] * by_model[0, 1]
    for i in range(memory.shape[1]):
        off = abs(taken[READING, i] - taken[SMOOTHED, i]) + taken[READING_NOISE, i] * numbers[HIDDEN]
        doubt = max(off * numbers[PER_SIGMAS], taken[STD, i])
        allowed = pull * doubt - numbers[NEAR_KPA]
        if memory[SIGN, i] < 0.0:
            allowed = min(allowed, by_model[0, 1] * taken[STD, i] * -numbers[SURE])
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


@loop
def keep(memory: Rows, of: Rows, flags: FlagRows, numbers: Row) -> None:
    """Keep the doubt where the other hypothesis has begun anew though it was apart by more than noise."""
    for i in range(memory.shape[1]):
        by_noise = of[UNSURE, i] * numbers[LOST_SIGMAS]
        lost = 0.0
        if flags[WHERE, i] and memory[VARIANCE, i] > by_noise * by_noise:
            lost = memory[VARIANCE, i] - of[SPARE, i]
        doubt = math.sqrt(memory[TURNED, i]) + math.sqrt(max(lost, 0.0))
        memory[TURNED, i] = min(doubt * doubt, numbers[MOST_LOST_KPA2])


@loop
def begin_anew(
    memory: Rows,
    anew: Rows,
    of: Rows,
    flags: FlagRows,
    held_kpa: float,
    unconfirmed: bool,
    numbers: Row,
) -> None:
    """Begin the other hypothesis anew near the extreme, and tell how far apart both are.

    ``anew`` (6, m) is by how much the hypotheses change if they begin where the other one is; ``held_kpa`` by how much
    a pressure that is held may seem to go back in three frames.
    """
    begun_anywhere = False
    for i in range(memory.shape[1]):
        held = (memory[THIRD_LAST, i] - memory[PRESSURE, i]) * memory[SIGN, i] < held_kpa
        flags[HELD, i] = held
        below_peak = memory[PEAK, i] - of[AHEAD, i]
        again = 0.0
        if below_peak < max(of[UNSURE, i], numbers[FLAT_KPA] if held else 0.0):
            again = numbers[AGAIN]
        if below_peak <= numbers[EXACT_KPA]:
            again = 1.0
        if unconfirmed and memory[LEFT, i] < FAR:
            again = 0.0
        rising, recovery = of[NOT_RISING, i] * again, of[NOT_RECOVERY, i] * again
        for row in range(0, 6, 2):
            memory[RISING_KPA + row, i] += anew[row, i] * rising
            memory[RECOVERY_KPA + row, i] += anew[row + 1, i] * recovery
        confirmed = bool(unconfirmed and flags[CONFIRMED, i])
        follow_earlier_turn(memory, i, anew[0, i] * rising + anew[1, i] * recovery, confirmed, of, numbers)
    for i in range(memory.shape[1]):
        ahead, noise = of[AHEAD, i], of[UNSURE, i]
        memory[PEAK, i] = max(memory[PEAK, i], ahead - noise)
        unsure = noise * numbers[LESS]
        of[UNSURE, i] = unsure
        memory[EXTREME, i] = max(memory[EXTREME, i], ahead - unsure)
        error_kpa, fades = math.sqrt(memory[TURNED, i]), 1.0 - of[FADE, i]
        recent = memory[RECENT_EXTREME, i] - (fades * error_kpa + held_kpa * numbers[CREEPS])
        memory[RECENT_EXTREME, i] = max(recent, ahead - unsure)
        if flags[HELD, i]:
            memory[PEAK, i] -= fades * min(error_kpa, numbers[TURN_KPA]) * numbers[GOES_BACK]
        may_bear = memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        memory[VARIANCE, i] -= memory[TURNED, i] + may_bear  # by which the hypotheses were apart in the last frame
        memory[TURNED, i] *= of[FADE, i]
        apart = abs(memory[RISING_KPA, i] - memory[RECOVERY_KPA, i]) * numbers[EITHER]
        if memory[LEFT, i] >= FAR:
            fallen = 0.0
            if flags[HELD, i]:
                fallen = (memory[PEAK, i] - memory[SIGN, i] * memory[PRESSURE, i]) * numbers[FALLEN]
            apart += earlier_kpa(memory, i, noise, fallen, numbers) * numbers[EARLIER]
        apart *= apart
        of[SPARE, i] = apart
        # Whether the variance is large, and little of it is left.
        begun = memory[VARIANCE, i] * numbers[LEFT_OVER] > max(apart, numbers[CLEAR])
        if unconfirmed and flags[CONFIRMED, i]:
            begun = False  # what the model that was left says has been decided
        flags[WHERE, i] = begun
        begun_anywhere |= begun
    if begun_anywhere:
        keep(memory, of, flags, numbers)
    for i in range(memory.shape[1]):
        may_bear = memory[MAY_BEAR_KPA, i] * memory[MAY_BEAR_KPA, i]
        memory[VARIANCE, i] = of[SPARE, i] + memory[TURNED, i] + may_bear


ALL = take, take_gains, step_and_turn, correct, begin_anew
