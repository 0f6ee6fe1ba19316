"""Amplifiers in time: propagators of their linear system, and of the sampling capacitors, over a repeated scan.

After a row switch the amplifiers approach their new outputs with the dynamics of :mod:`._dynamics`. The sampling
capacitor of the ADC follows them through its switch. Both are linear. One matrix exponential per phase of a step
therefore propagates the deviation from the settled state exactly, however stiff the system. The steady state of a
repeated scan is the fixed point of a whole frame.
"""

from __future__ import annotations

from functools import cached_property
from math import exp
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm, solve

from ...common.arrays import FloatArray
from .._board import Board
from ._dynamics import Dynamics, column_conductances, column_dynamics
from ._modes import Deviations, Modes


class AmplifierScan:
    """The repeated scan of constant cells by amplifiers on all columns (:class:`._modes.RepeatedScan`)."""

    def __init__(self, board: Board, cells: FloatArray, settled: FloatArray) -> None:
        """Prepare the dynamics.

        Args:
            board: with amplifiers that hold all columns.
            cells: (N, M) ohm.
            settled: (N, M) V, the settled readings.

        """
        self._board, self._settled = board, settled
        self.dynamics = [column_dynamics(board, conductance) for conductance in column_conductances(board, cells)]
        """of each row, or of all together where idle rows are grounded"""
        adc = board.adc
        self._sampling = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0  # s
        self._acquisition = adc.acquisition_time if adc else 0.0
        # One capacitor serves the columns in turn, so a row takes at least that long.
        self.briefest = self._acquisition * board.shape[1]

    def deviations(self, period: float) -> Deviations:
        """See :meth:`._modes.RepeatedScan.deviations`.

        With ``adc.acquisition_time`` one sampling capacitor serves the columns in turn, in the order of their numbers,
        and the last conversion ends with the step. The first column then has the least time to settle, and each
        conversion starts from the voltage that the previous one has left on the capacitor.
        """
        steps = self._steps(period)
        return Deviations(self._in_turn(steps), self._from_rest(steps))

    @cached_property
    def unhurried(self) -> float:
        """See :meth:`._modes.RepeatedScan.unhurried`."""
        left = self._left(1.0)
        if not self._acquisition or not left:
            return 0.0
        rest = left * np.abs(self._settled - self._board.level).max()
        return float(max(rest, np.abs(self._memory(np.zeros_like(self._settled), left)).max()))

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
        repeat = len(self._settled) // len(self.dynamics)  # grounded idle rows: all steps have the same dynamics
        propagators = [self._propagators(dynamics, period) for dynamics in self.dynamics] * repeat
        order = slice(None, None, -1) if self._board.turned else slice(None)
        return _Steps(propagators[order], ([d.lift for d in self.dynamics] * repeat)[order], self._left(period))

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
        state = expm(dynamics.matrix * (period - self.briefest))
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

    def modes(self) -> Modes:
        """See :meth:`._modes.RepeatedScan.modes`."""
        rates, sizes = [], []
        kept = 1.0 - self._left(1.0) if self._acquisition else 1.0
        rows, columns = self._settled.shape
        steps = [0] * rows if len(self.dynamics) == 1 else range(rows)
        before = np.roll(self._settled, -1 if self._board.turned else 1, axis=0)
        for number, dynamics in enumerate(self.dynamics):
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
            return Modes(np.empty(0, dtype=complex), np.empty(0))
        return Modes(np.concatenate(rates), np.concatenate(sizes))


class _Steps(NamedTuple):
    """The steps of a frame in the order of time, for one row period."""

    propagators: list[tuple[FloatArray, FloatArray]]
    """from the state after each row switch to the end of the step (S, S), and to the step's samples (M, S)"""
    lifts: list[FloatArray]
    """(S, M) derivative of each step's settled state by its settled outputs"""
    left: float
    """fraction of its charge that a sampling capacitor keeps"""


def _periodic_decay(arriving: FloatArray, left: float) -> FloatArray:
    """The periodic solution of ``c[n] = left c[n-1] + arriving[n]`` along axis 0."""
    from scipy.signal import lfilter  # loads scipy.stats, which takes as long as all else of this package

    once = lfilter([1.0], [1.0, -left], arriving, axis=0)
    before = once[-1] / (1 - left ** len(arriving))
    decay = left ** np.arange(1, len(arriving) + 1)
    periodic: FloatArray = once + decay[:, None] * before
    return periodic
