"""Watching a skin being calibrated: a state machine from frames to presses, without I/O.

==========  ========================================================  =======================================
state       what happens                                              left when
==========  ========================================================  =======================================
rest        readings of the unloaded skin are averaged                ``rest_s`` have passed
waiting     the skin is expected to be pressed                        a cell bears :data:`BEGIN` of the load
pressed     readings are kept                                         the load has fallen below :data:`END`
done        nothing                                                   never
==========  ========================================================  =======================================

Loads are judged by the pressures of the common cell model (``cell.estimator``) over the rest resistances measured at
first, from the lowest pressure since the last press on: a cell that has not yet recovered does not look pressed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from ..cell import Cell
from ..errors import InputError
from ._plan import Plan
from ._presses import Press, Rest

BEGIN, END = 0.15, 0.5
"""share of the load at which a press begins, and of its own largest value at which it ends"""
CLEAR = 8.0
"""standard deviations of the estimate that a press exceeds"""
OTHERS = 0.5
"""of the load on the target that no cell beside it may bear"""
COVERED = 0.5
"""share of the cells of a target that must bear a load"""
STEADY = 0.1
"""relative departure of the load from its mean over the second half of a hold"""
UNREAD_S = 0.2
"""a cell that was read at rest and is not for so long is pressed too hard"""
LEAST_HOLD = 0.8
"""share of the hold that was asked for"""
HOLD_WINDOWS = 3
"""windows in the second half of a hold"""
MOST_KEPT = 100_000
"""frames of one press"""
LONGEST_WINDOW_S = 10.0
"""of the hold, counted back from its end: longer holds say nothing more"""


@dataclass(frozen=True, slots=True)
class RestTaken:
    """The unloaded skin has been measured."""

    rest: Rest


@dataclass(frozen=True, slots=True)
class PressBegan:
    """A load is put on ``target``."""

    target: int


@dataclass(frozen=True, slots=True)
class HeldLongEnough:
    """The load may be taken off."""

    target: int


@dataclass(frozen=True, slots=True)
class PressTaken:
    """A press has ended, and is good for the calibration."""

    target: int
    press: Press


@dataclass(frozen=True, slots=True)
class PressRefused:
    """A press has ended, and is not used."""

    target: int
    press: Press


Event = RestTaken | PressBegan | HeldLongEnough | PressTaken | PressRefused


class Watch:
    """Takes frames in the order of time, and says what happened on the skin."""

    def __init__(
        self,
        cell: Cell,
        plan: Plan,
        *,
        hold_s: float,
        rest_s: float,
        rest: Rest | None = None,
        presses: Iterable[Press] = (),
    ) -> None:
        """Begin, or go on from the ``rest`` and ``presses`` of an earlier watch.

        Args:
            cell: the common cell model.
            plan: what is to be pressed.
            hold_s: for which a load must be held.
            rest_s: over which the unloaded skin is averaged.
            rest: of an earlier watch.
            presses: likewise.

        """
        self.cell, self.plan = cell, plan
        self.hold_s, self.rest_s = hold_s, rest_s
        self.rest = rest
        self.presses = list(presses)
        """all of them, in the order of time; those with a fault are not used"""
        self._step = self._next_step()
        self.trace: list[tuple[float, float]] = []
        """time in s, and the largest load on any cell in kPa as the common model has it: for a reference sensor"""
        self._first: list[tuple[float, FloatArray]] = []
        self._recent: deque[tuple[float, FloatArray, FloatArray]] = deque()
        self._held: _Hold | None = None
        self._time_s: float | None = None
        if rest is not None:
            self._begin_estimates(rest)

    # -- the plan ----------------------------------------------------------------------------------------------------

    @property
    def step(self) -> int | None:
        """The step of the plan that is under way; None: all are done."""
        return self._step

    def _next_step(self) -> int | None:
        steps = range(len(self.plan.loads_kpa))
        return next((step for step in steps if self.missing(step)), None)

    def missing(self, step: int) -> list[int]:
        """Targets that have no good press of a step yet."""
        done = {self._target_of(press) for press in self.presses if press.step == step and not press.fault}
        return [target for target in range(len(self.plan.targets)) if target not in done]

    @property
    def done(self) -> bool:
        """Whether all of the plan is done."""
        return self.rest is not None and self.step is None

    def _target_of(self, press: Press) -> int:
        count = [np.isin(cells, press.cells).sum() for cells in self.plan.targets]
        return int(np.argmax(count))

    # -- frames ------------------------------------------------------------------------------------------------------

    def feed(self, time_s: float, resistance_ohm: FloatArray) -> list[Event]:
        """Take the next frame, (rows, columns) ohm with NaN where not valid; what has happened.

        Raises:
            InputError: the skin is loaded, or not read, while it should rest.

        """
        if self._time_s is not None and time_s <= self._time_s:
            return []
        elapsed_s = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        if self.rest is None:
            return self._watch_rest(time_s, resistance_ohm)
        ohm = np.where(np.isfinite(resistance_ohm), resistance_ohm, np.nan).ravel()
        load = self._load(elapsed_s, time_s, ohm)
        self.trace.append((time_s, float(load[np.isfinite(load)].max(initial=0.0))))
        if self._held is not None:
            return self._follow_press(time_s, ohm, load)
        self._recent.append((time_s, ohm, load))
        while self._recent[0][0] < time_s - self.rest_s:
            self._recent.popleft()
        return self._watch_for_press(time_s, ohm, load)

    def interrupt(self) -> None:
        """The board was away: drop the press under way; times may go on anywhere later."""
        self._held = None
        self._recent.clear()
        if self.rest is not None:
            self._begin_estimates(self.rest)

    def _watch_rest(self, time_s: float, resistance_ohm: FloatArray) -> list[Event]:
        self._first.append((time_s, np.array(resistance_ohm)))
        if time_s - self._first[0][0] < self.rest_s:
            return []
        self.rest = rest_of(self._first)
        check_rest(self.rest, self.cell)
        self._first.clear()
        self._begin_estimates(self.rest)
        return [RestTaken(self.rest)]

    def _begin_estimates(self, rest: Rest) -> None:
        typical = float(np.median(rest.resistance_ohm[rest.measured]))
        rest_ohm = np.where(rest.measured, rest.resistance_ohm, typical)
        self._estimator = self.cell.estimator(self.plan.shape, rest_resistance_ohm=rest_ohm)
        self._lowest = np.zeros(rest_ohm.size)
        self._std_kpa = np.full(rest_ohm.size, np.inf)
        self._unread_s = np.zeros(rest_ohm.size)
        self._readable = rest.measured.ravel()
        self._begun = False

    def _load(self, elapsed_s: float, time_s: float, ohm: FloatArray) -> FloatArray:
        """(cells,) kPa above the lowest since the last press; infinite for cells that are not read any more."""
        shape = self.plan.shape
        pressure = self._estimator.step(elapsed_s if self._begun else 1.0, ohm.reshape(shape)).ravel()
        self._begun = True
        pressure = np.where(np.isfinite(pressure), pressure, 0.0)
        unread = self._readable & ~np.isfinite(ohm)
        self._unread_s = np.where(unread, self._unread_s + elapsed_s, 0.0)
        if self._held is None:
            self._lowest = np.minimum(self._lowest, pressure)
        return np.where(self._unread_s > UNREAD_S, np.inf, pressure - self._lowest)

    def _watch_for_press(self, time_s: float, ohm: FloatArray, load: FloatArray) -> list[Event]:
        step = self.step
        if step is None:
            return []
        # The least standard deviation is that of noise; a jump raises it for a moment.
        std = np.nan_to_num(self._estimator.std_kpa.ravel(), nan=0.0)
        self._std_kpa = np.minimum(self._std_kpa, std)
        begun = load > np.maximum(BEGIN * self.plan.loads_kpa[step], CLEAR * self._std_kpa)
        if not begun.any():
            return []
        target = self.plan.pressed_target(np.where(begun, load, 0.0))
        frames = [(time, reading) for time, reading, _ in self._recent]
        loads = [felt for _, _, felt in self._recent]
        self._held = _Hold(step, frames, loads, time_s)
        return [PressBegan(target)]

    def _follow_press(self, time_s: float, ohm: FloatArray, load: FloatArray) -> list[Event]:
        held = self._held
        assert held is not None
        if len(held.frames) < MOST_KEPT:
            held.frames.append((time_s, ohm))
            held.loads.append(load)
        target = self.plan.pressed_target(held.largest(load))
        total = self._total(load, target)
        held.highest = max(held.highest, total)
        if total >= END * held.highest or (np.isinf(total) and np.isinf(held.highest)):
            if not held.long_enough and time_s - held.began_s >= self.hold_s:
                held.long_enough = True
                return [HeldLongEnough(target)]
            return []
        return [self._finish(held, target)]

    def _total(self, load: FloatArray, target: int) -> float:
        """Mean load of a target; infinite cells count with ten times the plan's largest load."""
        most = 10 * max(self.plan.loads_kpa)
        return float(np.minimum(load[self.plan.targets[target]], most).mean())

    def _finish(self, held: _Hold, target: int) -> Event:
        press = self._press_of(held, target)
        self._held = None
        self._recent.clear()
        self._lowest = np.full_like(self._lowest, np.inf)
        if press.fault:
            self.presses.append(press)
            return PressRefused(target, press)
        # A press that is done again takes the place of the one before, which the cells still remember.
        again = "done again"
        for number, other in enumerate(self.presses):
            if other.step == press.step and not other.fault and self._target_of(other) == target:
                self.presses[number] = replace(other, fault=again)
        self.presses.append(press)
        self._step = self._next_step()
        return PressTaken(target, press)

    def _press_of(self, held: _Hold, target: int) -> Press:
        """The press that has just ended, with what is wrong with it."""
        plan = self.plan
        cells = plan.targets[target]
        time_s = np.array([time for time, _ in held.frames])
        loads = np.array(held.loads)
        total = np.array([self._total(load, target) for load in loads])
        corners = _corners(time_s, total)
        start_s, end_s = corners[1], corners[2]
        steady_from_s = max(start_s + 0.5 * (end_s - start_s), end_s - LONGEST_WINDOW_S)
        edges_s = np.linspace(steady_from_s, end_s, HOLD_WINDOWS + 1)
        middle_s = np.searchsorted(time_s, edges_s)
        ohm = np.array([reading for _, reading in held.frames])
        steady = slice(middle_s[0], max(middle_s[-1], middle_s[0] + 1))
        bears = np.median(loads[steady], axis=0)
        felt_kpa = float(np.median(total[steady]))
        step = self._step_of(target, felt_kpa, held.step)
        expected = plan.loads_kpa[step]
        covered = cells[bears[cells] > BEGIN * expected]
        fault = self._fault(held, target, covered, bears, total[steady], end_s - start_s)
        covered = covered if len(covered) else cells

        spans = [(corners[0] - self.rest_s, corners[0] - 0.05 * self.rest_s)]
        spans += list(pairwise(edges_s))
        windows = [(time_s >= low) & (time_s < high) for low, high in spans]
        # The first frame of the press already bears a part of the load.
        windows[0] &= time_s < held.began_s
        means = [_window_mean(ohm[window][:, covered]) for window in windows]
        middles = [_middle(time_s[window], span) for window, span in zip(windows, spans, strict=True)]
        middles[0] = min(middles[0], float(corners[0]))
        return Press(
            cells=covered,
            time_s=corners,
            load_kpa=np.array([0.0, expected, expected, 0.0]),
            window_s=np.array(middles),
            resistance_ohm=np.array(means),
            std_ohm=_noise(ohm[steady][:, covered]),
            frames=max(int(windows[-1].sum()), 1),
            step=step,
            felt_kpa=max(felt_kpa, 0.0),
            fault=fault,
        )

    def _step_of(self, target: int, felt_kpa: float, present: int) -> int:
        """The step that a press belongs to: the present one, unless earlier presses of the target say another load."""
        done = [press for press in self.presses if not press.fault and self._target_of(press) == target]
        if not any(press.step == present for press in done) or felt_kpa <= 0:
            return present
        felt_per_kpa = float(np.mean([press.felt_kpa / press.held_kpa for press in done]))
        away = np.abs(np.log(felt_kpa / max(felt_per_kpa, 1e-9) / np.array(self.plan.loads_kpa)))
        away[present] -= 1e-9  # of equal loads, the present one
        return int(np.argmin(away))

    def _fault(
        self, held: _Hold, target: int, covered: IntArray, bears: FloatArray, total: FloatArray, held_s: float
    ) -> str:
        plan = self.plan
        cells = plan.targets[target]
        share = len(covered) / len(cells)
        inside = float(np.median(np.minimum(bears[cells], 10 * max(plan.loads_kpa))))
        outside = np.where(plan.outside(target), bears, 0.0)
        if share < COVERED:
            return f"the load was on {len(covered)} of the {len(cells)} cells"
        if (outside > OTHERS * inside).any():
            worst = plan.place(int(np.argmax(outside)))
            return f"cell {worst} beside {plan.name(target)} was pressed, too"
        if held_s < LEAST_HOLD * self.hold_s:
            return f"the load was held for {held_s:.1f} s; expected {self.hold_s:g} s"
        mean = float(total.mean())
        if len(total) < HOLD_WINDOWS:
            return f"{len(total)} frames came while the load was held; expected more"
        if np.abs(total - mean).max() > STEADY * mean + 6 * _noise(total[:, None])[0]:
            return "the load was not held still"
        return ""


@dataclass
class _Hold:
    """A press under way."""

    step: int
    frames: list[tuple[float, FloatArray]]
    """those before the press included"""
    loads: list[FloatArray]
    began_s: float
    """time of the frame with which the press was noticed"""
    highest: float = 0.0
    long_enough: bool = False
    most: FloatArray | None = None

    def largest(self, load: FloatArray) -> FloatArray:
        """(cells,) largest load of each cell so far."""
        self.most = np.maximum(load, 0.0) if self.most is None else np.maximum(self.most, load)
        return self.most


def rest_of(frames: Sequence[tuple[float, FloatArray]]) -> Rest:
    """The skin at rest, averaged over frames of (time in s, ohm of (rows, columns), NaN where not valid)."""
    time_s = np.array([time for time, _ in frames])
    ohm = np.array([reading for _, reading in frames])
    half = max(len(ohm) // 2, 1)
    mean = _window_mean(ohm)
    change = (_window_mean(ohm[-half:]) - _window_mean(ohm[:half])) / mean
    return Rest(float(time_s.mean()), mean, _noise(ohm), change, len(ohm))


SHEET_FACTOR = 3.0
"""factor between the typical cell and the data sheet that manufacture explains"""
CELL_FACTOR = 2.0
"""factor between one cell and the typical one"""
REST_CHANGE, REST_CHANGE_STDS = 0.01, 6.0
"""relative change of a resting cell during the measurement of rest, and so many standard errors besides"""


def check_rest(rest: Rest, cell: Cell) -> None:
    """Raises InputError where the skin does not look unloaded."""
    measured: BoolArray = rest.measured
    if not measured.any():
        raise InputError("no cell has a valid reading")
    typical = float(np.median(rest.resistance_ohm[measured]))
    contact = cell.model.kind == "contact"
    ratio = typical / cell.rest_resistance_ohm
    advice = "Take everything off the skin"
    if not contact and not 1 / SHEET_FACTOR <= ratio <= SHEET_FACTOR:
        raise InputError(
            f"the skin seems to be loaded: the typical resistance is {typical:.4g} ohm, {ratio:.2g} times that of the "
            f"cell's data at rest. {advice}, or give the data of this cell (--cell)"
        )
    of_typical = np.where(measured, rest.resistance_ohm / typical, 1.0)
    far = np.abs(np.log(of_typical)) > np.log(CELL_FACTOR)
    if far.any() and not contact:
        worst = _worst(np.abs(np.log(of_typical)))
        raise InputError(
            f"the skin seems to be loaded: cell {worst} has {of_typical[worst]:.2g} times the typical resistance at "
            f"rest. {advice}"
        )
    limit = REST_CHANGE + REST_CHANGE_STDS * rest.std_ohm / rest.resistance_ohm * 2 / np.sqrt(max(rest.frames, 1))
    moving = measured & (np.abs(rest.change) > limit)
    if moving.any():
        worst = _worst(np.where(moving, np.abs(rest.change), 0.0))
        raise InputError(
            f"the skin is not at rest: the resistance of {int(moving.sum())} cells is changing, most at cell {worst} "
            f"by {100 * rest.change[worst]:.1f} %. {advice}, and wait until it has recovered"
        )


def _worst(amount: FloatArray) -> tuple[int, int]:
    row, column = np.unravel_index(int(np.argmax(amount)), amount.shape)
    return int(row), int(column)


def _window_mean(values: FloatArray) -> FloatArray:
    """Mean over the frames; NaN for a cell that misses a fifth of them or more."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    known = np.isfinite(values)
    mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.mean(axis=0) > 0.8, mean, np.nan)


def _middle(time_s: FloatArray, span: tuple[float, float]) -> float:
    return float(time_s.mean()) if len(time_s) else float(np.mean(span))


def _noise(values: FloatArray) -> FloatArray:
    """Standard deviation from frame to frame, by differences of neighbours, so that a trend does not count."""
    if len(values) < 2:
        return np.zeros(values.shape[1:])
    squares = np.diff(values, axis=0) ** 2
    known = np.isfinite(squares)
    mean = np.where(known, squares, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    noise: FloatArray = np.sqrt(mean / 2)
    return noise


def _corners(time_s: FloatArray, load: FloatArray) -> FloatArray:
    """Times (4,) at which a load begins to rise, is there, begins to fall, and is gone.

    The rise is a line through its crossings of 10 and 90 %, the fall one through those of 90 and 50 %, where a press
    ends.
    """
    last_half = load[len(load) // 2 : -1] if len(load) > 4 else load
    level = float(np.median(last_half))
    up90 = _crossing(time_s, load, 0.9 * level, int(np.argmax(load >= 0.9 * level)))
    before = np.flatnonzero((load < 0.1 * level) & (time_s < up90))
    up10 = _crossing(time_s, load, 0.1 * level, int(before[-1]) + 1 if before.size else 1)
    above = np.flatnonzero(load >= 0.9 * level)
    down90 = _crossing(time_s, load, 0.9 * level, min(int(above[-1]) + 1, len(load) - 1))
    down50 = max(_crossing(time_s, load, 0.5 * level, len(load) - 1), down90)
    rise_s, fall_s = max(up90 - up10, 0.0) / 8, (down50 - down90) / 4
    start = up10 - rise_s
    there = max(up90 + rise_s, start + 1e-6)
    falls = max(down90 - fall_s, there + 1e-6)
    gone = max(down50 + 5 * fall_s, falls + 1e-6)
    return np.array([start, there, falls, gone])


def _crossing(time_s: FloatArray, load: FloatArray, level: float, after: int) -> float:
    """Time at which the load passes ``level`` between the frame before ``after`` and that frame."""
    first, last = max(after - 1, 0), after
    change = load[last] - load[first]
    share = 1.0 if change == 0 else float(np.clip((level - load[first]) / change, 0.0, 1.0))
    return float(time_s[first] + share * (time_s[last] - time_s[first]))
