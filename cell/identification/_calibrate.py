"""Calibration of a cell from a recording: identify its model, train estimators, choose one, and state their errors."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...common.arrays import FloatArray
from ...common.progress import Progress, silent
from ...errors import InputError
from .._cell import Calibrated, Cell, EstimatorName
from ..estimation import Estimator, longest_s
from ..inversions import DRIFT, Seen
from ..materials import AsymmetricModel, M10Model, Model, resistance_on_logarithm, simulate
from . import _choice as choice
from . import _training as training
from ._fitted import Fit, Parameter, no_simulation
from ._fold_errors import FoldErrors, Regimes, best_share, mixed
from ._folds import Fold, folds, strokes
from ._identify import contact_fit, falls, fits
from ._recording import Recording
from ._remarks import remarks

MOST_SAMPLES, ENOUGH_SAMPLES, SAMPLES_PER_STROKE = 6000, 1500, 30.0
"""largest number of samples for training; a longer recording is thinned. Of a recording that is longer than the second
number, a short stroke of the load (the lower quartile) keeps the third number of samples"""
FOLD_CELLS = 32
"""simulated cells for training before each fold; a third of the number for the final estimators"""
SIMPLER_TEACHES = 0.7
"""fraction of the richer kind's held-out error; a simpler kind with less error is simulated for training instead"""
MOST_DRIFT_MISSED = 3.0
"""largest drift after the recording that an inverse may miss, over its held-out error"""
BREAKING_EXPLAINS = 0.5
"""a cell is believed to have chains that break if m10 with them has less than this fraction of the error without"""
MEMORY_EXPLAINS = 0.8
"""fraction of the static curve's error on its worst fold, below which a cell whose resistance falls has a memory"""
NEARLY_UNLOADED = 0.05
"""share of full scale, and of the samples, under which a cell counts as about at rest"""
KINDS = 3
"""progress steps of the fit"""


FALLING = (
    "the resistance falls under load, and no model with memory on a logarithmic scale is surely better: the cell is "
    "taken for a contact without memory, and creep and hysteresis are not made up for"
)
LOGARITHMIC = "the resistance falls under load: the model is one of r = ln(R0/R)/log_span"
RANGE_ON_LOGARITHM = 0.6
"""range of r in a recording on a logarithmic scale. Noise is taken to be proportional to (1 + r)^2, so that a smaller
range has less of it under load; relative noise is constant on this scale"""


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated cell, and all data of its report."""

    cell: Cell
    recording: Recording
    fits: tuple[Fit, ...]
    """the chosen kind first"""
    folds: tuple[Fold, ...]
    """test folds in the time of the recording; training used the part before each fold"""
    inverse_margin: float | None
    """least slope of a fast step over that at equilibrium: the exact inverse is safe if positive; None: no inverse"""
    remarks: tuple[str, ...] = ()
    """limits of the recording, and suspicious properties"""

    @property
    def fit(self) -> Fit:
        """The fit of the chosen kind."""
        return self.fits[0]


def calibrate(
    recording: Recording, *, full_scale_kpa: float | None = None, progress: Progress = silent
) -> CalibrationResult:
    """Identify the cell of a recording and calibrate its estimators.

    Kinds of models and estimators are compared by rolling-origin cross-validation. The recording is cut into folds that
    each hold a whole press. Fits and training use the part before a fold, and the worst fold counts. The final model
    and estimators are then fitted to the whole recording. A recording of fewer than three presses has no folds: an
    information criterion then decides between the kinds, and simulated cells between the estimators. Deterministic.

    Args:
        recording: presses and releases of one cell.
        full_scale_kpa: None: the largest pressure of the recording.
        progress: called after each step.

    Raises:
        InputError: the resistance does not follow the pressure, or no model of any kind fits.
    """
    clean = recording.without_sparks
    full = float(np.quantile(clean.pressure_kpa, 0.999)) if full_scale_kpa is None else full_scale_kpa
    if not 0 < full < np.inf:
        raise InputError(f"full scale is {full} kPa; expected more than 0")
    thin = _thinned(clean, full)
    parts, steps = folds(thin, full), itertools.count(1)

    def tell(what: str) -> None:
        progress(next(steps), KINDS + len(parts) + 1, what)

    if falls(thin, full):
        return _calibrated_falling(recording, thin, parts, full, tell)
    return _calibrated(recording, thin, parts, full, tell)


def _calibrated_falling(
    recording: Recording, thin: Recording, parts: tuple[Fold, ...], full: float, tell: Callable[[str], None]
) -> CalibrationResult:
    """Calibrate a cell whose resistance falls under load: with memory on a logarithmic scale, if that is surely better.

    Otherwise it is a contact.
    """
    contact = contact_fit(thin, full)
    simple = _calibrated_contact(
        Cell(rest_resistance_ohm=contact.rest_resistance_ohm, full_scale_kpa=full, model=contact.model), thin
    )
    light = thin.pressure_kpa <= max(NEARLY_UNLOADED * full, float(np.quantile(thin.pressure_kpa, NEARLY_UNLOADED)))
    unit = float(np.median(thin.resistance_ohm[light]))
    span = float(np.ptp(np.percentile(np.log(thin.resistance_ohm), [0.5, 99.5]))) / RANGE_ON_LOGARITHM
    scaled = replace(thin, resistance_ohm=unit * (1.0 + np.maximum(np.log(unit / thin.resistance_ohm) / span, -0.9)))
    try:
        found = _calibrated(recording, scaled, parts, full, tell)
    except InputError:
        found = None  # no model fits
    if found is not None:
        learned, plain = found.cell.estimators, simple.estimators
        assert learned is not None
        assert plain is not None
        least = MEMORY_EXPLAINS * plain.held_out_percent["static"]
        if learned.default != "static" and learned.held_out_percent[learned.default] < least:
            return _in_ohms(found, unit, span)
    presses = float(Regimes.of(thin, full).pressing[-1]) / 2
    said = (FALLING, *remarks(recording, full, presses, varied=True))
    return CalibrationResult(simple, recording, (contact,), parts, None, said)


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


def _calibrated(
    recording: Recording, thin: Recording, parts: tuple[Fold, ...], full: float, tell: Callable[[str], None]
) -> CalibrationResult:
    """Calibrate a cell whose readings rise under load by ``thin``, the readings of ``recording`` or a scale of them."""
    found = tuple(fits(thin, full, tell))
    model, rest = found[0].model, found[0].rest_resistance_ohm
    cell = Cell(rest_resistance_ohm=rest, full_scale_kpa=full, model=model)
    samples, seen = Regimes.of(thin, full), _seen(thin, full)
    presses = float(samples.pressing[-1]) / 2
    inverse = None
    teacher, breaks = _teacher(found), _breaks(found)
    whole = _normalised(thin, cell, teacher)
    judged: dict[EstimatorName, list[FoldErrors]] = {}
    for fold, simulation in zip(parts, teacher.simulate_folds, strict=True):
        first = replace(whole, simulation=simulation).until(fold.start_s)
        trial = cell.replace(estimators=_learned(first, full, cells=FOLD_CELLS, breaks=breaks).replace(seen=seen))
        for name in LEARNED:
            judged.setdefault(name, []).append(_judge(trial, name, thin, samples, fold))
        tell("learned before a fold, and judged on it")
    noise = seen.noise * float(np.mean(thin.resistance_ohm) / np.ptp(thin.resistance_ohm))
    final = _learned(whole, full, cells=training.CELLS, breaks=breaks).replace(seen=seen)
    if parts:
        judged |= _judge_models(cell.replace(estimators=None), found[0].before_folds, thin, samples, parts)
    else:
        judged = _judge_on_all(cell.replace(estimators=final), thin, samples)
    final = _mixed(final, judged, beyond_recorded=_beyond_noise(teacher, noise) < choice.MODEL_EXACT)
    tried = (*LEARNED, *(name for name in judged if name == "inverse"))
    simulated_error = choice.errors_on_simulated_cells(cell.replace(estimators=final), found, tried, whole)
    tell("learned from all")
    evidence = choice.Evidence(
        judged=judged,
        simulated_error=simulated_error,
        presses=presses,
        strokes=strokes(thin, full),
        unexplained=_beyond_noise(found[0], noise),
        held_out=bool(parts),
        least_slope=1.0 if inverse is None else inverse,
    )
    cell = cell.replace(estimators=_with_errors(final, evidence, whole, full))
    drift = next(fit.drift for fit in found if fit.drift is not None)
    said = tuple(remarks(recording, full, presses, varied=evidence.varied, drift=drift))
    return CalibrationResult(cell, recording, found, parts, inverse, said)


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
    pressure, std = np.empty((2, len(time_s)))
    for n, elapsed in enumerate(np.diff(time_s, prepend=time_s[0])):
        pressure[n] = estimator.step(float(elapsed), resistance_ohm[n])
        std[n] = estimator.std_kpa
    return pressure, std if estimator.states_std else None


def _teacher(found: tuple[Fit, ...]) -> Fit:
    """The fit that is simulated for training: the richest kind with one set of states, unless it is clearly worse.

    On a short recording, the errors of two kinds are often close. Training on a kind that is too simple then does more
    harm than the superfluous parameters of a richer kind. But a kind with a much larger error on its worst fold would
    teach its own errors. The paper's model switches at every change of direction, and learned maps follow such switches
    badly; it is used only if it is far better.
    """
    smooth = next(fit for fit in found if isinstance(fit.model, M10Model))
    plain = next(fit for fit in found if isinstance(fit.model, AsymmetricModel))
    if plain.judged_error < SIMPLER_TEACHES * smooth.judged_error:
        smooth = plain
    best = min(found, key=lambda fit: fit.judged_error)
    return best if best.judged_error < 0.5 * smooth.judged_error else smooth


def _breaks(found: tuple[Fit, ...]) -> bool:
    """Whether motion breaks conductive chains, that is, whether m10 fits far worse without them."""
    errors = {fit.label: fit.error for fit in found}  # an m10 fitted with k = 0 has the label of "whole"
    return errors.get("m10", np.inf) < BREAKING_EXPLAINS * errors.get("m10, k = 0", 0.0)


def _learned(
    calibration: training.NormalisedRecording, full_scale_kpa: float, *, cells: int, breaks: bool
) -> Calibrated:
    """All learned estimators, without error statistics; ``breaks``: conductive chains of the cell break by motion."""
    simulated = training.variations(calibration, np.random.default_rng(0), cells)
    return Calibrated(
        default="distilled",
        reason="",
        held_out_percent={},
        static=training.static_curve(calibration, full_scale_kpa),
        play=training.play(calibration, simulated),
        distilled=training.distilled(calibration, simulated, paths_s=training.PATHS_S if breaks else ()),
    )


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
    return training.NormalisedRecording(
        time_s=recording.time_s,
        r=recording.resistance_ohm / rest - 1,
        load=recording.pressure_kpa / cell.full_scale_kpa,
        rest_resistance_ohm=rest,
        simulation=teacher.simulate,
        unexplained=teacher.error * float(np.ptp(recording.resistance_ohm)) / rest,
    )


def _beyond_noise(fit: Fit, noise: float) -> float:
    """Error of a fit beyond the noise of the readings, both over the range of the resistance."""
    return float(np.sqrt(max(fit.judged_error**2 - noise**2, 0.0)))


def _mixed(learned: Calibrated, judged: dict[EstimatorName, list[FoldErrors]], *, beyond_recorded: bool) -> Calibrated:
    """Mix learned maps with the static curve by weights from the folds (stacking); changes ``judged`` accordingly."""
    for name in ("play", "distilled"):
        share = best_share(judged[name], judged["static"])
        judged[name] = mixed(judged[name], judged["static"], share)
        one = getattr(learned, name).replace(static_share=1 - share, beyond_recorded=beyond_recorded)
        learned = learned.replace(**{name: one})
    return learned


def _with_errors(
    final: Calibrated, evidence: choice.Evidence, whole: training.NormalisedRecording, full_scale_kpa: float
) -> Calibrated:
    """Choose the default estimator, and set the error statistics of all estimators."""
    judged = evidence.judged
    default, reason = choice.choose(evidence)
    pressed = {name: 100 * max(part.pressed_rms for part in of) for name, of in judged.items()}
    pressed_drift = max(abs(float(np.mean(part.pressed))) for part in judged["static"])
    calibrated = {
        name: training.with_calibrated_std(
            getattr(final, name),
            judged[name],
            drift=pressed_drift,
            simulated_error=0.0 if evidence.varied else evidence.simulated_error[name],
            most=pressed["static"] / 100,
        )
        for name in ("play", "distilled")
    }
    other_loads = training.error_on_other_loads(whole, final.static)
    static_std = full_scale_kpa * max(DRIFT * pressed["static"] / 100, other_loads)
    return Calibrated(
        default=default,
        reason=reason,
        held_out_percent={name: evidence.expected_percent(name) for name in judged},
        fold_percent={name: tuple(evidence.percent(name)) for name in judged},
        pressed_percent=pressed,
        # An inverse follows the drift that its model explains; its errors on the folds show how well.
        drift_percent=min(100 * pressed_drift, MOST_DRIFT_MISSED * pressed.get("inverse", np.inf)),
        seen=final.seen,
        static=final.static.replace(std_kpa=max(final.static.std_kpa, static_std)),
        **calibrated,
    )


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


LEARNED: tuple[EstimatorName, ...] = ("static", "play", "distilled")
FROM_MODEL: tuple[EstimatorName, ...] = ("paper", "inverse")


def _judge(cell: Cell, name: EstimatorName, recording: Recording, samples: Regimes, fold: Fold) -> FoldErrors:
    """Held-out errors of an estimator trained before the fold, run as in use: with smoothing, and sleep at rest."""
    until = int(np.searchsorted(recording.time_s, fold.end_s))
    part = slice(int(np.searchsorted(recording.time_s, fold.start_s)), until)
    estimator = cell.estimator((), name)
    pressure, std = estimate_recording(estimator, recording.time_s[:until], recording.resistance_ohm[:until])
    error = (pressure - recording.pressure_kpa[:until])[part] / cell.full_scale_kpa
    stated = np.full(error.shape, np.inf) if std is None else std[part] / cell.full_scale_kpa
    return FoldErrors(fold, error, stated, samples.part(part))


def _all_of(recording: Recording) -> Fold:
    return Fold(float(recording.time_s[0]), float(recording.time_s[-1]) + recording.step_s)


def _judge_on_all(cell: Cell, recording: Recording, samples: Regimes) -> dict[EstimatorName, list[FoldErrors]]:
    """Errors of all estimators on the whole recording, which they have learned."""
    every = _all_of(recording)
    judged = {name: [_judge(cell, name, recording, samples, every)] for name in LEARNED}
    model = cell.model, cell.rest_resistance_ohm
    return judged | _judge_models(cell.replace(estimators=None), (model,), recording, samples, (every,))


def _judge_models(
    cell: Cell,
    before_folds: tuple[tuple[Model, float] | None, ...],
    recording: Recording,
    samples: Regimes,
    parts: tuple[Fold, ...],
) -> dict[EstimatorName, list[FoldErrors]]:
    """Errors of estimators that follow from the model alone; ``before_folds``: as fitted before each fold.

    An estimator is left out unless the fits before all folds allow it.
    """
    judged: dict[EstimatorName, list[FoldErrors]] = {}
    for name in FROM_MODEL:
        pairs = []
        for fold, before in zip(parts, before_folds, strict=True):
            try:
                if before is not None:
                    model, rest = before
                    trial = cell.replace(model=model, rest_resistance_ohm=rest)
                    pairs.append(_judge(trial, name, recording, samples, fold))
            except InputError:
                break  # not for this kind of cell, or these parameters
        if len(pairs) == len(parts) and _has(cell, name):
            judged[name] = pairs
    return judged


def _has(cell: Cell, name: EstimatorName) -> bool:
    """Whether the estimator ``name`` exists for a cell."""
    try:
        cell.estimator((), name)
    except InputError:
        return False
    return True


def _calibrated_contact(cell: Cell, recording: Recording) -> Cell:
    """Calibrate a contact, which has no memory: the only estimator is a cubic in log(R0/R)."""
    r, load = recording.resistance_ohm / cell.rest_resistance_ohm - 1, recording.pressure_kpa / cell.full_scale_kpa

    whole = training.NormalisedRecording(recording.time_s, r, load, cell.rest_resistance_ohm, no_simulation, 0.0)
    samples = Regimes.of(recording, cell.full_scale_kpa)
    held_out, parts = folds(recording, cell.full_scale_kpa), []
    for fold in held_out or (_all_of(recording),):
        before = whole.until(fold.start_s) if held_out else whole
        first = training.static_curve(before, cell.full_scale_kpa, logarithmic=True)
        part = slice(*np.searchsorted(recording.time_s, (fold.start_s, fold.end_s)).tolist())
        error = np.clip(first.load(r[part]), first.limits.lowest, first.limits.highest) - load[part]
        parts.append(FoldErrors(fold, error, np.full(error.shape, np.inf), samples.part(part)))
    percent = max(100 * part.rms for part in parts)
    pressed = max(100 * part.pressed_rms for part in parts)
    curve = training.static_curve(whole, cell.full_scale_kpa, logarithmic=True)
    std = max(curve.std_kpa, DRIFT * pressed / 100 * cell.full_scale_kpa)
    estimators = Calibrated(
        default="static",
        reason=f"a contact without memory; {percent:.1f} % of full scale on "
        + (f"the worst of {len(parts)} folds" if held_out else "all of the recording"),
        held_out_percent={"static": percent},
        fold_percent={"static": tuple(100 * part.rms for part in parts)},
        pressed_percent={"static": pressed},
        seen=_seen(recording, cell.full_scale_kpa),
        static=curve.replace(std_kpa=std),
    )
    return cell.replace(estimators=estimators)
