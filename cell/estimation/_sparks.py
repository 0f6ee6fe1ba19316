"""Intermittent contacts ("sparks"): a reading that jumps and comes back within :data:`SPARK_S` was no load.

The memory of a cell from before a large jump is stored for that time. If the reading comes back, the stored memory is
restored, unless the jump was a tap: a tap changes the memory of a cell, a bad contact does not. Often the neighbouring
cells show at once that the jump is a tap (:mod:`._taps`).
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Places, Record, Records, Row, loop, values, zeros
from .._state import CellState
from ._gaps import Gaps
from ._inversion import Inversion
from ._taps import TOGETHER_S, Taps

SPARK_S = 0.1
"""longest duration of a spark in seconds; longer jumps are loads"""
BACK = 0.05
"""fraction of a jump within which the reading counts as back"""
LARGE_JUMP, CLEAR_JUMP = 0.05, 12.0
"""least size of a jump that may be a spark: fraction of full scale, and standard deviations of a reading"""
CLEAR = 3.0
"""standard deviations of a reading, by which the reading after a bad contact may differ from that before it"""
SUDDEN = 6.0
"""multiple of the change in the frame before; a smaller jump is part of a press"""
NEARER, EITHER, SMALL = 0.5, 0.25, 0.15
"""limits of the decision between spark and tap. The misfit of a spark must be at most the first fraction of the misfit
of a tap. After a tap, the pressure usually differs from that before it by less than the second fraction of the jump, or
than the third fraction of full scale"""
SUDDENLY = 0.6
"""fraction of a jump that must be reversed from one frame to the next"""
BEYOND = 0.57
"""distance from the middle of full scale, as a fraction of full scale, beyond which a jump is not shown at once: just
less than the largest pressure that an inverse in doubt shows"""
IN_DOUBT = 0.5
"""standard deviation of a jump that may be a spark, over the jump"""


class Sparks:
    """Cells whose reading has just jumped, with their states from before the jump."""

    def __init__(self, inversion: Inversion, gaps: Gaps, shape: tuple[int, ...]) -> None:
        """``gaps`` takes the doubt about jumps that may have been spark or tap; ``shape`` is that of the array."""
        self._inversion, self._gaps, cells = inversion, gaps, math.prod(shape)
        self._taps = Taps(inversion, shape)
        self.large_r = LARGE_JUMP * inversion.full_scale_r
        """least jump of r that may be a spark"""
        self.places = np.zeros(0, dtype=np.intp)
        """(k,) cells that have jumped"""
        self._cells, self._memory = zeros(CellState, cells), zeros(inversion.memory, cells)
        """states of these cells from before the jump"""

    def remember(
        self,
        cells: Records[CellState],
        memory: Records[Record],
        places: IntArray,
        before: tuple[FloatArray, FloatArray],
    ) -> None:
        """Store the states of cells from before a jump, unless they are stored from before an earlier jump.

        ``cells`` have taken the readings of the frame already, and the inversion has not. ``before`` are the readings
        (n,) of the two frames before.
        """
        found = np.empty(places.size, dtype=np.intp)
        side, light_kpa = self._inversion.side, LARGE_JUMP * self._inversion.full_scale_kpa
        count = find_each.unchecked(cells, places, *before, self.large_r, side, light_kpa, found)
        if count:
            new = found[:count]
            if not (cells["jump_s"][self.places] <= TOGETHER_S).any():
                self._taps.before = before[0].copy()
                self._taps.before[self.places] = self._cells["level"][self.places]
            self._cells[new], self._memory[new] = cells[new], memory[new]
            take_back_each.unchecked(self._cells, new)
            self.places = np.concatenate([self.places, new])

    def recognise_taps(
        self, cells: Records[CellState], dt_s: float, reading: FloatArray, noise_at_rest: FloatArray
    ) -> None:
        """Find jumps that are loads, by the readings (n,) of all cells, ``dt_s`` seconds after the last frame."""
        self._taps.look(cells, self.places, dt_s, reading, noise_at_rest)

    def taps(self, cells: Records[CellState]) -> IntArray:
        """(k,) cells that have just jumped, and are known to be under a load."""
        tapped = (cells["jump_is_load"][self.places] > 0.0) & (cells["jump_s"][self.places] <= TOGETHER_S)
        found: IntArray = self.places[tapped]
        return found

    def put_back(self, cells: Records[CellState], memory: Records[Record], dt_s: float) -> None:
        """Restore the states of cells whose reading has come back, in a frame ``dt_s`` after the last one."""
        came = np.empty(self.places.size, dtype=np.intp)
        back = come_back_each.unchecked(cells, self._cells, self.places, dt_s, came)
        if back:
            found = came[:back]
            self._restore(cells, memory, found[self._were_sparks(cells, memory, found, dt_s)])
            cells["jump"][found] = 0.0
        self.places = self.places[cells["jump"][self.places] != 0.0]

    def _were_sparks(
        self, cells: Records[CellState], memory: Records[Record], places: IntArray, dt_s: float
    ) -> BoolArray:
        """(k,) whether reversed jumps were bad contacts rather than taps.

        A tap changes the memory of a cell. After a tap, the pressure computed with that changed memory equals the
        pressure before the tap, but the reading differs from the reading before. After a bad contact it is the other
        way round. In doubt, a jump is a tap. If both are plausible, the difference between the two pressures is added
        as a standard deviation, which decays.
        """
        full_kpa, now = self._inversion.full_scale_kpa, cells[places]
        reading, noise, before = now["reading"], now["noise"], now["jumped_from_kpa"]
        if_tapped, memory_if_tapped = now.copy(), memory[places]
        if_tapped["level"], if_tapped["level_std"], if_tapped["noise"] = reading, noise, 0.0
        self._inversion.advance(if_tapped, memory_if_tapped, np.arange(places.size), dt_s)
        tapped = if_tapped["pressure_kpa"]
        off = np.abs(reading - self._cells["level"][places]) - CLEAR * noise
        off_if_tapped = np.abs(tapped - before)
        moved = np.abs(now["pressure_kpa"] - before)
        found: BoolArray = off * moved <= NEARER * off_if_tapped * np.abs(now["jump"])
        plausible = np.maximum(EITHER * moved, SMALL * full_kpa)
        either = found & (off_if_tapped < plausible) & (tapped > -LARGE_JUMP * full_kpa)
        self._gaps.doubt(places[either], off_if_tapped[either])
        return found

    def _restore(self, cells: Records[CellState], memory: Records[Record], places: IntArray) -> None:
        """Restore states, advanced by the time since the jump at constant load."""
        if places.size:
            memory[places] = self._memory[places]
            restore_each.unchecked(cells, self._cells, places)
            self._inversion.hold(cells, memory, places, cells["jump_s"][places])

    def undo(self, lost: IntArray, cells: Records[CellState], memory: Records[Record]) -> IntArray:
        """Restore the states of cells that are no longer read, where they have jumped; returns which (k,).

        Cells that were tapped keep their present memory.
        """
        gone = self.places[np.isin(self.places, lost)]
        undone: IntArray = gone[cells["jump_is_load"][gone] == 0.0]
        self._restore(cells, memory, undone)
        self.forget(cells, gone)
        return undone

    def forget(self, cells: Records[CellState], places: IntArray) -> None:
        """Treat jumps of cells as loads."""
        if self.places.size:
            cells["jump"][places] = 0.0
            self.places = self.places[cells["jump"][self.places] != 0.0]

    def hide(self, cells: Records[CellState], pressure_kpa: FloatArray) -> None:
        """Hide jumps beyond :data:`BEYOND` while they may be sparks; changes ``pressure_kpa`` (n,)."""
        full_kpa, now = self._inversion.full_scale_kpa, pressure_kpa[self.places]
        doubted = cells["jump_is_load"][self.places] == 0.0
        beyond = self.places[doubted & (np.abs(now - full_kpa / 2) > BEYOND * full_kpa)]
        pressure_kpa[beyond] = cells["jumped_from_kpa"][beyond]

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        jumped = np.zeros(self._cells.size)
        jumped[self.places] = 1.0
        before = {"cells_before": values(self._cells), "memory_before": values(self._memory)}
        return before | {"jumped": jumped, "readings_before": self._taps.before}

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Continue from a saved :meth:`state`."""
        values(self._cells)[...], values(self._memory)[...] = state["cells_before"], state["memory_before"]
        self.places, self._taps.before = np.flatnonzero(state["jumped"]), state["readings_before"]


@loop
def find_each(
    cells: Records[CellState],
    places: Places,
    before: Row,
    two_before: Row,
    large_r: float,
    side: float,
    light_kpa: float,
    found: Places,
) -> int:
    """Find cells whose reading has jumped from the line; writes their places to ``found``, and returns their number.

    Bad contacts add resistance. Where loads add resistance, too (``side`` > 0), a fall of a cell that bears more than
    ``light_kpa``, and that does not go below rest, is a release.
    """
    count = 0
    for k in range(places.size):
        i = places[k]
        cell = cells[i]
        jump = cell.reading - cell.level_before
        if cell.begun == 0.0 or cell.jump != 0.0 or abs(jump) <= max(CLEAR_JUMP * cell.noise, large_r):
            continue
        if side > 0.0 and cell.pressure_kpa > light_kpa and jump < 0.0 and cell.reading > -CLEAR * cell.noise:
            continue
        if abs(jump) <= SUDDEN * abs(before[i] - two_before[i]):
            continue
        cell.jump, cell.jump_s, cell.jumped_from_kpa = jump, 0.0, cell.pressure_kpa
        cell.jump_is_load, cell.jump_frames = 0.0, 0.0
        found[count] = i
        count += 1
    return count


@loop
def take_back_each(cells: Records[CellState], places: Places) -> None:
    """Set lines to those before the frame."""
    for k in range(places.size):
        cell = cells[places[k]]
        cell.level, cell.slope, cell.count = cell.level_before, cell.slope_before, cell.count_before
        cell.up, cell.down = cell.up_before, cell.down_before


@loop
def come_back_each(
    cells: Records[CellState], befores: Records[CellState], places: Places, dt_s: float, found: Places
) -> int:
    """Find jumps that are reversed, ``dt_s`` after the last frame; longer ones end. ``befores`` (n,) are from before.

    Writes the places of the reversed ones to ``found``, and returns their number.
    """
    count = 0
    for k in range(places.size):
        cell, before = cells[places[k]], befores[places[k]]
        cell.jump_s += dt_s
        off = cell.reading - before.level
        if abs(off) > abs(cell.jump):
            cell.jump = off
        jump, moved = abs(cell.jump), before.slope * cell.jump_s
        if cell.jump_s > SPARK_S * (1.0 + 1e-9):
            cell.jump = 0.0
            continue
        back = abs(off - moved) < BACK * jump + CLEAR * cell.noise + abs(moved)
        if back and abs(cell.level - cell.reading) > SUDDENLY * jump:
            if cell.jump_is_load > 0.0:
                cell.jump = 0.0
            else:
                found[count] = places[k]
                count += 1
    return count


@loop
def restore_each(cells: Records[CellState], befores: Records[CellState], places: Places) -> None:
    """Restore lines and estimates from ``befores`` (n,)."""
    for k in range(places.size):
        cell, before = cells[places[k]], befores[places[k]]
        cell.level, cell.slope, cell.count = before.level, before.slope, before.count
        cell.up, cell.down = before.up, before.down
        cell.pressure_kpa, cell.gain_kpa, cell.variance_kpa2 = (
            before.pressure_kpa,
            before.gain_kpa,
            before.variance_kpa2,
        )
        cell.last_kpa, cell.before_last_kpa = before.last_kpa, before.before_last_kpa
        cell.released, cell.unconfirmed, cell.left_kpa = before.released, before.unconfirmed, before.left_kpa
        cell.turn_variance_kpa2, cell.rest_variance_kpa2 = before.turn_variance_kpa2, before.rest_variance_kpa2
        cell.rested = before.rested


@loop
def doubted_jump(cell: CellState) -> float:
    """Standard deviation in kPa by a jump that may be a spark."""
    doubted = cell.jump != 0.0 and cell.jump_is_load == 0.0
    return IN_DOUBT * (cell.pressure_kpa - cell.jumped_from_kpa) if doubted else 0.0
