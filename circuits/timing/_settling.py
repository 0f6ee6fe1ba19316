"""Settling after a row switch: the error at the sample instant, the shortest row period, and amplifier stability.

After a row switch the readings approach their new values (:mod:`._repeated_scan`). Slewing and saturation are not
linear. Slewing is not modelled; saturated frames are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...errors import InputError, SolverError
from .._design import Design
from .._scan import scan
from ._circuit import column_networks, require_amplifiers
from ._repeated_scan import Deviations, RepeatedScan


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
        self._board = board = design.board
        if board.circuit.has_amplifiers and not board.circuit.virtual_ground:
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
        self.signal = float(np.abs(self.settled - board.level).max())
        """V, the largest difference of a settled reading from the reference"""
        self._settled = board.turn(result.volts)
        self._scan = RepeatedScan(board, board.turn(design.resistance(resistance)))

    def sampled(self, period: float) -> FloatArray:
        """Readings in V (rows, columns) if each row is selected for ``period`` s.

        The scan repeats endlessly over the same cells. Without ``adc.acquisition_time`` all columns are sampled at the
        end of the step. With ``adc.acquisition_time`` one sampling capacitor serves the columns in turn, in the order
        of their numbers, and the last conversion ends with the step. One amplifier behind a switch, and dividers whose
        idle columns are open, read the columns in turn, each after an equal share of the step.

        Raises:
            InputError: the period is not positive or shorter than the acquisitions of all columns.

        """
        return self._board.turn(self._settled + self._deviations(period).repeated)

    def sampled_from_rest(self, period: float) -> FloatArray:
        """As :meth:`sampled`, but each row follows a row without signal: outputs and capacitor at the reference.

        A shared capacitor, too, starts each conversion at the reference.

        Raises:
            InputError: as :meth:`sampled`.

        """
        return self._board.turn(self._settled + self._deviations(period).from_rest)

    def error(self, period: float) -> float:
        """Largest deviation from the settled readings, relative to the largest signal of the frame.

        This is the larger value of two scans: the repeated scan (:meth:`sampled`) and the scan from rest
        (:meth:`sampled_from_rest`). In a repeated scan of equal cells nothing has to settle.
        """
        deviation = self._deviations(period).largest
        return deviation / self.signal if deviation else 0.0

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
        from scipy.optimize import minimize_scalar

        if not 0 < error < 1:
            raise InputError(f"settling error {error}: expected a fraction between 0 and 1 of the largest signal")
        briefest, unhurried = self._scan.briefest, self._scan.unhurried
        if unhurried > error * self.signal:
            adc = self.design.adc
            assert adc is not None
            raise SolverError(
                f"the sampling capacitor of {adc.sampling_capacitance} F cannot follow within "
                f"adc.acquisition_time = {adc.acquisition_time} s"
            )
        modes = self._scan.modes()
        if not len(modes.rate):
            return briefest

        def excess(waiting: float) -> float:
            return self.error(briefest + waiting) - error

        allowed = error * self.signal - unhurried
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
                lower = 0.0 if briefest else 1e-9 / slowest
            lower_excess = excess(lower)
            if lower_excess > 0:
                return briefest + _crossing(excess, lower, upper)
            if upper_excess > -_NEAR * error and upper_excess >= max(lower_excess, after_excess):
                found = minimize_scalar(lambda waiting: -excess(waiting), bounds=(lower, after), method="bounded")
                if found.fun < 0:
                    return briefest + _crossing(excess, float(found.x), after)
            if lower <= 1e-9 / slowest:
                return briefest
            after, after_excess, upper, upper_excess = upper, upper_excess, lower, lower_excess

    def _deviations(self, period: float) -> Deviations:
        if not period > 0 or period < self._scan.briefest:
            raise InputError(
                f"row period {period} s: expected a time above 0, and adc.acquisition_time for each column at least"
            )
        return self._scan.deviations(period)


_NEAR = 0.1  # of the limit; between two steps of a quarter of a radian an error rises by less than this


def _crossing(excess: Callable[[float], float], lower: float, upper: float) -> float:
    """Time at which ``excess`` falls to zero, between ``lower`` (positive there) and ``upper`` (not positive)."""
    from scipy.optimize import brentq

    fine = 1e-9 * upper
    at, beyond = float(brentq(excess, lower, upper, xtol=fine, rtol=1e-12)), fine
    while at < upper and excess(at) > 0:
        at, beyond = min(at + beyond, upper), 2.0 * beyond
    return at


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
    networks = column_networks(board, board.turn(design.resistance(resistance)))
    seen = np.array([np.diagonal(network) for network, _ in networks])
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
