"""Report of a calibration: text, a dictionary for programs, and a figure of model, estimate and residuals."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...common import plots
from ...common.files import whole_file
from .._cell import Cell
from ._calibrate import CalibrationResult, estimate_recording

KPA_PER_PSI, KPA_PER_BAR = 6.894757, 100.0


def calibration_text(calibration: CalibrationResult) -> str:
    """The report as text: kind, parameters with standard errors, folds, estimators."""
    cell, fit = calibration.cell, calibration.fit
    estimators = cell.estimators
    assert estimators is not None
    lines = [
        f"cell of kind {cell.model.kind}{_scale(cell)}, R0 = {cell.rest_resistance_ohm:.6g} ohm, "
        f"full scale {_in_units(cell.full_scale_kpa)}",
        "error of r, % of its range, on what was fitted / on each fold after fitting what comes before it:",
        *(
            f"  {other.model.kind:<11} {100 * other.error:5.2f} / {_percents(other.fold_errors, 100) or 'no folds'}"
            + ("  <- chosen" if other is fit else "")
            for other in calibration.fits
        ),
        "parameters (gains: r at full scale):",
    ]
    lines += [
        f"  {p.name:<26} {p.value:10.4g} +- {p.std_error:.2g}" + ("" if p.identified else "   not identified")
        for p in fit.parameters
    ]
    if any(p.name == "rest_resistance_ohm" and not p.identified for p in fit.parameters):
        lines.append(
            "R0 is what the model needs, not what the material has: the recording does not show the cell at rest"
        )
    slow = [p.name for p in fit.parameters if p.name.endswith("_s") and not p.identified]
    if slow:
        lines.append(f"time constants this recording cannot tell: {', '.join(slow)}")
    begun = float(calibration.recording.time_s[0])
    spans = ", ".join(
        f"{n} from {fold.start_s - begun:.4g} to {fold.end_s - begun:.4g} s"
        for n, fold in enumerate(calibration.folds, 1)
    )
    lines.append(f"folds, since the beginning: {spans or 'none'}; static curve: {calibration.curve}")
    if spans:
        lines.append(
            "error on each fold after learning what comes before it, % of full scale / pooled with later folds:"
        )
    lines += [
        f"  {name:<11} {_percents(values)} / {estimators.held_out_percent[name]:5.1f}"
        for name, values in estimators.fold_percent.items()
    ]
    lines.append(f"estimator: {estimators.default}, because {estimators.reason}")
    if calibration.growth > 1.0:
        lines.append(
            f"errors grow with the time since calibration: by {100 * (calibration.growth - 1):.0f} % within a time as "
            "long as the recording, which the deviation includes"
        )
    lines += [f"note: {remark}" for remark in calibration.remarks]
    return "\n".join(lines)


def _scale(cell: Cell) -> str:
    return "" if cell.log_span is None else f" on a logarithmic scale (log_span {cell.log_span:.4g})"


def _in_units(pressure_kpa: float) -> str:
    """A pressure in kPa, psi and bar, so that the person who made the recording notices a wrong unit."""
    psi, bar = pressure_kpa / KPA_PER_PSI, pressure_kpa / KPA_PER_BAR
    return f"{pressure_kpa:.4g} kPa ({psi:.3g} psi, {bar:.3g} bar)"


def _percents(values: tuple[float, ...], unit: float = 1.0) -> str:
    return " ".join(f"{unit * value:5.1f}" for value in values)


def calibration_record(calibration: CalibrationResult) -> dict[str, Any]:
    """The content of :func:`calibration_text` for programs: only numbers, texts, lists and None.

    Errors of fits are fractions of the range of the resistance; errors of estimators are % of full scale. The standard
    error of a parameter that is not identified may be infinite.
    """
    cell = calibration.cell
    assert cell.estimators is not None
    return {
        "kind": cell.model.kind,
        "rest_resistance_ohm": cell.rest_resistance_ohm,
        "log_span": cell.log_span,
        "full_scale_kpa": cell.full_scale_kpa,
        "fits": [
            {
                "kind": fit.model.kind,
                "error": fit.error,
                "judged_error": fit.judged_error,
                "folds": list(fit.fold_errors),
            }
            for fit in calibration.fits
        ],
        "parameters": [asdict(parameter) for parameter in calibration.fit.parameters],
        "curve": calibration.curve,
        "growth": calibration.growth,
        "folds_s": [[fold.start_s, fold.end_s] for fold in calibration.folds],
        "remarks": list(calibration.remarks),
        "estimator": cell.estimators.default,
        "reason": cell.estimators.reason,
        "held_out_percent": dict(cell.estimators.held_out_percent),
        "fold_percent": {name: list(values) for name, values in cell.estimators.fold_percent.items()},
    }


def calibration_figure(calibration: CalibrationResult, path: str | Path) -> None:
    """Write a PNG: the recording with the fitted model, the residuals of the model, and the estimate.

    Raises:
        MissingExtra: matplotlib is not installed.
        InputError: the file cannot be written.
    """
    cell, recording = calibration.cell, calibration.recording
    time, resistance = recording.time_s, recording.resistance_ohm
    forward = cell.forward(())
    steps = np.diff(time, prepend=time[0])
    model = np.array([float(forward.step(dt, p)) for dt, p in zip(steps, recording.pressure_kpa, strict=True)])
    pressure, _ = estimate_recording(cell.estimator(()), time, resistance)

    with plots.drawing(3, 1, width=9, height=7, sharex=True) as (drawing, axes):
        top, middle, bottom = axes[:, 0]
        top.plot(time, resistance, label="measured")
        top.plot(time, model, label=f"model ({cell.model.kind})")
        top.set_ylabel("resistance, ohm")
        top.legend()
        middle.plot(time, resistance - model)
        middle.axhline(0, color="0.7")
        middle.set_ylabel("residual, ohm")
        bottom.plot(time, recording.pressure_kpa, label="applied")
        bottom.plot(time, pressure, label=f"estimate ({cell.default_estimator})")
        bottom.set_ylabel("pressure, kPa")
        bottom.set_xlabel("time, s")
        bottom.legend()
        with whole_file(path) as file:
            drawing.savefig(file, format="png", dpi=120, facecolor="white")
