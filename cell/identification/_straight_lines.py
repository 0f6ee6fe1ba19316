"""Fits of straight lines: power law of a contact (P2); branches of a recovery curve by stripping (P6, equation 9)."""

from __future__ import annotations

import numpy as np
from pydantic import ValidationError

from ...common.arrays import BoolArray, FloatArray
from ...errors import InputError
from ..materials import ContactModel
from ._fitted import Fit, Parameter
from ._folds import folds
from ._recording import Recording


def fit_contact(recording: Recording, full_scale_kpa: float, rest: float) -> Fit:
    """Fit P2: log of the contact's conductance against log of the load, over samples with a clear load."""
    load = recording.quiet.pressure_kpa / full_scale_kpa
    highest = float(np.max(recording.resistance_ohm[load < 0.05]))
    rest = max(rest, highest)
    conductance = 1 / recording.resistance_ohm - 1 / rest
    felt = (load > 0.05) & (conductance > 0)

    def line(where: BoolArray) -> tuple[FloatArray, FloatArray]:
        (n, log_g), covariance = np.polyfit(np.log(load[where]), np.log(conductance[where]), 1, cov=True)
        return np.array([n, np.exp(-log_g)]), covariance

    def left(parameters: FloatArray, where: BoolArray) -> float:
        n, full = parameters
        predicted = -np.log(1 / rest + np.maximum(load, 0) ** n / full)
        target = np.log(recording.resistance_ohm)
        return float(np.sqrt(np.mean((predicted - target)[where] ** 2)) / np.ptp(target))

    errors = []
    for fold in folds(recording, full_scale_kpa):
        before = felt & (recording.time_s < fold.start_s)
        if np.count_nonzero(before) < 10:
            raise InputError(f"{recording.name}: too little of it is pressed to read a contact's power law from")
        judged = (recording.time_s >= fold.start_s) & (recording.time_s < fold.end_s)
        errors.append(left(line(before)[0], judged))
    found, covariance = line(felt)
    try:
        model = ContactModel(exponent=float(found[0]), full_scale_resistance_ohm=float(found[1]))
    except ValidationError as error:
        raise InputError(
            f"{recording.name}: no contact cell fits: {error.errors()[0]['msg']} (exponent {found[0]:.3g})"
        ) from error
    std = np.sqrt(np.diag(covariance)) * np.array([1.0, found[1]])
    return Fit(
        model=model,
        rest_resistance_ohm=rest,
        parameters=tuple(
            Parameter(name, float(value), float(error), bool(error < 0.5 * abs(value)))
            for name, value, error in zip(("exponent", "full_scale_resistance_ohm"), found, std, strict=True)
        ),
        error=left(found, np.ones_like(felt)),
        fold_errors=tuple(errors),
    )


def recovery_branches(
    time_s: FloatArray, r: FloatArray, released_kpa: float
) -> tuple[float, float, float, float, float]:
    """E1, E2, E3 in kPa and T2, T3 in s from a recovery curve, by the paper's graphical method (P6, equation 9).

    Args:
        time_s: (n,) from the last loaded sample on; the cell is unloaded from the second sample on.
        r: (n,) normalised resistance, in equilibrium at the first sample.
        released_kpa: the pressure that was released.

    The slow branch is a straight line fitted to the late part of log r. The fast branch is a line fitted to the log of
    the remainder. The elastic branch is the instantaneous drop. Raises InputError if the curve does not decay.
    """
    t = time_s[1:] - time_s[1]
    left = r[1:]
    slow_gain, slow = _line(t, left, t >= 0.5 * t[-1])
    rest = left - slow_gain * np.exp(-t / slow)
    fast_gain, fast = _line(t, rest, (rest > 0.1 * rest[0]) & (t <= 0.5 * t[-1]))
    gains = np.array([r[0] - fast_gain - slow_gain, fast_gain, slow_gain])
    if not (gains > 0).all() or not fast < slow:
        raise InputError("the recovery curve is not an instant part and two decays, the slower one smaller")
    e1, e2, e3 = (released_kpa / gains).tolist()
    return e1, e2, e3, fast, slow


def _line(t: FloatArray, y: FloatArray, where: BoolArray) -> tuple[float, float]:
    usable = where & (y > 0)
    if np.count_nonzero(usable) < 3:
        raise InputError("the recovery curve has too few samples above zero to read a decay from")
    slope, log_gain = np.polyfit(t[usable], np.log(y[usable]), 1, w=y[usable])
    if not slope < 0:
        raise InputError("the recovery curve does not decay")
    return float(np.exp(log_gain)), float(-1 / slope)


def longest_recovery(recording: Recording, full_scale_kpa: float) -> slice | None:
    """The samples of the longest period without load after a press, beginning with the last loaded sample."""
    idle = np.abs(recording.pressure_kpa) < 0.05 * full_scale_kpa
    edges = np.flatnonzero(np.diff(idle.astype(int), prepend=0, append=0))
    runs = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a > 0 and b - a > 20]
    if not runs:
        return None
    start, stop = max(runs, key=lambda run: recording.time_s[run[1] - 1] - recording.time_s[run[0]])
    return slice(int(start) - 1, int(stop))
