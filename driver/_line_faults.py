"""Lines that still conduct, but no longer as the design says: cracked ones, and neighbours that are bridged.

A frame has as many readings as the board has cells, so whatever a line does, other cells of a sound board would read
the same. A crack of r ohm ahead of cells of G siemens makes each of them read 1 + r G times its resistance, which a bar
pressed on them can do as well, and a bridge lets two lines read as if each had both lines' cells. Time and the material
tell what a frame does not (fault detection with a model of the process, Isermann 2006):

* **No load does so.** The cells of a line fall together below whatever they have been, and below rest by far, though
  loads raise their resistance (bridged lines); or they rise together beyond what any load gives. Where one reading is
  too rough to say so, the mean of further ones does.
* **Loads do not keep so.** Readings from some place of a line to its end rise at once by one and the same factor, and
  keep to that factor, as the load of the line changes it (1 / (1 - r G') with the sum G' of the conductances that are
  read). Under a load this material would creep. That it does not is told after a second or more, where the readings
  are known well enough.

All others are given the benefit of the doubt: what comes on slowly, what was there when the skin was opened or tared,
materials that do not creep, and readings that noise or ADC steps leave open by more than the creep.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from ..arrays import BoolArray, FloatArray
from ..cell import Cell
from ..compiled import Rows, loop
from ..errors import InputError
from ._reading import Reading

EVERY_S = 0.08
"""from one look to the next"""
LONGEST_GAP_S = 1.0
"""without a frame, across which nobody knows what was sudden"""
LEAST_CELLS = 4
"""of a line that must have moved together: fewer are a fingertip"""
LEAST_CHANGE = 0.03
"""of a resistance (natural logarithm) that is looked at"""
MOST = 0.75
"""share of a line's cells that are to agree: others may be pressed or released meanwhile"""
ASIDE = 0.25
"""times the change of a line by which the rest of the board may have moved with it, and from which on a faulty line is
sound again"""
UNEQUAL = 0.03
"""of a change by which the cells of a cracked line may differ, beside noise: their columns load them differently"""
BELOW_REST = 0.2
"""(natural logarithm) below rest and below all that a cell has read, where no load takes it. Ageing is slower"""
SPREADS = 3.0
"""standard deviations of rest resistances that are not known, likewise"""
FIRST_VERDICT_S, LAST_VERDICT_S = 1.0, 8.0
"""after a change of a line for which creep is compared"""
CLEAR = 5.0
"""standard deviations of a reading, or of what decides, that noise does not reach"""
STEPS = 2.0
"""standard deviations by ADC steps that no reading is off by: rounding errs by the square root of 3 of them at most"""
LEAST_CREEP = 0.002
"""times the change, root mean square, that must decide: the creep is not known better"""
RESTED = 0.1
"""times the change, above the least that the cells have read, up to which their creep is that of cells at rest"""
KEPT = 1.0 / 3.0
"""times the creep of the model that a load shows at least; it shows at most as many times more"""
ONSETS_S = 0.0, 0.16, 0.5
"""by which a load may have begun before its change was seen, or have taken to come on"""
FITS = 2.0
"""times the variance of the noise, in the mean, that a crack may leave"""
TINY = 1e-300
POINTS = 33
"""of the table of creep, in time"""
OVERLOAD = 4.0
"""times what full scale makes of a resistance, which no press on a whole line exceeds"""
LOADS = np.linspace(0.02, 1.0, 25)
"""of full scale, in the table"""


class Creep:
    """How cells of one material go on after a sudden load, tabulated."""

    def __init__(self, cell: Cell) -> None:
        """Apply loads of up to full scale to cells at rest, and hold them."""
        forward = cell.forward(LOADS.shape)
        rest_ohm, load = forward.rest_resistance_ohm, LOADS * cell.full_scale_kpa
        self._time_s = np.geomspace(0.01, 2.0 * LAST_VERDICT_S, POINTS)
        ohms = [forward.step(dt_s, load) for dt_s in np.diff(self._time_s, prepend=0.0)]
        changes = np.log(np.array(ohms) / rest_ohm)
        self._first, self._further = changes[0], changes - changes[0]
        self.most = math.log1p(OVERLOAD * math.expm1(changes.max()))
        """of a logarithm at once that a load may be the cause of"""

    def of(self, change: float, time_s: FloatArray) -> FloatArray:
        """Further change of the logarithm of the resistance at times after a load that changed it by ``change``."""
        share = [np.interp(change, self._first, further) for further in self._further]
        further: FloatArray = np.interp(time_s, self._time_s, share)
        return further


@dataclass
class _Change:
    """A sudden change of a line."""

    cells: BoolArray
    """(rows, columns) that take part"""
    before: FloatArray
    """(rows, columns) logarithms of their resistances over rest, before"""
    size: float
    """of the change, in their median"""
    limits: tuple[FloatArray, float]
    """(rows, columns) below which no load takes the cells, and by how much none raises them at once"""
    conductance: float = 0.0
    """that was read then, sum over the cells, over that of a cell at rest"""
    times_s: list[float] = field(default_factory=list)
    """of later looks, since the change"""
    changes: list[tuple[float, float]] = field(default_factory=list)
    """from ``before``, likewise, and what the line's load makes of it if the line is cracked"""
    heights: list[float] = field(default_factory=list)
    """of most of the cells above the limit below which no load takes them, likewise"""

    @property
    def line(self) -> str:
        """Its name."""
        rows, columns = (np.flatnonzero(self.cells.any(axis=1 - axis)) for axis in (0, 1))
        if len(rows) == 1:
            return f"row {rows[0]}, columns {columns[0]} to {columns[-1]}"
        return f"column {columns[0]}, rows {rows[0]} to {rows[-1]}"

    def no_load(self, log: FloatArray, std: FloatArray) -> bool:
        """Whether most of the cells are where no load takes them, whatever the readings' errors are."""
        now = log[self.cells] - math.copysign(CLEAR, self.size) * std[self.cells]
        low, most = self.limits
        beyond = (now < low[self.cells]) if self.size < 0.0 else (now - self.before[self.cells] > most)
        return bool(beyond.sum() >= MOST * np.isfinite(now).sum() > 0)

    def stays_low(self, since_s: float, log: FloatArray, noise: float, steps: float) -> bool | None:
        """Whether most of the cells have been, in the mean, where no load takes them; None: not told yet.

        Cells may share their errors, as in a column of a divider: only other looks make these smaller.
        ``noise`` and ``steps`` are standard deviations of one reading, by what averages out and by what does not.
        """
        above = np.sort((log - self.limits[0])[self.cells])
        height = above.item(math.ceil(MOST * len(above)) - 1)  # NaN, where too many are not read
        if not height < 0.0:
            return False
        self.heights.append(height)
        looks = len(self.heights)
        if sum(self.heights) / looks + CLEAR * noise / math.sqrt(looks) + STEPS * steps < 0.0:
            return True
        return False if since_s > LAST_VERDICT_S else None

    def follow(self, since_s: float, log: FloatArray, std: FloatArray) -> bool:
        """Note what has become of the change. False where it is no longer that of a cracked line."""
        now = (log - self.before)[self.cells]
        middle = _median(now)
        if not _agree(now, middle, std[self.cells]):
            return False
        conductance = float(np.nansum(np.exp(-log[self.cells])))
        # 1 - r G' is the factor of the conductances; r follows from the first look.
        left = 1.0 + math.expm1(-self.size) * conductance / self.conductance
        if left <= 0.0:
            return False
        self.times_s.append(since_s)
        self.changes.append((middle, -math.log(left)))
        return True

    def verdict(self, creep: Creep, noise: float, steps: float) -> bool | None:
        """Whether the line is cracked rather than loaded; None: not told yet.

        Both say how the change goes on. The squares that one leaves beyond those of the other are to be beyond error.
        ``noise`` and ``steps`` are standard deviations of one reading, by what averages out and by what does not.
        """
        times = np.array(self.times_s)
        if times[-1] < FIRST_VERDICT_S:
            return None
        changes, cracked = _centred(np.array(self.changes).T)
        if_cracked = _squares(changes - cracked)
        if_loaded = math.inf
        for onset_s in ONSETS_S:
            (further,) = _centred(creep.of(self.size, times + onset_s)[None])
            scale = changes @ further / max(further @ further, TINY)
            if_loaded = min(if_loaded, _squares(changes - np.clip(scale, KEPT, 1.0 / KEPT) * further))
        # The variance of a median of so many is pi / 2 times that of a mean, unless they share their noise.
        scatter = np.diff(changes - cracked)
        variance = max(0.5 * math.pi * noise**2 / int(self.cells.sum()), 0.5 * _squares(scatter) / len(scatter))
        unknown = len(times) * (4.0 * steps**2 + (LEAST_CREEP * self.size) ** 2)
        error = CLEAR**2 * variance + unknown
        if if_loaded - if_cracked > error and if_cracked < FITS * len(times) * variance + unknown:
            return True
        return False if if_cracked - if_loaded > error or times[-1] > LAST_VERDICT_S else None


class LineFaults:
    """The lines of one skin whose readings no load explains. Arrays are (rows, columns)."""

    def __init__(self, rest_ohm: FloatArray, creep: Creep, *, rest_known: bool) -> None:
        """Begin.

        Args:
            rest_ohm: of the cells.
            creep: of the material, of which loads raise the resistance.
            rest_known: the rest resistances were measured, by a tare or a calibration.

        """
        self._per_ohm, self._creep = 1.0 / rest_ohm, creep
        self._rest_known = rest_known
        self._at: float | None = None
        self._looks: deque[FloatArray] = deque(maxlen=3)
        self._least: FloatArray = np.full(rest_ohm.shape, math.nan)  # that cells have read
        self._suspects: list[tuple[float, _Change]] = []
        self._faults: list[_Change] = []
        self._all_sound = all_sound.machine_code()
        self.cells: BoolArray | None = None
        """those of faulty lines; None: no line is"""

    def take(self, time_s: float, reading: Reading, rest_spread: float | None) -> BoolArray | None:
        """Take a frame's readings.

        Args:
            time_s: of the frame.
            reading: with the cells of faulty lines.
            rest_spread: relative standard deviation of rest resistances that were not measured; None: not known yet.

        Returns:
            :attr:`cells`.

        """
        since = math.inf if self._at is None else time_s - self._at
        if 0.0 <= since < EVERY_S:
            return self.cells
        self._at = time_s
        if not 0.0 < since < LONGEST_GAP_S:
            self._looks.clear()
            self._suspects.clear()
        log: FloatArray = np.multiply(reading.resistance, self._per_ohm, order="C")
        np.log(log, out=log)
        if self._faults or self._suspects:
            self._judge(time_s, log, reading)
        if len(self._looks) == self._looks.maxlen:
            self._look(time_s, log, reading, rest_spread)
        self._looks.append(log)
        return self.cells

    @property
    def remark(self) -> str:
        """Names the faulty lines."""
        lines = ", ".join(fault.line for fault in self._faults)
        return f"{lines}: read what no load makes of them; look for cracked or bridged lines, or tare() anew"

    def state(self) -> dict[str, FloatArray]:
        """Arrays by name for :meth:`restore`; the suspects are dropped, and what was sudden is not known."""
        self._looks.clear()
        self._suspects.clear()
        self._at = None
        faults = [np.stack([fault.cells, fault.before, fault.limits[0]]) for fault in self._faults]
        return {
            "least": self._least,
            "faults": np.array(faults).reshape(-1, 3, *self._least.shape),
            "sizes": np.array([fault.size for fault in self._faults]),
        }

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Go on from a :meth:`state`; InputError where it does not fit."""
        shape, sizes = self._least.shape, state.get("sizes", np.zeros(0))
        if (
            state.keys() != {"least", "faults", "sizes"}
            or state["least"].shape != shape
            or state["faults"].shape != (*sizes.shape, 3, *shape)
        ):
            raise InputError(f"faulty lines of another array; expected those of {shape[0]} x {shape[1]} cells")
        self._least = state["least"]
        self._faults = [
            _Change(cells > 0.0, before, float(size), (low, self._creep.most))
            for (cells, before, low), size in zip(state["faults"], sizes, strict=True)
        ]
        self._gather()

    def _gather(self) -> None:
        self.cells = np.any([fault.cells for fault in self._faults], axis=0) if self._faults else None

    def _judge(self, time_s: float, log: FloatArray, reading: Reading) -> None:
        """Follow faulty lines and those that may be."""
        faulty = [fault for fault in self._faults if not _sound(fault, log)]
        if len(faulty) < len(self._faults):
            self._looks.clear()  # as it comes back, a line changes as suddenly
        going_on = []
        noise, steps = _std_of(reading)
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

    def _look(self, time_s: float, log: FloatArray, reading: Reading, rest_spread: float | None) -> None:
        """Find lines that have changed of late, and note how low cells have read."""
        earlier, before, _ = self._looks
        margin = BELOW_REST if self._rest_known else max(BELOW_REST, SPREADS * (rest_spread or 0.0))
        if self._all_sound is not None and self.cells is None and not self._suspects:
            least = np.empty(log.shape)
            if self._all_sound(log, before, self._least, margin, least):
                self._least = least
                return
        change = log - before
        taken = None if self.cells is None else self.cells.copy()
        for _, suspect in self._suspects:
            taken = suspect.cells.copy() if taken is None else taken | suspect.cells
        if taken is not None:
            change[taken] = np.nan
        if _may_have_changed(change, log, margin):
            lowest = np.fmin(self._least, 0.0) - margin
            taken = np.zeros(log.shape, dtype=bool) if taken is None else taken
            for cells in self._candidates(change, log, before, lowest):
                size = _median(change[cells])
                if not (abs(_median(change[~cells & ~taken])) < ASIDE * abs(size)):
                    continue
                suspect, std = _Change(cells, before, size, (lowest, self._creep.most)), np.hypot(*_std_of(reading))
                if size > 0.0 and not suspect.no_load(log, std):
                    still = abs(_median((before - earlier)[cells])) < RESTED * size
                    rested = _median((before - self._least)[cells]) < RESTED * size
                    if not (still and rested and _agree(change[cells], size, std[cells])):
                        continue
                    suspect.conductance = float(np.nansum(np.exp(-log[cells])))
                self._suspects.append((time_s, suspect))
                taken |= cells
        self._least = np.fmin(self._least, before if taken is None else np.where(taken, math.nan, before))

    @staticmethod
    def _candidates(change: FloatArray, log: FloatArray, before: FloatArray, lowest: FloatArray) -> list[BoolArray]:
        """Cells of lines that have moved together since ``before``, by a ``change``, or below the ``lowest``."""
        size = np.abs(change)
        if np.count_nonzero(size > LEAST_CHANGE) < LEAST_CELLS:
            return []
        least = max(LEAST_CHANGE, SPREADS * _median(size))
        low, risen = log < np.minimum(lowest, before - least), change > least
        candidates = _lines(low) if np.count_nonzero(low) >= LEAST_CELLS else []
        if np.count_nonzero(risen) >= LEAST_CELLS:
            candidates += _ends(risen, np.isnan(log))
        return candidates


def _may_have_changed(change: FloatArray, log: FloatArray, margin: float) -> bool:
    """Whether a line may have moved as one: a quick look, as most frames are of boards without a fault.

    Of a line that has, either the cells at its end have risen, or cells are below rest by more than the ``margin``.
    """
    still: BoolArray = change <= LEAST_CHANGE  # False where nothing is known
    rows, columns = still[:, -LEAST_CELLS:], still[:LEAST_CELLS]  # as many as must have moved together
    for axis, ends in ((1, rows), (0, columns)):
        held = np.logical_or.reduce(ends, axis=axis)
        if np.count_nonzero(held) < held.size:
            return True
    return bool(np.fmin.reduce(log, axis=None) < -margin)


@loop
def all_sound(log: Rows, before: Rows, least: Rows, margin: float, lowered: Rows) -> bool:
    """Whether no line may have changed, see :func:`_may_have_changed`: of cells that read as ``before`` till then.

    Then the ``least`` that cells have read is ``lowered``. Arrays are (rows, columns).
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
    """Of those that are known; NaN where none is."""
    known = np.sort(values[np.isfinite(values)])
    if not known.size:
        return math.nan
    # np.median takes five times as long.
    return 0.5 * (known.item((known.size - 1) // 2) + known.item(known.size // 2))


def _agree(changes: FloatArray, middle: float, std: FloatArray) -> bool:
    """Whether nearly all cells have changed alike, within UNEQUAL and the errors of two readings."""
    known = np.isfinite(changes)
    alike = np.abs(changes - middle) < UNEQUAL * abs(middle) + SPREADS * math.sqrt(2.0) * std
    return bool(np.count_nonzero(alike) >= max(LEAST_CELLS, MOST * np.count_nonzero(known)))


def _centred(series: FloatArray) -> FloatArray:
    """Series (k, times) without their means."""
    centred: FloatArray = series - series.mean(axis=1, keepdims=True)
    return centred


def _squares(series: FloatArray) -> float:
    return float(series @ series)


def _sound(fault: _Change, log: FloatArray) -> bool:
    """Whether a line reads again as it did before."""
    return abs(_median((log - fault.before)[fault.cells])) < ASIDE * abs(fault.size)  # False where nothing is known


def _std_of(reading: Reading) -> tuple[FloatArray, FloatArray]:
    """Relative standard deviations of the resistances by noise and by ADC steps."""
    by_steps, by_noise = reading.std_shares
    return reading.uncertainty * by_noise, reading.uncertainty * by_steps


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
    """Columns out of rows whose last cell is that of the column's first row."""
    return rows.T[::-1]


def _lines(low: BoolArray) -> list[BoolArray]:
    """Whole rows and columns of which most cells are low."""
    found = []
    for axis in (0, 1):
        count, cells = low.sum(axis=1 - axis), low.shape[1 - axis]
        for line in np.flatnonzero((count >= MOST * cells) & (count >= LEAST_CELLS)):
            whole = np.zeros_like(low)
            np.moveaxis(whole, axis, 0)[line] = True
            found.append(whole)
    return found
