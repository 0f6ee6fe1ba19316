"""Settling after a row switch: the error at the sample instant, the shortest row period, and amplifier stability.

After a row switch the amplifiers approach their new outputs with the dynamics of :mod:`._dynamics`. The sampling
capacitor of the ADC follows them through its switch. Both are linear. One matrix exponential per phase of a step
therefore propagates the deviation from the settled state exactly, however stiff the system. The steady state of a
repeated scan is the fixed point of a whole frame.

Slewing and saturation are not linear. Slewing is not modelled; saturated frames are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, inf, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, solve
from scipy.optimize import brentq, minimize_scalar

from ...common.arrays import ComplexArray, FloatArray
from ...errors import InputError, SolverError
from .._design import Design
from .._scan import scan
from ._dynamics import Dynamics, column_conductances, column_dynamics, require_amplifiers


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
            InputError: cells that do not fit the design, or a readout without amplifiers.
            SolverError: an output saturates, so that the circuit is not linear.

        """
        self._board = board = design.board
        require_amplifiers(board)
        result = scan(design, resistance, method="exact")
        if result.saturated.any():
            row, column = np.argwhere(result.saturated)[0]
            raise SolverError(
                f"the output of column {column} saturates while row {row} is selected; settling is a linear model: "
                "lower readout.reference_resistance or drive.voltage"
            )
        self.design = design
        self.settled: FloatArray = result.volts
        """V (rows, columns) after a long time"""
        self._settled = board.turn(result.volts)  # in line coordinates, like all that follows
        self._signal = float(np.abs(self.settled - board.level).max())
        conductances = column_conductances(board, board.turn(design.resistance(resistance)))
        self._dynamics = [column_dynamics(board, conductance) for conductance in conductances]
        adc = design.adc
        self._sampling = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0  # s
        self._acquisition = adc.acquisition_time if adc else 0.0
        # One capacitor serves the columns in turn, so a row takes at least that long.
        self._briefest = self._acquisition * board.shape[1]

    def sampled(self, period: float) -> FloatArray:
        """Readings in V (rows, columns) if each row is selected for ``period`` s.

        The scan repeats endlessly over the same cells. Without ``adc.acquisition_time`` all columns are sampled at the
        end of the step. With ``adc.acquisition_time`` one sampling capacitor serves the columns in turn, in the order
        of their numbers, and the last conversion ends with the step. The first column then has the least time to
        settle, and each conversion starts from the voltage that the previous one has left on the capacitor.

        Raises:
            InputError: the period is not positive or shorter than the acquisitions of all columns.

        """
        return self._board.turn(self._settled + self._in_turn(self._steps(period)))

    def sampled_from_rest(self, period: float) -> FloatArray:
        """As :meth:`sampled`, but each row follows a row without signal: outputs and capacitor at the reference.

        A shared capacitor, too, starts each conversion at the reference.

        Raises:
            InputError: as :meth:`sampled`.

        """
        return self._board.turn(self._settled + self._from_rest(self._steps(period)))

    def error(self, period: float) -> float:
        """Largest deviation from the settled readings, relative to the largest signal of the frame.

        This is the larger value of two scans: the repeated scan (:meth:`sampled`) and the scan from rest
        (:meth:`sampled_from_rest`). In a repeated scan of equal cells nothing has to settle.
        """
        steps = self._steps(period)
        deviation = max(float(np.abs(d).max()) for d in (self._in_turn(steps), self._from_rest(steps)))
        return deviation / self._signal if deviation else 0.0

    def shortest_period(self, error: float) -> float:
        """Shortest row period in s such that :meth:`error` stays within ``error`` for all longer periods.

        A ringing amplifier may cross the right value much earlier; such crossings do not count. If nothing has to
        settle, the period is the sum of all acquisitions: 0 without ``adc.acquisition_time``.

        The search starts at a period where the sum of the envelopes of all modes is within the limit. From there the
        period decreases in steps that are short compared with the time scales of the modes that still matter. Where the
        error comes near the limit, the search looks for a peak between two steps.

        Raises:
            InputError: ``error`` is not between 0 and 1.
            SolverError: no period suffices, because the acquisition time is too short for the sampling capacitor.

        """
        if not 0 < error < 1:
            raise InputError(f"settling error {error}: expected a fraction between 0 and 1 of the largest signal")
        if self._unhurried() > error:
            raise SolverError(
                f"the sampling capacitor, of time constant {self._sampling} s, cannot follow within "
                f"adc.acquisition_time = {self._acquisition} s"
            )
        modes = self._modes()
        if not len(modes.rate):
            return self._briefest

        def excess(waiting: float) -> float:
            return self.error(self._briefest + waiting) - error

        allowed = (error - self._unhurried()) * self._signal
        slowest = float(-modes.rate.real.max())
        upper = modes.settled_after(allowed)
        for _ in range(60):
            if excess(upper) <= 0:
                break
            upper *= 2.0
        upper_excess = excess(upper)
        after, after_excess = upper, inf  # the step before the last one
        while True:
            lower = upper - modes.step(upper, allowed)
            if lower < 1e-9 / slowest:
                lower = 0.0 if self._briefest else 1e-9 / slowest
            lower_excess = excess(lower)
            if lower_excess > 0:
                return self._briefest + _crossing(excess, lower, upper)
            if upper_excess > -_NEAR * error and upper_excess >= max(lower_excess, after_excess):
                found = minimize_scalar(lambda waiting: -excess(waiting), bounds=(lower, after), method="bounded")
                if found.fun < 0:
                    return self._briefest + _crossing(excess, float(found.x), after)
            if lower <= 1e-9 / slowest:
                return self._briefest
            after, after_excess, upper, upper_excess = upper, upper_excess, lower, lower_excess

    def _unhurried(self) -> float:
        """Error that remains at any row period: a shared capacitor's memory of the previous conversion."""
        left = self._left(1.0)
        if not self._acquisition or not left:
            return 0.0
        rest = left * np.abs(self._settled - self._board.level).max()
        return float(max(rest, np.abs(self._memory(np.zeros_like(self._settled), left)).max())) / self._signal

    def _left(self, period: float) -> float:
        """Fraction of its charge that a capacitor keeps through one acquisition."""
        return exp(-(self._acquisition or period) / self._sampling) if self._sampling else 0.0

    def _in_time(self, rows: FloatArray) -> FloatArray:
        """Rows from line coordinates to the order of time, or back. A scan selects lines by their numbers in the array.

        Columns, too, are converted in the order of their numbers in the array; only :meth:`_memory` and
        :meth:`_propagators` need this order.
        """
        return rows[::-1] if self._board.turned else rows

    def _steps(self, period: float) -> _Steps:
        """Propagators of the states and samples through steps of ``period`` s."""
        if not period > 0 or period < self._briefest:
            raise InputError(
                f"row period {period} s: expected a time above 0, and adc.acquisition_time for each column at least"
            )
        repeat = len(self._settled) // len(self._dynamics)  # grounded idle rows: all steps have the same dynamics
        propagators = [self._propagators(dynamics, period) for dynamics in self._dynamics] * repeat
        order = slice(None, None, -1) if self._board.turned else slice(None)
        return _Steps(propagators[order], ([d.lift for d in self._dynamics] * repeat)[order], self._left(period))

    def _in_turn(self, steps: _Steps) -> FloatArray:
        """Deviations (rows, columns) in V of the samples of a repeated scan in its steady state."""
        settled = self._in_time(self._settled)
        jumps = [lift @ jump for lift, jump in zip(steps.lifts, np.roll(settled, 1, axis=0) - settled, strict=True)]
        # The state at the end of a frame that starts from zero; then the fixed point of a frame.
        through: FloatArray = np.eye(len(steps.lifts[0]))
        state: FloatArray = np.zeros(len(through))
        for (carry, _), jump in zip(steps.propagators, jumps, strict=True):
            through, state = carry @ through, carry @ (state + jump)
        if len(state):
            state = solve(np.eye(len(state)) - through, state)
        tails = np.empty(settled.shape)
        for row, ((carry, sample), jump) in enumerate(zip(steps.propagators, jumps, strict=True)):
            tails[row] = sample @ (state + jump)
            state = carry @ (state + jump)
        return self._in_time(self._memory(tails, steps.left))

    def _memory(self, tails: FloatArray, left: float) -> FloatArray:
        """Deviations in V, rows in time order, of samples on capacitors that keep the fraction ``left`` of the last."""
        settled = self._in_time(self._settled)
        arriving = (1 - left) * settled + tails
        if not self._acquisition:
            return _periodic_decay(arriving, left) - settled
        # One capacitor: conversions follow each other column by column.
        order = slice(None, None, -1) if self._board.turned else slice(None)
        conversions = arriving[:, order].reshape(-1, 1)
        return _periodic_decay(conversions, left).reshape(arriving.shape)[:, order] - settled

    def _from_rest(self, steps: _Steps) -> FloatArray:
        """Deviations (rows, columns) in V of the samples of rows that each start from rest."""
        settled = self._in_time(self._settled)
        jump = self._board.level - settled
        tails = [
            sample @ (lift @ own) for (_, sample), lift, own in zip(steps.propagators, steps.lifts, jump, strict=True)
        ]
        return self._in_time(np.array(tails) + steps.left * jump)

    def _propagators(self, dynamics: Dynamics, period: float) -> tuple[FloatArray, FloatArray]:
        """Propagators from the state after a row switch to the end of the step (S, S), and to each sample (M, S)."""
        if not self._acquisition:
            return self._acquired(dynamics, period)
        carry, sample = self._acquired(dynamics, self._acquisition)
        state = expm(dynamics.matrix * (period - self._briefest))
        samples = np.empty_like(sample)
        columns = np.arange(len(samples))
        for column in columns[::-1] if self._board.turned else columns:
            samples[column] = sample[column] @ state
            state = carry @ state
        return state, samples

    def _acquired(self, dynamics: Dynamics, duration: float) -> tuple[FloatArray, FloatArray]:
        """Propagators over ``duration`` s from the instant when the capacitors are connected.

        Returns:
            (S, S) from the state to the state, and (M, S) from the state to the capacitors' voltages.

        """
        if self._sampling == 0:
            carry = expm(dynamics.matrix * duration)
            return carry, dynamics.output @ carry
        states = len(dynamics.matrix)
        propagated = expm(self._with_capacitors(dynamics) * duration)[:, :states]
        return propagated[:states], propagated[states:]

    def _with_capacitors(self, dynamics: Dynamics) -> FloatArray:
        """The system's matrix (S + M, S + M) in 1/s, with a capacitor on each output."""
        states, columns = len(dynamics.matrix), len(dynamics.output)
        together = np.zeros((states + columns, states + columns))
        together[:states, :states] = dynamics.matrix
        together[states:, :states] = dynamics.output / self._sampling
        together[states:, states:] = -np.eye(columns) / self._sampling
        return together

    def _modes(self) -> _Modes:
        """Modes whose sum is the deviation of a sample, with bounds on their amplitudes."""
        rates, sizes = [], []
        kept = 1.0 - self._left(1.0) if self._acquisition else 1.0
        rows, columns = self._settled.shape
        steps = [0] * rows if len(self._dynamics) == 1 else range(rows)
        before = np.roll(self._settled, -1 if self._board.turned else 1, axis=0)
        for number, dynamics in enumerate(self._dynamics):
            own = self._settled[[step == number for step in steps]]
            jumps = np.concatenate([own - self._board.level, own - before[[step == number for step in steps]]])
            matrix, start = dynamics.matrix, dynamics.lift @ jumps.T
            if self._acquisition:
                seen = self._acquired(dynamics, self._acquisition)[1]
            elif self._sampling:
                matrix = self._with_capacitors(dynamics)
                start = np.concatenate([start, jumps.T])
                seen = np.eye(len(matrix))[-columns:]
            else:
                seen = dynamics.output
            if not len(matrix):
                continue
            rate, shape = np.linalg.eig(matrix)
            share = np.abs(np.linalg.solve(shape, start.astype(complex))).max(axis=1)
            rates.append(rate)
            sizes.append(np.abs(seen @ shape).max(axis=0) * share / kept)
        if not rates:
            return _Modes(np.empty(0, dtype=complex), np.empty(0))
        return _Modes(np.concatenate(rates), np.concatenate(sizes))


class _Steps(NamedTuple):
    """The steps of a frame in the order of time, for one row period."""

    propagators: list[tuple[FloatArray, FloatArray]]
    """from the state after each row switch to the end of the step (S, S), and to the step's samples (M, S)"""
    lifts: list[FloatArray]
    """(S, M) derivative of each step's settled state by its settled outputs"""
    left: float
    """fraction of its charge that a sampling capacitor keeps"""


class _Modes(NamedTuple):
    """Exponential modes whose sum is the deviation of a sample."""

    rate: ComplexArray
    """1/s, eigenvalues"""
    size: FloatArray
    """V, largest amplitude at the start of a step"""

    def envelope(self, waiting: float) -> FloatArray:
        """Bound in V on each mode in a sample taken ``waiting`` s after a row switch, earlier steps included."""
        decay = self.rate.real * waiting
        envelope: FloatArray = self.size * np.exp(decay) / np.maximum(-np.expm1(decay), 1e-300)
        return envelope

    def settled_after(self, allowed: float) -> float:
        """Seconds after which the sum of all modes stays within ``allowed`` V."""
        least = 1.0 / float(np.abs(self.rate).max())
        while self.envelope(least).sum() > allowed:
            least *= 1.2
        return least

    def step(self, waiting: float, allowed: float) -> float:
        """Step in s of the search, short enough that the sum of the modes that still matter is nearly straight."""
        matter = self.envelope(waiting) > _NEGLIGIBLE * allowed / len(self.rate)
        fastest = float(np.abs(self.rate[matter]).max(initial=0.0))
        return min(0.1 * waiting, 0.25 / fastest) if fastest else 0.1 * waiting


_NEAR = 0.1  # of the limit; between two steps of a quarter of a radian an error rises by less than this
_NEGLIGIBLE = 1e-3  # of the limit: sum of all modes that are neglected


def _crossing(excess: Callable[[float], float], lower: float, upper: float) -> float:
    """Time at which ``excess`` falls to zero, between ``lower`` (positive there) and ``upper`` (not positive)."""
    fine = 1e-9 * upper
    at, beyond = float(brentq(excess, lower, upper, xtol=fine, rtol=1e-12)), fine
    while at < upper and excess(at) > 0:
        at, beyond = min(at + beyond, upper), 2.0 * beyond
    return at


def _periodic_decay(arriving: FloatArray, left: float) -> FloatArray:
    """The periodic solution of ``c[n] = left c[n-1] + arriving[n]`` along axis 0."""
    from scipy.signal import lfilter  # loads scipy.stats, which takes as long as all else of this package

    once = lfilter([1.0], [1.0, -left], arriving, axis=0)
    before = once[-1] / (1 - left ** len(arriving))
    decay = left ** np.arange(1, len(arriving) + 1)
    periodic: FloatArray = once + decay[:, None] * before
    return periodic


@dataclass(frozen=True)
class Stability:
    """Stability of each amplifier on its line, (rows, columns). Rows differ only with floating idle rows."""

    noise_gain: FloatArray
    """1 + Rref Y_jj, the other columns at their virtual grounds"""
    crossover: FloatArray
    """Hz at which the loop gain is 1: the closed-loop bandwidth, about GBW / noise gain without capacitances; NaN if
    the loop gain is below 1 throughout"""
    phase_margin: FloatArray
    """degrees"""
    peaking: FloatArray
    """largest gain from cell current to output over frequency, relative to DC; 1: no peak"""


def stability(design: Design, resistance: ArrayLike) -> Stability:
    """Phase margin and peaking of each amplifier on its column.

    The loop gain is A(s) (1/Rref + s Cf) / (1/Rref + Y_jj + s (C + Cf)), where A(s) has one pole. Crossover, margin and
    peak follow in closed form. An amplifier with more than one pole has a smaller margin.

    Raises:
        InputError: as :class:`Settling`, or ``readout.gain_bandwidth`` is infinite.

    """
    board, part = design.board, design.readout
    require_amplifiers(board)
    if np.isinf(part.gain_bandwidth):
        raise InputError("readout.gain_bandwidth is infinite: an amplifier without a pole has no phase margin")
    seen = np.einsum("...jj->...j", column_conductances(board, board.turn(design.resistance(resistance))))
    rref, slack, speed = board.reference, 1 / board.gain, 2 * pi * part.gain_bandwidth
    slowed = part.column_capacitance + part.feedback_capacitance > 0
    gain = 1 + rref * seen
    zero, pole = rref * part.feedback_capacitance, rref * (part.column_capacitance + part.feedback_capacitance)
    # |A| |beta| = 1:  1 + zero^2 w^2 = (w^2/speed^2 + slack^2) (gain^2 + pole^2 w^2), in x = (w/speed)^2
    a = (pole * speed) ** 2
    b = gain**2 + (slack * pole * speed) ** 2 - (zero * speed) ** 2
    c = (slack * gain) ** 2 - 1
    root = np.sqrt(np.maximum(b**2 - 4 * a * c, 0))
    x = np.where(b > 0, -2 * c / (b + root), (root - b) / (2 * a) if slowed else np.nan)
    omega = np.sqrt(np.where(c < 0, x, np.nan))  # in units of speed
    lag = np.arctan2(omega, slack) - np.arctan(omega * speed * zero) + np.arctan(omega * speed * pole / gain)
    # Closed loop: pole/speed s^2 + (gain/speed + slack pole + zero) s + (1 + slack gain)
    stiffness = 1 + slack * gain
    damping = (gain / speed + slack * pole + zero) / (2 * np.sqrt(stiffness * pole / speed)) if slowed else np.inf
    with np.errstate(invalid="ignore", divide="ignore"):
        resonant = 1 / (2 * damping * np.sqrt(1 - damping**2))
    peaking = np.where(damping < np.sqrt(0.5), resonant, 1.0)

    def for_each_cell(values: FloatArray) -> FloatArray:
        return board.turn(np.broadcast_to(values, board.shape))

    return Stability(
        noise_gain=for_each_cell(gain),
        crossover=for_each_cell(omega * part.gain_bandwidth),
        phase_margin=for_each_cell(180 - np.degrees(lag)),
        peaking=for_each_cell(peaking),
    )
