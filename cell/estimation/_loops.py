"""Compiled loops (:mod:`ohmskin.common.compiled`) over cells for the part of a frame that all estimators share.

Each loop repeats array operations of :mod:`._inversion`, :mod:`._sleep`, :mod:`._smoothing` or :mod:`._deviation`,
operation for operation and in the same order, so that the results agree to the last bit. Rare events (cells that wake,
gaps, sparks) have no loop, except for :func:`copy`, since the memory of a whole skin may have to be copied at once.
"""

from __future__ import annotations

import math

from ...common.compiled import FixedRow, Flags, Places, Row, Rows, SpacedRows, loop
from ._rows import GAIN, NOISE, PRESSURE, READING, STD, VARIANCE
from ._smoothing import LEVEL


@loop
def read(resistance: FixedRow, per_ohm: Row, r: Row, low: float, high: float) -> bool:
    """Normalise resistances (n,) to ``r`` (n,); returns whether all are between ``low`` and ``high``."""
    for i in range(r.size):
        r[i] = resistance[i] * per_ohm[i] - 1.0
    outside = 0
    for i in range(r.size):
        outside += not (low < r[i] < high)  # NaN is outside, too
    return outside == 0


@loop
def watch(r: Row, watched: Row, blurred: Row, total: Row, wake_at: Row) -> bool:
    """Add readings ``watched`` (n,) to their sum; returns whether one of them, or of ``r`` (n,), wakes its cell.

    The noise of ``watched`` is ``blurred`` (n,) times that of ``r``.
    """
    woken = False
    for i in range(r.size):
        total[i] += watched[i]
        woken |= abs(r[i]) > wake_at[i] or abs(watched[i]) > wake_at[i] * blurred[i]
    return woken


@loop
def renew_means(
    total: Row, summed: int, mean: Row, share: float, wake_at: Row, band: float, averaged: float, blurred: Row
) -> bool:
    """Update the means (n,) by the sums of readings, and reset the sums; returns whether a mean wakes its cell.

    ``averaged`` is the standard deviation of a mean over that of a reading. The noise of the summed readings is
    ``blurred`` (n,) times that of the readings to which ``wake_at`` applies.
    """
    woken = False
    for i in range(mean.size):
        mean[i] += (total[i] / summed - mean[i]) * share
        total[i] = 0.0
        woken |= abs(mean[i]) > band + averaged * blurred[i] * (wake_at[i] - band)
    return woken


@loop
def take(r: Row, noise_at_rest: Row, cells: Places, line: Rows, taken: Rows, least: float) -> None:
    """Gather the readings of ``cells`` (m,) and their noise into ``taken`` (4, m)."""
    every = cells.size == r.size
    for i in range(cells.size):
        cell = i if every else cells[i]
        scale = line[LEVEL, i] + 1.0
        taken[READING, i] = r[cell]
        taken[NOISE, i] = scale * scale * noise_at_rest[cell] + least


@loop
def copy(
    values: SpacedRows, rows: Places, cells: Places, found: SpacedRows, found_rows: Places, found_cells: Places
) -> None:
    """Copy ``rows`` (k,) of ``values`` at ``cells`` (m,) to ``found_rows`` (k,) of ``found`` at ``found_cells``."""
    for k in range(rows.size):
        row, found_row = rows[k], found_rows[k]
        for i in range(cells.size):
            found[found_row, found_cells[i]] = values[row, cells[i]]


MODEL_VARIANCE, WITHIN, SURE, FULL, MUCH, MUCH_NOISE, NO_LOAD, TINY = range(8)
HIDDEN, PER_SIGMAS, STATED, SIGMAS, HIDDEN_SHARE, RISE_KPA, FALL_KPA, RESTS, DOUBT_KPA2, LIGHT_KPA2, DOUBTED_KPA2 = (
    range(8, 19)
)
"""indices into the parameter array of :func:`show` and :func:`watch_over`.

MODEL_VARIANCE: variance in kPa^2 by the model. WITHIN, SURE: :attr:`._inversion.Inversion.bends`. FULL: full scale in
kPa. MUCH, MUCH_NOISE: pressure and noise in kPa beyond which :func:`show` limits or shrinks pressures. NO_LOAD:
:data:`._inversion.NO_LOAD_SIGMAS`. TINY: avoids 0/0. HIDDEN, SIGMAS: as in :mod:`._smoothing`; PER_SIGMAS: 1 / SIGMAS;
HIDDEN_SHARE: HIDDEN / SIGMAS. STATED: 1 if a standard deviation is stated, else 0. RISE_KPA, FALL_KPA: pressure per r
of a fast rise and of a fast fall. RESTS: :attr:`._inversion.Inversion.rests`. DOUBT_KPA2: variance in kPa^2 above which
pressures are limited to MUCH. LIGHT_KPA2, DOUBTED_KPA2: squares of :data:`._inversion.LIGHT_LOAD` and
:data:`._inversion.DOUBTED_LOAD` in kPa^2"""
LAST, BEFORE_LAST = 3, 4
"""rows of the memory with the pressures of the last two frames, in inversions with ``bends``"""
TURNED, SIGN, LEFT, REST_VARIANCE, RESTED = 6, 7, 10, 20, 21
"""rows of the memory in inversions with ``rests``: variance in kPa^2 of the memory by its last turning point; negative
where the cell is released; below :data:`FAR` where the last turning point is unconfirmed; variance in kPa^2 of the
memory of a released cell; 1 where the cell is classified as at rest"""
FAR = 1e12
"""value of the row LEFT in kPa where no turning point is unconfirmed"""


@loop
def interpolated(x: float, at: Row, values: Row) -> float:
    """:func:`numpy.interp` for a single number."""
    last = at.size - 1
    if x >= at[last]:
        return float(values[last])
    if x < at[0]:
        return float(values[0])
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if x >= at[middle]:
            low = middle
        else:
            high = middle
    if at[low] == x:
        return float(values[low])
    slope = (values[low + 1] - values[low]) / (at[low + 1] - at[low])
    return float(slope * (x - at[low]) + values[low])


@loop
def show(
    memory: SpacedRows,
    line: Rows,
    taken: Rows,
    added: Row,
    numbers: Row,
    rest_at_kpa: Row,
    rest_variance: Row,
    cells: Places,
    pressure: Row,
    variance: Row,
) -> None:
    """Write the pressures to show of ``cells`` (m,) to ``pressure`` (n,), and variances in kPa^2 to ``variance`` (n,).

    ``added`` (m,) holds variances by effects outside the inversion, and is changed.
    """
    full, much, no_load = numbers[FULL], False, numbers[NO_LOAD]
    most_kpa, doubt_kpa2 = numbers[MUCH], numbers[DOUBT_KPA2]
    much_noise = False
    # Read once: the compiler cannot know that no array written below is ``numbers``.
    rise_kpa, fall_kpa = numbers[RISE_KPA], numbers[FALL_KPA]
    rests, light_kpa2, doubted_kpa2 = numbers[RESTS], numbers[LIGHT_KPA2], numbers[DOUBTED_KPA2]
    hidden, per_sigmas, within, sure = numbers[HIDDEN], numbers[PER_SIGMAS], numbers[WITHIN], numbers[SURE]
    model_variance, stated, tiny = numbers[MODEL_VARIANCE], numbers[STATED] > 0.0, numbers[TINY]
    for i in range(cells.size):
        much |= memory[PRESSURE, i] > most_kpa
        much_noise |= taken[STD, i] * memory[GAIN, i] > numbers[MUCH_NOISE]
    for i in range(cells.size):
        shown, gain = memory[PRESSURE, i], memory[GAIN, i]
        found = shown
        noise_kpa = taken[STD, i] * gain
        off, slope = taken[READING, i] - line[LEVEL, i], gain
        if fall_kpa != 0.0:
            slope = fall_kpa if off < 0.0 else rise_kpa
        doubt = (abs(off) * slope + taken[NOISE, i] * gain * hidden) * per_sigmas
        std = max(doubt, noise_kpa)
        if much:
            if memory[VARIANCE, i] + added[i] + std * std > doubt_kpa2:
                shown = min(shown, most_kpa)
            excess = max(found - full, 0.0)
            added[i] += excess * excess
        released = rests != 0.0 and memory[SIGN, i] < 0.0
        doubted = rests != 0.0 and not released and memory[LEFT, i] < FAR
        if much_noise or released or doubted:
            believed = shown
            squared = shown * shown
            squared *= squared
            hides = no_load * noise_kpa
            hides *= hides
            if doubted:
                by_memory = (noise_kpa * noise_kpa + memory[TURNED, i]) * rests
                # LEFT is minus the pressure before the rise; compared with noise and a light load.
                loaded = memory[LEFT, i] < -(noise_kpa * math.sqrt(rests) + math.sqrt(light_kpa2))
                hides = max(hides, min(by_memory, light_kpa2 if loaded else doubted_kpa2))
            elif released:
                by_memory = (noise_kpa * noise_kpa + memory[REST_VARIANCE, i]) * rests
                hides = by_memory if memory[RESTED, i] > 0.0 or shown < 0.0 else max(hides, min(by_memory, light_kpa2))
            shown *= squared / (squared + hides * hides + tiny)
            off = believed - shown
            added[i] += off * off
        pressure[cells[i]] = shown
        own = std * std
        if within != 0.0:
            bend = abs(found - 2.0 * memory[LAST, i] + memory[BEFORE_LAST, i])
            bend = within * max(bend - sure * math.sqrt(own), 0.0) * gain
            own += bend * bend
        own += memory[VARIANCE, i]
        own += model_variance
        if rest_at_kpa.size > 0:
            own += interpolated(found, rest_at_kpa, rest_variance)
        variance[cells[i]] = own + added[i] if stated else math.nan


@loop
def add_asleep(variance: Row, reading: Row, cells: Places, per_reading: Row, hidden_kpa: Row) -> None:
    """:meth:`._deviation.Asleep.add_to` as a loop: variances of sleeping ``cells`` (m,) are added to ``variance``."""
    for i in range(cells.size):
        std = abs(reading[cells[i]]) * per_reading[i] + hidden_kpa[i]
        variance[cells[i]] += std * std


ASLEEP_SIGMAS = 5.0
"""standard deviations beyond which a single reading, or the mean, wakes a cell"""
CALM_SIGMAS, LEVEL_BANDS = 0.4, 3.0
"""a cell counts as at rest if its mean exceeds the band of rest by less than the first number of standard deviations,
and its smoothed reading is within the second number times that limit"""


@loop
def noise_std(mean: float, at_rest: float) -> float:
    """:meth:`._noise.NoiseMeter.std` for one cell."""
    scale = max(mean, -0.9) + 1.0
    return scale * scale * at_rest


@loop
def find_calm(cells: Places, mean: Row, noise_at_rest: Row, line: Rows, band: float, calm: Flags) -> None:
    """Mark those of ``cells`` (m,) in ``calm`` (m,) that read as at rest, within ``band`` of r and the noise."""
    for i in range(cells.size):
        cell = cells[i]
        quiet = band + CALM_SIGMAS * noise_std(mean[cell], noise_at_rest[cell])
        calm[i] = abs(mean[cell]) < quiet and abs(line[LEVEL, i]) < LEVEL_BANDS * quiet


@loop
def watch_over(
    asleep: Places,
    memory: SpacedRows,
    mean: Row,
    noise_at_rest: Row,
    band: float,
    numbers: Row,
    rest_at_kpa: Row,
    rest_variance: Row,
    wake_at: Row,
    per_reading: Row,
    hidden_kpa: Row,
    variance: Row,
) -> None:
    """Update the wake-up thresholds ``wake_at`` (n,) of r, and the variances, of the cells ``asleep`` (m,).

    Of the arrays (n,) only the entries of sleeping cells change. ``per_reading`` and ``hidden_kpa`` (m,) are written
    for :func:`add_asleep`. ``variance`` (n,) in kPa^2 is for a reading at rest.
    """
    for i in range(asleep.size):
        cell = asleep[i]
        pressure, gain = memory[PRESSURE, cell], memory[GAIN, cell]
        noise = noise_std(mean[cell], noise_at_rest[cell])
        wake_at[cell] = ASLEEP_SIGMAS * noise + band
        per_reading[i] = gain / numbers[SIGMAS]
        hidden_kpa[i] = gain * numbers[HIDDEN_SHARE] * noise
        own = 0.0
        if numbers[WITHIN] != 0.0:
            bend = abs(pressure - 2.0 * memory[LAST, cell] + memory[BEFORE_LAST, cell])
            bend = numbers[WITHIN] * bend * gain
            own += bend * bend
        own += memory[VARIANCE, cell]
        own += numbers[MODEL_VARIANCE]
        if rest_at_kpa.size > 0:
            own += interpolated(pressure, rest_at_kpa, rest_variance)
        variance[cell] = own + pressure * pressure if numbers[STATED] > 0.0 else math.nan


ALL = read, watch, renew_means, take, copy, show, add_asleep, find_calm, watch_over
