"""Press detection during a calibration: a state machine from frames to presses, without I/O.

==========  ========================================================  =======================================
state       action                                                    ends when
==========  ========================================================  =======================================
rest        readings of the unloaded skin are averaged                ``rest_s`` have passed
waiting     waits for a press                                         a cell bears a quarter of the load
pressed     readings are stored                                       half of the load is gone
==========  ========================================================  =======================================

Loads are estimated with the common cell model (``cell.estimator``) and the measured rest resistances. A baseline, which
slowly follows the estimates between presses, is subtracted, so that a cell that is still recovering does not look
pressed. For the detection, readings are averaged over as many frames as their noise requires. The windows of a press
use the readings themselves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from ..cell import Cell
from ..common.arrays import FloatArray
from ..errors import InputError
from ._hold import Hold
from ._plan import Plan
from ._presses import Press, Rest
from ._rest import check_rest, rest_of
from ._tuning import (
    BASELINE_FALL_S,
    BASELINE_RISE_S,
    BEGIN,
    CLEAR_STDS,
    END,
    MOST_SMOOTHED,
    OTHER_STEP,
    TOUCH,
    UNREAD_S,
)

AGAIN = "done again"


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
    """A press has ended, and is not used; its ``fault`` says why."""

    target: int
    press: Press


Event = RestTaken | PressBegan | HeldLongEnough | PressTaken | PressRefused


class Watch:
    """Turns frames, in the order of time, into events on the skin."""

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
        """Begin, or continue from the ``rest`` and ``presses`` of an earlier watch.

        Args:
            cell: the common cell model.
            plan: the presses to expect.
            hold_s: required duration of a hold.
            rest_s: averaging time of the unloaded skin.
            rest: rest measurement of an earlier watch.
            presses: presses of an earlier watch.

        """
        self.cell, self.plan = cell, plan
        self.hold_s, self.rest_s = hold_s, rest_s
        self.rest = rest
        self.presses = list(presses)
        """all presses, in the order of time; those with a fault are not used"""
        self.step = self._next_step()
        """present step of the plan; None: all steps are done"""
        self.trace: list[tuple[float, float]] = []
        """time in s, and largest load on any cell in kPa by the common model; for the alignment with a reference"""
        self._first: list[tuple[float, FloatArray]] = []
        self._recent: deque[tuple[float, FloatArray, float, FloatArray]] = deque()
        self._hold: Hold | None = None
        self._time_s: float | None = None
        self._loads: _Loads | None = None
        if rest is not None:
            self._loads = _Loads(cell, plan, rest, hold_s, rest_s)

    @property
    def done(self) -> bool:
        """Whether all steps of the plan are done."""
        return self.rest is not None and self.step is None

    def missing(self, step: int) -> list[int]:
        """Targets without a good press of a step."""
        done = {self._target_of(press) for press in self.presses if press.step == step and not press.fault}
        return [target for target in range(len(self.plan.targets)) if target not in done]

    def feed(self, time_s: float, resistance_ohm: FloatArray) -> list[Event]:
        """Take the next frame, (rows, columns) in ohm with NaN where not valid; returns the events.

        Raises:
            InputError: in the rest measurement the skin is loaded, too noisy, or not read.

        """
        if self._time_s is not None and time_s <= self._time_s:
            return []
        elapsed_s = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = time_s
        if self._loads is None:
            return self._watch_rest(time_s, resistance_ohm)
        ohm = np.where(np.isfinite(resistance_ohm), resistance_ohm, np.nan).ravel()
        load_s, load = self._loads.step(time_s, elapsed_s, ohm, pressed=self._hold is not None)
        self.trace.append((load_s, float(load[np.isfinite(load)].max(initial=0.0))))
        if self._hold is not None:
            self._hold.add(time_s, ohm, load_s, load)
            return self._follow(self._hold, time_s)
        self._recent.append((time_s, ohm, load_s, load))
        while self._recent[0][0] < time_s - self.rest_s - self._loads.delay_s:
            self._recent.popleft()
        return self._look_for_press(self._loads, time_s, load)

    def interrupt(self) -> None:
        """Drop the press in progress, after the board was away. Later times may continue with any offset."""
        self._hold = None
        self._recent.clear()
        if self.rest is not None:
            self._loads = _Loads(self.cell, self.plan, self.rest, self.hold_s, self.rest_s)

    def _watch_rest(self, time_s: float, resistance_ohm: FloatArray) -> list[Event]:
        self._first.append((time_s, np.array(resistance_ohm)))
        if time_s - self._first[0][0] < self.rest_s:
            return []
        rest = rest_of(self._first)
        self._first.clear()
        check_rest(rest, self.cell)
        self._loads = _Loads(self.cell, self.plan, rest, self.hold_s, self.rest_s)
        self.rest = rest
        return [RestTaken(rest)]

    def _look_for_press(self, loads: _Loads, time_s: float, load: FloatArray) -> list[Event]:
        if self.step is None:
            return []
        begun = load > np.maximum(BEGIN * self.plan.loads_kpa[self.step], CLEAR_STDS * loads.noise_kpa)
        if not begun.any():
            return []
        self._hold = Hold(self.plan, self.step, time_s)
        for frame in self._recent:
            self._hold.add(*frame)
        return []

    def _follow(self, hold: Hold, time_s: float) -> list[Event]:
        target = hold.target()
        total_kpa = hold.total_kpa(target)
        hold.highest_kpa = max(hold.highest_kpa, total_kpa)
        lasts_s = time_s - hold.began_s
        if total_kpa < END * hold.highest_kpa:
            if not hold.reported:
                self._hold = None
                return []
            return [self._finish(hold, target)]
        if not hold.reported and lasts_s >= TOUCH * self.hold_s:
            hold.reported = True
            return [PressBegan(target)]
        if not hold.long_enough and lasts_s >= self.hold_s:
            hold.long_enough = True
            return [HeldLongEnough(target)]
        return []

    def _finish(self, hold: Hold, target: int) -> Event:
        assert self._loads is not None
        step = self._step_of(target, hold.felt_kpa(target), hold.step)
        smoothed = self._loads.smoothed
        press = hold.press(target, step, hold_s=self.hold_s, rest_s=self.rest_s, smoothed=smoothed)
        self._hold = None
        self._recent.clear()
        self._loads.released()
        if press.fault:
            self.presses.append(press)
            return PressRefused(target, press)
        # A repeated press replaces the earlier one, which stays in the list since it changed the cells' memory.
        for number, other in enumerate(self.presses):
            if other.step == step and not other.fault and self._target_of(other) == target:
                self.presses[number] = replace(other, fault=AGAIN)
        self.presses.append(press)
        self.step = self._next_step()
        return PressTaken(target, press)

    def _step_of(self, target: int, felt_kpa: float, present: int) -> int:
        """The step of a press: the present one, unless the load, compared with earlier presses, fits another better."""
        done = [press for press in self.presses if not press.fault and self._target_of(press) == target]
        if not done or felt_kpa <= 0:
            return present
        felt_per_kpa = float(np.mean([press.felt_kpa / press.held_kpa for press in done]))
        away = np.abs(np.log(felt_kpa / max(felt_per_kpa, 1e-9) / np.array(self.plan.loads_kpa)))
        nearest = int(np.argmin(away))
        return nearest if away[nearest] < OTHER_STEP * away[present] else present

    def _next_step(self) -> int | None:
        steps = range(len(self.plan.loads_kpa))
        return next((step for step in steps if self.missing(step)), None)

    def _target_of(self, press: Press) -> int:
        return self.plan.target_of_cell(int(press.cells[0]))


class _Loads:
    """Loads on the cells by the common cell model: smoothed, and relative to a baseline."""

    def __init__(self, cell: Cell, plan: Plan, rest: Rest, hold_s: float, rest_s: float) -> None:
        """Raises InputError if noise hides the smallest load."""
        typical = float(np.median(rest.resistance_ohm[rest.measured]))
        rest_ohm = np.where(rest.measured, rest.resistance_ohm, typical)
        least_kpa = min(plan.loads_kpa)
        # The response of the cell to the smallest load converts the noise to kPa.
        loaded = cell.forward((1,)).step(1.0, least_kpa)[0] / cell.rest_resistance_ohm - 1
        share = float(np.median((rest.std_ohm / rest_ohm)[rest.measured])) / max(abs(loaded), 1e-12)
        frame_s = rest_s / max(rest.frames - 1, 1)
        self.smoothed = max(1, ceil((CLEAR_STDS * share / BEGIN) ** 2))
        """number of frames over which readings are averaged"""
        if self.smoothed > 1 and self.smoothed * frame_s > MOST_SMOOTHED * hold_s:
            raise InputError(
                f"the noise of a frame is {share * least_kpa:.2g} kPa, which hides a load of {least_kpa:g} kPa; use "
                "larger loads, or hold them for longer (--hold)"
            )
        self.noise_kpa = share * least_kpa / np.sqrt(self.smoothed)
        """standard deviation of a smoothed load, of the typical cell at rest"""
        self.delay_s = (self.smoothed - 1) / 2 * frame_s
        # In strong noise, an estimator with memory would detect false turning points.
        name = "static" if self.smoothed > 1 else None
        self._estimator = cell.estimator(plan.shape, name, rest_resistance_ohm=rest_ohm)
        self._shape = plan.shape
        self._readable = rest.measured.ravel()
        self._frames: deque[tuple[float, FloatArray]] = deque(maxlen=self.smoothed)
        self._baseline_kpa = np.zeros(rest_ohm.size)
        self._unread_s = np.zeros(rest_ohm.size)
        self._pressure_kpa = np.zeros(rest_ohm.size)
        self._begun = False

    def step(self, time_s: float, elapsed_s: float, ohm: FloatArray, *, pressed: bool) -> tuple[float, FloatArray]:
        """Take a frame (cells,).

        Returns:
            The time of the smoothed load, and the load (cells,) in kPa; infinite for cells that are no longer read.

        """
        self._frames.append((time_s, ohm))
        middle_s = float(np.mean([time for time, _ in self._frames]))
        readings = np.array([reading for _, reading in self._frames])
        known = np.isfinite(readings)
        mean = np.where(known, readings, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        mean = np.where(known[-1], mean, np.nan)
        dt_s = elapsed_s if self._begun and elapsed_s > 0 else 1.0
        pressure = self._estimator.step(dt_s, mean.reshape(self._shape)).ravel()
        pressure = np.where(np.isfinite(pressure), pressure, 0.0)
        if not self._begun:
            self._baseline_kpa = np.minimum(pressure, 0.0)
        self._begun = True
        self._pressure_kpa = pressure
        if not pressed:
            away = pressure - self._baseline_kpa
            constant_s = np.where(away > 0, BASELINE_RISE_S, BASELINE_FALL_S)
            self._baseline_kpa -= away * np.expm1(-elapsed_s / constant_s)
        unread = self._readable & ~np.isfinite(ohm)
        self._unread_s = np.where(unread, self._unread_s + elapsed_s, 0.0)
        return middle_s, np.where(self._unread_s > UNREAD_S, np.inf, pressure - self._baseline_kpa)

    def released(self) -> None:
        """After a press, set the baseline to the present estimates, which are due to the memory of the cells."""
        self._baseline_kpa = self._pressure_kpa.copy()
