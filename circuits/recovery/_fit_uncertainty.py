"""Uncertainty of a fit: by ADC steps, noise, the converter's offset and gain errors, and steps not taken."""

from __future__ import annotations

from math import hypot

import numpy as np

from ...common.arrays import FloatArray
from ._coupled_board import CoupledBoard, Frame
from ._gauss_newton import FITS, Fit
from ._linearised import Base

_SIGMAS = 4.5  # posterior standard deviations by ADC steps that an uncertainty covers: a bound on the error
_NOISE_SIGMAS = 3.5  # the same by noise: a fifth more, a factor of two at the limit of validity, is 5 of them
ALIKE = 2.0
"""standard deviation by ADC steps over that by independent errors. Readings of cells at rest are alike, and so are
their errors, which add up in the sum of a column's currents; 1.8 in a pressed column of equal cells
"""
_CHANGED = 1.03  # least factor by which cells have changed since the derivatives were made for scales to be taken anew
_MOST = 50.0  # uncertainty of a logarithm that counts as infinite
_STALLED = 10.0  # possible length of the remaining steps over the next one if the misfit no longer tells


class FitUncertainty:
    """Relative uncertainties of the fitted conductances."""

    def __init__(self, parts: CoupledBoard, *, scales_columns: bool) -> None:
        """For a board, on which errors of readings may scale whole columns (:attr:`.LiveRecovery.scales_columns`)."""
        adc = parts.board.adc
        self._behind = parts.board.reference + parts.board.column_lead if scales_columns else None  # (M,) ohm
        self._noise = parts.noise  # V
        self._leads = np.where(np.isfinite(parts.leads), parts.leads, 0.0).ravel()  # (n,) ohm
        self._random = 1.0  # share of the converter's error that differs from reading to reading
        self._shifts: tuple[float, float, float] | None = None  # V and relative: errors of all readings; V of code 0
        if adc is not None and (adc.offset_voltage or adc.gain_error):
            self._shifts = abs(adc.offset_voltage), abs(adc.gain_error), adc.range[0]
            self._random = (0.5 + abs(adc.inl_steps)) * adc.step / parts.half_step

    def by_own_reading(self, frame: Frame) -> FloatArray:
        """The part (n,) by a cell's own reading."""
        own = frame.error * frame.slope
        own[frame.slope == 0] = 1.0
        return own

    def covered(self, frame: Frame) -> float:
        """V, standard deviation of the random error of readings that gives the uncertainty."""
        return hypot(_SIGMAS * self._random * self._noise, _NOISE_SIGMAS * frame.noise)

    def of_own_reading(self, frame: Frame, uncertainty: FloatArray) -> FloatArray:
        """The part (n,) of an ``uncertainty`` (n,) by a cell's own reading, at most 1."""
        own = self.covered(frame) * frame.slope
        own[frame.slope == 0] = 1.0
        at_most: FloatArray = np.minimum(np.minimum(own, uncertainty), 1.0)
        return at_most

    def of_all_readings(
        self, frame: Frame, std: FloatArray, steeper: FloatArray, uncertainty: FloatArray
    ) -> FloatArray:
        """The part (n,) of an ``uncertainty`` (n,) by random errors of all readings, at most 1.

        Args:
            frame: the readings.
            std: :attr:`.Base.std` of the fit's derivatives.
            steeper: :attr:`.Fit.steeper`.
            uncertainty: the whole uncertainty.

        """
        by_all = _spread(std, steeper) * (self.covered(frame) / self._noise)
        at_most = np.minimum(np.minimum(by_all, uncertainty), 1.0)
        at_least: FloatArray = np.maximum(at_most, self.of_own_reading(frame, uncertainty))
        return at_least

    def sigmas(self, frame: Frame, fit: Fit) -> float:
        """Number of posterior standard deviations, by rounding alone, in an uncertainty.

        A misfit larger than an ADC step explains increases the uncertainty of the whole fit in proportion.
        """
        by_noise = _NOISE_SIGMAS * frame.noise / self._noise
        return max(hypot(_SIGMAS * self._random, by_noise), fit.misfit * hypot(_SIGMAS, by_noise))

    def by_readings(
        self, frame: Frame, fit: Fit, base: Base, own: FloatArray, by_shifts: FloatArray | None
    ) -> FloatArray:
        """Uncertainty (n,) by all readings, at least ``own`` (n,), with :meth:`by_shifts`."""
        sigmas, spread = self.sigmas(frame, fit), _spread(base.std, fit.steeper)
        random = sigmas * spread if self._behind is None else self._with_scales(frame, fit, base, sigmas, spread)
        beyond: FloatArray = np.maximum(random - own, 0.0)
        beyond += np.abs(fit.step) * (_STALLED if fit.stalled and fit.misfit > FITS else fit.stale)
        if by_shifts is not None:
            beyond += by_shifts
        # A reading is nearly proportional to its own cell. The rest is an error of the logarithm, hence a factor.
        uncertainty: FloatArray = own + np.expm1(np.minimum(beyond, _MOST))
        if by_shifts is not None:
            # Errors by shifts are at their bound in every frame. Behind leads R a conductance is G = D / (1 - R D).
            change = own + beyond
            by_lead = self._leads / (self._leads + fit.known.cells.ravel())
            behind_leads = change / np.maximum(1.0 - by_lead * change, 1.0 / _MOST)
            np.maximum(uncertainty, behind_leads, out=uncertainty)
        return uncertainty

    def _with_scales(self, frame: Frame, fit: Fit, base: Base, sigmas: float, spread: FloatArray) -> FloatArray:
        """Deviations (n,) of the logarithms that are covered, where readings scale whole columns.

        Args:
            frame: the readings.
            fit: the cells that have been found for them.
            base: derivatives, perhaps of other cells.
            sigmas: standard deviations of independent errors that are covered.
            spread: these deviations (n,) at the base.

        """
        change, added = self._scale_change(fit, base), self._added(frame)
        independent: FloatArray = sigmas * spread
        if change is None and added is None:
            return independent
        by_scale = np.maximum(spread**2 - (self._noise * frame.slope) ** 2, 0.0)
        more = (sigmas**2 + (0.0 if added is None else added)) * (1.0 if change is None else change**2) - sigmas**2
        covered: FloatArray = np.sqrt(independent**2 + (by_scale.reshape(frame.volts.shape) * more).ravel())
        return covered

    def _scale_change(self, fit: Fit, base: Base) -> FloatArray | None:
        """Factor (M,) by which errors scale columns more, or less, than at the base; None: hardly differently.

        The conductances of a column are s / (1 - S), with the cells' shares s of the drive and their sum S. An error of
        S counts 1 / (1 - S) = 1 + T R times, with the column's conductance T and the resistance R behind it.
        """
        if fit.stale < _CHANGED:
            return None
        then = np.exp(base.log).reshape(fit.known.cells.shape)
        now, before = (1.0 + self._behind * each.sum(axis=0) for each in (1.0 / fit.known.cells, then))
        change: FloatArray = now / before
        return change

    def _added(self, frame: Frame) -> FloatArray | None:
        """What equal roundings add to the squared ``sigmas`` (M,) of independent ones; None: nothing.

        Equal cells read the same code, and are all off by the same part of a step: n of them by n half steps at most,
        where independent errors come to a root of n. Cells that differ by half a step, or noise of as much, hardly
        let so many readings share a code.
        """
        volts = frame.volts
        rows = len(volts)
        if 3.0 * rows <= _SIGMAS**2 or frame.noise > frame.half_step:
            return None
        alike = np.count_nonzero(volts == np.sort(volts, axis=0)[rows // 2], axis=0)
        # Half a step is the root of 3 standard deviations of an error within it.
        added: FloatArray = np.maximum((3.0 * alike**2 + _SIGMAS**2 * (rows - alike)) / rows - _SIGMAS**2, 0.0)
        return added if added.any() else None

    def by_shifts(self, frame: Frame, base: Base) -> FloatArray | None:
        """Change (n,) of the logarithms by the converter's offset and gain errors, which shift all readings together.

        Returns:
            None for a converter without these errors.

        """
        if self._shifts is None:
            return None
        offset, gain, lowest = self._shifts
        by_gain: FloatArray = np.abs(base.step(gain * (frame.measured - lowest)))
        by_gain += np.abs(base.step(np.full(len(base.log), offset)))
        return by_gain


def _spread(std: FloatArray, steeper: FloatArray) -> FloatArray:
    """(n,) posterior standard deviations of the logarithms by rounding, at readings ``steeper`` (n,) than the base."""
    spread: FloatArray = std * np.maximum(steeper, 1.0)
    return spread
