"""Loads on coarse boards: a joint significance test of the rises of neighbouring cells (matched filter).

On boards with few ADC steps the standard deviation of a pressure is large, since past loads, bad contacts and steps
leave much uncertainty. Whether a cell is touched *just now* is an easier question: by how much has its reading risen
within the last moment, compared with the noise of the readings? The memory of the material (hysteresis, creep) hardly
changes in that time. A fingertip also presses several neighbours at once, so the weighted sum of their rises tells far
more than the rise of one cell.

Presses that take longer than a moment are found in means over blocks of frames (:mod:`._slow_rises`).

Electrical faults have the shape of the wiring: one cell, or a line. The test therefore also requires a rise of cells
beside the row of a cell, and of cells beside its column. The rise that most cells of a line have in common is
subtracted first, since a bad line moves its cells alike, and so does the error of one reading in a column of a divider.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ..common.arrays import BoolArray, FloatArray, scatter
from ._around import ACROSS, highest_around, sums_around, with_all_neighbours, with_direct_neighbours
from ._slow_rises import SlowRises

NOW_S, APART_S, BEFORE_S = 0.01, 0.02, 0.06
"""lengths in s of the present interval, of the pause before it, and of the earlier interval for comparison. A fingertip
comes down within the pause; at slow frame rates each interval has at least one frame"""
LEAST_BEFORE = 3
"""least number of frames in the earlier interval"""
EACH = 2.0
"""standard deviations by which a cell of a touch has risen"""
TOGETHER = 6.0
"""standard deviations of the weighted sum of rises. By chance a cell exceeds this once in 1e9 frames; four cells of a
square whose readings flip by one ADC step in the same frame have 5.2"""
ASIDE = 4.0
"""the same for the sum without the cell's row, and for the sum without its column. A fault of the wiring moves one row
or one column, hence only one of these sums"""
MIDDLE, SHARED = 0.5, 0.1
"""least rise of a cell in the middle of a touch, over the largest rise in the 3 x 3 cells around it. The second is the
same for a cell at the rim, and for the two sums, over the cell's own rise. Crosstalk by leads is far less"""
OWN = 0.3
"""least fraction of a cell's rise that is its own; the rest is common to most cells of its row or column"""
FALLEN = 4.0
"""standard deviations by which the weighted sum is negative when a touch may have ended; the pressure decides"""
FALLEN_IN_BLOCKS = 3.0
"""the same in means over blocks of frames. A rise since before such a fall is no slow press. Each block is tested
once, and each place separately, so that a false alarm hardly ever hides a press"""
ROUNDING_S = 1e-9
"""rounding error of frame times; readings exactly at the lengths above belong to the intervals"""
LONGEST_S = 1.0
"""pause between frames after which nothing is compared"""
LEAST_RATIO = 1e-3
"""lower bound of R/R0, so that a short is no infinite rise"""
LEAST_LINE = 4
"""least length of a line of which a quarter stays untouched: a fingertip covers shorter lines"""


_OF_LINE = 1.0 + 2.0 * ACROSS**2
STD_OF_WHOLE, STD_OF_OTHERS = _OF_LINE, math.sqrt(2.0 * ACROSS**2 * _OF_LINE)
"""standard deviations of the sums over 3 x 3 cells (:mod:`._around`) of independent standard normal numbers: of all
nine cells, and of those beside a row or column. The weights are about the shape of a fingertip (matched filter)"""


@dataclass(frozen=True, slots=True)
class _Sum:
    """Cumulative sums of the readings up to a frame."""

    time_s: float
    frames: int
    rise: FloatArray
    """(rows, columns)"""
    missing: FloatArray
    """(rows, columns) frames in which the cell was not read"""


class JointRise(NamedTuple):
    """Joint rises in one frame; (rows, columns) each."""

    middle: BoolArray
    """cells that have suddenly risen, jointly with neighbours along both axes"""
    risen: BoolArray
    """these cells, those that have risen jointly within seconds, and their neighbours that have risen as well"""
    fallen: BoolArray
    """cells that have fallen jointly with their neighbours"""


class Rises:
    """Finds cells that are being pressed just now."""

    def __init__(self, shape: tuple[int, int], *, loads_raise: bool = True) -> None:
        """``loads_raise``: whether a load raises the resistance of a cell."""
        self.shape = shape
        self._side = 1.0 if loads_raise else -1.0
        self._sums: deque[_Sum] = deque()
        self._slow = SlowRises(shape)
        self._fallen_s = np.full(shape, -np.inf)
        """(rows, columns) last time that the cell fell jointly with its neighbours, or that a neighbour suddenly did"""

    def forget(self) -> None:
        """Begin anew: rest resistances have changed."""
        self._sums.clear()
        self._slow.forget()
        self._fallen_s.fill(-np.inf)

    def look(self, time_s: float, reading: FloatArray, noise: FloatArray) -> JointRise | None:
        """Take the readings of the next frame.

        Args:
            time_s: of the frame, increasing.
            reading: (rows, columns) R/R0 - 1, positive in the direction of a load; NaN where the cell was not read.
            noise: (rows, columns) standard deviation of one reading.

        Returns:
            The cells that have risen jointly with neighbours along both axes, and those that have fallen jointly.
            None: no cell has.

        """
        if self._sums and time_s - self._sums[-1].time_s > LONGEST_S:
            self.forget()
        reading, noise = _of_conductance(reading, noise, self._side)
        found = self._look_now(time_s, reading, noise)
        if found is not None and found.fallen.any():
            self._fallen_s[with_all_neighbours(found.fallen)] = time_s
        slowly = self._look_back(time_s, reading, noise)
        if slowly is None:
            return found
        if found is None:
            none = np.zeros(self.shape, dtype=np.bool_)
            return JointRise(none, slowly, none)
        return found._replace(risen=found.risen | slowly)

    def _look_back(self, time_s: float, reading: FloatArray, noise: FloatArray) -> BoolArray | None:
        """(rows, columns) cells that have risen jointly within seconds, and are still up; None: no cell.

        A slow rise at the rim is faint, and may stay for seconds where a finger has passed. Cells beside the middle
        therefore count only from :data:`MIDDLE` on.
        """
        changes = self._slow.take(time_s, reading, noise)
        if changes is None:
            return None
        self._fallen_s[_weighted(changes.lately) < -FALLEN_IN_BLOCKS] = time_s
        risen = None
        for since_s, rise in changes.rises:
            rise[(rise > 0.0) & (self._fallen_s >= since_s)] = 0.0
            found = _together(rise, _weighted(rise), MIDDLE)
            if found is not None:
                risen = found[1] if risen is None else risen | found[1]
        return risen

    def _look_now(self, time_s: float, reading: FloatArray, noise: FloatArray) -> JointRise | None:
        """As :meth:`look`, for the last moment, with conductances."""
        self._add(time_s, reading)
        places = self._places(time_s)
        if places is None:
            return None
        before, until, since, now = places
        earlier, present = until.frames - before.frames, now.frames - since.frames
        rise = (now.rise - since.rise) / present - (until.rise - before.rise) / earlier
        rise /= noise * math.sqrt(1.0 / present + 1.0 / earlier)
        if max(rise.item(rise.argmax()), -rise.item(rise.argmin())) < EACH:
            return None
        rise[now.missing > before.missing] = 0.0
        weighted = _weighted(rise)
        fallen = weighted < -FALLEN
        found = _together(rise, weighted, SHARED)
        if found is None:
            return JointRise(fallen & False, fallen & False, fallen) if fallen.any() else None
        middle, risen = found
        between = since.frames - until.frames
        if between:
            # After a release readings fall, though the memory of the material keeps them above the earlier ones.
            lately = (now.rise - since.rise) / present - (since.rise - until.rise) / between
            still = lately > -EACH * noise * math.sqrt(1.0 / present + 1.0 / between)
            middle, risen = middle & still, risen & still
        return JointRise(middle, risen, fallen)

    def _add(self, time_s: float, reading: FloatArray) -> None:
        if not self._sums:
            nothing = np.zeros(self.shape)
            self._sums.append(_Sum(-math.inf, 0, nothing, nothing))
        last = self._sums[-1]
        missing = np.isnan(reading)
        if missing.any():
            reading, lacking = np.where(missing, 0.0, reading), last.missing + missing
        else:
            lacking = last.missing
        self._sums.append(_Sum(time_s, last.frames + 1, last.rise + reading, lacking))

    def _places(self, time_s: float) -> tuple[_Sum, _Sum, _Sum, _Sum] | None:
        """Sums before and after the earlier interval, and before and after the present one; drops older sums."""
        sums, last = self._sums, len(self._sums) - 1
        now_s = time_s + ROUNDING_S
        since = self._last_until(now_s - NOW_S, last - 1)
        until = self._last_until(now_s - NOW_S - APART_S, since)
        before = self._last_until(now_s - NOW_S - APART_S - BEFORE_S, until - LEAST_BEFORE)
        if until - before < LEAST_BEFORE:
            return None
        found = sums[before], sums[until], sums[since], sums[last]
        for _ in range(before):
            sums.popleft()
        return found

    def _last_until(self, time_s: float, most: int) -> int:
        """Index of the last sum up to that time, at most ``most``; 0 if all are later."""
        return max(min(bisect_right(self._sums, time_s, key=attrgetter("time_s")) - 1, most), 0)


def _weighted(rise: FloatArray) -> FloatArray:
    """(rows, columns) weighted sums over 3 x 3 cells of rises in standard deviations; in standard deviations, too."""
    return sums_around(rise).whole / STD_OF_WHOLE


def _together(rise: FloatArray, weighted: FloatArray, least_beside: float) -> tuple[BoolArray, BoolArray] | None:
    """Cells in the middle of joint rises, and these with the neighbours that have risen as well; None: no cell.

    Args:
        rise: (rows, columns) in standard deviations.
        weighted: :func:`_weighted` of ``rise``.
        least_beside: least rise of a neighbour, over the largest rise in the 3 x 3 cells around it.

    """
    if weighted.item(weighted.argmax()) <= TOGETHER:
        return None  # subtracting the common rise of lines makes no larger sums
    own = rise - _in_common(rise)
    own /= max(scatter(own), 1.0)
    own[(own <= OWN * rise) & (own > 0)] = 0.0
    highest = highest_around(own)
    sums = sums_around(own)
    least_aside = np.maximum(ASIDE, SHARED * own) * STD_OF_OTHERS
    together = (own > np.maximum(EACH, MIDDLE * highest)) & (sums.whole > TOGETHER * STD_OF_WHOLE)
    together &= (sums.other_rows > least_aside) & (sums.other_columns > least_aside)
    if not together.any():
        return None
    return together, with_direct_neighbours(together) & (own > np.maximum(EACH, least_beside * highest))


def _in_common(rise: FloatArray) -> FloatArray:
    """(rows, columns) rise that most cells of a cell's row or column have in common, at least 0.

    This is the lower quartile, since a fingertip covers half of a short line.
    """
    common = np.zeros(rise.shape)
    rows, columns = rise.shape
    if rows >= LEAST_LINE:
        np.maximum(common, np.partition(rise, rows // 4, axis=0)[rows // 4], out=common)
    if columns >= LEAST_LINE:
        np.maximum(common, np.partition(rise, columns // 4, axis=1)[:, columns // 4, None], out=common)
    return common


def _of_conductance(reading: FloatArray, noise: FloatArray, side: float) -> tuple[FloatArray, FloatArray]:
    """Readings and noise (rows, columns) of conductance instead of resistance: R0/R - 1, positive under a load.

    An ADC step is a step of conductance, and so is the noise of the outputs. In R/R0 both grow with the square of R.
    A press that doubles R would then hardly exceed the noise of its own reading, however small the noise is at rest.
    ``side``: 1 if a load raises the resistance, -1 if it lowers it.
    """
    conductance = 1.0 / np.maximum(1.0 + side * reading, LEAST_RATIO)
    return side * (1.0 - conductance), noise * conductance * conductance
