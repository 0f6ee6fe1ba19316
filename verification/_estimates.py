"""What estimators make of a reading: the paper's and ours, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..cell import Cell, estimate_recording
from ..common import plots
from ..common.arrays import FloatArray
from ._outcome import Table
from ._subject import Subject

STEP_KPA = 15.5  # 10.0 N on one square inch (V.A)
RATE_HZ = 50.0
EDGE_S = 0.1  # time in which a press is applied and released
SETTLED_S = 1e-6  # time before the first sample in which the first pressure is applied


def pressed(presses: list[tuple[float, float, float]], duration_s: float) -> tuple[FloatArray, FloatArray]:
    """Presses (start s, kPa, length s) as samples at RATE_HZ."""
    time_s = np.arange(0.0, duration_s, 1 / RATE_HZ)
    pressure = np.zeros_like(time_s)
    for start, kpa, length in presses:
        corners = [start, start + EDGE_S, start + length, start + length + EDGE_S]
        pressure += np.interp(time_s, corners, [0.0, kpa, kpa, 0.0])
    return time_s, pressure


def respond(cell: Cell, time_s: FloatArray, pressure: FloatArray, rest: FloatArray | None = None) -> FloatArray:
    """Resistance (samples,) of one cell, or (samples, cells) of several with their own R0."""
    shape = (1,) if rest is None else rest.shape
    forward = cell.forward(shape, rest_resistance_ohm=rest)
    loads = np.broadcast_to(pressure[:, None], (len(pressure), *shape))
    ohms = forward.run(np.diff(time_s, prepend=time_s[0] - SETTLED_S), loads)
    return ohms[:, 0] if rest is None else ohms


def side_by_side(
    subject: Subject, time_s: FloatArray, ohms: FloatArray, rest: float | None = None
) -> dict[str, FloatArray]:
    """kPa (samples,) by label, from a reading of the subject's cell; ``rest`` replaces R0.

    Several experiments look at the same press. The estimates of a reading are therefore kept with the subject.
    """
    reading = ("side by side", time_s.tobytes(), ohms.tobytes(), rest)
    if reading not in subject.memo:
        subject.memo[reading] = _side_by_side(subject, time_s, ohms, rest)
    return dict(subject.memo[reading])


def _side_by_side(subject: Subject, time_s: FloatArray, ohms: FloatArray, rest: float | None) -> dict[str, FloatArray]:
    return {
        "the paper's": estimate(subject.cell, "paper", time_s, ohms, rest),
        f"ours ({subject.ours})": estimate(subject.calibrated, subject.ours, time_s, ohms, rest),
    }


def estimate(cell: Cell, name: str, time_s: FloatArray, ohms: FloatArray, rest: float | None = None) -> FloatArray:
    """kPa (samples,) of one cell."""
    return estimate_recording(cell.estimator((), name, rest_resistance_ohm=rest), time_s, ohms)[0]


def rmse(estimate: FloatArray, truth: FloatArray, subject: Subject) -> float:
    """% of full scale."""
    return float(100 * np.sqrt(np.mean((estimate - truth) ** 2)) / subject.full_scale_kpa)


def errors(cases: Mapping[str, tuple[FloatArray, Mapping[str, FloatArray]]], subject: Subject, what: str) -> Table:
    """RMSE of the estimates of several loads: name -> (kPa applied, kPa by estimator)."""
    labels = list(dict.fromkeys(label for _, estimates in cases.values() for label in estimates))
    return Table(
        [what, *labels],
        [
            [case, *(f"{rmse(found[label], load, subject):.2f} %" if label in found else "-" for label in labels)]
            for case, (load, found) in cases.items()
        ],
        "RMSE of the pressure, in % of full scale, of the paper's estimator and of ours.",
    )


def draw(panel: Any, time_s: FloatArray, pressure: FloatArray, estimates: Mapping[str, FloatArray]) -> None:
    """Applied and estimated pressure into one panel."""
    panel.plot(time_s, pressure, color=plots.INK, lw=4, alpha=0.25, label="applied")
    for label, values in estimates.items():
        panel.plot(time_s, values, lw=1.2, label=label)
    panel.set(xlabel="time / s", ylabel="pressure / kPa")
    panel.legend()
