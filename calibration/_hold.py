"""A press in progress: collects its frames, and turns them into a :class:`Press` when the load is gone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ..common.arrays import FloatArray, IntArray
from ._plan import Plan
from ._presses import Press
from ._tuning import (
    BEGIN,
    HOLD_WINDOWS,
    LEAST_COVERED,
    LEAST_HOLD,
    LONGEST_WINDOW_S,
    MARGIN,
    MOST_BESIDE,
    STEADY,
    SURE_STDS,
    UNREAD_LOADS,
)
from ._windows import corners, noise, window_mean

MOST_FRAMES = 100_000


class Hold:
    """The frames of a press, beginning shortly before it."""

    def __init__(self, plan: Plan, step: int, began_s: float) -> None:
        """``step`` is the current step of the plan, ``began_s`` the time of the frame that revealed the press."""
        self._plan = plan
        self.step = step
        self.began_s = began_s
        self.highest_kpa = 0.0
        """largest mean load on the target so far"""
        self.reported = False
        """whether the press has lasted longer than a touch, and has been reported"""
        self.long_enough = False
        """whether the load may be taken off"""
        self._frames: list[tuple[float, FloatArray]] = []
        self._loads: list[tuple[float, FloatArray]] = []
        self._largest = np.zeros(plan.shape[0] * plan.shape[1])

    def add(self, time_s: float, ohm: FloatArray, load_s: float, load_kpa: FloatArray) -> None:
        """Take a frame: readings (cells,), and the smoothed load (cells,) with its time."""
        if len(self._frames) < MOST_FRAMES:
            self._frames.append((time_s, ohm))
            self._loads.append((load_s, self._limited(load_kpa)))

    def target(self) -> int:
        """The target with the largest load since the press was noticed."""
        if self._loads:
            self._largest = np.maximum(self._largest, self._loads[-1][1])
        return self._plan.pressed_target(self._largest)

    def total_kpa(self, target: int) -> float:
        """Present mean load on a target."""
        return float(self._loads[-1][1][self._plan.targets[target]].mean())

    def _limited(self, load_kpa: FloatArray) -> FloatArray:
        return np.minimum(load_kpa, UNREAD_LOADS * max(self._plan.loads_kpa))

    def felt_kpa(self, target: int) -> float:
        """Median over the hold of the mean load on a target."""
        return float(np.median(self._totals(target)[self._steady(target)]))

    def press(self, target: int, step: int, *, hold_s: float, rest_s: float, smoothed: int) -> Press:
        """The press that has just ended, with its fault if there is one.

        Args:
            target: the pressed target.
            step: the step of the plan that gives the load.
            hold_s: requested duration of the hold.
            rest_s: longest averaging window before the press.
            smoothed: number of frames over which loads are averaged.

        """
        cells = self._plan.targets[target]
        load_kpa = self._plan.loads_kpa[step]
        steady = self._steady(target)
        bears = np.median([load for _, load in self._loads[steady]], axis=0)
        covered = cells[bears[cells] > BEGIN * load_kpa]
        total = self._totals(target)[steady]
        fault = self._fault(target, covered, bears, hold_s) or _unsteady(total, smoothed)
        covered = covered if len(covered) else cells

        time_s = np.array([time for time, _ in self._frames])
        ohm = np.array([reading for _, reading in self._frames])[:, covered]
        at_s = self._corners(target)
        before = (at_s[0] - rest_s, min(at_s[0] - MARGIN * rest_s, self.began_s))
        spans = [before, *pairwise(self._edges_s(target))]
        windows = [(time_s >= low) & (time_s < high) for low, high in spans]
        means = [window_mean(ohm[window]) for window in windows]
        middles = [_middle(time_s[window], span) for window, span in zip(windows, spans, strict=True)]
        return Press(
            cells=covered,
            time_s=at_s,
            load_kpa=np.array([0.0, load_kpa, load_kpa, 0.0]),
            window_s=np.array(middles),
            resistance_ohm=np.array(means),
            std_ohm=noise(ohm[(time_s >= spans[1][0]) & (time_s < spans[-1][1])]),
            frames=max(int(windows[-1].sum()), 1),
            step=step,
            felt_kpa=max(self.felt_kpa(target), 0.0),
            fault=fault,
        )

    def _fault(self, target: int, covered: IntArray, bears: FloatArray, hold_s: float) -> str:
        plan = self._plan
        cells = plan.targets[target]
        at_s = self._corners(target)
        held_s = float(at_s[2] - at_s[1])
        if held_s < LEAST_HOLD * hold_s:
            return f"the load was held for {held_s:.1f} s; expected {hold_s:g} s"
        if len(covered) < LEAST_COVERED * len(cells):
            return f"the load was on {len(covered)} of the {len(cells)} cells"
        outside = np.where(plan.outside(target), bears, 0.0)
        if (outside > MOST_BESIDE * float(np.median(bears[cells]))).any():
            return f"cell {plan.place(int(np.argmax(outside)))} beside {plan.name(target)} was pressed, too"
        return ""

    def _totals(self, target: int) -> FloatArray:
        """(frames,) mean load on a target."""
        cells = self._plan.targets[target]
        return np.array([load[cells].mean() for _, load in self._loads])

    def _corners(self, target: int) -> FloatArray:
        return corners(np.array([time for time, _ in self._loads]), self._totals(target))

    def _edges_s(self, target: int) -> FloatArray:
        """Edges of the averaging windows in the hold."""
        _, there, falls, _ = self._corners(target)
        begin = max(there + 0.5 * (falls - there), falls - LONGEST_WINDOW_S)
        return np.linspace(begin, falls, HOLD_WINDOWS + 1)

    def _steady(self, target: int) -> slice:
        """The loads of the second half of the hold."""
        edges_s = self._edges_s(target)
        times = np.array([time for time, _ in self._loads])
        first, last = np.searchsorted(times, [edges_s[0], edges_s[-1]])
        first = min(first, len(times) - 1)
        return slice(int(first), int(max(last, first + 1)))


def _unsteady(total: FloatArray, smoothed: int) -> str:
    """The fault of a load (frames,) that was not held still; else empty."""
    if len(total) < HOLD_WINDOWS:
        return f"{len(total)} frames came while the load was held; expected more"
    mean = float(total.mean())
    # Successive moving averages share most of their frames: their differences are smaller than their noise.
    noise_kpa = float(noise(total[:, None])[0]) * np.sqrt(smoothed)
    moved = float(np.abs(total - mean).max())
    return "the load was not held still" if moved > STEADY * mean + SURE_STDS * noise_kpa else ""


def _middle(time_s: FloatArray, span: tuple[float, float]) -> float:
    return float(time_s.mean()) if len(time_s) else float(np.mean(span))
