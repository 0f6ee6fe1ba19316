"""Power-law fit of a contact resistance to a recording (P2): linear regression in logarithms."""

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
