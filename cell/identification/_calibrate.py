"""Calibration of a cell from a recording: identify its model, train estimators, choose one, and state their errors."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...common.arrays import FloatArray
from ...common.progress import Progress, silent
from ...errors import InputError
from .._cell import Calibrated, Cell, EstimatorName
from ..estimation import Estimator, longest_s
from ..inversions import Learned, LearnedInversion, Seen, StaticCurve
from ..materials import M10Model, PaperModel, equilibrium_gain, resistance_on_logarithm, simulate
from . import _training as training
from ._curves import CURVES, CurveName, answers, static_curve
from ._fitted import Fit, Parameter
from ._folds import Fold, folds, pressing, strokes
from ._held_out import Judged, best_share, by_fold, conformal, growth, mixed, pooled_rms, representative
from ._identify import Task, falls, find_drift, fit_contact, fits
from ._kinds import M10
from ._recording import Recording
from ._remarks import clock_shift_s, remarks

MOST_SAMPLES, ENOUGH_SAMPLES, SAMPLES_PER_STROKE = 6000, 1500, 30.0
"""largest number of samples for training; a longer recording is thinned. Of a recording that is longer than the second
number, a short stroke of the load (the lower quartile) keeps the third number of samples"""
FOLD_CELLS = 32
"""simulated cells for training before each fold; a third of the number for the final estimators"""
EXPLAINS = 0.7
"""fraction of a standard deviation that the best curve may leave of the load, or the best model of the resistance"""
PAPER_TEACHES = 0.5
"""fraction of the other kind's error, below which the paper's kind is simulated for training. It switches at every
change of direction, and learned maps follow such switches badly"""
MODEL_EXACT = 0.005
"""held-out error of a model beyond noise, over the range of r, below which its map is followed beyond what was read"""
ONE_PRESS = 1.6
"""path of the load, over full scale, from which a recording without folds shows a memory"""
RANGE_ON_LOGARITHM = 0.6
"""range of r in a recording on a logarithmic scale. Noise is taken to be proportional to (1 + r)^2, so that a smaller
range has less of it under load; relative noise is constant on this scale"""
FALLING = (
    "the resistance falls under load, and no estimator with memory is better: the cell is taken for a contact without "
    "memory, and creep and hysteresis are not made up for"
)
LOGARITHMIC = "the resistance falls under load: the model is one of r = ln(R0/R)/log_span"
NOT_KNOWN = (
    "how the estimator errs on other presses is not known, as no whole press is left to judge by: the deviation is the "
    "width of the static curve's own residual"
)


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated cell, and all data of its report."""

    cell: Cell
    recording: Recording
    fits: tuple[Fit, ...]
    """the kind of the cell first"""
    folds: tuple[Fold, ...]
    """test folds in the time of the recording; training used the part before each fold"""
    curve: CurveName
    """kind of the static curve"""
    growth: float = 1.0
    """factor by which the deviation exceeds that on the folds, see :func:`._held_out.growth`"""
    remarks: tuple[str, ...] = ()
    """limits of the recording, and suspicious properties"""

    @property
    def fit(self) -> Fit:
        """The fit of the cell's kind."""
        return self.fits[0]


def calibrate(
    recording: Recording, *, full_scale_kpa: float | None = None, progress: Progress = silent
) -> CalibrationResult:
    """Identify the cell of a recording and calibrate its estimators.

    Estimators are compared by rolling-origin cross-validation. The recording is cut into folds that each hold a whole
    press. Fits and training use the part before a fold, and the estimator with the least error on this and all later
    folds is chosen. The same errors determine the deviations. The final model and estimators are then fitted to the
    whole recording. A recording of fewer than three presses has no folds, and its report says so. Deterministic.

    Args:
        recording: presses and releases of one cell.
        full_scale_kpa: None: the largest pressure of the recording.
        progress: called after each step.

    Raises:
        InputError: the resistance does not follow the pressure, or the recording is too short.
    """
    clean = recording.without_sparks
    full = float(np.quantile(clean.pressure_kpa, 0.999)) if full_scale_kpa is None else full_scale_kpa
    if not 0 < full < np.inf:
        raise InputError(f"full scale is {full} kPa; expected more than 0")
    parts, steps = folds(_thinned(clean, full), full), itertools.count(1)

    def tell(what: str) -> None:
        progress(next(steps), len(parts) + 4, what)

    if not falls(clean):
        return _calibrated(recording, clean, parts, full, tell)
    # A cell whose resistance falls is calibrated on a logarithmic scale. If it has no memory there, it is a contact.
    light = clean.pressure_kpa <= max(0.05 * full, float(np.quantile(clean.pressure_kpa, 0.05)))
    unit = float(np.median(clean.resistance_ohm[light]))
    span = float(np.ptp(np.percentile(np.log(clean.resistance_ohm), [0.5, 99.5]))) / RANGE_ON_LOGARITHM
    scaled = replace(clean, resistance_ohm=unit * (1.0 + np.maximum(np.log(unit / clean.resistance_ohm) / span, -0.9)))
    found = _calibrated(recording, scaled, parts, full, tell)
    assert found.cell.estimators is not None
    if found.cell.estimators.default != "static":
        return _in_ohms(found, unit, span)
    return _contact(found, clean)


def _calibrated(
    recording: Recording, clean: Recording, parts: tuple[Fold, ...], full: float, tell: Callable[[str], None]
) -> CalibrationResult:
    """Calibrate a cell whose readings rise under load by ``clean``, those of ``recording`` or a scale of them."""
    task = Task.of(clean, full)
    found = tuple(fits(task, parts, tell))
    teacher = _teacher(found)
    cell = Cell(rest_resistance_ohm=found[0].rest_resistance_ohm, full_scale_kpa=full, model=found[0].model)
    thin = _thinned(clean, full)
    seen = _seen(thin, full)
    whole = _normalised(thin, cell, teacher)
    _check_follows(recording, found, whole)
    places = np.searchsorted(thin.time_s, [fold.start_s for fold in parts] + [fold.end_s for fold in parts[-1:]])
    trials = _Trials(cell, whole, places.tolist())
    for place, fold in enumerate(parts):
        trials.add_curves(place, whole.until(fold.start_s))
        trials.add_distilled(place, replace(whole, simulation=teacher.simulate_folds[place]).until(fold.start_s))
        tell("learned before a fold, and judged on it and on later ones")
    if isinstance(cell.model, PaperModel):
        trials.add_inverses(thin, found[0])
    curve = min(CURVES, key=lambda name: pooled_rms(representative(trials.curves[name]))) if parts else _best_fit(whole)
    static = static_curve(curve, whole.r, whole.load)
    simulated = training.variations(whole, np.random.default_rng(0))
    final = training.distilled(whole, simulated)
    beyond = _beyond_noise(teacher, thin) < MODEL_EXACT
    final = final.replace(beyond_recorded=beyond)
    estimators, grown = _stated(trials.judged(curve), static, final, whole, full)
    tell("learned from all")
    presses = float(pressing(thin, full)[-1]) / 2
    m10 = next(fit.model for fit in found if isinstance(fit.model, M10Model))
    times = np.array([getattr(m10, name) for name in M10.times])
    said = remarks(recording, full, presses, varied=strokes(thin, full).vary, drift=find_drift(task, times))
    tell("examined")
    notes = tuple(said) if parts else (NOT_KNOWN, *said)
    cell = cell.replace(estimators=estimators.replace(seen=seen))
    return CalibrationResult(cell, recording, found, parts, curve, grown, notes)


class _Trials:
    """Held-out errors of all estimators: after learning what comes before a fold, on this fold and on later ones."""

    def __init__(self, cell: Cell, whole: training.NormalisedRecording, places: list[int]) -> None:
        """``places``: first sample of each fold, and the end of the last."""
        self._cell, self._whole, self._places = cell, whole, places
        self.curves: dict[CurveName, list[Judged]] = {name: [] for name in CURVES}
        self.distilled: list[Judged] = []
        self.inverse: list[Judged] = []

    def _judge(self, before: int, *answer: FloatArray) -> list[Judged]:
        """Errors of an answer (n,) to the whole recording, with what it expects and what lies beyond its knowledge."""
        nothing = np.zeros_like(answer[0])
        load, (expected, beyond) = answer[0], answer[1:] or (nothing, nothing)
        found = []
        for fold in range(before, len(self._places) - 1):
            part = slice(self._places[fold], self._places[fold + 1])
            found.append(Judged(before, fold, (load - self._whole.load)[part], expected[part], beyond[part]))
        return found

    def add_curves(self, before: int, first: training.NormalisedRecording) -> None:
        """Fit each static curve to the part before a fold."""
        for name in CURVES:
            self.curves[name] += self._judge(before, answers(static_curve(name, first.r, first.load), self._whole.r))

    def add_distilled(self, before: int, first: training.NormalisedRecording) -> None:
        """Train the distilled map on the part before a fold."""
        map_ = training.distilled(first, training.variations(first, np.random.default_rng(0), FOLD_CELLS))
        curve = static_curve("cubic", first.r, first.load)
        self.distilled += self._judge(before, *_run(map_, curve, self._cell, self._whole))

    def add_inverses(self, thin: Recording, fit: Fit) -> None:
        """Run the inverse of each model that was fitted before a fold."""
        judged: list[Judged] = []
        for before, made in enumerate(fit.before_folds):
            try:
                if made is None:
                    return
                cell = self._cell.replace(model=made[0], rest_resistance_ohm=made[1])
                estimator = cell.estimator((), "inverse")
            except InputError:
                return  # not for these parameters
            pressure, _ = estimate_recording(estimator, thin.time_s, thin.resistance_ohm)
            judged += self._judge(before, pressure / cell.full_scale_kpa)
        self.inverse = judged

    def judged(self, curve: CurveName) -> dict[EstimatorName, list[Judged]]:
        """Errors of each estimator that has been judged."""
        all_: dict[EstimatorName, list[Judged]] = {
            "static": self.curves[curve],
            "distilled": self.distilled,
            "inverse": self.inverse,
        }
        return {name: judged for name, judged in all_.items() if judged}


def _run(
    map_: Learned, curve: StaticCurve, cell: Cell, whole: training.NormalisedRecording
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What a map answers to a whole recording, the error that it expects, and the deviation beyond its knowledge."""
    full_r = equilibrium_gain(cell.model, cell.full_scale_kpa, cell.rest_resistance_ohm)
    inversion = LearnedInversion(map_, curve, cell.full_scale_kpa, full_r, exact=False)
    return inversion.run(np.diff(whole.time_s, prepend=whole.time_s[0]), whole.r)


def _stated(
    judged: dict[EstimatorName, list[Judged]],
    static: StaticCurve,
    final: Learned,
    whole: training.NormalisedRecording,
    full: float,
) -> tuple[Calibrated, float]:
    """The estimators with their deviations and the choice among them; and the growth of the chosen one's errors."""
    if not judged:
        own = np.abs(answers(static, whole.r) - whole.load)
        _, floor = conformal([Judged(0, 0, own, np.zeros_like(own), np.zeros_like(own))])
        remembers = float(np.sum(np.abs(np.diff(whole.load)))) >= ONE_PRESS
        return (
            Calibrated(
                default="distilled" if remembers else "static",
                reason="it is the usual one; how it errs on other presses is not known",
                held_out_percent={},
                static=static.replace(std_kpa=floor * full),
                distilled=final.replace(std_factor=1e-9, std_floor=floor),
            ),
            1.0,
        )
    by_folds = {name: by_fold(parts) for name, parts in judged.items()}
    judged = {name: representative(parts) for name, parts in judged.items()}
    share = best_share(judged["distilled"], judged["static"])
    judged["distilled"] = mixed(judged["distilled"], judged["static"], share)
    percent = {name: 100 * pooled_rms(parts) for name, parts in judged.items()}
    default = min(percent, key=lambda name: percent[name])
    grown = {name: growth(parts) for name, parts in judged.items()}
    factor, floor = conformal(judged["distilled"])
    stated = {name: conformal(parts)[1] * grown[name] for name, parts in judged.items()}
    others = ", ".join(f"{name} {value:.1f} %" for name, value in percent.items() if name != default)
    return (
        Calibrated(
            default=default,
            reason=f"it errs by {percent[default]:.1f} % of full scale on what comes after what is learned ({others})",
            held_out_percent=percent,
            fold_percent=by_folds,
            std_kpa=full * stated.get("inverse", 0.0),
            static=static.replace(std_kpa=full * stated["static"]),
            distilled=final.replace(
                static_share=1 - share,
                std_factor=max(factor * grown["distilled"], 1e-9),
                std_floor=floor * grown["distilled"],
            ),
        ),
        grown[default],
    )


def _best_fit(whole: training.NormalisedRecording) -> CurveName:
    """The curve that fits a recording without folds best."""
    return min(CURVES, key=lambda name: _own(static_curve(name, whole.r, whole.load), whole))


def _own(curve: StaticCurve, whole: training.NormalisedRecording) -> float:
    """What a curve leaves of the recording that it was fitted to."""
    return float(np.std(answers(curve, whole.r) - whole.load))


def _check_follows(recording: Recording, found: Sequence[Fit], whole: training.NormalisedRecording) -> None:
    """InputError, naming the recording, unless a curve or a model leaves clearly less than knowing nothing.

    Either has few parameters, so that what it leaves of the whole recording tells whether there is anything to learn.
    """
    by_curve = _own(static_curve(_best_fit(whole), whole.r, whole.load), whole) / float(np.std(whole.load))
    by_model = min(fit.error for fit in found) * float(np.ptp(whole.r)) / float(np.std(whole.r))
    left = min(by_curve, by_model)
    if left < EXPLAINS:
        return
    question = "are the columns right, and is the noise smaller than what the load does?"
    if shift_s := clock_shift_s(recording):
        side = "before" if shift_s > 0 else "after"
        question = (
            f"but it changes {abs(shift_s):.2g} s {side} the pressure does, again and again: the clocks of the two are "
            f"apart. Shift the times of one by {abs(shift_s):.2g} s, or let --align do so, and fit again"
        )
    raise InputError(
        f"{recording.name}: the resistance does not follow the pressure: the best curve or model leaves "
        f"{100 * left:.0f} % of its standard deviation; {question}"
    )


def _in_ohms(found: CalibrationResult, unit_ohm: float, span: float) -> CalibrationResult:
    """The result of a recording of ``unit_ohm`` (1 + ln(unit_ohm/R)/span) instead of R, for R."""

    def ohms(scaled: float) -> float:
        return float(resistance_on_logarithm(np.array(scaled / unit_ohm - 1.0), unit_ohm, span))

    def told(parameter: Parameter) -> Parameter:
        if parameter.name != "rest_resistance_ohm":
            return parameter
        rest = ohms(parameter.value)
        return replace(parameter, value=rest, std_error=rest * span * parameter.std_error / unit_ohm)

    scaled = found.cell.rest_resistance_ohm
    cell = found.cell.replace(rest_resistance_ohm=ohms(scaled), log_span=span * scaled / unit_ohm)
    kinds = tuple(
        replace(fit, rest_resistance_ohm=ohms(fit.rest_resistance_ohm), parameters=tuple(map(told, fit.parameters)))
        for fit in found.fits
    )
    return replace(found, cell=cell, fits=kinds, remarks=(LOGARITHMIC, *found.remarks))


def _contact(found: CalibrationResult, clean: Recording) -> CalibrationResult:
    """The result for a cell without memory on a logarithmic scale: a contact, read by the same curve of log(R0/R)."""
    full, learned = found.cell.full_scale_kpa, found.cell.estimators
    assert learned is not None
    fit = fit_contact(clean, full)
    rest = fit.rest_resistance_ohm
    kind: CurveName = "monotone" if found.curve == "monotone" else "cubic"
    curve = static_curve(kind, clean.resistance_ohm / rest - 1, clean.pressure_kpa / full, logarithmic=True)
    kept = {
        "held_out_percent": {name: value for name, value in learned.held_out_percent.items() if name == "static"},
        "fold_percent": {name: value for name, value in learned.fold_percent.items() if name == "static"},
    }
    estimators = learned.replace(distilled=None, static=curve.replace(std_kpa=learned.static.std_kpa), **kept)
    cell = Cell(rest_resistance_ohm=rest, full_scale_kpa=full, model=fit.model, estimators=estimators)
    return replace(found, cell=cell, fits=(fit, *found.fits), remarks=(FALLING, *found.remarks))


def estimate_recording(
    estimator: Estimator, time_s: FloatArray, resistance_ohm: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Pressure (n,) of one cell over a whole recording, and its standard deviation (n,), in kPa.

    Args:
        estimator: made for the shape ().
        time_s: (n,) increasing.
        resistance_ohm: (n,); NaN where there is no reading.

    Returns:
        Pressure, and its standard deviation or None if the estimator states none.
    """
    pressure, std = estimator.run(np.diff(time_s, prepend=time_s[0]), resistance_ohm)
    return pressure, std if estimator.states_std else None


def _teacher(found: Sequence[Fit]) -> Fit:
    """The fit that is simulated for training."""
    paper, other = sorted(found, key=lambda fit: not isinstance(fit.model, PaperModel))
    return paper if paper.judged_error < PAPER_TEACHES * other.judged_error else other


def _thinned(recording: Recording, full_scale_kpa: float) -> Recording:
    """The recording, thinned to at most :data:`MOST_SAMPLES` samples, and to fewer where the load is slow."""
    samples, found = len(recording.time_s), strokes(recording, full_scale_kpa)
    slow = found.short_s / (SAMPLES_PER_STROKE * recording.step_s)
    every = max(-(-samples // MOST_SAMPLES), min(int(slow), samples // ENOUGH_SAMPLES), 1)
    time_s, pressure, resistance = recording.time_s, recording.pressure_kpa, recording.resistance_ohm
    return replace(
        recording, time_s=time_s[::every], pressure_kpa=pressure[::every], resistance_ohm=resistance[::every]
    )


def _normalised(recording: Recording, cell: Cell, teacher: Fit) -> training.NormalisedRecording:
    """Training data: the recording in normalised units, and a simulation of cells like those of the fit ``teacher``."""
    rest = cell.rest_resistance_ohm
    assert teacher.simulate is not None
    return training.NormalisedRecording(
        time_s=recording.time_s,
        r=recording.resistance_ohm / rest - 1,
        load=recording.pressure_kpa / cell.full_scale_kpa,
        rest_resistance_ohm=rest,
        simulation=teacher.simulate,
        unexplained=teacher.error * float(np.ptp(recording.resistance_ohm)) / rest,
    )


def _beyond_noise(fit: Fit, recording: Recording) -> float:
    """Error of a fit beyond the noise of the readings, both over the range of the resistance."""
    noise = simulate.white_noise(recording.resistance_ohm) / float(np.ptp(recording.resistance_ohm))
    return float(np.sqrt(max(fit.judged_error**2 - noise**2, 0.0)))


def _seen(recording: Recording, full_scale_kpa: float) -> Seen:
    loads = recording.quiet.loads
    time, load = loads.time_s, loads.pressure_kpa
    later = np.interp(time + 1.0, time, load)
    log_ohm = np.log(recording.resistance_ohm)
    return Seen(
        noise=simulate.white_noise(log_ohm) or simulate.step_noise(log_ohm),
        step_s=recording.step_s,
        speed_kpa_per_s=float(np.sqrt(np.mean((later - load) ** 2))),
        longest_load_s=longest_s(time, load / full_scale_kpa),
    )
