"""Estimators without memory: the equilibrium curve of a model, or the calibrated curve."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Record, Records
from .._state import CellState
from ..estimation import UNKNOWN, USUAL, Inversion
from ..materials import AsymmetricModel, ContactModel, M10Model, Model, PaperModel, equilibrium_curve, equilibrium_gain
from ._learned import BEYOND, STEEPER, StaticCurve, credible_range

POINTS, REACH = 1025, 3
"""points of the tabulated equilibrium curve from rest to full scale; and the end of the table over full scale, since an
overload must not read as full scale"""
SLOPES, FLAT = 33, 3.0
"""points at which the effect of an error of R0 is tabulated; and the largest effect over its mean"""
CONTACT_SHARE = 0.02
"""standard deviation over the pressure, for the estimate of a contact"""
STEEPEST = 20.0
"""largest slope of the inverse of a curve, over its mean slope; a contact's would be infinite at rest"""


class Chains(Record):
    """Memory of :class:`EquilibriumInversion`."""

    chains: float
    """r of the chains that must have broken"""


def rest_slope(
    equilibrium_ohm: Callable[[FloatArray], FloatArray], full_scale_kpa: float, *, parallel: bool = False
) -> FloatArray:
    """(:data:`SLOPES`,) pressure in kPa that a relative error of R0 looks like, per unit of that error.

    This is the slope dp/d(ln R) of the equilibrium curve, at evenly spaced pressures from 0 to full scale. It is
    limited where the curve is flat, since no estimator follows it there. ``equilibrium_ohm`` gives the resistance under
    normalised loads (n,). ``parallel``: the load adds a conductance to 1/R0, instead of changing R0 by a factor.
    """
    load = np.linspace(0, 1, SLOPES)
    log_r = np.log(equilibrium_ohm(load))
    mean = max(abs(float(log_r[-1] - log_r[0])), 1e-9)
    slope = np.maximum(np.abs(np.gradient(log_r, load)), mean / FLAT)
    share = np.exp(log_r - log_r[0]) if parallel else 1.0
    return np.asarray(full_scale_kpa / slope * share)


def memory_share(model: Model) -> float:
    """Standard deviation over the pressure, for an estimate that ignores the memory of the model.

    It is half of the range of r at the same pressure.
    """
    match model:
        case PaperModel():
            return 0.5 * (model.overshoot - 1 / (model.e1_kpa * model.gain_per_kpa))
        case AsymmetricModel():
            return 0.5 * (1 - 1 / (model.e1_kpa * model.gain_per_kpa))
        case M10Model():
            remembered = model.alpha1 + model.alpha2 + 2 * model.k
            return min(0.5 * remembered / max(model.a + model.b + model.alpha1 + model.alpha2, 1e-9), 2.0)
        case ContactModel():
            return CONTACT_SHARE


class EquilibriumInversion(Inversion):
    """The equilibrium of the model inverted, without memory: what a calibration curve gives.

    Motion breaks chains of an `m10` cell, which raises r. If a reading exceeds the largest r of the usual load, the
    excess must be broken chains, which heal with their own time constant. This excess is subtracted from later
    readings. Otherwise a cell that was tapped would show an overload for minutes.

    All cells share one curve of r. A contact's r is that of :class:`..estimation.Contact`.
    """

    def __init__(
        self,
        model: Model,
        full_scale_kpa: float,
        rest_resistance_ohm: float,
        *,
        exact: bool,
    ) -> None:
        """``rest_resistance_ohm`` is R0, or the resistance of a contact that the scale of its readings begins at."""
        self.model, self._share = model, memory_share(model)
        self.remembers = not isinstance(model, ContactModel)
        rest = rest_resistance_ohm
        full_r = equilibrium_gain(model, full_scale_kpa, rest)
        load = np.linspace(0, REACH, REACH * (POINTS - 1) + 1)
        curve = equilibrium_curve(model, full_scale_kpa, rest, load)
        # A contact's r falls with the load: its table is one of -r, which rises.
        self._sign = -1.0 if isinstance(model, ContactModel) else 1.0
        curve = np.maximum.accumulate(self._sign * curve)
        rises = np.concatenate(([True], np.diff(curve) > 0))
        self._curve, self._load = curve[rises], load[rises]
        slope = np.gradient(self._load, self._curve) if self._curve.size > 1 else np.zeros_like(self._curve)
        steepest = np.full(slope.size, STEEPEST / max(abs(full_r), 1e-12))
        if isinstance(model, ContactModel):
            # A contact's slope diverges only near rest, and is limited there; under load it is the true noise gain.
            steepest[np.argmin(np.abs(slope)) :] = np.inf
        self._slope = np.minimum(np.abs(slope), steepest)
        self._breaks = isinstance(model, M10Model) and model.k > 0
        """whether motion breaks chains"""
        self.memory = Chains if self._breaks else Record
        if isinstance(model, M10Model) and self._breaks:
            self._heals_s = model.tau_s
            statics = model.a * load + model.b * load**2
            self._most_r = float(statics[load <= USUAL].max()) + (model.alpha1 + model.alpha2) * USUAL
            """r of the largest credible load without broken chains: no branch exceeds its target"""
        super().__init__(full_scale_kpa, full_r, exact=exact)
        self.usual_level = float(np.interp(USUAL, self._load, self._curve)) / max(abs(full_r), 1e-12)

    def begin(self, cells: Records[CellState], memory: Records[Chains], places: IntArray, r: FloatArray) -> None:
        if self._breaks:
            memory["chains"][places] = 0.0
        self._take(cells, memory, places, r)

    def _take(self, cells: Records[CellState], memory: Records[Chains], places: IntArray, r: FloatArray) -> None:
        """Take readings ``r`` (k,) of ``places`` (k,)."""
        if self._breaks:
            memory["chains"][places] = chains = np.maximum(memory["chains"][places], r - self._most_r)
            r = r - chains
        pressure = np.interp(self._sign * r, self._curve, self._load) * self.full_scale_kpa
        variance = (self._share * pressure) ** 2
        if self._breaks:  # no more than the usual load is believed where chains may be broken
            variance = np.minimum(variance, (UNKNOWN * self.full_scale_kpa) ** 2)
        cells["pressure_kpa"][places], cells["variance_kpa2"][places] = pressure, variance
        cells["gain_kpa"][places] = np.interp(self._sign * r, self._curve, self._slope) * self.full_scale_kpa

    def advance(self, cells: Records[CellState], memory: Records[Chains], awake: IntArray, dt_s: float) -> None:
        self.hold(cells, memory, awake, np.asarray(dt_s))
        self._take(cells, memory, awake, cells["level"][awake])

    def hold(self, cells: Records[CellState], memory: Records[Chains], places: IntArray, dt_s: FloatArray) -> None:
        if self._breaks:
            memory["chains"][places] *= np.exp(-dt_s / self._heals_s)

    def settled(self, cells: Records[CellState], memory: Records[Chains], places: IntArray, band: float) -> BoolArray:
        return memory["chains"][places] < band if self._breaks else super().settled(cells, memory, places, band)


class StaticCurveInversion(Inversion):
    """The calibrated curve, without memory."""

    def __init__(self, curve: StaticCurve, full_scale_kpa: float, full_scale_r: float, *, exact: bool) -> None:
        self.curve = curve
        self.remembers = not curve.logarithmic  # the curve of a contact is logarithmic
        # A contact may be open at rest.
        credible = (-1.0, np.inf) if curve.logarithmic else credible_range(*curve.range)
        super().__init__(full_scale_kpa, full_scale_r, credible=credible, exact=exact)

    def begin(self, cells: Records[CellState], memory: Records[Record], places: IntArray, r: FloatArray) -> None:
        curve, small, full = self.curve, 1e-3 * self.full_scale_r, self.full_scale_kpa
        load, beyond = curve.load(r), curve.load(r + small)
        over = STEEPER * np.maximum(load - curve.limits.highest / BEYOND, 0.0)
        variance = curve.std_kpa**2 + (curve.doubt(r) * full) ** 2 + (over * full) ** 2
        cells["pressure_kpa"][places] = np.clip(load, curve.limits.lowest, curve.limits.highest) * full
        cells["gain_kpa"][places], cells["variance_kpa2"][places] = np.abs(beyond - load) / small * full, variance

    def advance(self, cells: Records[CellState], memory: Records[Record], awake: IntArray, dt_s: float) -> None:
        self.begin(cells, memory, awake, cells["level"][awake])
