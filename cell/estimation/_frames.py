"""Kernels of a block of frames: conductances with their errors to what the filter follows, and that to pressures.

Frames are taken one after the other, and all cells of a frame before the next one, so that a stream gives the same
numbers however it is cut into blocks.
"""

from __future__ import annotations

import math

from ...common.compiled import Blocks, PlaceRows, Places, Reasons, Record, Records, Row, Rows, loop
from ...common.measurement import (
    COLUMN_HALF_STEP,
    COLUMN_STD,
    CONDUCTANCE,
    GREATEST,
    HALF_STEP,
    LEAST,
    NOISE_VARIANCE,
    STEP_STD,
)
from .._state import CellState
from ._columns import share_each
from ._filter import Candidates, Estimates, Pools, Reading, Watch, begin, step_each
from ._modes import Step
from ._neighbours import BELIEVED, LOAD, VARIANCE, alike, fuse, prior
from ._scale import Scale, scaled

FORGET_EVERY_S = 0.05
"""s, after which evidence is forgotten, and cells are put to sleep"""
LEAST_STD = 1e-6
"""of r: readings are not taken as more exact"""
FAR = 1e9
"""r of a bound that is none"""
BELOW_STD = 3.0
"""standard deviations of the noise below zero, from which a reading is in error"""
READ, AWAKE, ASLEEP, BEGUN, DOUBTED = 1, 2, 4, 8, 16
"""flags of a cell in a frame: it was read; and not only watched; it sleeps now; it began; its contact seems bad"""


class Settings(Record):
    """What an estimator knows of all its cells."""

    unit: float
    """r, or load, of one unit of what the filter follows"""
    r_unit: float
    """r of one"""
    least: float
    """credible r"""
    most: float
    usual_level: float
    """level of the heaviest usual load"""
    remembers: float
    """0: what was before a gap says nothing of a cell"""
    filtered: float
    """0: readings pass as they are"""
    follows: float
    """1: the filter follows the load itself"""
    geq: float
    """r of full scale held for ever, and as it is reached; and the slow branch"""
    gu: float
    g3: float
    full_kpa: float
    unknown_kpa: float
    """standard deviation of an unknown usual load"""
    floor_kpa: float
    """least standard deviation, where the filter does not state it"""
    model_std_kpa: float
    rest_error: float
    """relative standard deviation of R0"""
    states_std: float
    lasting: float
    """1: the measurement says which errors no average lessens; they are stated with the load"""
    alone: float
    """see :class:`._modes.Tuning`"""
    sudden: float


class Clock(Record):
    """The time of an estimator."""

    frames: float
    """taken so far"""
    since_forgot_s: float


LIKE, BELIEVES, LOST = 2, -1.0, -2.0
"""row of what is shown: the probability that the load was one that the neighbours tell; or that the cell is believed,
or has just been lost"""
WAS_READ, WAS_KNOWN = 0, 1
"""rows of what is remembered of readings: 1 where a cell has ever been read, and where it was in the last frame"""


@loop
def take_reading(block: Rows, i: int, settings: Settings, scale: Scale, rest_ohm: float, reading: Reading) -> bool:
    """Turn what a measurement (fields, n) says of cell ``i`` into an interval of r; returns whether it says anything.

    A reading counts as missing if it is NaN, shorted, or beyond every credible load. Without current a cell that is
    open at rest bears no load.
    """
    conductance, unit = block[CONDUCTANCE, i], settings.r_unit
    reading.low = reading.high = reading.slope = 0.0
    reading.variance = 1.0
    if not math.isfinite(conductance):
        return bound_reading(block, i, settings, scale, rest_ohm, reading)
    r, by_conductance = scaled(scale, rest_ohm, conductance)
    r, by_conductance = r / unit, by_conductance / unit
    half = abs(by_conductance) * block[HALF_STEP, i]
    var = by_conductance * by_conductance * block[NOISE_VARIANCE, i]
    var = max(var, LEAST_STD * LEAST_STD)
    if scale.open_at_rest > 0.0 and not (math.isfinite(r) and math.isfinite(by_conductance) and conductance > 0.0):
        r, half, var = 0.0, 0.0, LEAST_STD * LEAST_STD
    if not (math.isfinite(r) and math.isfinite(half) and math.isfinite(var)):
        return False
    # No load and no memory leaves r below zero: what is there beyond the noise is an error of the reading.
    below = min(r + BELOW_STD * math.sqrt(var) + half, 0.0)
    seen, r = r, r - below
    if not (seen * unit > settings.least and r * unit < settings.most):
        return False
    reading.low, reading.high, reading.variance = r - half, r + half, var + below * below
    reading.slope = by_conductance if math.isfinite(by_conductance) else 0.0
    return True


@loop
def bound_reading(block: Rows, i: int, settings: Settings, scale: Scale, rest_ohm: float, reading: Reading) -> bool:
    """The same for a cell of which only bounds on the conductance are known, as of a reading at a limit."""
    least, greatest = math.nan, math.nan
    if math.isfinite(block[LEAST, i]) and block[LEAST, i] > 0.0:
        least = scaled(scale, rest_ohm, block[LEAST, i])[0] / settings.r_unit
    if math.isfinite(block[GREATEST, i]) and block[GREATEST, i] > 0.0:
        greatest = scaled(scale, rest_ohm, block[GREATEST, i])[0] / settings.r_unit
    # The unit of a cell whose resistance falls is negative, so that r rises with its load either way.
    falls = scale.falls > 0.0
    first, last = (least, greatest) if falls else (greatest, least)
    if falls and scale.open_at_rest > 0.0:  # a bound below is none
        says = math.isfinite(first) or math.isfinite(last)
    else:
        says = math.isfinite(first) if falls else math.isfinite(last) and last > 0.0
    first = first if math.isfinite(first) else -FAR
    last = last if math.isfinite(last) else FAR
    if falls:  # usual loads alone are credited
        last = min(last, max(settings.usual_level, first))
    # No load reads less than rest but for errors: as far below as above, so that the middle says nothing.
    reading.low, reading.high, reading.variance = max(first, -last), last, LEAST_STD * LEAST_STD
    return says and first <= last and last > 0.0


@loop
def errors_of(block: Rows, i: int, reading: Reading) -> None:
    """Take what a measurement says of the errors that cell ``i`` shares with its column."""
    held = block[COLUMN_HALF_STEP, i] * reading.slope
    reading.shared, reading.held, reading.lasting = STEP_STD * held, abs(held), 0.0
    if block[COLUMN_STD, i] != 0.0:
        shared_std, own = block[COLUMN_STD, i] * reading.slope, math.sqrt(reading.variance)
        reading.variance += shared_std * shared_std
        beyond = math.sqrt(reading.variance) - own  # what a column shares hardly averages: its cells move together
        reading.lasting = beyond * beyond


@loop
def middle(reading: Reading) -> float:
    """The r with which a cell begins; 0 where nothing bounds it."""
    r = 0.5 * (reading.low + reading.high)
    return r if abs(r) < 0.1 * FAR else 0.0


@loop
def take_frames(
    cells: Records[Estimates],
    befores: Records[Estimates],
    watches: Records[Watch],
    candidates: Records[Candidates],
    pools: Records[Pools],
    trial: Records[Estimates],
    all_settings: Records[Settings],
    scales: Records[Scale],
    clocks: Records[Clock],
    rest_ohm: Row,
    sleeps: Row,
    columns: Row,
    seen: Rows,
    readings: Records[Reading],
    states: Records[CellState],
    slopes: Row,
    shown: Rows,
    beside: PlaceRows,
    loads: Rows,
    steps: Records[Step],
    which: Places,
    blocks: Blocks,
    status: Reasons,
    level: Rows,
    level_variance: Rows,
    pressure: Rows,
    std: Rows,
) -> None:
    """Take frames of n cells.

    Args:
        cells: (n,) state of the filter, as ``befores`` and ``watches``; see :func:`.step_each`.
        befores: see ``cells``.
        watches: see ``cells``.
        candidates: (1,) scratch of the filter, as ``pools`` and ``trial``.
        pools: see ``candidates``.
        trial: see ``candidates``.
        all_settings: (1,)
        scales: (1,) of the readings.
        clocks: (1,)
        rest_ohm: (n,) R0.
        sleeps: (n,) 1 where a cell may sleep.
        columns: (columns,) recent mean of what each shares.
        seen: (2, n) what is remembered of readings.
        readings: (n,) written: the readings of the last frame.
        states: (n,) what the inversion says of the cells.
        slopes: (m,) see :func:`show_frames`, as ``shown``, ``beside`` and ``loads``.
        shown: see ``slopes``.
        beside: see ``slopes``.
        loads: see ``slopes``.
        steps: (k,) weights of time steps.
        which: (frames,) number of the step of each frame.
        blocks: (frames, fields, n) measurements.
        status: (frames, n) written: flags.
        level: (frames, n) written: what the filter follows.
        level_variance: (frames, n) written.
        pressure: (frames, n) written in kPa if the filter follows the load, else by :func:`show_frames`.
        std: (frames, n) likewise, standard deviations.

    """
    settings, scale, clock = all_settings[0], scales[0], clocks[0]
    for frame in range(blocks.shape[0]):
        place = which[frame]
        step, block = steps[place : place + 1], blocks[frame]
        t = step[0]
        clock.frames += 1.0
        shares, was_read = False, seen[WAS_READ if settings.remembers > 0.0 else WAS_KNOWN]
        for i in range(rest_ohm.size):
            reading, watch, flags = readings[i], watches[i], 0
            reading.known = seen[WAS_READ, i] - 1.0
            if take_reading(block, i, settings, scale, rest_ohm[i], reading):
                reading.known, flags = 1.0, READ
                if was_read[i] == 0.0:
                    flags = READ | BEGUN
                    begin(cells[i], middle(reading), settings.geq, settings.gu, settings.g3)
                    watch.odds = watch.since_s = watch.asleep = watch.offset = watch.cusum = 0.0
                seen[WAS_READ, i] = 1.0
            seen[WAS_KNOWN, i] = max(reading.known, 0.0)
            errors_of(block, i, reading)
            shares = shares or reading.held != 0.0
            status[frame, i] = flags | ASLEEP if watch.asleep > 0.0 else flags
        if settings.filtered == 0.0:
            for i in range(rest_ohm.size):
                reading = readings[i]
                level[frame, i], level_variance[frame, i] = 0.5 * (reading.low + reading.high) * settings.r_unit, 0.0
                if status[frame, i] & READ:
                    status[frame, i] |= AWAKE
            continue
        if shares:
            share_each(cells, watches, step, columns, readings)
        clock.since_forgot_s += t.dt_s
        forget = 1.0
        if clock.since_forgot_s >= FORGET_EVERY_S:
            forget = math.exp(-clock.since_forgot_s / t.forget_s)
            clock.since_forgot_s = 0.0
        step_each(
            *(cells, befores, watches, candidates, pools, trial, step, readings, sleeps),
            *(beside, loads, settings.sudden, forget),
        )
        for i in range(rest_ohm.size):
            slept, sleeping = status[frame, i] & ASLEEP, watches[i].asleep > 0.0
            if status[frame, i] & READ and not (slept and sleeping):
                status[frame, i] |= AWAKE
            if slept and not sleeping:
                status[frame, i] -= ASLEEP
            elif sleeping and not slept:
                status[frame, i] |= ASLEEP
            level[frame, i], level_variance[frame, i] = 0.0, 0.0
            reading = readings[i]
            if reading.believed == 0.0:
                status[frame, i] |= DOUBTED
            if reading.known >= 0.0:
                level[frame, i], level_variance[frame, i] = reading.load * settings.unit, reading.load_variance
                if settings.lasting > 0.0 and reading.slope != 0.0:
                    half, held = 0.5 * (reading.high - reading.low), reading.held
                    lasting = STEP_STD * STEP_STD * (half * half + held * held) + reading.lasting
                    level_variance[frame, i] += lasting / (settings.geq * settings.geq)
    if settings.follows > 0.0:
        show_frames(
            *(status, level, level_variance, states, states, all_settings, slopes, shown),
            *(beside, loads, pressure, std),
        )


@loop
def show_frames(
    status: Reasons,
    level: Rows,
    level_variance: Rows,
    answers: Records[CellState],
    states: Records[CellState],
    all_settings: Records[Settings],
    slopes: Row,
    shown: Rows,
    beside: PlaceRows,
    loads: Rows,
    pressure: Rows,
    std: Rows,
) -> None:
    """Write the pressures (frames, n) of frames in kPa, and their standard deviations.

    Args:
        status: (frames, n) flags, as ``level`` and ``level_variance`` of :func:`take_frames`.
        level: see ``status``.
        level_variance: see ``status``.
        answers: (frames n,) of the inversion; not needed where the filter follows the load.
        states: (n,) the last answer for each cell, renewed.
        all_settings: (1,)
        slopes: (m,) kPa per relative error of R0, at pressures spaced evenly from 0 to full scale.
        shown: (3, n) the last pressures and deviations, and for cells that are not believed the probability that their
            loads were like those beside when they last were; renewed.
        beside: (n, most) cells beside each; n: none.
        loads: (3, n) scratch.
        pressure: written.
        std: written.

    """
    settings, cells = all_settings[0], states.size
    full = settings.full_kpa
    for frame in range(status.shape[0]):
        if lose(status, frame, shown, loads):
            for i in range(cells):
                if shown[LIKE, i] == LOST:
                    usual, about = prior(i, beside, loads)
                    own, own_var = shown[0, i], shown[1, i] * shown[1, i]
                    shown[LIKE, i] = alike(own, own_var, usual, about, full, settings.alone)
        missing = False
        for i in range(cells):
            flags, state = status[frame, i], states[i]
            if flags & AWAKE:
                state.level = level[frame, i]
                if settings.follows > 0.0:
                    state.pressure_kpa, state.gain_kpa, state.variance_kpa2 = state.level * full, full, 0.0
                else:
                    answer = answers[frame * cells + i]
                    state.pressure_kpa, state.gain_kpa = answer.pressure_kpa, answer.gain_kpa
                    state.variance_kpa2 = answer.variance_kpa2
            kpa = 0.0 if flags & ASLEEP else state.pressure_kpa
            var = state.variance_kpa2 + settings.model_std_kpa * settings.model_std_kpa
            if settings.filtered > 0.0:
                gain = state.gain_kpa * settings.unit
                if settings.follows == 0.0 and not flags & READ:  # of the levels that it may have
                    gain = answers[frame * cells + i].gain_kpa * settings.unit
                unknown, floor = settings.unknown_kpa, settings.floor_kpa
                var += min(gain * gain * level_variance[frame, i], unknown * unknown) + floor * floor
            if settings.rest_error > 0.0:
                by_rest = settings.rest_error * between(slopes, kpa / full)
                var += by_rest * by_rest
            if settings.states_std == 0.0:
                var = math.nan
            if not flags & READ:  # the last pressure is kept; what the filter thinks of it since counts as doubt
                off = min(abs(state.gain_kpa * (level[frame, i] - state.level)), settings.unknown_kpa)
                kpa = shown[0, i]
                var = math.nan if math.isnan(kpa) else var + off * off
            believed = shown[LIKE, i] == BELIEVES
            loads[LOAD, i], loads[VARIANCE, i], loads[BELIEVED, i] = kpa, var, 1.0 if believed else 0.0
            missing = missing or not believed
            shown[0, i], shown[1, i] = kpa, math.sqrt(var)
            pressure[frame, i], std[frame, i] = kpa, shown[1, i]
        if missing:
            for i in range(cells):
                if shown[LIKE, i] != BELIEVES:
                    usual, about = prior(i, beside, loads)
                    if about >= 0.0 and not math.isnan(loads[LOAD, i]):
                        kpa, var = fuse(loads[LOAD, i], loads[VARIANCE, i], usual, about, shown[LIKE, i])
                        shown[1, i] = math.sqrt(var)
                        pressure[frame, i], std[frame, i] = kpa, shown[1, i]


@loop
def lose(status: Reasons, frame: int, shown: Rows, loads: Rows) -> bool:
    """Mark cells that are not believed any more, and tell what they and the others showed; returns if there are any."""
    lost = False
    for i in range(status.shape[1]):
        loads[LOAD, i], loads[VARIANCE, i] = shown[0, i], shown[1, i] * shown[1, i]
        loads[BELIEVED, i] = 1.0 if shown[LIKE, i] == BELIEVES and not math.isnan(shown[0, i]) else 0.0
        if status[frame, i] & READ and not status[frame, i] & DOUBTED:
            shown[LIKE, i] = BELIEVES
        elif shown[LIKE, i] == BELIEVES:
            shown[LIKE, i], lost = LOST, True
    return lost


@loop
def between(table: Row, share: float) -> float:
    """The value of an evenly spaced ``table`` (m,) at a ``share`` of the way from its first to its last point."""
    if math.isnan(share):
        return share
    place = min(max(share, 0.0), 1.0) * (table.size - 1)
    at = min(int(place), table.size - 2)
    return float(table[at] + (table[at + 1] - table[at]) * (place - at))
