"""Identification: which kind of cell a recording shows, and its parameters with their standard errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ...arrays import FloatArray
from ...errors import InputError
from ..materials import Model, simulate
from ._contact_fit import fit_contact
from ._fitted import Drift, Fit, Parameter
from ._folds import Fold, folds, pressing
from ._kinds import (
    Kind,
    Richer,
    asymmetric_as_whole,
    asymmetric_kind,
    drifting,
    m10_kind,
    model_of,
    paper_kind,
    whole_as_m10,
    whole_kind,
    with_drift,
)
from ._least_squares import Grid, predict, solve
from ._recording import Recording
from ._recovery_curve import longest_recovery, recovery_branches

POINTS, POINTS_BEFORE_FOLDS = 2000, 1000
"""samples that enter the least squares, of the whole and of a fold with what comes before it; more are thinned"""
EXPLAINS = 0.7
"""share of the standard deviation of the resistance that some model must fit better than; of a contact's load, its
curve"""
TAUGHT = 1.2
"""full presses before a fold from which on it tells how well a kind describes the cell, and not how little it needs"""
SIMPLER = 1.05
"""a simpler kind wins when the error of its worst fold is within this factor of the best"""
SEEN_AT_REST, NEVER_AT_REST = 0.15, 0.7
"""share by which the true R0 may be below what was read before the first press, or below the least reading"""
BEGINS_LOADED = 0.05
"""load at which a recording begins, over full scale, from which on what the cell remembers there is fitted too"""
NEAR_STEPS = 2.0
"""steps of the recording from its nearest reading, within which the resistance counts as read"""
NOISY = 0.1
"""of the variance of noise: squared error beyond noise that is too little for a drift to explain"""


def fits(recording: Recording, full_scale_kpa: float, told: Callable[[str], None] = lambda what: None) -> list[Fit]:
    """Every kind that can describe the recording, the best first.

    Best is the simplest whose held-out error is within 5 % of the least one. ``told`` hears of each kind that is done.

    Raises:
        InputError: the resistance does not follow the pressure.
    """
    rest, lower = rest_resistance(recording, full_scale_kpa)
    load, log_ohm = recording.pressure_kpa / full_scale_kpa, np.log(recording.resistance_ohm)
    if np.corrcoef(load, log_ohm)[0, 1] < -0.3:
        _check_follows(recording.name, _left_by_curve(load, log_ohm), float(np.std(load)), "curve", "full scale")
        found = [fit_contact(recording, full_scale_kpa, rest)]
    else:
        found = _fit_kinds(_Task(recording, full_scale_kpa, rest, lower, folds(recording, full_scale_kpa)), told)
        blind = float(np.std(recording.resistance_ohm) / np.ptp(recording.resistance_ohm))
        _check_follows(recording.name, min(fit.error for fit in found), blind, "model", "its range")
    least = min(fit.held_out_error for fit in found)
    best = next(fit for fit in found if fit.held_out_error <= SIMPLER * least)
    return [best, *sorted((fit for fit in found if fit is not best), key=lambda fit: fit.held_out_error)]


def _left_by_curve(load: FloatArray, log_ohm: FloatArray) -> float:
    """Rms of the load that the best cubic in the log of the resistance leaves: by such a curve contacts are read.

    Their power law says less of that. It is fitted to logs, too, where what a released contact still conducts, though
    hardly a load to the curve, may be decades.
    """
    curve, _ = np.polynomial.Polynomial.fit(log_ohm, load, 3, full=True)
    return float(np.std(curve(log_ohm) - load))


def _check_follows(name: str, left: float, blind: float, best: str, of: str) -> None:
    """InputError, naming the recording, unless the ``best`` explanation leaves clearly less than knowing nothing."""
    if not left < EXPLAINS * blind:
        raise InputError(
            f"{name}: the resistance does not follow the pressure: the best {best} leaves {100 * left:.0f} % of {of}, "
            f"knowing nothing {100 * blind:.0f} %; are the columns right, and is the noise smaller than what the load "
            "does?"
        )


def _fit_kinds(task: _Task, told: Callable[[str], None]) -> list[Fit]:
    """Fits of all kinds whose resistance rises under load, the simplest first.

    What contains another kind is started from where that one ended too, so that it never fits worse.
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
    """What every kind is fitted to."""

    recording: Recording
    full_scale_kpa: float
    rest_ohm: float
    lower: float
    """share by which R0 may be below ``rest_ohm``"""
    folds: tuple[Fold, ...]

    @property
    def first_telling(self) -> int:
        """The first fold that :data:`TAUGHT` presses precede, or the last one."""
        before = np.interp(
            [fold.start_s for fold in self.folds],
            self.recording.time_s,
            pressing(self.recording, self.full_scale_kpa) / 2,
        )
        return min(int(np.count_nonzero(before < TAUGHT)), len(self.folds) - 1)

    def grid(self, until_s: float, end_s: float) -> Grid:
        """The recording before ``end_s``, of which the part before ``until_s`` counts as fitted."""
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
    """Fit what comes before each fold, then the whole; each from its own starts, the last solution, and ``nested``.

    Args:
        kind: how.
        task: what.
        nested: solutions of a kind that this one contains: before each fold, and of the whole.

    Returns:
        The fit, and the solutions before each fold and of the whole.
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
    found, covariance = solve(kind, whole, [kind.starts[0], tuple(solutions[-1]), *nested[-1:]], task.lower)
    error = float(np.sqrt(np.mean(whole.left(predict(kind, found, whole)) ** 2)) / spread)
    offset = float(found[-1])
    model = model_of(kind.kind, found, task.full_scale_kpa)
    duration = float(recording.time_s[-1] - recording.time_s[0])
    *deviations, rest_error = np.sqrt(np.diag(covariance)).tolist()
    parameters = [
        Parameter(name, value, std, std < 0.5 * abs(value) and not _too_slow(name, value, duration))
        for name, value, std in zip(kind.names, found.tolist(), deviations, strict=False)
    ]
    corrected = rest * (1 + offset)
    # The model's R0 and what was read at rest are two answers to one question: they are known no better than that.
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
        first_telling=task.first_telling,
    )
    return fit, [tuple(map(float, solution)) for solution in (*solutions, found)]


def _find_drift(models: Sequence[tuple[Kind, tuple[float, ...], Richer]], task: _Task) -> Drift:
    """Fit a steady drift of R0 together with every parameter of the last, richest model.

    A drift changes the readings at rest and under load by the same share. Creep mostly does not. A slow branch can
    nevertheless take up much of a drift. Each model therefore begins from the simpler one's optimum with a drift, too.

    Args:
        models: each contains the one before: how it is fitted, its optimum without a drift, and that optimum as the
            parameters of the next one.
        task: what is fitted.
    """
    grid = task.grid(np.inf, np.inf)
    nested: list[tuple[float, ...]] = []
    for kind, found, richer in models:
        count = len(kind.names)
        drifting_kind = drifting(kind)
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
    """R0, and by which share of it the truth may be lower.

    The median before the first press, if that lasts a second; else the lowest resistance while hardly loaded, and
    then the cell may never have been seen at rest.
    """
    pressure = np.abs(recording.quiet.pressure_kpa)
    pressed = np.flatnonzero(pressure > 0.03 * full_scale_kpa)
    first = int(pressed[0]) if pressed.size else len(pressure)
    if first > 2 and recording.time_s[first] - recording.time_s[0] >= 1.0:
        return float(np.median(recording.resistance_ohm[:first])), SEEN_AT_REST
    light = pressure <= max(0.05 * full_scale_kpa, float(np.quantile(pressure, 0.02)))
    return float(np.min(recording.resistance_ohm[light])), NEVER_AT_REST


def _start(recording: Recording, full_scale_kpa: float, rest: float) -> tuple[float, ...]:
    """Gains of the three parts at full scale and two times: graphically if there is a recovery to read (P6)."""
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
            pass  # not the shape that can be read graphically; least squares starts from plain values instead
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
    """Cells like the identified one, gains known to 6 %, times to 12 %."""
    cells = load.shape[1]
    jittered = np.repeat(found[:-1, None], cells, axis=1)
    jittered[len(kind.names) :] = 0.0  # what was remembered when the recording began is no property of the cell
    for place, name in enumerate(kind.names):
        noise = rng.standard_normal(cells)
        jittered[place] *= np.exp(0.12 * noise) if name.endswith("_s") else 1 + 0.06 * noise
    resistance: FloatArray = rest * (1 + found[-1] + kind.run(jittered, kind.felt(load), dt))
    return resistance
