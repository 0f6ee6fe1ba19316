"""Vibration and slip within the noise of the readings, and the uncertainty of the rises that they fake.

Vibration and slip that turn within a frame, or by less than the noise, are never noticed as turns. A cell answers a
fast rise by more than a fast fall, or breaks chains both ways, so that such motion seems to be a load that rises. What
tells of it is that the readings scatter more than the board's noise about a smooth curve. An edge of a load does so as
well, for one window of readings or two. A rise is therefore in doubt for the time being while one window shows motion,
and for good where several windows in a row do.

Before a window is full, single readings tell: a load that falls within a frame leaves its reading below the line of
those before, by little, since a fast fall is answered by little. What the cell would keep of such a fall, if the load
came back, is in doubt from that frame on (a test of the normalised residual). Later windows confirm it, or it fades.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import FloatArray, IntArray
from ...compiled import Places, Row, Rows, loop
from ._noise import CROSSED
from ._rows import GAIN, NOISE, PRESSURE, READING, STD
from ._smoothing import LEVEL, Looked

HIDES, SURELY_HIDES = 1.25, 1.6
"""variance of a cell's readings beside smooth motion, over that of the board's noise, in two windows: from the first
on, a load may move within the noise; from the second on, it does"""
SUSPECTS, SURELY_SUSPECTS = 2.0, 2.6
"""the same of a single window, which noise alone exceeds in 4 and in 0.5 % of all windows"""
UNTOLD = 1.0
"""rise that other windows of such motion have faked, over that of a window in which motion is certain: about half of
them do not differ from noise. From slips of a few standard deviations of the noise"""
SUSPICION = 0.5
"""of a rise that is in doubt for the time being: its standard deviation"""

FADES = 0.5
"""share of such a doubt that the next window leaves, if nothing tells more"""
MAY_FALL, FALLS = 1.75, 2.75
"""standard deviations of what noise leaves between a reading and its line, by which a reading is below: from the first
on, the load may have fallen, and from the second on, it most likely has. Noise alone exceeds them in 4 and 0.3 % of
all frames"""
FALLEN = 1.5
"""of what a fall would leave behind: how much of it is in doubt. Noise may hide a part of the fall"""
_SUSPICION, _MAY_FALL2, _ZERO, _ONE = (np.array(x) for x in (SUSPICION, MAY_FALL * MAY_FALL, 0.0, 1.0))
# As arrays: NumPy makes an array of a float in every call, which takes as long as a small operation.


def _share(ratio: FloatArray, low: float, high: float) -> FloatArray:
    share: FloatArray = ratio - low
    share /= high - low
    np.maximum(share, _ZERO, out=share)
    np.minimum(share, _ONE, out=share)
    return share


class Tremor:
    """How far the rises of n cells are in doubt. Methods take the indices of m cells, and arrays (m,) of theirs."""

    _KEPT = ("risen_from", "looked_at", "edge_kpa", "waiting_kpa", "suspicion", "amplitude", "unrest_before")

    def __init__(self, cells: int) -> None:
        self._risen_from = np.zeros(cells)
        """kPa at the beginning of the window"""
        self._looked_at = np.zeros(cells)
        """kPa at the last look"""
        self._edge_kpa = np.zeros(cells)
        """largest rise from one look to the next in this window: an edge of a load is in one of them"""
        self._waiting_kpa = np.zeros(cells)
        """rise of the windows before, in doubt until this one has told"""
        self._suspicion = np.zeros(cells)
        """largest in this window, 0 to 1"""
        self._amplitude = np.ones(cells)
        """of motion over that of the noise, as far as the readings show it"""
        self._unrest_before = np.zeros(cells)
        self.suspicious = False
        """whether a rise is in doubt for the time being"""
        self.compiled = False
        """whether the loops are there as machine code"""

    def look(self, cells: IntArray, memory: FloatArray, beside: FloatArray) -> None:
        """Take the cells' memory, and the variance (m,) of readings beside smooth motion over that of the noise."""
        if self.compiled:
            kept = self._suspicion, self._amplitude, self._waiting_kpa, self._looked_at, self._edge_kpa
            self.suspicious = look_each.unchecked(cells, memory, beside, *kept)
            return
        pressure_kpa = memory[PRESSURE]
        self._edge_kpa[cells] = np.maximum(self._edge_kpa[cells], pressure_kpa - self._looked_at[cells])
        self._looked_at[cells] = pressure_kpa
        self._suspicion[cells] = np.maximum(self._suspicion[cells], _share(beside, HIDES, SUSPECTS))
        squared = np.maximum(beside - _ONE, _ONE)
        self._amplitude[cells] = np.sqrt(np.minimum(squared, CROSSED, out=squared))
        self._renew()

    def doubt_falls(self, cells: IntArray, memory: FloatArray, looked: Looked, fall_kpa: float) -> None:
        """Doubt what the memory (rows, m) would keep of falls that readings ``looked`` at may be the only ones to show.

        ``fall_kpa`` is the pressure per r of a fast fall. Between a reading and the line that it has been taken into,
        noise leaves its own variance less that of the line; the share that is left of a sudden change is as large.
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
        self._waiting_kpa[cells[fell]] += np.minimum(kept_kpa, np.maximum(memory[PRESSURE, fell], 0.0))
        self.suspicious = True

    def doubt_falls_compiled(
        self, cells: IntArray, memory: FloatArray, taken: FloatArray, line: FloatArray, fall_kpa: float
    ) -> None:
        """:meth:`doubt_falls` by machine code, for readings ``taken`` (4, m) into a ``line`` (ROWS, m)."""
        found = doubt_each_fall.unchecked(cells, memory, taken, line, fall_kpa, self._waiting_kpa)
        self.suspicious = self.suspicious or found

    def end_window(
        self, cells: IntArray, pressure_kpa: FloatArray, most_kpa: FloatArray, beside: FloatArray, unrest: FloatArray
    ) -> FloatArray | None:
        """End a window of readings, after :meth:`look`, and begin the next one.

        Args:
            cells: (m,) indices.
            pressure_kpa: (m,) estimates.
            most_kpa: (m,) by which motion as large as the noise may let them seem to rise in a window.
            beside: (m,) as in :meth:`look`.
            unrest: (m,) the lesser of the last two windows'.

        Returns:
            (m,) kPa of the rise that is in doubt for good; None: of no cell.

        """
        rise, waiting = self._seeming_rise(cells, pressure_kpa, most_kpa), self._waiting_kpa[cells]
        spread = np.maximum(rise - self._edge_kpa[cells], 0.0)
        missed = None
        if unrest.item(unrest.argmax()) > HIDES:
            sure = _share(unrest, HIDES, SURELY_HIDES)
            by_two = sure * np.where(rise < most_kpa, rise, 0.0)
            by_three = _share(np.minimum(unrest, self._unrest_before[cells]), SUSPECTS, SURELY_SUSPECTS)
            now = np.maximum(by_two, by_three * spread)
            missed = (now + by_three * waiting) * (1.0 + UNTOLD * sure)
            spread *= 1.0 - by_three
            waiting *= 1.0 - by_three
        self._waiting_kpa[cells] = self._suspicion[cells] * (spread + FADES * waiting)
        self._edge_kpa[cells] = 0.0
        self._suspicion[cells] = _share(beside, HIDES, SUSPECTS)
        self._unrest_before[cells] = unrest
        self._risen_from[cells] = pressure_kpa
        return missed

    def accept(self, cells: IntArray, pressure_kpa: FloatArray) -> None:
        """Take the pressures (m,) of cells for those of a load: nothing of their rise until now is in doubt."""
        self._risen_from[cells] = self._looked_at[cells] = pressure_kpa
        self._waiting_kpa[cells] = self._edge_kpa[cells] = 0.0

    def variance(self, cells: IntArray, pressure_kpa: FloatArray, most_kpa: FloatArray) -> FloatArray:
        """(m,) kPa^2 of what is in doubt for the time being."""
        std = self._seeming_rise(cells, pressure_kpa, most_kpa)
        std *= self._suspicion.take(cells, mode="clip")  # a third of the time of [cells], here and below
        std += self._waiting_kpa.take(cells, mode="clip")
        std *= _SUSPICION
        std *= std
        return std

    def add_variance(
        self, cells: IntArray, memory: FloatArray, taken: FloatArray, seeming: float, added: FloatArray
    ) -> None:
        """Add :meth:`variance` to ``added`` (m,) by machine code, from the memory and the readings (4, m) of cells."""
        kept = self._risen_from, self._amplitude, self._suspicion, self._waiting_kpa, self._edge_kpa, self._looked_at
        doubt_rises.unchecked(cells, memory, taken, seeming, *kept, added)

    def end_window_compiled(
        self,
        cells: IntArray,
        memory: FloatArray,
        taken: FloatArray,
        seeming: float,
        beside: FloatArray,
        beside_before: FloatArray,
    ) -> FloatArray | None:
        """:meth:`end_window` by machine code; ``beside_before`` (n,) is that of the window before, and changed."""
        kept = (
            self._risen_from,
            self._amplitude,
            self._suspicion,
            self._waiting_kpa,
            self._unrest_before,
            self._edge_kpa,
        )
        missed = np.empty(cells.size)
        found = end_window_each.unchecked(cells, memory, taken, seeming, beside, beside_before, *kept, missed)
        return missed if found else None

    def forget(self, cells: IntArray) -> None:
        """Let nothing be in doubt about cells that are put to sleep."""
        self._suspicion[cells] = self._waiting_kpa[cells] = 0.0
        self._risen_from[cells] = self._looked_at[cells] = self._edge_kpa[cells] = 0.0

    def _seeming_rise(self, cells: IntArray, pressure_kpa: FloatArray, most_kpa: FloatArray) -> FloatArray:
        """(m,) kPa by which pressures have risen in this window beside loads.

        What rose faster than motion within the noise may seem to is a load: an edge. Its steepest part is in no doubt,
        and of the rest no more than is in doubt already.
        """
        rise: FloatArray = pressure_kpa - self._risen_from.take(cells, mode="clip")
        np.maximum(rise, _ZERO, out=rise)
        most = self._amplitude.take(cells, mode="clip")
        most *= most_kpa
        fast = np.flatnonzero(~(rise < most))
        if fast.size:
            some = cells[fast]
            steepest = np.maximum(self._edge_kpa[some], pressure_kpa[fast] - self._looked_at[some])
            beside_edge = np.maximum(rise[fast] - steepest, 0.0)
            rise[fast] = np.minimum(np.minimum(beside_edge, most[fast]), self._waiting_kpa[some])
        return rise

    def state(self) -> dict[str, FloatArray]:
        """All that is remembered, by name."""
        return {f"tremor_{name}": getattr(self, f"_{name}") for name in self._KEPT}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        for name in self._KEPT:
            setattr(self, f"_{name}", state[f"tremor_{name}"])
        self._renew()

    def _renew(self) -> None:
        """Tell whether a rise is in doubt."""
        self.suspicious = bool(np.count_nonzero(self._suspicion) or np.count_nonzero(self._waiting_kpa))


@loop
def look_each(
    cells: Places,
    memory: Rows,
    beside: Row,
    suspicion: Row,
    amplitude: Row,
    waiting_kpa: Row,
    looked_at: Row,
    edge_kpa: Row,
) -> bool:
    """:meth:`Tremor.look` as a loop over cells."""
    for i in range(cells.size):
        cell, pressure_kpa = cells[i], memory[PRESSURE, i]
        edge_kpa[cell] = max(edge_kpa[cell], pressure_kpa - looked_at[cell])
        looked_at[cell] = pressure_kpa
        suspects = min(max((beside[i] - HIDES) / (SUSPECTS - HIDES), 0.0), 1.0)
        suspicion[cell] = max(suspicion[cell], suspects)
        amplitude[cell] = math.sqrt(min(max(beside[i] - 1.0, 1.0), CROSSED))
    suspicious = False
    for cell in range(suspicion.size):
        suspicious |= suspicion[cell] != 0.0 or waiting_kpa[cell] != 0.0
    return suspicious


@loop
def seeming_rise(rise: float, most_kpa: float, steepest: float, waiting: float) -> float:
    """:meth:`Tremor._seeming_rise` of one cell, which has risen by ``rise``, and by the ``steepest`` between looks."""
    if rise < most_kpa:
        return max(rise, 0.0)
    return min(max(rise - steepest, 0.0), most_kpa, waiting)


@loop
def doubt_rises(
    cells: Places,
    memory: Rows,
    taken: Rows,
    seeming: float,
    risen_from: Row,
    amplitude: Row,
    suspicion: Row,
    waiting_kpa: Row,
    edge_kpa: Row,
    looked_at: Row,
    added: Row,
) -> None:
    """:meth:`Tremor.variance` as a loop over cells. ``seeming`` is the rise in a window, per noise and squared gain."""
    for i in range(cells.size):
        cell, gain, pressure = cells[i], memory[GAIN, i], memory[PRESSURE, i]
        most_kpa = amplitude[cell] * (seeming * taken[NOISE, i] * (gain * gain))
        steepest = max(edge_kpa[cell], pressure - looked_at[cell])
        rise = seeming_rise(pressure - risen_from[cell], most_kpa, steepest, waiting_kpa[cell])
        std = (rise * suspicion[cell] + waiting_kpa[cell]) * SUSPICION
        added[i] += std * std


@loop
def doubt_each_fall(cells: Places, memory: Rows, taken: Rows, line: Rows, fall_kpa: float, waiting_kpa: Row) -> bool:
    """:meth:`Tremor.doubt_falls` as a loop over cells; whether one is in doubt."""
    found = False
    for i in range(cells.size):
        below, noise, std = line[LEVEL, i] - taken[READING, i], taken[NOISE, i], taken[STD, i]
        noise2 = noise * noise
        left = noise2 - std * std
        if not (below * below > left * (MAY_FALL * MAY_FALL) and below > 0.0 and left > 0.0):
            continue
        kept_kpa = below * noise2 / left * max(fall_kpa - memory[GAIN, i], 0.0) * FALLEN
        kept_kpa *= min(max((below / math.sqrt(left) - MAY_FALL) / (FALLS - MAY_FALL), 0.0), 1.0)
        waiting_kpa[cells[i]] += min(kept_kpa, max(memory[PRESSURE, i], 0.0))
        found = True
    return found


@loop
def end_window_each(
    cells: Places,
    memory: Rows,
    taken: Rows,
    seeming: float,
    beside: Row,
    beside_before: Row,
    risen_from: Row,
    amplitude: Row,
    suspicion: Row,
    waiting_kpa: Row,
    unrest_before: Row,
    edge_kpa: Row,
    missed: Row,
) -> bool:
    """:meth:`._noise.NoiseMeter.unrest` and :meth:`Tremor.end_window` as a loop over cells.

    Returns:
        Whether a rise is in doubt for good: then ``missed`` (m,) has it.
    """
    found = False
    for i in range(cells.size):
        cell, gain, pressure, present = cells[i], memory[GAIN, i], memory[PRESSURE, i], beside[i]
        unrest = min(present, beside_before[cell])
        if max(present, beside_before[cell]) > CROSSED:
            unrest = 0.0
        beside_before[cell] = present
        most_kpa = seeming * taken[NOISE, i] * (gain * gain)
        waiting = waiting_kpa[cell]
        rise = seeming_rise(pressure - risen_from[cell], amplitude[cell] * most_kpa, edge_kpa[cell], waiting)
        found |= unrest > HIDES
        sure = min(max((unrest - HIDES) / (SURELY_HIDES - HIDES), 0.0), 1.0)
        by_two = sure * (rise if rise < most_kpa else 0.0)
        lesser = min(unrest, unrest_before[cell])
        by_three = min(max((lesser - SUSPECTS) / (SURELY_SUSPECTS - SUSPECTS), 0.0), 1.0)
        spread = max(rise - edge_kpa[cell], 0.0)
        now = max(by_two, by_three * spread)
        missed[i] = (now + by_three * waiting) * (1.0 + UNTOLD * sure)
        spread *= 1.0 - by_three
        waiting *= 1.0 - by_three
        waiting_kpa[cell] = suspicion[cell] * (spread + FADES * waiting)
        edge_kpa[cell] = 0.0
        suspicion[cell] = min(max((present - HIDES) / (SUSPECTS - HIDES), 0.0), 1.0)
        unrest_before[cell] = unrest
        risen_from[cell] = pressure
    return found


LOOPS = look_each, doubt_rises, end_window_each
LOOPS_OF_FALLS = (doubt_each_fall,)
"""those that only cells need which answer fast rises and fast falls differently"""
