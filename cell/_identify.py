"""Identification: which kind of cell a recording shows, and its parameters with their standard errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..arrays import FloatArray
from ..errors import InputError
from ._contact import fit_contact
from ._drift import Richer, find_drift
from ._fitted import Fit, Parameter, Simulation
from ._folds import folds
from ._graphical import start_values
from ._grid import SEEN_AT_REST, Task, rest_resistance
from ._kinds import Kind, asymmetric_as_whole, asymmetric_kind, m10_kind, model_of, paper_kind, whole_as_m10, whole_kind
from ._least_squares import predict, solve
from ._models import Model
from ._recording import Recording

EXPLAINS = 0.7
"""share of the standard deviation of the resistance that some model must fit better than"""
SIMPLER = 1.05
"""a simpler kind wins when the error of its worst fold is within this factor of the best"""
BEGINS_LOADED = 0.05
"""load at which a recording begins, over full scale, from which on what the cell remembers there is fitted too"""


def fits(recording: Recording, full_scale_kpa: float, told: Callable[[str], None] = lambda what: None) -> list[Fit]:
    """Every kind that can describe the recording, the best first.

    Best is the simplest whose held-out error is within 5 % of the least one. ``told`` hears of each kind that is done.

    Raises:
        InputError: the resistance does not follow the pressure.
    """
    rest, lower = rest_resistance(recording, full_scale_kpa)
    load = recording.pressure_kpa / full_scale_kpa
    if np.corrcoef(load, np.log(recording.resistance_ohm))[0, 1] < -0.3:
        found = [fit_contact(recording, full_scale_kpa, rest)]
    else:
        start = start_values(recording, full_scale_kpa, rest)
        size = float(np.ptp(np.percentile(recording.resistance_ohm, [0.5, 99.5])) / rest)
        begun = bool(recording.quiet.pressure_kpa[0] > BEGINS_LOADED * full_scale_kpa)
        task = Task(recording, full_scale_kpa, rest, lower, folds(recording, full_scale_kpa))
        kinds = asymmetric_kind(start, size, begun), whole_kind(start, size, begun), m10_kind(start, size, begun)
        asymmetric, branches = _fit(kinds[0], task, [])
        told("fitted asymmetric")
        # What contains another kind is started from where that one ended too, so that it never fits worse.
        paper, _ = _fit(
            paper_kind(start, size), task, [(*solution[:5], 0.2, 5.0, solution[-1]) for solution in branches]
        )
        told("fitted paper")
        whole, unbroken = _fit(kinds[1], task, [asymmetric_as_whole(one) for one in branches])
        m10, broken = _fit(kinds[2], task, [whole_as_m10(one, size) for one in unbroken])
        richer: tuple[Richer, ...] = asymmetric_as_whole, lambda one: whole_as_m10(one, size), lambda one: one
        optima = branches[-1], unbroken[-1], broken[-1]
        m10 = replace(m10, drift=find_drift(list(zip(kinds, optima, richer, strict=True)), task))
        told("fitted m10")
        found = [asymmetric, paper, whole, m10]
    least = min(fit.held_out_error for fit in found)
    blind = float(np.std(recording.resistance_ohm) / np.ptp(recording.resistance_ohm))
    left = min(fit.error for fit in found)
    if not left < EXPLAINS * blind:
        raise InputError(
            f"{recording.name}: the resistance does not follow the pressure: the best model leaves "
            f"{100 * left:.0f} % of its range, knowing nothing {100 * blind:.0f} %; are the columns right, "
            "and is the noise smaller than what the load does?"
        )
    best = next(fit for fit in found if fit.held_out_error <= SIMPLER * least)
    return [best, *sorted((fit for fit in found if fit is not best), key=lambda fit: fit.held_out_error)]


def _fit(kind: Kind, task: Task, nested: list[tuple[float, ...]]) -> tuple[Fit, list[tuple[float, ...]]]:
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
        left = (predict(kind, solution, grid) - grid.r)[grid.fitted :]
        errors.append(float(np.sqrt(np.mean(left**2)) / spread) if left.size else np.inf)

    whole = task.grid(np.inf, np.inf)
    found, covariance = solve(kind, whole, [kind.starts[0], tuple(solutions[-1]), *nested[-1:]], task.lower)
    error = float(np.sqrt(np.mean((predict(kind, found, whole) - whole.r) ** 2)) / spread)
    offset = float(found[-1])
    model = model_of(kind.kind, found, task.full_scale_kpa)
    duration = recording.time_s[-1] - recording.time_s[0]
    *deviations, rest_error = np.sqrt(np.diag(covariance)).tolist()
    parameters = [
        Parameter(name, float(value), std, std < 0.5 * abs(value) and not _too_slow(name, value, duration))
        for name, value, std in zip(kind.names, found, deviations, strict=False)
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
        simulate=_simulation(kind, found, rest),
        simulate_folds=tuple(_simulation(kind, solution, rest) for solution in solutions),
        before_folds=tuple(_valid_model(kind, solution, task) for solution in solutions),
        first_telling=task.first_telling,
    )
    return fit, [tuple(map(float, solution)) for solution in (*solutions, found)]


def _too_slow(name: str, value: float, duration_s: float) -> bool:
    return name.endswith("_s") and value > duration_s / 2


def _valid_model(kind: Kind, found: FloatArray, task: Task) -> tuple[Model, float] | None:
    """The model and R0 in ohm, or None if the parameters make no valid cell."""
    try:
        return model_of(kind.kind, found, task.full_scale_kpa), task.rest_ohm * (1 + float(found[-1]))
    except InputError:
        return None


def _simulation(kind: Kind, found: FloatArray, rest: float) -> Simulation:
    """Cells like the identified one, gains known to 6 %, times to 12 %."""

    def run(rng: np.random.Generator, load: FloatArray, dt: float) -> FloatArray:
        cells = load.shape[1]
        jittered = np.repeat(found[:-1, None], cells, axis=1)
        jittered[len(kind.names) :] = 0.0  # what was remembered when the recording began is no property of the cell
        for place, name in enumerate(kind.names):
            noise = rng.standard_normal(cells)
            jittered[place] *= np.exp(0.12 * noise) if name.endswith("_s") else 1 + 0.06 * noise
        resistance: FloatArray = rest * (1 + found[-1] + kind.run(jittered, kind.felt(load), dt))
        return resistance

    return run
