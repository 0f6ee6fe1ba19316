"""Line faults without an open circuit: cracked lines (added resistance) and bridged neighbours, told from loads.

A frame has as many readings as the board has cells. Whatever a line does, a sound board with other cells would give the
same readings. A crack of r ohm ahead of cells of G siemens multiplies the resistance of each by 1 + r G, and a bar
pressed on them can do the same. A bridge makes two lines read as if each had the cells of both. One frame therefore
cannot tell a fault from a load. Time and a model of the material can (model-based fault detection, Isermann 2006):

* **No load gives such readings.** The cells of a line fall together below everything that they have read, and far below
  rest, though loads raise their resistance (bridged lines). Or they rise together beyond what any load gives. Where one
  reading is too rough to decide, the mean of several updates does.
* **No load stays like this.** The readings from some place of a line to its end rise at once by one common factor, and
  keep this factor, except for the change that the line's load makes: 1 / (1 - r G') with the sum G' of the conductances
  that are read. Under a load this material would creep. Whether creep is missing is decided after a second or more, if
  the readings are accurate enough.

All other readings count as loads: slow changes; faults from before the skin was opened or tared; materials that do not
creep; and readings whose noise or ADC steps exceed the creep.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from ..cell import Cell
from ..common.arrays import BoolArray, FloatArray
from ..common.compiled import Rows, loop
from ..common.measurement import Measurement
from ._tuning import (
    ASIDE,
    BELOW_REST,
    CREEP_KEPT,
    EVERY_S,
    FIRST_VERDICT_S,
    FITS,
    LAST_VERDICT_S,
    LEAST_CELLS,
    LEAST_CHANGE,
    LEAST_CREEP,
    LONGEST_GAP_S,
    ONSET_S,
    OVERLOAD,
    RESTED,
    SHARE_OF_CELLS,
    SPREADS,
    STEPS,
    SURE_STDS,
    UNEQUAL,
)

TINY = 1e-300
POINTS = 33
"""points in time of the creep table"""
LOADS = np.linspace(0.02, 1.0, 25)
"""loads of the creep table, as fractions of full scale"""


class Creep:
    """Table of creep: further change of the resistance of one material after a sudden load."""

    def __init__(self, cell: Cell) -> None:
        """Simulate cells at rest to which loads of up to full scale are applied and held."""
        forward = cell.forward(LOADS.shape)
        rest_ohm, load = forward.rest_resistance_ohm, LOADS * cell.full_scale_kpa
        self._time_s = np.geomspace(0.01, 2.0 * LAST_VERDICT_S, POINTS)
        ohms = [forward.step(dt_s, load) for dt_s in np.diff(self._time_s, prepend=0.0)]
        changes = np.log(np.array(ohms) / rest_ohm)
        self._first, self._further = changes[0], changes - changes[0]
        self.most = math.log1p(OVERLOAD * math.expm1(changes.max()))
        """largest sudden change of a resistance (natural logarithm) by a load"""

    def of(self, change: float, time_s: FloatArray) -> FloatArray:
        """Further change of the logarithm of the resistance, at times after a load that changed it by ``change``."""
        share = [np.interp(change, self._first, further) for further in self._further]
        further: FloatArray = np.interp(time_s, self._time_s, share)
        return further


@dataclass
class _Change:
    """A sudden change of a line."""

    cells: BoolArray
    """(rows, columns) cells that take part"""
    before: FloatArray
    """(rows, columns) logarithms of their resistances over rest, before the change"""
    size: float
    """median change of these logarithms"""
    limits: tuple[FloatArray, float]
    """(rows, columns) logarithms below which no load takes the cells; the largest sudden rise by a load"""
    conductance: float = 0.0
    """sum of the conductances just after the change, over the conductance of a cell at rest"""
    times_s: list[float] = field(default_factory=list)
    """times of later updates, since the change"""
    changes: list[tuple[float, float]] = field(default_factory=list)
    """for each of these updates the change from ``before``, and the change by the line's load if the line is cracked"""
    heights: list[float] = field(default_factory=list)
    """for each update the height above the limit below which no load takes the cells: most cells are lower"""

    @property
    def line(self) -> str:
        """Name of the line."""
        rows, columns = (np.flatnonzero(self.cells.any(axis=1 - axis)) for axis in (0, 1))
        if len(rows) == 1:
            return f"row {rows[0]}, columns {columns[0]} to {columns[-1]}"
        return f"column {columns[0]}, rows {rows[0]} to {rows[-1]}"

    def no_load(self, log: FloatArray, std: FloatArray) -> bool:
        """Whether most of the cells are where no load takes them, beyond the errors of the readings."""
        now = log[self.cells] - math.copysign(SURE_STDS, self.size) * std[self.cells]
        low, most = self.limits
        beyond = (now < low[self.cells]) if self.size < 0.0 else (now - self.before[self.cells] > most)
        return bool(beyond.sum() >= SHARE_OF_CELLS * np.isfinite(now).sum() > 0)

    def stays_low(self, since_s: float, log: FloatArray, noise: float, steps: float) -> bool | None:
        """Whether most of the cells have been, in the mean, where no load takes them; None: undecided.

        Cells may share their errors, as in a column of a divider. Only further updates reduce these errors.
        ``noise`` and ``steps`` are standard deviations of one reading: of errors that average out, and of those that
        do not.
        """
        above = np.sort((log - self.limits[0])[self.cells])
        height = above.item(math.ceil(SHARE_OF_CELLS * len(above)) - 1)  # NaN if too many cells are not read
        if not height < 0.0:
            return False
        self.heights.append(height)
        updates = len(self.heights)
        if sum(self.heights) / updates + SURE_STDS * noise / math.sqrt(updates) + STEPS * steps < 0.0:
            return True
        return False if since_s > LAST_VERDICT_S else None

    def follow(self, since_s: float, log: FloatArray, std: FloatArray) -> bool:
        """Record the further course of the change. False if it is no longer that of a cracked line."""
        now = (log - self.before)[self.cells]
        middle = _median(now)
        if not _agree(now, middle, std[self.cells]):
            return False
        conductance = float(np.nansum(np.exp(-log[self.cells])))
        # The conductances have changed by the factor 1 - r G'; r follows from the first update.
        left = 1.0 + math.expm1(-self.size) * conductance / self.conductance
        if left <= 0.0:
            return False
        self.times_s.append(since_s)
        self.changes.append((middle, -math.log(left)))
        return True

    def verdict(self, creep: Creep, noise: float, steps: float) -> bool | None:
        """Whether the line is cracked rather than loaded; None: undecided.

        Each hypothesis predicts the further course of the change. Their sums of squared residuals must differ by more
        than the error of the difference. ``noise`` and ``steps`` are standard deviations of one reading: of errors that
        average out, and of those that do not.
        """
        times = np.array(self.times_s)
        if times[-1] < FIRST_VERDICT_S:
            return None
        changes, cracked = _centred(np.array(self.changes).T)
        if_cracked = _squares(changes - cracked)
        if_loaded = math.inf
        for onset_s in (0.0, 2.0 * EVERY_S, ONSET_S):
            (further,) = _centred(creep.of(self.size, times + onset_s)[None])
            scale = changes @ further / max(further @ further, TINY)
            if_loaded = min(if_loaded, _squares(changes - np.clip(scale, CREEP_KEPT, 1.0 / CREEP_KEPT) * further))
        # The variance of a median of n cells is pi / 2 times that of their mean, unless the cells share their noise.
        differences = np.diff(changes - cracked)
        variance = max(0.5 * math.pi * noise**2 / int(self.cells.sum()), 0.5 * _squares(differences) / len(differences))
        unknown = len(times) * (4.0 * steps**2 + (LEAST_CREEP * self.size) ** 2)
        error = SURE_STDS**2 * variance + unknown
        if if_loaded - if_cracked > error and if_cracked < FITS * len(times) * variance + unknown:
            return True
        return False if if_cracked - if_loaded > error or times[-1] > LAST_VERDICT_S else None


class LineFaults:
    """Finds the lines of one skin whose readings no load explains. Arrays are (rows, columns)."""

    def __init__(self, rest_ohm: FloatArray, creep: Creep, *, rest_known: bool) -> None:
        """Begin.

        Args:
            rest_ohm: of the cells.
            creep: of a material whose resistance rises under load.
            rest_known: the rest resistances were measured, by a tare or a calibration.

        """
        self._per_ohm, self._creep = 1.0 / rest_ohm, creep
        self._rest_known = rest_known
        self._at: float | None = None
        self._logs: deque[FloatArray] = deque(maxlen=3)
        self._least: FloatArray = np.full(rest_ohm.shape, math.nan)  # least readings of the cells
        self._suspects: list[tuple[float, _Change]] = []
        self._faults: list[_Change] = []
        self.cells: BoolArray | None = None
        """cells of faulty lines; None: no line is faulty"""

    def take(self, time_s: float, reading: Measurement, rest_spread: float | None) -> BoolArray | None:
        """Take a frame's readings.

        Args:
            time_s: of the frame.
            reading: includes the cells of faulty lines.
            rest_spread: relative standard deviation of rest resistances that were not measured; None: not known yet.

        Returns:
            :attr:`cells`.

        """
        since = math.inf if self._at is None else time_s - self._at
        if 0.0 <= since < EVERY_S:
            return self.cells
        self._at = time_s
        if not 0.0 < since < LONGEST_GAP_S:
            self._logs.clear()
            self._suspects.clear()
        log: FloatArray = np.multiply(reading.resistance, self._per_ohm, order="C")
        np.log(log, out=log)
        if self._faults or self._suspects:
            self._judge(time_s, log, reading)
        if len(self._logs) == self._logs.maxlen:
            self._find(time_s, log, reading, rest_spread)
        self._logs.append(log)
        return self.cells

    @property
    def remark(self) -> str:
        """Message that names the faulty lines."""
        lines = ", ".join(fault.line for fault in self._faults)
        return f"{lines}: read what no load makes of them; look for cracked or bridged lines, or tare() anew"

    def _gather(self) -> None:
        self.cells = np.any([fault.cells for fault in self._faults], axis=0) if self._faults else None

    def _judge(self, time_s: float, log: FloatArray, reading: Measurement) -> None:
        """Follow faulty lines and suspects."""
        faulty = [fault for fault in self._faults if not _sound(fault, log)]
        if len(faulty) < len(self._faults):
            self._logs.clear()  # a line that recovers changes as suddenly
        going_on = []
        noise, steps = reading.noise_std, reading.steps_std
        std = np.hypot(noise, steps)
        for began_s, suspect in self._suspects:
            if suspect.no_load(log, std):
                faulty.append(suspect)
                continue
            verdict: bool | None = False
            of_one = _median(noise[suspect.cells]), _median(steps[suspect.cells])
            if suspect.size < 0.0:
                verdict = suspect.stays_low(time_s - began_s, log, *of_one)
            elif suspect.follow(time_s - began_s, log, std):
                verdict = suspect.verdict(self._creep, *of_one)
            if verdict:
                faulty.append(suspect)
            elif verdict is None:
                going_on.append((began_s, suspect))
        self._faults, self._suspects = faulty, going_on
        self._gather()

    def _find(self, time_s: float, log: FloatArray, reading: Measurement, rest_spread: float | None) -> None:
        """Find lines that have changed recently, and keep the least readings of the cells."""
        earlier, before, _ = self._logs
        margin = BELOW_REST if self._rest_known else max(BELOW_REST, SPREADS * (rest_spread or 0.0))
        if self.cells is None and not self._suspects:
            least = np.empty(log.shape)
            if all_sound(log, before, self._least, margin, least):
                self._least = least
                return
        change = log - before
        taken = np.zeros(log.shape, dtype=np.bool_) if self.cells is None else self.cells.copy()
        for _, suspect in self._suspects:
            taken |= suspect.cells
        change[taken] = np.nan
        lowest = np.fmin(self._least, 0.0) - margin
        for cells in self._candidates(change, log, before, lowest):
            size = _median(change[cells])
            if not (abs(_median(change[~cells & ~taken])) < ASIDE * abs(size)):
                continue
            suspect, std = (
                _Change(cells, before, size, (lowest, self._creep.most)),
                np.hypot(reading.noise_std, reading.steps_std),
            )
            if size > 0.0 and not suspect.no_load(log, std):
                still = abs(_median((before - earlier)[cells])) < RESTED * size
                rested = _median((before - self._least)[cells]) < RESTED * size
                if not (still and rested and _agree(change[cells], size, std[cells])):
                    continue
                suspect.conductance = float(np.nansum(np.exp(-log[cells])))
            self._suspects.append((time_s, suspect))
            taken |= cells
        self._least = np.fmin(self._least, np.where(taken, math.nan, before))

    @staticmethod
    def _candidates(change: FloatArray, log: FloatArray, before: FloatArray, lowest: FloatArray) -> list[BoolArray]:
        """Cells of lines that have moved together since ``before``, by a ``change``, or fallen below the ``lowest``."""
        size = np.abs(change)
        if np.count_nonzero(size > LEAST_CHANGE) < LEAST_CELLS:
            return []
        least = max(LEAST_CHANGE, SPREADS * _median(size))
        low, risen = log < np.minimum(lowest, before - least), change > least
        candidates = _lines(low) if np.count_nonzero(low) >= LEAST_CELLS else []
        if np.count_nonzero(risen) >= LEAST_CELLS:
            candidates += _ends(risen, np.isnan(log))
        return candidates


@loop
def all_sound(log: Rows, before: Rows, least: Rows, margin: float, lowered: Rows) -> bool:
    """Whether no line can have moved as one since ``before``: a quick test, since most frames are of sound boards.

    If a line has, either the cells at its end have risen, or cells are below rest by more than the ``margin``. Else
    ``lowered`` becomes the least reading of each cell so far, given the ``least`` until now. Arrays are (N, M).
    """
    rows, columns = log.shape
    for i in range(rows):
        moving = True
        for j in range(max(columns - LEAST_CELLS, 0), columns):
            moving &= not (log[i, j] - before[i, j] <= LEAST_CHANGE)
        if moving:
            return False
    for j in range(columns):
        moving = True
        for i in range(min(LEAST_CELLS, rows)):
            moving &= not (log[i, j] - before[i, j] <= LEAST_CHANGE)
        if moving:
            return False
    for i in range(rows):
        for j in range(columns):
            if log[i, j] < -margin:
                return False
            lower = least[i, j] <= before[i, j] or math.isnan(before[i, j])
            lowered[i, j] = least[i, j] if lower else before[i, j]
    return True


def _median(values: FloatArray) -> float:
    """Median of the finite values; NaN if there are none."""
    known = np.sort(values[np.isfinite(values)])
    if not known.size:
        return math.nan
    # np.median takes five times as long.
    return 0.5 * (known.item((known.size - 1) // 2) + known.item(known.size // 2))


def _agree(changes: FloatArray, middle: float, std: FloatArray) -> bool:
    """Whether nearly all cells have changed alike, within :data:`UNEQUAL` and the errors of two readings."""
    known = np.isfinite(changes)
    alike = np.abs(changes - middle) < UNEQUAL * abs(middle) + SPREADS * math.sqrt(2.0) * std
    return bool(np.count_nonzero(alike) >= max(LEAST_CELLS, SHARE_OF_CELLS * np.count_nonzero(known)))


def _centred(series: FloatArray) -> FloatArray:
    """Series (k, times) without their means."""
    centred: FloatArray = series - series.mean(axis=1, keepdims=True)
    return centred


def _squares(series: FloatArray) -> float:
    return float(series @ series)


def _sound(fault: _Change, log: FloatArray) -> bool:
    """Whether a line reads again as before the fault."""
    return abs(_median((log - fault.before)[fault.cells])) < ASIDE * abs(fault.size)  # False if nothing is known


def _ends(moved: BoolArray, unknown: BoolArray) -> list[BoolArray]:
    """Cells from some place of a row to its last column, or of a column to its first row, that have all moved."""
    found = []
    for here, hidden, back in ((moved, unknown, _same), (moved[::-1].T, unknown[::-1].T, _columns)):
        ends = np.logical_and.accumulate((here | hidden)[:, ::-1], axis=1)[:, ::-1] & here
        for line in np.flatnonzero(ends.sum(axis=1) >= LEAST_CELLS):
            cells = np.zeros_like(ends)
            cells[line] = ends[line]
            found.append(back(cells))
    return found


def _same(rows: BoolArray) -> BoolArray:
    return rows


def _columns(rows: BoolArray) -> BoolArray:
    """Undo the transposition for columns, of which the last place is the first row."""
    return rows.T[::-1]


def _lines(low: BoolArray) -> list[BoolArray]:
    """Whole rows and columns most of whose cells are low."""
    found = []
    for axis in (0, 1):
        count, cells = low.sum(axis=1 - axis), low.shape[1 - axis]
        for line in np.flatnonzero((count >= SHARE_OF_CELLS * cells) & (count >= LEAST_CELLS)):
            whole = np.zeros_like(low)
            np.moveaxis(whole, axis, 0)[line] = True
            found.append(whole)
    return found
