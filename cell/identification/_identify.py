"""Model selection and least-squares fit of cell models to a recording; parameters with their standard errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ...common.arrays import FloatArray
from ...errors import InputError
from ..materials import Model, simulate
from ._contact_fit import fit_contact
from ._fitted import Drift, Fit, Parameter
from ._folds import Fold, folds
from ._kinds import (
    Kind,
    Richer,
    asymmetric_as_whole,
    asymmetric_kind,
    m10_kind,
    model_of,
    paper_kind,
    whole_as_m10,
    whole_kind,
    with_drift,
)
from ._least_squares import Grid, correlation_length, predict, solve
from ._recording import Recording
from ._recovery_curve import longest_recovery, recovery_branches
from ._remarks import clock_shift_s
from ._training import cubic

POINTS, POINTS_BEFORE_FOLDS = 2000, 1000
"""largest number of samples in a least-squares fit: of the whole recording, and of the part up to the end of a fold;
longer ones are thinned"""
EXPLAINS = 0.7
"""fraction of the standard deviation of the resistance; the error of the best model must be below. Of a contact, the
same of the load, and the error of its curve"""
FALLS = -0.3
"""correlation of the load with the logarithm of the resistance, below which the load lowers the resistance"""
SIMPLER = 1.05
"""a simpler kind is preferred if the error on its worst fold is within this factor of the best"""
SEEN_AT_REST, NEVER_AT_REST = 0.15, 0.7
"""fraction by which the true R0 may be lower than the readings before the first press, or than the least reading"""
BEGINS_LOADED = 0.05
"""initial load over full scale, beyond which the initial memory of the cell is fitted, too"""
NEAR_STEPS = 2.0
"""distance to the nearest reading, in time steps of the recording, within which the resistance counts as read"""
NOISY = 0.1
"""fraction of the variance of noise; a smaller squared error beyond noise is too small to test a drift with"""


def fits(recording: Recording, full_scale_kpa: float, told: Callable[[str], None] = lambda what: None) -> list[Fit]:
    """Fits of every kind of cell whose readings rise under load to the recording, the best first.

    The best is the simplest kind whose error is within 5 % of the least: the held-out error, or where the recording has
    no folds, the error on all of it with the penalty of the Bayesian information criterion (Schwarz, "Estimating the
    dimension of a model", 1978). ``told`` is called after each kind.

    Raises:
        InputError: the resistance does not follow the pressure.
    """
    rest, lower = rest_resistance(recording, full_scale_kpa)
    found = _fit_kinds(_Task(recording, full_scale_kpa, rest, lower, folds(recording, full_scale_kpa)), told)
    blind = float(np.std(recording.resistance_ohm) / np.ptp(recording.resistance_ohm))
    _check_follows(recording, min(fit.error for fit in found), blind, "model", "its range")
    found = _penalised(found)
    least = min(fit.judged_error for fit in found)
    best = next(fit for fit in found if fit.judged_error <= SIMPLER * least)
    return [best, *sorted((fit for fit in found if fit is not best), key=lambda fit: fit.judged_error)]


def _penalised(found: list[Fit]) -> list[Fit]:
    """The fits with their penalties. The criterion n ln(error^2) + p ln(n) orders them as error * n^(p / 2n) does.

    n is the number of independent samples by the residual of the best fit: model errors of neighbouring samples are
    alike.
    """
    n = max(min(found, key=lambda fit: fit.error).independent, 2.0)
    return [replace(fit, penalty=float(n ** (len(fit.parameters) / (2 * n)))) for fit in found]


def falls(recording: Recording, full_scale_kpa: float) -> bool:
    """Whether the load lowers the resistance."""
    load, log_ohm = recording.pressure_kpa / full_scale_kpa, np.log(recording.resistance_ohm)
    return bool(np.corrcoef(load, log_ohm)[0, 1] < FALLS)


def contact_fit(recording: Recording, full_scale_kpa: float) -> Fit:
    """The fit of a contact without memory; InputError if the resistance does not follow the pressure."""
    load, log_ohm = recording.pressure_kpa / full_scale_kpa, np.log(recording.resistance_ohm)
    _check_follows(recording, _left_by_curve(load, log_ohm), float(np.std(load)), "curve", "full scale")
    return fit_contact(recording, full_scale_kpa, rest_resistance(recording, full_scale_kpa)[0])


def _left_by_curve(load: FloatArray, log_ohm: FloatArray) -> float:
    """Rms error of the load by the best cubic in the log of the resistance: the curve by which contacts are read.

    The error of the power law would say less. The power law is fitted in logarithms, where the current through a
    released contact may scatter by decades, which is hardly a load to the curve.
    """
    return float(np.std(cubic(log_ohm, load)(log_ohm) - load))


def _check_follows(recording: Recording, left: float, blind: float, best: str, of: str) -> None:
    """InputError, naming the recording, unless the ``best`` explanation leaves clearly less than knowing nothing."""
    if left < EXPLAINS * blind:
        return
    question = "are the columns right, and is the noise smaller than what the load does?"
    if shift_s := clock_shift_s(recording):
        side = "before" if shift_s > 0 else "after"
        question = (
            f"but it changes {abs(shift_s):.2g} s {side} the pressure does, again and again: the clocks of the two are "
            f"apart. Shift the times of one by {abs(shift_s):.2g} s, and fit again"
        )
    raise InputError(
        f"{recording.name}: the resistance does not follow the pressure: the best {best} leaves {100 * left:.0f} % of "
        f"{of}, knowing nothing {100 * blind:.0f} %; {question}"
    )


def _fit_kinds(task: _Task, told: Callable[[str], None]) -> list[Fit]:
    """Fits of all kinds whose resistance rises under load, the simplest first.

    A kind that contains a simpler one is also started from the simpler optimum, so that it never fits worse.
    """
    recording, full_scale_kpa, rest = task.recording, task.full_scale_kpa, task.rest_ohm
    start = _start(recording, full_scale_kpa, rest)
    size = float(np.ptp(np.percentile(recording.resistance_ohm, [0.5, 99.5])) / rest)
    begun = bool(recording.quiet.pressure_kpa[0] > BEGINS_LOADED * full_scale_kpa)
    kinds = asymmetric_kind(start, size, begun), whole_kind(start, size, begun), m10_kind(start, size, begun)
    asymmetric, branches = _fit(kinds[0], task, [])
    told("fitted asymmetric")
    as_paper = [(*solution[:5], 0.2, 5.0, solution[-1]) for solution in branches]
    paper, _ = _fit(paper_kind(start, size), task, as_paper)
    told("fitted paper")
    whole, unbroken = _fit(kinds[1], task, [asymmetric_as_whole(one) for one in branches])
    m10, broken = _fit(kinds[2], task, [whole_as_m10(one, size) for one in unbroken])
    richer: tuple[Richer, ...] = asymmetric_as_whole, lambda one: whole_as_m10(one, size), lambda one: one
    optima = branches[-1], unbroken[-1], broken[-1]
    m10 = replace(m10, drift=_find_drift(list(zip(kinds, optima, richer, strict=True)), task))
    told("fitted m10")
    return [asymmetric, paper, whole, m10]


@dataclass(frozen=True)
class _Task:
    """The data and limits that are common to the fits of all kinds."""

    recording: Recording
    full_scale_kpa: float
    rest_ohm: float
    lower: float
    """fraction by which R0 may be lower than ``rest_ohm``"""
    folds: tuple[Fold, ...]

    def grid(self, until_s: float, end_s: float) -> Grid:
        """The recording before ``end_s`` on a uniform time grid; samples before ``until_s`` count in the fit."""
        recording = self.recording
        time = recording.time_s
        last = min(end_s, float(time[-1]))
        points = POINTS if until_s >= time[-1] else POINTS_BEFORE_FOLDS
        dt = max(recording.step_s, (last - time[0]) / points)
        at = np.arange(time[0], last + 1e-9 * dt, dt)
        quiet = recording.quiet
        load = np.interp(at, quiet.loads.time_s, quiet.loads.pressure_kpa) / self.full_scale_kpa
        r = np.interp(at, time, quiet.resistance_ohm) / self.rest_ohm - 1
        read = quiet.near_reading(at, max(dt, NEAR_STEPS * recording.step_s))
        fitted = int(np.searchsorted(at, until_s))
        return Grid(dt, load, r, read, max(2, min(fitted, len(at))))


def _fit(kind: Kind, task: _Task, nested: list[tuple[float, ...]]) -> tuple[Fit, list[tuple[float, ...]]]:
    """Fit the part before each fold, then the whole recording.

    Each fit starts from the kind's own starts, from the last solution, and from ``nested``.

    Args:
        kind: the kind of model.
        task: the data.
        nested: solutions of a simpler kind that this kind contains: one before each fold, then that of the whole.

    Returns:
        The fit, and its solutions before each fold and of the whole.
    """
    recording, rest = task.recording, task.rest_ohm
    spread = float(np.ptp(recording.quiet.resistance_ohm)) / rest
    solutions: list[FloatArray] = []
    errors = []
    for number, fold in enumerate(task.folds):
        grid = task.grid(fold.start_s, fold.end_s)
        starts = [*kind.starts, *map(tuple, solutions[-1:]), *nested[number : number + 1]]
        solution, _ = solve(kind, grid, starts, task.lower)
        solutions.append(solution)
        left = grid.left(predict(kind, solution, grid), grid.fitted)
        errors.append(float(np.sqrt(np.mean(left**2)) / spread) if left.size else np.inf)

    whole = task.grid(np.inf, np.inf)
    earlier = [kind.starts[0], tuple(solutions[-1])] if solutions else kind.starts
    found, covariance = solve(kind, whole, [*earlier, *nested[-1:]], task.lower)
    residual = whole.left(predict(kind, found, whole))
    error = float(np.sqrt(np.mean(residual**2)) / spread)
    offset = float(found[-1])
    model = model_of(kind.kind, found, task.full_scale_kpa)
    duration = float(recording.time_s[-1] - recording.time_s[0])
    *deviations, rest_error = np.sqrt(np.diag(covariance)).tolist()
    parameters = [
        Parameter(name, value, std, std < 0.5 * abs(value) and not _too_slow(name, value, duration))
        for name, value, std in zip(kind.names, found.tolist(), deviations, strict=False)
    ]
    corrected = rest * (1 + offset)
    # The fitted R0 and the reading at rest are two estimates of one quantity: R0 is known no better than they agree.
    rest_error = float(np.hypot(rest_error, offset))
    seen = task.lower == SEEN_AT_REST and rest_error < 0.05
    parameters.append(Parameter("rest_resistance_ohm", float(corrected), rest * rest_error, seen))
    fit = Fit(
        model=model,
        rest_resistance_ohm=corrected,
        parameters=tuple(parameters),
        error=error,
        fold_errors=tuple(errors),
        simulate=partial(_simulated, kind, found, rest),
        simulate_folds=tuple(partial(_simulated, kind, solution, rest) for solution in solutions),
        before_folds=tuple(_valid_model(kind, solution, task) for solution in solutions),
        independent=len(residual) / correlation_length(residual),
    )
    return fit, [tuple(map(float, solution)) for solution in (*solutions, found)]


def _find_drift(models: Sequence[tuple[Kind, tuple[float, ...], Richer]], task: _Task) -> Drift:
    """Fit a steady drift of R0 together with every parameter of the last, richest model.

    A drift changes the readings at rest and under load by the same relative amount. Creep mostly does not.
    Nevertheless, a slow branch can absorb much of a drift. Each model is therefore also started from the optimum, with
    a drift, of the simpler model before it.

    Args:
        models: in an order in which each contains the one before. Each has its kind, its optimum without a drift, and
            a function that converts its parameters to those of the next model.
        task: the data.
    """
    grid = task.grid(np.inf, np.inf)
    nested: list[tuple[float, ...]] = []
    for kind, found, richer in models:
        count = len(kind.names)
        drifting_kind = kind.drifting()
        starts = [drifting_kind.starts[0], with_drift(found, count, 0.0), *nested]
        fitted, covariance = solve(drifting_kind, grid, starts, task.lower)
        noise = simulate.white_noise(grid.r[grid.read]) ** 2
        without = float(np.mean(grid.left(predict(kind, np.array(found), grid)) ** 2)) - noise
        left = float(np.mean(grid.left(predict(drifting_kind, fitted, grid)) ** 2)) - noise
        unexplained = max(left, 0.0) / without if without > NOISY * noise else 1.0
        drift = Drift(float(fitted[count]), float(np.sqrt(covariance[count, count])), unexplained)
        plain = richer(tuple(np.delete(fitted, count).tolist()))
        nested = [with_drift(plain, count + len(plain) - len(found), drift.share)]
    return drift


def _too_slow(name: str, value: float, duration_s: float) -> bool:
    return name.endswith("_s") and value > duration_s / 2


def rest_resistance(recording: Recording, full_scale_kpa: float) -> tuple[float, float]:
    """R0 in ohm, and the fraction by which the true R0 may be lower.

    R0 is the median reading before the first press, if that part lasts a second. Else R0 is the lowest reading at light
    load; the recording may then never show the cell at rest.
    """
    pressure = np.abs(recording.quiet.pressure_kpa)
    pressed = np.flatnonzero(pressure > 0.03 * full_scale_kpa)
    first = int(pressed[0]) if pressed.size else len(pressure)
    if first > 2 and recording.time_s[first] - recording.time_s[0] >= 1.0:
        return float(np.median(recording.resistance_ohm[:first])), SEEN_AT_REST
    light = pressure <= max(0.05 * full_scale_kpa, float(np.quantile(pressure, 0.02)))
    return float(np.min(recording.resistance_ohm[light])), NEVER_AT_REST


def _start(recording: Recording, full_scale_kpa: float, rest: float) -> tuple[float, ...]:
    """Start values: gains of the three parts at full scale, and two time constants.

    They are read off a recovery curve by the graphical method (P6), if the recording has one.
    """
    gain = float(np.percentile(recording.resistance_ohm, 98) / rest - 1)
    place = longest_recovery(recording, full_scale_kpa)
    if place is not None:
        r = recording.resistance_ohm[place] / rest - 1
        before = slice(max(0, place.start - 20), place.start + 1)
        released = float(np.max(recording.pressure_kpa[before]))
        try:
            e1, e2, e3, t2, t3 = recovery_branches(recording.time_s[place], r - min(0.0, float(r.min())), released)
            return full_scale_kpa / e1, full_scale_kpa / e2, full_scale_kpa / e3, t2, t3
        except InputError:
            pass  # the graphical method does not apply to this curve: start from default values instead
    return 0.5 * gain, 0.4 * gain, 0.1 * gain, 5.0, 100.0


def _valid_model(kind: Kind, found: FloatArray, task: _Task) -> tuple[Model, float] | None:
    """The model and R0 in ohm, or None if the parameters make no valid cell."""
    try:
        return model_of(kind.kind, found, task.full_scale_kpa), task.rest_ohm * (1 + float(found[-1]))
    except InputError:
        return None


def _simulated(
    kind: Kind, found: FloatArray, rest: float, rng: np.random.Generator, load: FloatArray, dt: float
) -> FloatArray:
    """Simulated cells like the identified one, with random deviations of 6 % in gains and 12 % in time constants."""
    cells = load.shape[1]
    jittered = np.repeat(found[:-1, None], cells, axis=1)
    jittered[len(kind.names) :] = 0.0  # the initial memory belongs to the recording, not to the cell
    for place, name in enumerate(kind.names):
        noise = rng.standard_normal(cells)
        jittered[place] *= np.exp(0.12 * noise) if name.endswith("_s") else 1 + 0.06 * noise
    resistance: FloatArray = rest * (1 + found[-1] + kind.run(jittered, kind.felt(load), dt))
    return resistance
