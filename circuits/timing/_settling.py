"""Reading before everything has settled: the error at the sample instant, the fastest scan, and stability.

After a row switch the amplifiers approach their new outputs through the dynamics of :mod:`._dynamics`, and the
sampling capacitor of the ADC follows them through its switch. Both are linear, so one matrix exponential per phase of a
step carries the deviation from the settled state exactly, however stiff the parts; a scan that goes on and on is the
fixed point of a whole frame. Slewing and saturation are not linear: slewing is left out, saturation is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log, pi

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, solve
from scipy.signal import lfilter

from ...arrays import FloatArray
from ...errors import InputError, SolverError
from .._design import Design
from .._scan import scan
from ._dynamics import Dynamics, column_conductances, column_dynamics, require_amplifiers


class Settling:
    """The scan of one unchanging frame in time; prepared once, then asked for any row period.

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
        """What is read, V (rows, columns), if each row is selected for ``period`` s and sampled at its end.

        The scan is taken to go round and round over the same cells. With ``adc.acquisition_time`` one sampling
        capacitor serves the columns in turn, so that each conversion starts from what the one before has left; the
        outputs of all columns are taken at the end of the step.

        Raises:
            InputError: the period is not positive or shorter than the acquisitions of all columns.

        """
        tail, left = self._tails(period, np.roll(self._settled, 1, axis=0), periodic=True)
        arriving = (1 - left) * self._settled + tail
        if self._acquisition:  # one capacitor: conversions follow each other column by column
            sampled = _periodic_decay(arriving.reshape(-1, 1), left).reshape(arriving.shape)
        else:
            sampled = _periodic_decay(arriving, left)
        return self._board.turn(sampled)

    def sampled_from_rest(self, period: float) -> FloatArray:
        """As :meth:`sampled`, for rows that each follow one without any signal: outputs and capacitor at the reference.

        Raises:
            InputError: as :meth:`sampled`.

        """
        rest = np.full_like(self._settled, self._board.level)
        tail, left = self._tails(period, rest, periodic=False)
        return self._board.turn(self._settled + tail + left * (rest - self._settled))

    def error(self, period: float) -> float:
        """The largest deviation from settled, relative to the largest signal of the frame.

        The larger one of the steady scan and of the scan from rest, since cells that are all alike would need no
        settling at all.
        """
        deviation = max(np.abs(v - self.settled).max() for v in (self.sampled(period), self.sampled_from_rest(period)))
        return float(deviation) / self._signal if deviation else 0.0

    def shortest_period(self, error: float) -> float:
        """The shortest row period in s from which on :meth:`error` stays within ``error``.

        A ringing amplifier may pass the right value much earlier; such luck does not count. 0 if nothing has to settle.

        Raises:
            SolverError: no period will do, because the acquisition time is too short for the sampling capacitor.

        """
        if not 0 < error < 1:
            raise InputError(f"settling error {error}: expected a fraction between 0 and 1 of the largest signal")
        slowest = min((-_slowest(d.matrix) for d in self._dynamics if d.matrix.size), default=np.inf)
        if self._sampling and not self._acquisition:
            slowest = min(slowest, 1 / self._sampling)
        if np.isinf(slowest):
            longest = self._briefest
            if longest and self.error(longest) > error:
                raise self._hopeless()
            return longest
        longest = self._briefest + log(10 / error) / slowest
        for _ in range(20):
            if self.error(longest) <= error:
                break
            longest = self._briefest + 2 * (longest - self._briefest)
        else:
            raise self._hopeless()
        while True:
            shorter = self._briefest + 0.98 * (longest - self._briefest)
            if shorter - self._briefest < 1e-9 / slowest:
                return self._briefest
            if self.error(shorter) > error:
                break
            longest = shorter
        for _ in range(30):
            middle = (shorter + longest) / 2
            if self.error(middle) > error:
                shorter = middle
            else:
                longest = middle
        return longest

    def _hopeless(self) -> SolverError:
        return SolverError(
            f"the sampling capacitor, of time constant {self._sampling} s, cannot follow within "
            f"adc.acquisition_time = {self._acquisition} s"
        )

    def _tails(self, period: float, before: FloatArray, *, periodic: bool) -> tuple[FloatArray, float]:
        """What the amplifiers' own settling adds to each sample, V (rows, columns), and what the sampling capacitor
        keeps of its charge.

        ``before``: the settled outputs of the step before each row. ``periodic``: these were not reached either.
        """
        if not period > 0 or period < self._briefest:
            raise InputError(
                f"row period {period} s: expected a time above 0, and adc.acquisition_time for each column at least"
            )
        acquisition = self._acquisition or period
        rows, columns = self._settled.shape
        propagators = [self._propagators(d, period - acquisition, acquisition) for d in self._dynamics]
        repeat = rows // len(self._dynamics)  # grounded idle rows: all steps have the same dynamics
        steps, lifts = propagators * repeat, [d.lift for d in self._dynamics] * repeat
        jumps = [lift @ jump for lift, jump in zip(lifts, before - self._settled, strict=True)]
        states = len(self._dynamics[0].matrix)
        state: FloatArray = np.zeros(states)
        if periodic and states:
            # What a frame leaves at its end if it starts from nothing; then what it leaves if it starts from that.
            through: FloatArray = np.eye(states)
            for (carry, _), jump in zip(steps, jumps, strict=True):
                through, state = carry @ through, carry @ (state + jump)
            state = solve(np.eye(states) - through, state)
        tails = np.empty((rows, columns))
        for row, ((carry, sample), jump) in enumerate(zip(steps, jumps, strict=True)):
            start = state + jump
            tails[row] = sample @ start
            if periodic:
                state = carry @ start
        return tails, exp(-acquisition / self._sampling) if self._sampling else 0.0

    def _propagators(self, dynamics: Dynamics, waiting: float, acquisition: float) -> tuple[FloatArray, FloatArray]:
        """From the state after a row switch to that at the end of the step (S, S), and to the sample (M, S)."""
        states = len(dynamics.matrix)
        if self._sampling == 0:
            carry = expm(dynamics.matrix * (waiting + acquisition))
            return carry, dynamics.output @ carry
        columns = len(dynamics.output)
        together = np.zeros((states + columns, states + columns))
        together[:states, :states] = dynamics.matrix
        together[states:, :states] = dynamics.output / self._sampling
        together[states:, states:] = -np.eye(columns) / self._sampling
        connected = expm(together * acquisition)[:, :states] @ expm(dynamics.matrix * waiting)
        return connected[:states], connected[states:]


def _slowest(matrix: FloatArray) -> float:
    """The largest real part of the eigenvalues, 1/s: negative."""
    return float(np.linalg.eigvals(matrix).real.max())


def _periodic_decay(arriving: FloatArray, left: float) -> FloatArray:
    """The periodic solution of ``c[n] = left c[n-1] + arriving[n]`` along axis 0."""
    once = lfilter([1.0], [1.0, -left], arriving, axis=0)
    before = once[-1] / (1 - left ** len(arriving))
    decay = left ** np.arange(1, len(arriving) + 1)
    periodic: FloatArray = once + decay[:, None] * before
    return periodic


@dataclass(frozen=True)
class Stability:
    """How each amplifier stands on its line, (rows, columns): rows differ only with floating idle rows."""

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

    The loop gain is A(s) (1/Rref + s Cf) / (1/Rref + Y_jj + s (C + Cf)) with A(s) of one pole; crossover, margin and
    peak follow from it in closed form. An amplifier of two or more poles of its own has less margin than that.

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
