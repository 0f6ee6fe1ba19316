"""From a recording to CELL.toml: identify the cell, teach its estimators, choose one, and say how sure all that is."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import FloatArray
from ..errors import InputError
from ..progress import Progress, silent
from . import _choice as choice
from . import _simulate as simulate
from . import _training as training
from ._cell import Calibrated, Cell, EstimatorName
from ._estimator import Estimator
from ._fitted import Fit
from ._folds import Fold, folds
from ._held import longest_s
from ._identify import fits
from ._inverse import margin as inverse_margin
from ._judged import Judged, Regimes, best_share, mixed
from ._learned import DRIFT, Seen
from ._models import AsymmetricModel, ContactModel, M10Model
from ._recording import Recording
from ._remarks import remarks
from ._teaching import chains_break, find_teacher

MOST = 6000
"""samples that are learned from; a longer recording is thinned"""
FOLD_CELLS = 32
"""simulated for learning before each fold; a third of those for the final estimators"""
MISSES = 3.0
"""times its held-out error, that an inverse may miss of a drift that goes on after the recording"""
WORTH_COMPILING = 1000
"""samples from which on machine code is loaded before a recording is estimated, which takes about half a second"""
STEPS = 7
"""of a calibration, for progress: three kinds of model, three folds, and learning from all"""


FALLING = (
    "the resistance falls under load: the cell is taken for a contact without memory, and creep and hysteresis are not "
    "made up for"
)


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated cell and everything the report of it says."""

    cell: Cell
    recording: Recording
    fits: tuple[Fit, ...]
    """the chosen kind first"""
    folds: tuple[Fold, ...]
    """of the recording, in its time: what comes before each was learned from to judge on it"""
    inverse_margin: float | None
    """least slope of a fast step over that at equilibrium: the exact inverse is safe where positive; None: no such"""
    remarks: tuple[str, ...] = ()
    """what the recording does not say of the cell, and what looks wrong in it"""

    @property
    def fit(self) -> Fit:
        """Of the chosen kind."""
        return self.fits[0]


def calibrate(
    recording: Recording, *, full_scale_kpa: float | None = None, progress: Progress = silent
) -> CalibrationResult:
    """Identify the cell of a recording and calibrate its estimators.

    Kinds of models and estimators are compared by rolling-origin evaluation. The recording is cut into folds that each
    contain presses. What comes before a fold is fitted and learned from, and the worst fold counts. What is kept is
    then fitted and learned from the whole. Deterministic.

    Args:
        recording: presses and releases of one cell.
        full_scale_kpa: None: the largest pressure of the recording.
        progress: told of each step that is done.

    Raises:
        InputError: the resistance does not follow the pressure, or no model of any kind fits.
    """
    clean = recording.without_sparks
    every = -(-len(clean.time_s) // MOST)
    thin = Recording(clean.time_s[::every], clean.pressure_kpa[::every], clean.resistance_ohm[::every], clean.name)
    full = float(np.quantile(thin.pressure_kpa, 0.999)) if full_scale_kpa is None else full_scale_kpa
    if not 0 < full < np.inf:
        raise InputError(f"full scale is {full} kPa; expected more than 0")
    steps = itertools.count(1)

    def tell(what: str) -> None:
        progress(next(steps), STEPS, what)

    found = tuple(fits(thin, full, tell))
    model = found[0].model
    rest = found[0].rest_resistance_ohm
    cell = Cell(rest_resistance_ohm=rest, full_scale_kpa=full, model=model)
    inverse = inverse_margin(model, full) if isinstance(model, AsymmetricModel | M10Model) else None
    if isinstance(model, ContactModel):
        contact = _calibrated_contact(cell, thin)
        said = (FALLING, *remarks(recording, full, float(Regimes.of(thin, full).pressing[-1]) / 2, varied=True))
        return CalibrationResult(contact, recording, found, folds(thin, full), inverse, said)

    parts = folds(thin, full)
    teacher, breaks = find_teacher(found), chains_break(found)
    whole = training.NormalisedRecording(
        time_s=thin.time_s,
        r=thin.resistance_ohm / rest - 1,
        load=thin.pressure_kpa / full,
        rest_resistance_ohm=rest,
        simulation=teacher.simulate,
        unexplained=teacher.error * float(np.ptp(thin.resistance_ohm)) / rest,
    )
    seen, samples = _seen(thin, full), Regimes.of(thin, full)
    judged: dict[EstimatorName, list[Judged]] = {}
    for fold, simulation in zip(parts, teacher.simulate_folds, strict=True):
        first = replace(whole, simulation=simulation).until(fold.start_s)
        trial = cell.replace(estimators=_learned(first, full, cells=FOLD_CELLS, breaks=breaks).replace(seen=seen))
        for name in LEARNED:
            judged.setdefault(name, []).append(_judge(trial, name, thin, samples, fold))
        tell("learned before a fold, and judged on it")
    judged |= _judge_models(cell.replace(estimators=None), found[0], thin, samples, parts)
    final = _learned(whole, full, cells=training.CELLS, breaks=breaks).replace(seen=seen)
    noise = seen.noise * float(np.mean(thin.resistance_ohm) / np.ptp(thin.resistance_ohm))
    unexplained = float(np.sqrt(max(found[0].held_out_error ** 2 - noise**2, 0.0)))
    taught = float(np.sqrt(max(teacher.held_out_error**2 - noise**2, 0.0)))
    for name in ("play", "distilled"):
        share = best_share(judged[name], judged["static"])
        judged[name] = mixed(judged[name], judged["static"], share)
        learned = getattr(final, name).replace(static_share=1 - share, beyond_recorded=taught < choice.EXACT)
        final = final.replace(**{name: learned})
    tried = (*LEARNED, *(name for name in judged if name == "inverse"))
    elsewhere = choice.errors_elsewhere(cell.replace(estimators=final), found, tried, whole)
    tell("learned from all")
    evidence = choice.Evidence(
        judged=judged,
        elsewhere=elsewhere,
        presses=float(samples.pressing[-1]) / 2,
        unexplained=unexplained,
        least_slope=1.0 if inverse is None else inverse,
    )
    default, reason = choice.choose(evidence)
    pressed = {name: 100 * max(part.pressed_rms for part in of) for name, of in judged.items()}
    pressed_drift = max(abs(float(np.mean(part.pressed))) for part in judged["static"])
    calibrated = {
        name: training.calibrated(
            getattr(final, name),
            judged[name],
            drift=pressed_drift,
            elsewhere=0.0 if evidence.varied else elsewhere[name],
            most=pressed["static"] / 100,
        )
        for name in ("play", "distilled")
    }
    other_loads = training.error_on_other_loads(whole, final.static)
    static_std = full * max(DRIFT * pressed["static"] / 100, other_loads)
    static = final.static.replace(std_kpa=max(final.static.std_kpa, static_std))
    estimators = Calibrated(
        default=default,
        reason=reason,
        held_out_percent={name: evidence.worst(name) for name in judged},
        fold_percent={name: tuple(evidence.percent(name)) for name in judged},
        pressed_percent=pressed,
        # An inverse follows the drift that its model explains, which shows in its errors on the folds.
        drift_percent=min(100 * pressed_drift, MISSES * pressed.get("inverse", np.inf)),
        seen=seen,
        static=static,
        **calibrated,
    )
    drift = next(fit.drift for fit in found if fit.drift is not None)
    said = tuple(remarks(recording, full, evidence.presses, varied=evidence.varied, drift=drift))
    return CalibrationResult(cell.replace(estimators=estimators), recording, found, parts, inverse, said)


def estimate_recording(
    estimator: Estimator, time_s: FloatArray, resistance_ohm: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Estimates (n,) of one cell and their standard deviations, in kPa, of a whole recording.

    Args:
        estimator: made for the shape ().
        time_s: (n,) increasing.
        resistance_ohm: (n,); NaN where there is no reading.

    Returns:
        Pressure, and its standard deviation or None if the estimator states none.
    """
    if len(time_s) >= WORTH_COMPILING:
        estimator.compile()
    pressure, std = np.empty((2, len(time_s)))
    for n, elapsed in enumerate(np.diff(time_s, prepend=time_s[0])):
        pressure[n] = estimator.step(float(elapsed), resistance_ohm[n])
        std[n] = estimator.std_kpa
    return pressure, std if estimator.states_std else None


def _learned(
    calibration: training.NormalisedRecording, full_scale_kpa: float, *, cells: int, breaks: bool
) -> Calibrated:
    """All learned estimators, not judged yet; of a cell whose conductive chains break under motion, or not."""
    simulated = training.variations(calibration, np.random.default_rng(0), cells)
    return Calibrated(
        default="distilled",
        reason="",
        held_out_percent={},
        static=training.static_curve(calibration, full_scale_kpa),
        play=training.play(calibration, simulated),
        distilled=training.distilled(calibration, simulated, paths_s=training.PATHS_S if breaks else ()),
    )


def _seen(recording: Recording, full_scale_kpa: float) -> Seen:
    time, load = recording.time_s, recording.quiet.pressure_kpa
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


def _judge(cell: Cell, name: EstimatorName, recording: Recording, samples: Regimes, fold: Fold) -> Judged:
    """Of an estimator that was learned before the fold, run as it will be used: smoothed, and asleep at rest."""
    until = int(np.searchsorted(recording.time_s, fold.end_s))
    part = slice(int(np.searchsorted(recording.time_s, fold.start_s)), until)
    estimator = cell.estimator((), name)
    pressure, std = estimate_recording(estimator, recording.time_s[:until], recording.resistance_ohm[:until])
    error = (pressure - recording.pressure_kpa[:until])[part] / cell.full_scale_kpa
    stated = np.full(error.shape, np.inf) if std is None else std[part] / cell.full_scale_kpa
    return Judged(fold, error, stated, samples.part(part))


def _judge_models(
    cell: Cell, fit: Fit, recording: Recording, samples: Regimes, parts: tuple[Fold, ...]
) -> dict[EstimatorName, list[Judged]]:
    """Of the estimators that follow from the model alone, as fitted before each fold, where all folds have them."""
    judged: dict[EstimatorName, list[Judged]] = {}
    for name in FROM_MODEL:
        pairs = []
        for fold, before in zip(parts, fit.before_folds, strict=True):
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
    """Whether a cell can have that estimator."""
    try:
        cell.estimator((), name)
    except InputError:
        return False
    return True


def _calibrated_contact(cell: Cell, recording: Recording) -> Cell:
    """A contact has no memory: a cubic in log(R0/R), and nothing else to choose from."""
    r, load = recording.resistance_ohm / cell.rest_resistance_ohm - 1, recording.pressure_kpa / cell.full_scale_kpa

    def unused(rng: np.random.Generator, loads: FloatArray, dt: float) -> FloatArray:
        raise AssertionError("the static curve is not learned from simulations")

    whole = training.NormalisedRecording(recording.time_s, r, load, cell.rest_resistance_ohm, unused, 0.0)
    samples = Regimes.of(recording, cell.full_scale_kpa)
    parts = []
    for fold in folds(recording, cell.full_scale_kpa):
        first = training.static_curve(whole.until(fold.start_s), cell.full_scale_kpa, logarithmic=True)
        part = slice(*np.searchsorted(recording.time_s, (fold.start_s, fold.end_s)).tolist())
        error = np.clip(first.load(r[part]), first.limits.lowest, first.limits.highest) - load[part]
        parts.append(Judged(fold, error, np.full(error.shape, np.inf), samples.part(part)))
    percent = max(100 * part.rms for part in parts)
    pressed = max(100 * part.pressed_rms for part in parts)
    curve = training.static_curve(whole, cell.full_scale_kpa, logarithmic=True)
    std = max(curve.std_kpa, DRIFT * pressed / 100 * cell.full_scale_kpa)
    estimators = Calibrated(
        default="static",
        reason=f"a contact without memory; {percent:.1f} % of full scale on the worst of {len(parts)} folds",
        held_out_percent={"static": percent},
        fold_percent={"static": tuple(100 * part.rms for part in parts)},
        pressed_percent={"static": pressed},
        seen=_seen(recording, cell.full_scale_kpa),
        static=curve.replace(std_kpa=std),
    )
    return cell.replace(estimators=estimators)
