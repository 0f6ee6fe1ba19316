"""Detection of vibration and slip below the noise (excess variance), and uncertainty of the rises that they mimic.

Turning points of vibration and slip go unnoticed if they lie within one frame, or are smaller than the noise. A cell
responds more to a fast rise than to a fast fall, or breaks chains both ways. Unnoticed motion therefore looks like a
rise of the load. The sign of such motion is an excess variance: the readings scatter about a smooth curve by more than
the board's noise. An edge of a load has the same sign, in one window of readings or two. A rise is therefore in doubt
temporarily while one window shows motion, and permanently if several consecutive windows do.

Before a window is full, single readings are tested (normalised residual). A load that falls within a frame leaves its
reading below the line through the readings before, but only slightly, since the response to a fast fall is small. If
the load came back unnoticed, the cell would keep a false remainder of the fall. The size of that remainder is in doubt
from this frame on. Later windows confirm the doubt, or it decays.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray, IntArray
from ...common.compiled import Places, Row, Rows, SpacedRows, loop
from ._noise import CROSSED
from ._rows import GAIN, NOISE, PRESSURE, READING, STD
from ._smoothing import LEVEL, Looked

HIDES, SURELY_HIDES = 1.25, 1.6
"""variance ratio (variance of a cell's readings about a parabola, over that of the board's noise) in two consecutive
windows: above the first limit, a load may move within the noise; above the second, it does"""
SUSPECTS, SURELY_SUSPECTS = 2.0, 2.6
"""variance ratio of a single window; noise alone exceeds these limits in 4 and in 0.5 % of all windows"""
UNTOLD = 1.0
"""apparent rise in windows without visible motion, over that of a window in which motion is certain: about half of the
windows do not differ from noise. From slips of a few standard deviations of the noise"""
SUSPICION = 0.5
"""standard deviation of a rise that is temporarily in doubt, over that rise"""

FADES = 0.5
"""fraction of a temporary doubt that remains after the next window, if that window shows no more"""
MAY_FALL, FALLS = 1.75, 2.75
"""distance of a reading below its line, in standard deviations of the residual: above the first limit, the load may
have fallen; above the second, it most likely has. Noise alone exceeds them in 4 and 0.3 % of all frames"""
FALLEN = 1.5
"""doubt about a fall over the remainder that the fall would leave; above 1, since noise may hide a part of the fall"""

RISEN_FROM, LOOKED_AT, EDGE_KPA, WAITING_KPA, SUSPECTED, AMPLITUDE, BESIDE_BEFORE, UNREST_BEFORE = range(8)
"""rows of the state.

RISEN_FROM, LOOKED_AT: pressure in kPa at the beginning of the window, and at the last look. EDGE_KPA: largest rise from
one look to the next in this window; an edge of a load lies between two looks. WAITING_KPA: rise in earlier windows that
is in doubt until this window ends. SUSPECTED: largest suspicion in this window, 0 to 1. AMPLITUDE: estimated amplitude
of the motion over that of the noise. BESIDE_BEFORE: variance ratio of the last window. UNREST_BEFORE: the lesser
variance ratio of the last two windows"""
ROWS = 8
_SUSPICION, _MAY_FALL2, _ZERO, _ONE = (np.array(x) for x in (SUSPICION, MAY_FALL * MAY_FALL, 0.0, 1.0))
# As arrays: NumPy makes an array of a float in every call, which takes as long as a small operation.


def _share(ratio: FloatArray, low: float, high: float) -> FloatArray:
    share: FloatArray = ratio - low
    share /= high - low
    np.maximum(share, _ZERO, out=share)
    np.minimum(share, _ONE, out=share)
    return share


class Tremor:
    """The uncertainty of recent rises of n cells. Methods take indices (m,) of cells, and arrays (m,) for these."""

    def __init__(self, cells: int) -> None:
        self._kept = np.zeros((ROWS, cells))
        self._kept[AMPLITUDE] = 1.0
        self.suspicious = False
        """whether any rise is temporarily in doubt"""
        self.compiled = False
        """whether compiled loops are in use"""

    def look(self, cells: IntArray, memory: FloatArray, beside: FloatArray) -> None:
        """Update the suspicion from the cells' memory, and from the variance ratio ``beside`` (m,) of their readings.

        The ratio is that of :meth:`._noise.NoiseMeter.beside_parabola`.
        """
        if self.compiled:
            self.suspicious = look_each.unchecked(cells, memory, beside, self._kept)
            return
        kept, pressure_kpa = self._kept, memory[PRESSURE]
        kept[EDGE_KPA, cells] = np.maximum(kept[EDGE_KPA, cells], pressure_kpa - kept[LOOKED_AT, cells])
        kept[LOOKED_AT, cells] = pressure_kpa
        kept[SUSPECTED, cells] = np.maximum(kept[SUSPECTED, cells], _share(beside, HIDES, SUSPECTS))
        squared = np.maximum(beside - _ONE, _ONE)
        kept[AMPLITUDE, cells] = np.sqrt(np.minimum(squared, CROSSED, out=squared))
        self._renew()

    def doubt_falls(self, cells: IntArray, memory: FloatArray, looked: Looked, fall_kpa: float) -> None:
        """Add doubt about falls that only the readings ``looked`` of this frame may show; uses the memory (rows, m).

        ``fall_kpa`` is the pressure per r of a fast fall. The residual between a reading and its line after the update
        has the variance of the noise minus that of the line. The line has absorbed the rest of a sudden change: the
        residual is (variance of the residual / variance of the noise) times the change.
        """
        below = looked.line[LEVEL] - looked.reading
        squared = np.abs(below)
        squared *= below
        left = looked.noise * looked.noise
        left -= looked.std * looked.std  # 0 where a line begins
        fell = (squared > left * _MAY_FALL2).nonzero()[0]
        if fell.size:
            fell = fell[left[fell] > _ZERO]
        if not fell.size:
            return
        below, left, noise2 = below[fell], left[fell], looked.noise[fell] ** 2
        kept_kpa = below * noise2 / left * np.maximum(fall_kpa - memory[GAIN, fell], 0.0) * FALLEN
        kept_kpa *= _share(below / np.sqrt(left), MAY_FALL, FALLS)
        self._kept[WAITING_KPA, cells[fell]] += np.minimum(kept_kpa, np.maximum(memory[PRESSURE, fell], 0.0))
        self.suspicious = True

    def doubt_falls_compiled(
        self, cells: IntArray, memory: FloatArray, taken: FloatArray, line: FloatArray, fall_kpa: float
    ) -> None:
        """:meth:`doubt_falls` by compiled loops, for readings ``taken`` (4, m) and their ``line`` (ROWS, m)."""
        found = doubt_each_fall.unchecked(cells, memory, taken, line, fall_kpa, self._kept)
        self.suspicious = self.suspicious or found

    def end_window(
        self, cells: IntArray, pressure_kpa: FloatArray, most_kpa: FloatArray, beside: FloatArray
    ) -> FloatArray | None:
        """End a window of readings, after :meth:`look`, and begin the next one.

        Args:
            cells: (m,) indices.
            pressure_kpa: (m,) estimates.
            most_kpa: (m,) largest apparent rise in a window by motion as large as the noise.
            beside: (m,) as in :meth:`look`.

        Returns:
            (m,) rise in kPa that is permanently in doubt; None: zero.

        """
        kept = self._kept
        rise, waiting = self._seeming_rise(cells, pressure_kpa, most_kpa), kept[WAITING_KPA, cells]
        spread = np.maximum(rise - kept[EDGE_KPA, cells], 0.0)
        unrest, missed = self._unrest(cells, beside), None
        if unrest.item(unrest.argmax()) > HIDES:
            sure = _share(unrest, HIDES, SURELY_HIDES)
            by_two = sure * np.where(rise < most_kpa, rise, 0.0)
            by_three = _share(np.minimum(unrest, kept[UNREST_BEFORE, cells]), SUSPECTS, SURELY_SUSPECTS)
            now = np.maximum(by_two, by_three * spread)
            missed = (now + by_three * waiting) * (1.0 + UNTOLD * sure)
            spread *= 1.0 - by_three
            waiting *= 1.0 - by_three
        kept[WAITING_KPA, cells] = kept[SUSPECTED, cells] * (spread + FADES * waiting)
        kept[EDGE_KPA, cells] = 0.0
        kept[SUSPECTED, cells] = _share(beside, HIDES, SUSPECTS)
        kept[UNREST_BEFORE, cells] = unrest
        kept[RISEN_FROM, cells] = pressure_kpa
        return missed

    def _unrest(self, cells: IntArray, beside: FloatArray) -> FloatArray:
        """(m,) the lesser variance ratio of the last two windows, since a single edge lies in only one of them."""
        before = self._kept[BESIDE_BEFORE, cells]
        found: FloatArray = np.minimum(beside, before)
        found[np.maximum(beside, before) > CROSSED] = 0.0
        self._kept[BESIDE_BEFORE, cells] = beside
        return found

    def accept(self, cells: IntArray, pressure_kpa: FloatArray) -> None:
        """Accept the present pressures (m,) as those of a load: clears all doubt about their rise."""
        kept = self._kept
        kept[RISEN_FROM, cells] = kept[LOOKED_AT, cells] = pressure_kpa
        kept[WAITING_KPA, cells] = kept[EDGE_KPA, cells] = 0.0

    def variance(self, cells: IntArray, pressure_kpa: FloatArray, most_kpa: FloatArray) -> FloatArray:
        """(m,) variance in kPa^2 of rises that are temporarily in doubt."""
        std = self._seeming_rise(cells, pressure_kpa, most_kpa)
        std *= self._kept[SUSPECTED].take(cells, mode="clip")  # a third of the time of [cells], here and below
        std += self._kept[WAITING_KPA].take(cells, mode="clip")
        std *= _SUSPICION
        std *= std
        return std

    def add_variance(
        self, cells: IntArray, memory: FloatArray, taken: FloatArray, seeming: float, added: FloatArray
    ) -> None:
        """Add :meth:`variance` to ``added`` (m,) by compiled loops, from the memory and readings (4, m) of cells."""
        doubt_rises.unchecked(cells, memory, taken, seeming, self._kept, added)

    def end_window_compiled(
        self, cells: IntArray, memory: FloatArray, taken: FloatArray, seeming: float, beside: FloatArray
    ) -> FloatArray | None:
        """:meth:`end_window` by compiled loops, with arguments as :meth:`add_variance`."""
        missed = np.empty(cells.size)
        found = end_window_each.unchecked(cells, memory, taken, seeming, beside, self._kept, missed)
        return missed if found else None

    def forget(self, cells: IntArray) -> None:
        """Clear all doubt about cells that are put to sleep."""
        for row in (SUSPECTED, WAITING_KPA, RISEN_FROM, LOOKED_AT, EDGE_KPA):
            self._kept[row, cells] = 0.0

    def _seeming_rise(self, cells: IntArray, pressure_kpa: FloatArray, most_kpa: FloatArray) -> FloatArray:
        """(m,) rise of the pressure in kPa in this window that unnoticed motion may explain.

        A rise larger than motion within the noise can cause contains the edge of a load. Its steepest part is then
        certain; the doubt about the rest is limited to the doubt from earlier windows.
        """
        rise: FloatArray = pressure_kpa - self._kept[RISEN_FROM].take(cells, mode="clip")
        np.maximum(rise, _ZERO, out=rise)
        most = self._kept[AMPLITUDE].take(cells, mode="clip")
        most *= most_kpa
        fast = np.flatnonzero(~(rise < most))
        if fast.size:
            some = cells[fast]
            steepest = np.maximum(self._kept[EDGE_KPA, some], pressure_kpa[fast] - self._kept[LOOKED_AT, some])
            beside_edge = np.maximum(rise[fast] - steepest, 0.0)
            rise[fast] = np.minimum(np.minimum(beside_edge, most[fast]), self._kept[WAITING_KPA, some])
        return rise

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {"tremor": self._kept}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        self._kept = state["tremor"]
        self._renew()

    def _renew(self) -> None:
        """Update :attr:`suspicious`."""
        self.suspicious = bool(np.count_nonzero(self._kept[WAITING_KPA : SUSPECTED + 1]))


@loop
def look_each(cells: Places, memory: SpacedRows, beside: Row, kept: Rows) -> bool:
    """:meth:`Tremor.look` as a loop over cells; ``kept`` (ROWS, n) is the state, here and below."""
    for i in range(cells.size):
        cell, pressure_kpa = cells[i], memory[PRESSURE, i]
        kept[EDGE_KPA, cell] = max(kept[EDGE_KPA, cell], pressure_kpa - kept[LOOKED_AT, cell])
        kept[LOOKED_AT, cell] = pressure_kpa
        suspects = min(max((beside[i] - HIDES) / (SUSPECTS - HIDES), 0.0), 1.0)
        kept[SUSPECTED, cell] = max(kept[SUSPECTED, cell], suspects)
        kept[AMPLITUDE, cell] = math.sqrt(min(max(beside[i] - 1.0, 1.0), CROSSED))
    suspicious = False
    for cell in range(kept.shape[1]):
        suspicious |= kept[SUSPECTED, cell] != 0.0 or kept[WAITING_KPA, cell] != 0.0
    return suspicious


@loop
def seeming_rise(rise: float, most_kpa: float, steepest: float, waiting: float) -> float:
    """:meth:`Tremor._seeming_rise` for one cell, which rose by ``rise``, and at most by ``steepest`` between looks."""
    if rise < most_kpa:
        return max(rise, 0.0)
    return min(max(rise - steepest, 0.0), most_kpa, waiting)


@loop
def doubt_rises(cells: Places, memory: SpacedRows, taken: Rows, seeming: float, kept: Rows, added: Row) -> None:
    """:meth:`Tremor.variance` as a loop over cells; ``seeming`` is :attr:`._inversion.Inversion.seeming`."""
    for i in range(cells.size):
        cell, gain, pressure = cells[i], memory[GAIN, i], memory[PRESSURE, i]
        most_kpa = kept[AMPLITUDE, cell] * (seeming * taken[NOISE, i] * (gain * gain))
        waiting = kept[WAITING_KPA, cell]
        steepest = max(kept[EDGE_KPA, cell], pressure - kept[LOOKED_AT, cell])
        rise = seeming_rise(pressure - kept[RISEN_FROM, cell], most_kpa, steepest, waiting)
        std = (rise * kept[SUSPECTED, cell] + waiting) * SUSPICION
        added[i] += std * std


@loop
def doubt_each_fall(cells: Places, memory: SpacedRows, taken: Rows, line: Rows, fall_kpa: float, kept: Rows) -> bool:
    """:meth:`Tremor.doubt_falls` as a loop over cells; returns whether any cell is in doubt."""
    found = False
    for i in range(cells.size):
        below, noise, std = line[LEVEL, i] - taken[READING, i], taken[NOISE, i], taken[STD, i]
        noise2 = noise * noise
        left = noise2 - std * std
        if not (below * below > left * (MAY_FALL * MAY_FALL) and below > 0.0 and left > 0.0):
            continue
        kept_kpa = below * noise2 / left * max(fall_kpa - memory[GAIN, i], 0.0) * FALLEN
        kept_kpa *= min(max((below / math.sqrt(left) - MAY_FALL) / (FALLS - MAY_FALL), 0.0), 1.0)
        kept[WAITING_KPA, cells[i]] += min(kept_kpa, max(memory[PRESSURE, i], 0.0))
        found = True
    return found


@loop
def end_window_each(
    cells: Places, memory: SpacedRows, taken: Rows, seeming: float, beside: Row, kept: Rows, missed: Row
) -> bool:
    """:meth:`Tremor.end_window` as a loop over cells.

    Returns:
        Whether a rise is permanently in doubt; if so, ``missed`` (m,) holds the rises.
    """
    found = False
    for i in range(cells.size):
        cell, gain, pressure, present = cells[i], memory[GAIN, i], memory[PRESSURE, i], beside[i]
        before, waiting, edge_kpa = kept[BESIDE_BEFORE, cell], kept[WAITING_KPA, cell], kept[EDGE_KPA, cell]
        unrest = min(present, before) if max(present, before) <= CROSSED else 0.0
        most_kpa = seeming * taken[NOISE, i] * (gain * gain)
        rise = seeming_rise(pressure - kept[RISEN_FROM, cell], kept[AMPLITUDE, cell] * most_kpa, edge_kpa, waiting)
        found |= unrest > HIDES
        sure = min(max((unrest - HIDES) / (SURELY_HIDES - HIDES), 0.0), 1.0)
        by_two = sure * (rise if rise < most_kpa else 0.0)
        lesser = min(unrest, kept[UNREST_BEFORE, cell])
        by_three = min(max((lesser - SUSPECTS) / (SURELY_SUSPECTS - SUSPECTS), 0.0), 1.0)
        spread = max(rise - edge_kpa, 0.0)
        now = max(by_two, by_three * spread)
        missed[i] = (now + by_three * waiting) * (1.0 + UNTOLD * sure)
        spread *= 1.0 - by_three
        waiting *= 1.0 - by_three
        kept[WAITING_KPA, cell] = kept[SUSPECTED, cell] * (spread + FADES * waiting)
        kept[SUSPECTED, cell] = min(max((present - HIDES) / (SUSPECTS - HIDES), 0.0), 1.0)
        kept[RISEN_FROM, cell], kept[EDGE_KPA, cell] = pressure, 0.0
        kept[BESIDE_BEFORE, cell], kept[UNREST_BEFORE, cell] = present, unrest
    return found


LOOPS = look_each, doubt_rises, end_window_each
LOOPS_OF_FALLS = (doubt_each_fall,)
"""loops for cells that respond differently to fast rises and fast falls"""
