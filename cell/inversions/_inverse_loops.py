"""The frame of :class:`._inverse.AsymmetricInversion` as loops over cells for :mod:`ohmskin.common.compiled`.

The loops do what the array operations of its ``advance`` do, in the same order. A step has three parts: the quadratic
equation of every cell, Newton's method for all cells together of which a branch changes over, and the new memory.
"""

from __future__ import annotations

import math

from ...common.compiled import Places, Row, Rows, SpacedRows, loop
from ..estimation import GAIN, PRESSURE, SMOOTHED, STD, VARIANCE

LOAD, BRANCH, BROKEN, ANCHOR, MOVED, BEFORE, ERROR, MISSED = 3, 4, 6, 7, 8, 9, 10, 13
WENT_UP, FURTHEST, LATELY = 14, 15, 16
"""rows of the memory, see :mod:`._inverse`; two branches, and three variances"""

A, B, K, ALPHA, RISE_S, FALL_S = 0, 1, 2, 3, 5, 7
FULL_KPA, FULL_R, HIGHEST, IN_DOUBT, DOUBT_KPA2, MOST_KPA2, LOWEST_END, HIGHEST_END = range(9, 17)
STILL, BETWEEN, BY_TURNS, TO_AND_FRO, ACCURACY, EVALUATIONS, OVERSHOOT, STEPS, AT_A_TURN = range(17, 26)
HELD_STEPS, MOVING_STEPS, MOVES, TURNS_KNOWN = range(26, 30)
"""places of the estimator's numbers: of its model, with two branches; full scale in kPa and in r; the largest credible
load, in general and while the memory is uncertain; the variance in kPa^2 above which the memory is uncertain; the
largest variance; the range of loads that the solver searches; the constants of :mod:`._inverse` (those of turns times
``k``) and of :mod:`._change_over`; and the standard deviation of r at rest by ADC steps"""

FREE, BREAKING, FORGETS, KEPT, FOLLOWS, SLOPE, CHANGE, STEP, NEW_BRANCH, WIDTH, UP = 0, 1, 2, 4, 6, 8, 9, 10, 11, 13, 14
TURNED, HIDDEN = 15, 16
"""rows of the work array for each cell; two rows where there is one for each branch"""
LOW, HIGH, NEWTON, NEXT, RATE, TRIED = 17, 18, 19, 20, 21, 23
"""rows of Newton's method; their columns count the cells with a change-over"""
ROWS = 24


@loop
def root(b: float, slope: float, change: float) -> float:
    """:func:`._inverse._root` of one cell."""
    if b < 0.0:
        change = min(change, slope * slope / (-4.0 * b))
    elif b > 0.0:
        change = max(change, slope * slope / (-4.0 * b))
    return 2.0 * change / (slope + math.sqrt(max(slope * slope + 4.0 * b * change, 0.0)))


@loop
def solve(memory: SpacedRows, taken: Rows, gone: Row, ramp: Row, numbers: Row, of: Rows, crossed: Places) -> int:
    """Solve for steps of the load without change-over, into ``of``; returns the number of cells written to ``crossed``.

    In these cells a branch changes over. ``gone`` and ``ramp`` (6,) are weights as in :func:`._inverse._weights`.
    """
    a, b, k = numbers[A], numbers[B], numbers[K]
    count = 0
    for i in range(memory.shape[1]):
        s0, std, anchor = memory[LOAD, i], taken[STD, i], memory[ANCHOR, i]
        free = memory[BROKEN, i] * (1.0 - gone[4])
        breaking = k * (1.0 - ramp[4])
        for j in range(2):
            lead = numbers[ALPHA + j] * s0 - memory[BRANCH + j, i]
            of[FORGETS + j, i] = gone[j] if lead > 0.0 else gone[2 + j]
            of[KEPT + j, i] = memory[BRANCH + j, i] + lead * of[FORGETS + j, i]
        slope = a + 2.0 * b * s0
        change = taken[SMOOTHED, i] - (a + b * s0) * s0 - free - of[KEPT, i] - of[KEPT + 1, i]
        up = change > 0.0  # r rises with the load, so that this is also the sign of the step
        for j in range(2):
            alpha = numbers[ALPHA + j]
            lead = alpha * s0 - memory[BRANCH + j, i]
            charging = lead > 0.0 or (lead == 0.0 and up)
            of[FOLLOWS + j, i] = alpha * ramp[j] if charging else alpha * ramp[2 + j]
        still = max(slope + of[FOLLOWS, i] + of[FOLLOWS + 1, i], 1e-9)
        scale = taken[SMOOTHED, i] + 1.0
        steps = min(scale * scale * numbers[STEPS], std)
        by_noise = math.sqrt(std * std - steps * steps) * (numbers[STILL] / numbers[FULL_KPA]) * memory[GAIN, i]
        width = numbers[HELD_STEPS] * steps / still
        if memory[LATELY, i] > numbers[MOVES] * width:
            width = numbers[MOVING_STEPS] * steps / still
        width = max(by_noise, width)
        went_up, turned, hidden = up, 0.0, 0.0
        if k != 0.0:
            moves = abs(s0 + change / still - anchor) > width
            # A load that has turned has crossed its play, and broken chains there. A load that goes on after noise took
            # it back has broken the chains up to its furthest point before.
            went_up = memory[WENT_UP, i] > 0.0
            if moves:
                if up != went_up:
                    turned, hidden = numbers[AT_A_TURN] * steps / still, numbers[TURNS_KNOWN] * by_noise
                    gone_back = (memory[FURTHEST, i] - s0) * (1.0 if went_up else -1.0) - numbers[OVERSHOOT] * by_noise
                    crossed_play = k * min(max(gone_back, 0.0), 2.0 * width)
                    free += crossed_play
                    change -= crossed_play
                else:
                    again = k * max((memory[FURTHEST, i] - s0) * (1.0 if up else -1.0), 0.0)
                    free -= again
                    change += again
                went_up = up
            else:
                breaking = 0.0
        slope = slope + (breaking if up else -breaking)
        step = root(b, slope + of[FOLLOWS, i] + of[FOLLOWS + 1, i], change)
        crosses = False
        for j in range(2):
            target = numbers[ALPHA + j] * s0
            branch = of[KEPT + j, i] + of[FOLLOWS + j, i] * step
            of[NEW_BRANCH + j, i] = branch
            lead = target - memory[BRANCH + j, i]
            crosses |= (target + numbers[ALPHA + j] * step - branch) * lead < 0.0
        of[FREE, i], of[BREAKING, i], of[SLOPE, i], of[CHANGE, i] = free, breaking, slope, change
        of[STEP, i], of[WIDTH, i], of[UP, i] = step, width, 1.0 if went_up else 0.0
        of[TURNED, i], of[HIDDEN, i] = turned, hidden
        if crosses:
            crossed[count] = i
            count += 1
    return count


@loop
def change_over(
    memory: SpacedRows, i: int, j: int, step: float, dt_s: float, numbers: Row, of: Rows
) -> tuple[float, float]:
    """:meth:`._change_over.ChangeOver.branches` of cell ``i`` and branch ``j``: where it ends, and its derivative."""
    alpha = numbers[ALPHA + j]
    target = alpha * memory[LOAD, i]
    lead = target - memory[BRANCH + j, i]
    speed = alpha * step / dt_s
    if lead * speed < 0.0:
        first_s, second_s = numbers[RISE_S + j], numbers[FALL_S + j]
        if lead < 0.0:
            first_s, second_s = second_s, first_s
        since = lead / speed
        ratio = -since / first_s
        left = dt_s - first_s * math.log1p(ratio)
        if left > 0.0:
            done = -math.expm1(-left / second_s)
            lags = second_s * done
            rate = alpha * (1.0 - (lags - (1.0 - done) * since / (1.0 + ratio)) / dt_s)
            return target + alpha * step - speed * lags, rate
    return of[KEPT + j, i] + of[FOLLOWS + j, i] * step, of[FOLLOWS + j, i]


@loop
def solve_crossed(memory: SpacedRows, crossed: Places, count: int, dt_s: float, numbers: Row, of: Rows) -> None:
    """:meth:`._change_over.ChangeOver.solved`, for the first ``count`` of the cells ``crossed``."""
    b, accuracy = numbers[B], numbers[ACCURACY]
    bend = 0.0
    for j in range(2):
        bend += numbers[ALPHA + j] * dt_s * abs(1.0 / numbers[RISE_S + j] - 1.0 / numbers[FALL_S + j])
    for n in range(count):
        i = crossed[n]
        load = memory[LOAD, i]
        if of[CHANGE, i] > 0.0:
            of[LOW, n], of[HIGH, n] = 0.0, max(numbers[HIGHEST_END] - load, 0.0)
            of[TRIED, n] = of[HIGH, n]
        else:
            of[LOW, n], of[HIGH, n] = min(numbers[LOWEST_END] - load, 0.0), 0.0
            of[TRIED, n] = of[LOW, n]
        of[STEP, i] = min(max(of[STEP, i], of[LOW, n]), of[HIGH, n])
        if of[STEP, i] == of[TRIED, n]:
            of[TRIED, n] = math.inf  # the end of the bracket has been tried
    for left in range(int(numbers[EVALUATIONS]) - 1, -1, -1):
        all_solved = True
        for n in range(count):
            i = crossed[n]
            step, slope, change = of[STEP, i], of[SLOPE, i], of[CHANGE, i]
            of[NEW_BRANCH, i], of[RATE, n] = change_over(memory, i, 0, step, dt_s, numbers, of)
            of[NEW_BRANCH + 1, i], of[RATE + 1, n] = change_over(memory, i, 1, step, dt_s, numbers, of)
            if left == 0:
                continue
            rate = slope + 2.0 * b * step + of[RATE, n] + of[RATE + 1, n]
            kept = of[KEPT, i] + of[KEPT + 1, i]
            excess = (slope + b * step) * step + of[NEW_BRANCH, i] + of[NEW_BRANCH + 1, i] - kept - change
            if excess > 0.0:
                of[HIGH, n] = step
            else:
                of[LOW, n] = step
            low, high = of[LOW, n], of[HIGH, n]
            rises = rate > 1e-6
            move = -excess / rate if rises else 0.0
            newton = min(max(step + move, low), high)
            # The error after a Newton step is the next term of the Taylor series.
            next_term = (bend + abs(b * step)) * (move * move)
            small = next_term <= accuracy * rate * abs(step) or abs(move) <= accuracy
            solved = (rises and small) or low == high
            to_end = rises and newton == of[TRIED, n]
            inside = solved or (rises and low < newton and newton < high)
            of[NEWTON, n] = newton
            of[NEXT, n] = newton if inside or to_end else 0.5 * (low + high)
            if to_end:
                of[TRIED, n] = math.inf
            all_solved = all_solved and solved
        if left == 0:
            return
        for n in range(count):
            i = crossed[n]
            if all_solved:
                move = of[NEWTON, n] - of[STEP, i]
                of[NEW_BRANCH, i] += of[RATE, n] * move
                of[NEW_BRANCH + 1, i] += of[RATE + 1, n] * move
                of[STEP, i] = of[NEWTON, n]
            else:
                of[STEP, i] = of[NEXT, n]
        if all_solved:
            return


@loop
def finish(memory: SpacedRows, taken: Rows, heals: float, forgets: float, numbers: Row, of: Rows) -> None:
    """Write the memory after the steps, limit it, and update its variances: ``advance``, ``_limit`` and ``_err``.

    In the step, the share ``heals`` of the broken chains heals, and the recent way fades by the share ``forgets``.
    """
    a, b, k, full_kpa = numbers[A], numbers[B], numbers[K], numbers[FULL_KPA]
    for i in range(memory.shape[1]):
        r, std, step, width = taken[SMOOTHED, i], taken[STD, i], of[STEP, i], of[WIDTH, i]
        load = memory[LOAD, i] + step
        one, other = of[NEW_BRANCH, i], of[NEW_BRANCH + 1, i]
        broken = of[FREE, i] + of[BREAKING, i] * abs(step)
        allowed = -(3.0 * std / numbers[FULL_R] + 0.01)
        if load < allowed:
            load = allowed
            left, remembered = r - (a + b * load) * load, one + other + broken
            share = min(max(left / remembered, 0.0), 1.0) if remembered > 0.0 else 0.0
            one, other, broken = one * share, other * share, broken * share
        highest = numbers[IN_DOUBT] if memory[VARIANCE, i] > numbers[DOUBT_KPA2] else numbers[HIGHEST]
        if load >= highest:
            load = highest
            left = r - (a + b * load) * load - (one + other + broken)
            if k > 0.0:  # No credible load explains so much r: chains have broken unseen.
                broken += max(left, 0.0)
        if k != 0.0:
            memory[WENT_UP, i] = of[UP, i]
            memory[LATELY, i] *= 1.0 - forgets
            if of[BREAKING, i] != 0.0:
                memory[FURTHEST, i] = load
                memory[LATELY, i] += abs(step)
        gain = full_kpa / max(a + 2.0 * b * load - k, 0.05 * numbers[FULL_R])
        memory[LOAD, i], memory[BRANCH, i], memory[BRANCH + 1, i], memory[BROKEN, i] = load, one, other, broken
        memory[PRESSURE, i], memory[GAIN, i] = load * full_kpa, gain
        memory[ANCHOR, i] = max(min(memory[ANCHOR, i], load + width), load - width)

        still = numbers[STILL] * std * gain / full_kpa
        bend = max(abs(step - memory[MOVED, i]) - still, 0.0)
        # Before it turned, the load may have gone on and come back by as much as it moves in a frame.
        sign = 1.0 if step > 0.0 else (-1.0 if step < 0.0 else 0.0)
        little = still / numbers[STILL]
        turned = -sign * memory[MOVED, i] > little or -sign * memory[BEFORE, i] > little
        way = max(abs(step) - still, 0.0) if turned else 0.0
        for j in range(2):
            stays = 1.0 - of[FORGETS + j, i]
            follows, alpha = of[FOLLOWS + j, i], max(numbers[ALPHA + j], 1e-9)
            lag = numbers[BETWEEN] * bend * follows * (1.0 - follows / alpha)
            memory[ERROR + j, i] = memory[ERROR + j, i] * (stays * stays) + lag * lag
        by_turns = numbers[BY_TURNS] * way
        memory[ERROR + 2, i] = memory[ERROR + 2, i] * ((1.0 - heals) * (1.0 - heals)) + (
            by_turns * by_turns + of[TURNED, i] * of[TURNED, i]
        )
        missed = memory[MISSED, i] * (1.0 - heals) + (numbers[TO_AND_FRO] * way + of[HIDDEN, i])
        memory[MISSED, i] = missed
        memory[BEFORE, i] = memory[MOVED, i]
        memory[MOVED, i] = step
        errors = memory[ERROR, i] + memory[ERROR + 1, i] + memory[ERROR + 2, i]
        memory[VARIANCE, i] = min((errors + missed * missed) * (gain * gain), numbers[MOST_KPA2])


ALL = solve, solve_crossed, finish
