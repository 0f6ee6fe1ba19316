"""Fits of the kinds of cell to a recording, and to the part before each of its folds; parameters with their errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from ...common.arrays import FloatArray
from ...errors import InputError
from ..materials import ContactModel, Model, white_noise
from ._fitted import Drift, Fit, Parameter
from ._folds import Fold
from ._kinds import M10, PAPER, model_of, parameters, simulated
from ._projection import STARTS_BEFORE_FOLDS, Grid, Kind, Solution, correlation_length, predict, solve
from ._recording import Recording

MOST_STEPS = 40_000
"""largest number of time steps of the load in a simulation"""
SIMPLER = 1.05
"""the simpler kind, the paper's, is preferred if its error is within this factor of the other's"""
FALLS = -0.3
"""correlation of the load with the logarithm of the resistance, below which the load lowers the resistance"""
SEEN_AT_REST, AT_REST_S = 0.05, 1.0
"""R0 counts as seen if it is known to this fraction, and if the recording begins with so many seconds without load"""
BEGINS_LOADED = 0.05
"""initial load over full scale, beyond which the initial memory of the cell is fitted, too"""
NEAR_STEPS = 2.0
"""distance to the nearest reading, in time steps of the recording, within which the resistance counts as read"""
NOISY = 0.1
"""fraction of the variance of noise; a smaller squared error beyond noise is too small to test a drift with"""
STEEPEST, FELT = 4.0, 0.05
"""largest exponent of a contact, and least share of full scale at which its conductance tells its power law"""


@dataclass(frozen=True)
class Task:
    """A recording as the fits take it."""

    recording: Recording
    full_scale_kpa: float
    rest_ohm: float
    seen_at_rest: bool
    grid: Grid
    start_s: float

    @classmethod
    def of(cls, recording: Recording, full_scale_kpa: float) -> Task:
        """The recording on a uniform time grid, normalised."""
        rest, seen = rest_resistance(recording, full_scale_kpa)
        time, quiet = recording.time_s, recording.quiet
        dt = max(recording.step_s, (time[-1] - time[0]) / MOST_STEPS)
        at = np.arange(time[0], time[-1] + 1e-9 * dt, dt)
        load = np.interp(at, quiet.loads.time_s, quiet.loads.pressure_kpa) / full_scale_kpa
        r = np.interp(at, time, quiet.resistance_ohm) / rest - 1
        read = quiet.near_reading(at, max(dt, NEAR_STEPS * recording.step_s))
        return cls(recording, full_scale_kpa, rest, seen, Grid(dt, load, r, read), float(time[0]))

    def sample(self, time_s: float) -> int:
        """Number of samples before a time."""
        return int(np.clip(np.ceil((time_s - self.start_s) / self.grid.dt_s - 1e-9), 2, len(self.grid.r)))

    def free(self, kind: Kind, *, drift: bool = False) -> Callable[[FloatArray], FloatArray]:
        """Columns with coefficients of either sign: R0, its drift, and the memory with which a recording begins."""
        seconds = self.grid.dt_s * np.arange(len(self.grid.r))
        columns = [np.ones_like(seconds)]
        if drift:
            columns.append((1 + self.grid.r) * seconds / max(seconds[-1], 1e-9))
        begun = kind is M10 and self.grid.load[0] > BEGINS_LOADED

        def made(times_s: FloatArray) -> FloatArray:
            memory = [np.exp(-seconds / times_s[place]) for place in (1, 3, 4)] if begun else []
            return np.stack([*columns, *memory], axis=1)

        return made


def fits(task: Task, folds: tuple[Fold, ...], told: Callable[[str], None] = lambda what: None) -> list[Fit]:
    """Fits of every kind of cell whose readings rise under load to the recording, the best first.

    The best is the paper's kind if its error is within 5 % of the other's: the held-out error, or where the recording
    has no folds, the error on all of it with the penalty of the Bayesian information criterion (Schwarz, "Estimating
    the dimension of a model", 1978). ``told`` is called after each kind.
    """
    found = []
    for kind in (PAPER, M10):
        found.append(_fit(kind, task, folds))
        told(f"fitted {kind.name}")
    if found[0].judged_error > SIMPLER * found[1].judged_error:
        found.reverse()
    return found


def _fit(kind: Kind, task: Task, folds: tuple[Fold, ...]) -> Fit:
    """Fit the part before each fold, then the whole recording; each fit also starts from the last solution."""
    grid, free, count = task.grid, task.free(kind), len(task.grid.r)
    spread = float(np.ptp(grid.r[grid.read]))
    solutions: list[Solution] = []
    errors = []
    for fold in folds:
        start, end = task.sample(fold.start_s), task.sample(fold.end_s)
        before = [one.times_s for one in solutions[-1:]]
        solutions.append(solve(kind, grid, start, free, best=STARTS_BEFORE_FOLDS, starts=before))
        left = (predict(solutions[-1], grid, free, end) - grid.r[:end])[start:][grid.read[start:end]]
        errors.append(float(np.sqrt(np.mean(left**2)) / spread) if left.size else np.inf)
    whole = solve(kind, grid, count, free, starts=[one.times_s for one in solutions[-1:]])
    residual = (predict(whole, grid, free, count) - grid.r)[grid.read]
    return Fit(
        model=model_of(whole, task.full_scale_kpa),
        rest_resistance_ohm=task.rest_ohm * (1 + whole.offset),
        parameters=_parameters(whole, task),
        error=float(np.sqrt(np.mean(residual**2)) / spread),
        fold_errors=tuple(errors),
        simulate=partial(simulated, whole, task.rest_ohm),
        simulate_folds=tuple(partial(simulated, one, task.rest_ohm) for one in solutions),
        before_folds=tuple(_valid_model(one, task) for one in solutions),
        penalty=_penalty(residual, len(kind.gains) + len(kind.times)),
    )


def _penalty(residual: FloatArray, count: int) -> float:
    """The criterion n ln(error^2) + p ln(n) orders as error * n^(p / 2n) does, with n independent samples."""
    n = max(len(residual) / correlation_length(residual), 2.0)
    return float(n ** (count / (2 * n)))


def _parameters(solution: Solution, task: Task) -> tuple[Parameter, ...]:
    """Named parameters with their standard errors."""
    deviation = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
    times = len(solution.times_s)
    known = dict(zip(solution.kind.times, solution.times_s * deviation[:times], strict=True))
    of_gains = dict(zip(solution.kind.gains, deviation[times:], strict=False))
    if solution.kind is M10:
        slopes = of_gains["rest_slope"], of_gains["full_slope"]
        of_gains["a"] = float(np.hypot(slopes[0], np.hypot(of_gains["alpha1"], of_gains["alpha2"])))
        of_gains["b"] = float(np.hypot(*slopes)) / 2
    known |= of_gains
    if "overshoot" in known:
        known["overshoot"] /= max(float(solution.gains[:3].sum()), 1e-9)
    duration = float(task.recording.time_s[-1] - task.recording.time_s[0])
    found = []
    for name, value in parameters(solution).items():
        slow = name.endswith("_s") and value > duration / 2
        found.append(Parameter(name, value, float(known[name]), bool(known[name] < 0.5 * abs(value)) and not slow))
    # The fitted R0 and the reading at rest are two estimates of one quantity: R0 is known no better than they agree.
    error = float(np.hypot(deviation[times + len(solution.gains)], solution.offset))
    rest = task.rest_ohm * (1 + solution.offset)
    seen = task.seen_at_rest and error < SEEN_AT_REST
    return (*found, Parameter("rest_resistance_ohm", rest, task.rest_ohm * error, seen))


def find_drift(task: Task, times_s: FloatArray) -> Drift:
    """A steady drift of R0, fitted together with every parameter of the richest model.

    A drift changes the readings at rest and under load by the same relative amount. Creep mostly does not. ``times_s``
    are the time constants of that model without a drift.
    """
    grid, count = task.grid, len(task.grid.r)
    noise = white_noise(grid.r[grid.read]) ** 2
    left, starts = [], [times_s]
    for drifts in (False, True):
        free = task.free(M10, drift=drifts)
        solution = solve(M10, grid, count, free, best=0, starts=starts)
        residual = (predict(solution, grid, free, count) - grid.r)[grid.read]
        left.append(float(np.mean(residual**2)) - noise)
    place = len(solution.times_s) + len(solution.gains) + 1
    std = float(np.sqrt(max(solution.covariance[place, place], 0.0)))
    unexplained = max(left[1], 0.0) / left[0] if left[0] > NOISY * noise else 1.0
    return Drift(float(solution.free[1]), std, unexplained)


def falls(recording: Recording) -> bool:
    """Whether the load lowers the resistance."""
    return bool(np.corrcoef(recording.pressure_kpa, np.log(recording.resistance_ohm))[0, 1] < FALLS)


def rest_resistance(recording: Recording, full_scale_kpa: float) -> tuple[float, bool]:
    """R0 in ohm, and whether the recording shows the cell at rest.

    R0 is the median reading before the first press, if that part lasts a second. Else R0 is the reading closest to
    that of no load among those at light load.
    """
    pressure = np.abs(recording.quiet.pressure_kpa)
    pressed = np.flatnonzero(pressure > 0.03 * full_scale_kpa)
    first = int(pressed[0]) if pressed.size else len(pressure)
    if first > 2 and recording.time_s[first - 1] - recording.time_s[0] >= AT_REST_S:
        return float(np.median(recording.resistance_ohm[:first])), True
    light = recording.resistance_ohm[pressure <= max(0.05 * full_scale_kpa, float(np.quantile(pressure, 0.02)))]
    return float(light.max() if falls(recording) else light.min()), False


def fit_contact(recording: Recording, full_scale_kpa: float) -> Fit:
    """Fit a contact's power law (P2): log of its conductance against log of the load, where the load is clear.

    The law describes the cell to an emulator. Loads are read from the calibrated curve, whatever the law leaves.
    """
    load = recording.quiet.pressure_kpa / full_scale_kpa
    rest = rest_resistance(recording, full_scale_kpa)[0]
    rest = max(rest, float(np.quantile(recording.resistance_ohm, 0.99)))
    conductance = 1 / recording.resistance_ohm - 1 / rest
    felt = (load > FELT) & (conductance > 1e-3 / rest)
    if np.count_nonzero(felt) < 10:
        raise InputError(f"{recording.name}: too little of it is pressed to read a contact's power law from")
    (slope, log_g), covariance = np.polyfit(np.log(load[felt]), np.log(conductance[felt]), 1, cov=True)
    exponent = float(np.clip(slope, 0.1, STEEPEST))
    if exponent != slope:
        log_g = float(np.median(np.log(conductance[felt]) - exponent * np.log(load[felt])))
    full_ohm = float(np.exp(-log_g))
    predicted = -np.log(1 / rest + np.maximum(load, 0) ** exponent / full_ohm)
    target = np.log(recording.resistance_ohm)
    std = np.sqrt(np.diag(covariance)) * np.array([1.0, full_ohm])
    found = {"exponent": exponent, "full_scale_resistance_ohm": full_ohm}
    named = zip(found.items(), std.tolist(), strict=True)
    return Fit(
        model=ContactModel.model_validate(found),
        rest_resistance_ohm=rest,
        parameters=tuple(Parameter(name, value, error, error < 0.5 * value) for (name, value), error in named),
        error=float(np.sqrt(np.mean((predicted - target) ** 2)) / np.ptp(target)),
    )


def _valid_model(solution: Solution, task: Task) -> tuple[Model, float] | None:
    """The model and R0 in ohm, or None if the parameters make no valid cell."""
    try:
        return model_of(solution, task.full_scale_kpa), task.rest_ohm * (1 + solution.offset)
    except InputError:
        return None
