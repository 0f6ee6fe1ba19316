"""Settling after a row switch: the error at the sample instant, the shortest row period, and amplifier stability.

:class:`BoardsInTime` and :func:`stability_of_boards` serve many boards at once, :class:`Settling` and
:func:`stability` one.

After a row switch the readings approach their new values (:mod:`._repeated_scan`). Slewing and saturation are not
linear. Slewing is not modelled; saturated frames are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import IN_CACHE, ComplexArray, FloatArray
from ...errors import InputError, SolverError
from .._design import Design
from .._parts import of_columns
from .._population import Boards
from .._scan import scan
from .._tuning import FULL_GAIN, MOST_CROSSINGS, NEAR, NO_GAIN, ROUNDING
from ._circuit import ColumnNetworks, require_amplifiers
from ._repeated_scan import Deviations, RepeatedScan


class BoardsInTime:
    """The repeated scan of many boards of one design in time, each with cells of its own."""

    def __init__(self, design: Design, boards: Boards, cells: FloatArray) -> None:
        """Solve the settled frames and their dynamics.

        Args:
            design: which parts there are.
            boards: part values of B boards, or of one.
            cells: (B, rows, columns) ohm.

        Raises:
            InputError: a circuit whose dynamics are not modelled.

        """
        if design.is_described:
            raise InputError("networks at the lines' ends have no row period; expected [scan] and EventScan")
        self._board = board = design.board
        if board.circuit.has_amplifiers and not board.circuit.virtual_ground:
            require_amplifiers(board)
        self._scan = RepeatedScan(design, boards, cells)
        self.briefest = self._scan.briefest
        """shortest row period in s: the acquisitions of all columns, if one sampling capacitor serves them"""
        self.settled: FloatArray = board.transpose(self._scan.settled) + boards.reference_voltage[..., None]
        """(B, rows, columns) V after a long time, without supply limits"""

    @property
    def takes_time(self) -> bool:
        """Whether any reading follows its row switch with a delay."""
        return bool((self._scan.modes().size > 0).any())

    def deviations(self, period: FloatArray | float) -> Deviations:
        """Deviations in V (B, rows, columns) from the settled readings if each row is selected for ``period`` s (B,).

        Raises:
            InputError: a period is not positive or shorter than the acquisitions of all columns.

        """
        least = float(np.min(period))
        if not least > 0 or least < self.briefest:
            raise InputError(
                f"row period {least} s: expected a time above 0, and adc.acquisition_time for each column at least"
            )
        return Deviations(*map(self._board.transpose, self._scan.deviations(period)))

    def shortest_period(self, allowed: FloatArray) -> FloatArray:
        """Shortest row period (B,) in s such that no deviation exceeds ``allowed`` V (B,), nor at any longer period.

        A ringing amplifier may cross the right value much earlier; such crossings do not count. If nothing has to
        settle, the period is the sum of all acquisitions. Infinite where no period suffices, because a shared sampling
        capacitor cannot follow within its acquisition time.

        The search starts at a period where the sum of the envelopes of all modes is within the limit. From there the
        period decreases in steps that are short compared with the time scales of the modes that still matter. Where the
        deviation comes near the limit, the search looks for a peak between two steps.
        """
        modes = self._scan.modes()
        unhurried = self._scan.unhurried.larger.max(axis=(1, 2))
        found = np.where(unhurried > allowed, inf, self.briefest)
        left = (unhurried <= allowed) & (modes.slowest > 0) & np.isfinite(modes.slowest)
        if not left.any():
            return found
        least = np.where(left, 1e-9 / np.where(left, modes.slowest, 1.0), 0.0)

        def excess(waiting: FloatArray) -> FloatArray:
            largest: FloatArray = self._scan.deviations(self.briefest + waiting).larger.max(axis=(1, 2))
            return largest - allowed

        room = np.where(left, allowed - unhurried, inf)
        upper = np.maximum(modes.settled_after(room), least)
        upper_excess = excess(upper)
        for _ in range(60):
            if not (late := left & (upper_excess > 0)).any():
                break
            upper[late] *= 2.0
            upper_excess = excess(upper)
        after, after_excess = upper.copy(), np.full(len(upper), inf)  # the step before the last one
        bracket = np.zeros((2, len(upper)))
        crosses = np.zeros(len(upper), dtype=np.bool_)
        while left.any():
            lower = np.maximum(upper - modes.step(upper, room), 0.0)
            ends = lower < least
            lower[ends] = 0.0 if self.briefest else least[ends]
            lower_excess = excess(lower)
            near = left & (lower_excess <= 0) & (upper_excess > -NEAR * allowed)
            peaks = near & (upper_excess >= np.maximum(lower_excess, after_excess))
            top, top_excess = _peak(excess, lower, after) if peaks.any() else (upper, upper_excess)
            over = left & (lower_excess > 0)
            hidden = peaks & (top_excess > 0)
            bracket[:, over] = lower[over], upper[over]
            bracket[:, hidden] = top[hidden], after[hidden]
            crosses |= over | hidden
            left &= ~(over | hidden | ends)
            after, after_excess, upper, upper_excess = upper, upper_excess, lower, lower_excess
        if crosses.any():

            def decades(seconds: FloatArray) -> FloatArray:  # over the limit: nearly straight in time
                found: FloatArray = np.log(np.maximum(excess(seconds) / allowed + 1.0, 1e-300))
                return found

            crossing = _crossing(decades, bracket[0], bracket[1])
            found[crosses] = (self.briefest + crossing)[crosses]
        return found


_AROUND = np.geomspace(0.2, 3.0, 31)
"""multiples of the crossover at which a peak is looked for"""
_GOLDEN = (5.0**0.5 - 1.0) / 2.0
_SECTIONS = math.ceil(math.log(ROUNDING) / 2.0 / math.log(_GOLDEN))  # a peak errs by the square of its place


def _peak(
    excess: Callable[[FloatArray], FloatArray], lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where ``excess`` has its peak between two times (B,), and its value there, by golden sections."""
    low, high = lower.copy(), upper.copy()
    for _ in range(_SECTIONS):
        width = _GOLDEN * (high - low)
        rises = excess(high - width) < excess(low + width)
        low, high = np.where(rises, high - width, low), np.where(rises, high, low + width)
    middle = (low + high) / 2
    return middle, excess(middle)


def _crossing(level: Callable[[FloatArray], FloatArray], lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Where ``level`` falls to zero, between ``lower`` (positive there) and ``upper`` (not positive).

    False position with the Illinois weights (Dowell and Jarratt, BIT 11, 1971).
    """
    low, high, before, after = lower.copy(), upper.copy(), level(lower), level(upper)
    moved = np.zeros_like(low)
    for number in range(MOST_CROSSINGS):
        width = high - low
        if (width <= ROUNDING * high).all():
            break
        share = np.full_like(low, 0.5) if number % 3 == 2 else before / np.where(before > after, before - after, 1.0)
        margin = np.minimum(ROUNDING / 2 * high / np.where(width > 0, width, 1.0), 0.5)  # so that both ends close in
        middle = low + width * np.clip(share, margin, 1.0 - margin)
        there = level(middle)
        positive = there > 0
        after = np.where(positive, np.where(moved > 0, after / 2, after), there)
        before = np.where(positive, there, np.where(moved < 0, before / 2, before))
        low, high, moved = (
            np.where(positive, middle, low),
            np.where(positive, high, middle),
            np.where(positive, 1.0, -1.0),
        )
    return high


class Settling:
    """The repeated scan of constant cells in time; prepared once, then evaluated for any row period.

    Example::

        settling = Settling(design, resistance)
        settling.sampled(20e-6)         # V (rows, columns), each row sampled 20 us after it was selected
        settling.shortest_period(1e-3)  # s per row for 0.1 % of the largest signal
    """

    def __init__(self, design: Design, resistance: ArrayLike) -> None:
        """Solve the settled frame and its dynamics.

        Raises:
            InputError: cells that do not fit the design, or a circuit whose dynamics are not modelled.
            SolverError: an output saturates, so that the circuit is not linear.

        """
        board = design.board
        cells = design.resistance(resistance)
        self._in_time = BoardsInTime(design, Boards.of(design), cells[None])
        result = scan(design, cells, method="exact")
        if result.saturated.any():
            row, column = np.argwhere(result.saturated)[0]
            raise SolverError(
                f"the output of column {column} saturates while row {row} is selected; settling is a linear model: "
                "lower readout.reference_resistance or drive.voltage"
            )
        self.design = design
        self.settled: FloatArray = result.volts
        """V (rows, columns) after a long time"""
        self.signal = float(np.abs(self.settled - board.level).max())
        """V, the largest difference of a settled reading from the reference"""

    def sampled(self, period: float) -> FloatArray:
        """Readings in V (rows, columns) if each row is selected for ``period`` s.

        The scan repeats endlessly over the same cells. Without ``adc.acquisition_time`` all columns are sampled at the
        end of the step. With ``adc.acquisition_time`` one sampling capacitor serves the columns in turn, in the order
        of their numbers, and the last conversion ends with the step. One amplifier behind a switch, and dividers whose
        idle columns are open, read the columns in turn, each after an equal share of the step.

        Raises:
            InputError: the period is not positive or shorter than the acquisitions of all columns.

        """
        sampled: FloatArray = self.settled + self._in_time.deviations(period).repeated[0]
        return sampled

    def sampled_from_rest(self, period: float) -> FloatArray:
        """As :meth:`sampled`, but each row follows a row without signal: outputs and capacitor at the reference.

        A shared capacitor, too, starts each conversion at the reference.

        Raises:
            InputError: as :meth:`sampled`.

        """
        sampled: FloatArray = self.settled + self._in_time.deviations(period).from_rest[0]
        return sampled

    def error(self, period: float) -> float:
        """Largest deviation from the settled readings, relative to the largest signal of the frame.

        This is the larger value of two scans: the repeated scan (:meth:`sampled`) and the scan from rest
        (:meth:`sampled_from_rest`). In a repeated scan of equal cells nothing has to settle.
        """
        deviation = float(self._in_time.deviations(period).larger.max())
        return deviation / self.signal if deviation else 0.0

    def shortest_period(self, error: float) -> float:
        """Shortest row period in s such that :meth:`error` stays within ``error`` for all longer periods.

        See :meth:`BoardsInTime.shortest_period`.

        Raises:
            InputError: ``error`` is not between 0 and 1.
            SolverError: no period suffices, because the acquisition time is too short for the sampling capacitor.

        """
        if not 0 < error < 1:
            raise InputError(f"settling error {error}: expected a fraction between 0 and 1 of the largest signal")
        period = float(self._in_time.shortest_period(np.array([error * self.signal]))[0])
        if period == inf:
            adc = self.design.adc
            assert adc is not None
            raise SolverError(
                f"the sampling capacitor of {adc.sampling_capacitance} F cannot follow within "
                f"adc.acquisition_time = {adc.acquisition_time} s"
            )
        return period


@dataclass(frozen=True)
class LoopGain:
    """Loop gain of each amplifier, (rows, columns) or (B, rows, columns). Rows differ only with floating idle rows."""

    noise_gain: FloatArray
    """1 + Rref Y_jj, the other columns at their virtual grounds"""
    crossover: FloatArray
    """Hz at which the loop gain is 1: the closed-loop bandwidth, about GBW / noise gain without capacitances; NaN if
    the loop gain is below 1 throughout"""
    phase_margin: FloatArray
    """degrees"""


@dataclass(frozen=True)
class Stability(LoopGain):
    """Stability of each amplifier on its line, (rows, columns)."""

    _peaking: Callable[[], FloatArray] = field(repr=False)

    @cached_property
    def peaking(self) -> FloatArray:
        """Largest gain from cell current to output over frequency, relative to DC; 1: no peak. Searched on access."""
        return self._peaking()


def stability(design: Design, resistance: ArrayLike) -> Stability:
    """Phase margin and peaking of each amplifier on its column, while all other amplifiers hold theirs.

    The amplifiers have one pole. One with more has a smaller margin.

    Raises:
        InputError: as :class:`Settling`, or ``readout.gain_bandwidth`` is infinite.

    """
    loops = _Loops.of(design, Boards.of(design), design.resistance(resistance)[None])
    found = _loop_gain(design, loops, 1)
    values = found.noise_gain[0], found.crossover[0], found.phase_margin[0]
    return Stability(*values, lambda: _each_cell(design, loops.peaking(), 1)[0])


def stability_of_boards(design: Design, boards: Boards, cells: FloatArray) -> LoopGain:
    """The loop gains of many boards with cells (B, rows, columns) in ohm; errors as :func:`stability`."""
    return _loop_gain(design, _Loops.of(design, boards, cells), len(cells))


def _loop_gain(design: Design, loops: _Loops, count: int) -> LoopGain:
    omega = loops.crossover()
    angle = np.degrees(np.angle(loops.at(omega, loops.grid(omega))[0]))
    values = loops.noise_gain, omega / (2 * pi), np.where(angle > 90.0, angle - 180.0, angle + 180.0)
    return LoopGain(*(_each_cell(design, value, count) for value in values))


def _each_cell(design: Design, values: FloatArray, count: int) -> FloatArray:
    """(B, rows, columns) of values of the columns of each grid."""
    board = design.board
    grids = values.reshape(count, -1, values.shape[-1])
    return board.transpose(np.broadcast_to(grids, (count, *board.shape)))


class _Loops(NamedTuple):
    """Amplifiers on the M columns of K grids in line coordinates."""

    network: FloatArray
    """(K, M, M) S, the grid as the column ends see it"""
    feedback: FloatArray
    """(K, M) S"""
    slack: FloatArray
    """(K, M) reciprocal of the open-loop gain"""
    speed: FloatArray
    """(K, 1) 1/s, 2 pi GBW"""
    line: FloatArray
    """(K, 1) F"""
    across: FloatArray
    """(K, 1) F"""

    @classmethod
    def of(cls, design: Design, boards: Boards, cells: FloatArray) -> _Loops:
        require_amplifiers(design.board)
        if np.isinf(boards.gain_bandwidth).any():
            raise InputError("readout.gain_bandwidth is infinite: an amplifier without a pole has no phase margin")
        _, stack, network, _ = ColumnNetworks.of(design, boards, cells)
        parts = 1 / of_columns(stack.reference), 1 / of_columns(stack.gain), 2 * pi * boards.gain_bandwidth
        count, grids, columns = network.shape[:3]
        each = [
            np.repeat(np.broadcast_to(part, (count, part.shape[1])), grids, axis=0)
            for part in (*parts, boards.column_capacitance, boards.feedback_capacitance)
        ]
        return cls(network.reshape(-1, columns, columns), *each)

    @property
    def noise_gain(self) -> FloatArray:
        gain: FloatArray = 1.0 + np.einsum("kjj->kj", self.network) / self.feedback
        return gain

    def grid(self, omega: FloatArray) -> ComplexArray:
        """(K, M) S of the grid at each column's end at a frequency (K, M) of its own, without its own amplifier.

        All other amplifiers hold their columns as well as they can at that frequency.
        """
        found = np.empty(omega.shape, dtype=np.complex128)
        columns = np.arange(omega.shape[1])
        size = max(1, IN_CACHE // len(columns) ** 3)
        for first in range(0, len(omega), size):
            network, feedback, slack, speed, line, across = (part[first : first + size, None] for part in self)
            s = 1j * omega[first : first + size, :, None]
            back = feedback + s * across  # (K, judged column, column)
            held = back + s * line + np.where(np.eye(len(columns)), 0.0, back / (slack + s / speed))
            matrix = network + held[..., None] * np.eye(len(columns))
            ends = np.linalg.solve(matrix, np.eye(len(columns))[None, :, :, None])[:, columns, columns, 0]
            found[first : first + size] = 1.0 / ends - held[:, columns, columns]
        return found

    def at(self, omega: FloatArray, grid: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Loop gain (K, M), and gain from current to output in ohm, at a frequency (K, M)."""
        s: ComplexArray = (1j * omega).astype(np.complex128)
        gain, back = 1.0 / (self.slack + s / self.speed), self.feedback + s * self.across
        ahead = grid + back + s * self.line
        return gain * back / ahead, gain / (ahead + gain * back)

    def crossover(self) -> FloatArray:
        """(K, M) 1/s at which the loop gain is 1; NaN: nowhere.

        The grid at a column changes little with frequency, so that a few evaluations of it suffice.
        """
        low, high = (np.log(bound * self.speed) + np.zeros_like(self.slack) for bound in (FULL_GAIN, NO_GAIN))
        grid: ComplexArray = np.einsum("kjj->kj", self.network).astype(np.complex128)
        log_omega = high
        for _ in range(MOST_CROSSINGS):

            def level(at: FloatArray, grid: ComplexArray = grid) -> FloatArray:
                return np.log(np.abs(self.at(np.exp(at), grid)[0]))

            crosses, before = level(low) > 0, log_omega
            log_omega = _crossing(level, low, high)
            if not (crosses & (np.abs(log_omega - before) > ROUNDING)).any():
                break
            grid = self.grid(np.exp(log_omega))
        return np.where(crosses, np.exp(log_omega), np.nan)

    def peaking(self) -> FloatArray:
        """(K, M) largest gain relative to DC: on a grid of frequencies, then by golden sections."""
        omega = self.crossover()

        def gain(omega: FloatArray) -> FloatArray:
            return np.where(np.isfinite(omega), np.abs(self.at(omega, self.grid(omega))[1]), 0.0)

        steady = gain(FULL_GAIN * self.speed + np.zeros_like(self.slack))
        top = np.argmax([gain(omega * ratio) for ratio in _AROUND], axis=0)
        beside = (_AROUND[np.clip(top + step, 0, len(_AROUND) - 1)] for step in (-1, 1))
        _, peak = _peak(gain, *(omega * ratio for ratio in beside))
        return np.maximum(peak / steady, 1.0)
