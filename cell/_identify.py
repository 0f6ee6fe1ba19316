"""Identification: which kind of cell a recording shows, and its parameters with their standard errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.optimize import least_squares

from ..arrays import BoolArray, FloatArray
from ..errors import InputError
from . import _simulate as simulate
from ._features import play_follow
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel
from ._recording import Recording

Simulation = Callable[[np.random.Generator, FloatArray, float], FloatArray]
"""Cells like the identified one, jittered, under loads (n, m) at a time step: resistance (n, m) in ohm"""
POINTS, POINTS_BEFORE_FOLDS = 2000, 1000
"""samples that enter the least squares, of the whole and of a fold with what comes before it; more are thinned"""
ORIGINS = (0.45, 0.65, 0.825)
"""shares of all pressing after which the folds begin: what comes before is fitted, the fold judges"""
PRESSED = 0.05
"""of full scale: half width of the play whose movement counts as pressing"""
FEWEST = 30
"""readings before a fold that are enough to fit"""
STARTS = 3
"""of the starts, those that are nearest to the recording, are followed to the end"""
EXPLAINS = 0.7
"""share of the standard deviation of the resistance that some model must fit better than"""
TAUGHT = 1.2
"""full presses before a fold from which on it tells how well a kind describes the cell, and not how little it needs"""
SIMPLER = 1.05
"""a simpler kind wins when the error of its worst fold is within this factor of the best"""
PRIOR = 0.02
"""residual, over the range of r, that a parameter one width from its usual value counts as: what the recording does not
tell stays usual"""
PRIOR_LOG, PRIOR_PLAIN, PRIOR_REST = 1.5, 0.5, 0.1
"""those widths: of the logarithm of a positive parameter, over its bound for one of either sign, and of R0, relative"""
SEEN_AT_REST, NEVER_AT_REST = 0.15, 0.7
"""share by which the true R0 may be below what was read before the first press, or below the least reading"""
INSTANT_S, RISE2_S = 0.05, 1.0
"""time constant of a branch that is charged at once, and the usual one of the slow branch"""
BEGINS_LOADED, BEGUN = 0.05, 0.5
"""load at which a recording begins, over full scale, from which on what the cell remembers there is fitted too; and how
far each branch may then be from its equilibrium, over the range of r"""
DRIFTS = 1.0
"""share of R0 up to which a drift over the recording is looked for, either way"""
NOISY = 0.1
"""of the variance of noise: squared error beyond noise that is too little for a drift to explain"""
FLATTEST = 0.1
"""of the range of r: slope over full scale that the equilibrium curve of m10 should have everywhere"""


@dataclass(frozen=True)
class Parameter:
    """One identified number."""

    name: str
    value: float
    std_error: float
    identified: bool
    """False where the recording does not say: a time constant beyond half of it, an error above half the value, or R0
    of a cell that it never shows at rest"""


@dataclass(frozen=True)
class Fit:
    """One kind of model fitted to a recording."""

    model: Model
    rest_resistance_ohm: float
    parameters: tuple[Parameter, ...]
    error: float
    """rms of the resistance it leaves, over the range of the resistance, on what was fitted"""
    fold_errors: tuple[float, ...]
    """the same on each fold, fitted on what comes before it"""
    simulate: Simulation
    """jittered cells like it"""
    simulate_folds: tuple[Simulation, ...]
    """the same as fitted before each fold"""
    before_folds: tuple[tuple[Model, float] | None, ...] = ()
    """model and R0 in ohm as fitted before each fold; None: what was found is no valid cell"""
    first_telling: int = 0
    """the first fold before which enough was pressed to fit a model at all"""
    drift: Drift | None = None
    """of R0, by the richest model; None: of the other kinds"""

    @property
    def label(self) -> str:
        """The kind, and whether its chains never break: m10 is fitted with and without such chains."""
        unbroken = isinstance(self.model, M10Model) and self.model.k == 0
        return "m10, k = 0" if unbroken else self.model.kind

    @property
    def held_out_error(self) -> float:
        """That of the worst of the folds that tell."""
        return max(self.fold_errors[self.first_telling :])


@dataclass(frozen=True)
class Drift:
    """A steady change of R0 from the begin of a recording to its end, fitted with all the rest of a model."""

    share: float
    """of R0 at the begin"""
    std_error: float
    unexplained: float
    """squared error beyond noise that the model with the drift leaves, over that of the model without; 1 where the
    latter leaves hardly more than noise"""


@dataclass(frozen=True)
class Fold:
    """A part of a recording, in seconds of its time: rolling-origin evaluation fits what comes before it."""

    start_s: float
    end_s: float


@dataclass(frozen=True)
class _Grid:
    """A recording on a uniform, thinned time grid, normalised."""

    dt_s: float
    load: FloatArray
    r: FloatArray
    fitted: int
    """samples that count in the fit; the ones after it are predicted"""


@dataclass(frozen=True)
class _Kind:
    """How a kind of model is fitted: free parameters, which of them are positive, bounds, starts."""

    kind: str
    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    starts: tuple[tuple[float, ...], ...]
    """the first is what is usual for a recording of that range of r, and what the prior holds to"""
    size: float
    """range of r in the recording"""
    run: Callable[[FloatArray, FloatArray, float], FloatArray]
    """parameters (p, m), load (n,) or (n, m) as ``felt``, dt -> r (n, m), without the offset of R0"""
    begun: int = 0
    """how many parameters, after those with names, are what branches and chains remember as the recording begins"""
    felt: Callable[[FloatArray], FloatArray] = lambda load: load
    """the load (n, m) or (n,) as this kind takes it: worked out once, for any number of parameters"""


_Richer = Callable[[tuple[float, ...]], tuple[float, ...]]
"""a solution as one of the richer kind that is fitted next"""


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


def pressing(recording: Recording, full_scale_kpa: float) -> FloatArray:
    """(n,) path length of the normalised load up to each sample: a press to full scale and its release add 2.

    The load passes a play (Prandtl's) first, so that noise does not add to the path.
    """
    load = recording.quiet.pressure_kpa[:, None] / full_scale_kpa
    followed = play_follow(load, PRESSED)[:, 0]
    path: FloatArray = np.cumsum(np.abs(np.diff(followed, prepend=followed[0])))
    return path


def folds(recording: Recording, full_scale_kpa: float) -> tuple[Fold, ...]:
    """Consecutive folds that each have a share of all :func:`pressing`, however long the rests between.

    Raises:
        InputError: a fold, or what comes before the first, has hardly any readings: most of the time is a gap.
    """
    moved = pressing(recording, full_scale_kpa)
    moved += 1e-9 * np.arange(len(moved))
    at = np.searchsorted(moved, np.array(ORIGINS) * moved[-1]).clip(1, len(moved) - 1)
    time = recording.time_s
    step = recording.step_s
    starts = time[at]
    ends = np.append(starts[1:], time[-1] + step)
    found = tuple(Fold(float(a), float(b)) for a, b in zip(starts, ends, strict=True) if b > a)
    expected = (time[-1] - time[0]) / step
    before = int(np.count_nonzero(time < found[0].start_s))
    longest = float(np.diff(time).max())
    if before < FEWEST or longest > 0.5 * (time[-1] - time[0]) or len(time) < 0.1 * expected:
        raise InputError(
            f"{recording.name}: {before} of {len(time)} readings come before the last half of its presses, and the "
            f"longest gap is {longest:.3g} s of {time[-1] - time[0]:.3g} s; expected presses throughout the recording, "
            "without a gap that takes up most of it"
        )
    return found


def recovery_branches(
    time_s: FloatArray, r: FloatArray, released_kpa: float
) -> tuple[float, float, float, float, float]:
    """The paper's graphical way (P6, equation 9): E1, E2, E3, T2, T3 from a recovery curve.

    Args:
        time_s: (n,) from the last loaded sample on, the cell unloaded from the second sample.
        r: (n,) normalised resistance, in equilibrium at the first sample.
        released_kpa: the pressure that was released.

    The slow branch is the straight line that log r becomes, the fast branch the line that log of the remainder
    becomes, the elastic one what went at once. Raises InputError if the curve does not decay.
    """
    t = time_s[1:] - time_s[1]
    left = r[1:]
    slow_gain, slow = _line(t, left, t >= 0.5 * t[-1])
    rest = left - slow_gain * np.exp(-t / slow)
    fast_gain, fast = _line(t, rest, (rest > 0.1 * rest[0]) & (t <= 0.5 * t[-1]))
    gains = np.array([r[0] - fast_gain - slow_gain, fast_gain, slow_gain])
    if not (gains > 0).all() or not fast < slow:
        raise InputError("the recovery curve is not an instant part and two decays, the slower one smaller")
    e1, e2, e3 = (released_kpa / gains).tolist()
    return e1, e2, e3, fast, slow


def _line(t: FloatArray, y: FloatArray, where: BoolArray) -> tuple[float, float]:
    usable = where & (y > 0)
    if np.count_nonzero(usable) < 3:
        raise InputError("the recovery curve has too few samples above zero to read a decay from")
    slope, log_gain = np.polyfit(t[usable], np.log(y[usable]), 1, w=y[usable])
    if not slope < 0:
        raise InputError("the recovery curve does not decay")
    return float(np.exp(log_gain)), float(-1 / slope)


def longest_recovery(recording: Recording, full_scale_kpa: float) -> slice | None:
    """The samples of the longest stay at no load after a press, from the last loaded sample on."""
    idle = np.abs(recording.pressure_kpa) < 0.05 * full_scale_kpa
    edges = np.flatnonzero(np.diff(idle.astype(int), prepend=0, append=0))
    runs = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a > 0 and b - a > 20]
    if not runs:
        return None
    start, stop = max(runs, key=lambda run: recording.time_s[run[1] - 1] - recording.time_s[run[0]])
    return slice(int(start) - 1, int(stop))


def fits(recording: Recording, full_scale_kpa: float, told: Callable[[str], None] = lambda what: None) -> list[Fit]:
    """Every kind that can describe the recording, the best first.

    Best is the simplest whose held-out error is within 5 % of the least one. ``told`` hears of each kind that is done.

    Raises:
        InputError: the resistance does not follow the pressure.
    """
    rest, lower = rest_resistance(recording, full_scale_kpa)
    load = recording.pressure_kpa / full_scale_kpa
    if np.corrcoef(load, np.log(recording.resistance_ohm))[0, 1] < -0.3:
        found = [_fit_contact(recording, full_scale_kpa, rest)]
    else:
        start = _start(recording, full_scale_kpa, rest)
        size = float(np.ptp(np.percentile(recording.resistance_ohm, [0.5, 99.5])) / rest)
        begun = bool(recording.quiet.pressure_kpa[0] > BEGINS_LOADED * full_scale_kpa)
        task = _Task(recording, full_scale_kpa, rest, lower, folds(recording, full_scale_kpa))
        kinds = _asymmetric_kind(start, size, begun), _whole_kind(start, size, begun), _m10_kind(start, size, begun)
        asymmetric, branches = _fit(kinds[0], task, [])
        told("fitted asymmetric")
        # What contains another kind is started from where that one ended too, so that it never fits worse.
        paper, _ = _fit(
            _paper_kind(start, size), task, [(*solution[:5], 0.2, 5.0, solution[-1]) for solution in branches]
        )
        told("fitted paper")
        whole, unbroken = _fit(kinds[1], task, [_asymmetric_as_whole(one) for one in branches])
        m10, broken = _fit(kinds[2], task, [_whole_as_m10(one, size) for one in unbroken])
        richer: tuple[_Richer, ...] = _asymmetric_as_whole, lambda one: _whole_as_m10(one, size), lambda one: one
        optima = branches[-1], unbroken[-1], broken[-1]
        m10 = replace(m10, drift=_find_drift(list(zip(kinds, optima, richer, strict=True)), task))
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

    def grid(self, until_s: float, end_s: float) -> _Grid:
        """The recording before ``end_s``, of which the part before ``until_s`` counts as fitted."""
        recording = self.recording
        time = recording.time_s
        last = min(end_s, float(time[-1]))
        points = POINTS if until_s >= time[-1] else POINTS_BEFORE_FOLDS
        dt = max(recording.step_s, (last - time[0]) / points)
        at = np.arange(time[0], last + 1e-9 * dt, dt)
        quiet = recording.quiet
        load, r = quiet.pressure_kpa / self.full_scale_kpa, quiet.resistance_ohm / self.rest_ohm - 1
        fitted = int(np.searchsorted(at, until_s))
        return _Grid(dt, np.interp(at, time, load), np.interp(at, time, r), max(2, min(fitted, len(at))))


def _fit(kind: _Kind, task: _Task, nested: list[tuple[float, ...]]) -> tuple[Fit, list[tuple[float, ...]]]:
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
        solution, _ = _solve(kind, grid, starts, task.lower)
        solutions.append(solution)
        left = (_predict(kind, solution, grid) - grid.r)[grid.fitted :]
        errors.append(float(np.sqrt(np.mean(left**2)) / spread) if left.size else np.inf)

    whole = task.grid(np.inf, np.inf)
    found, covariance = _solve(kind, whole, [kind.starts[0], tuple(solutions[-1]), *nested[-1:]], task.lower)
    error = float(np.sqrt(np.mean((_predict(kind, found, whole) - whole.r) ** 2)) / spread)
    offset = float(found[-1])
    model = _model(kind.kind, found, task.full_scale_kpa)
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


def _find_drift(models: Sequence[tuple[_Kind, tuple[float, ...], _Richer]], task: _Task) -> Drift:
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
        drifting = _drifting(kind)
        starts = [drifting.starts[0], _with_drift(found, count, 0.0), *nested]
        fitted, covariance = _solve(drifting, grid, starts, task.lower)
        noise = simulate.white_noise(grid.r) ** 2
        without = float(np.mean((_predict(kind, np.array(found), grid) - grid.r) ** 2)) - noise
        left = float(np.mean((_predict(drifting, fitted, grid) - grid.r) ** 2)) - noise
        unexplained = max(left, 0.0) / without if without > NOISY * noise else 1.0
        drift = Drift(float(fitted[count]), float(np.sqrt(covariance[count, count])), unexplained)
        plain = richer(tuple(np.delete(fitted, count).tolist()))
        nested = [_with_drift(plain, count + len(plain) - len(found), drift.share)]
    return drift


def _drifting(kind: _Kind) -> _Kind:
    """The same kind of cells with a drift of R0 as one more parameter, after those with names."""
    count = len(kind.names)

    def run(parameters: FloatArray, load: FloatArray, dt: float) -> FloatArray:
        r = kind.run(np.delete(parameters, count, axis=0), load, dt)
        return _drifted(parameters[count], r)

    return replace(
        kind,
        names=(*kind.names, "drift"),
        low=(*kind.low, -DRIFTS),
        high=(*kind.high, DRIFTS),
        starts=tuple((*start, 0.0) for start in kind.starts),
        run=run,
    )


def _with_drift(solution: tuple[float, ...], count: int, share: float) -> tuple[float, ...]:
    """A solution with a drift after its ``count`` parameters with names."""
    return *solution[:count], share, *solution[count:]


def _drifted(drift: FloatArray, r: FloatArray) -> FloatArray:
    """r (n, m), relative to R0 at the begin, of cells whose R0 changes steadily by a share ``drift`` (m,) of it."""
    return np.asarray((1 + r) * (1 + np.linspace(0, 1, len(r))[:, None] * drift) - 1)


def _asymmetric_as_whole(solution: tuple[float, ...]) -> tuple[float, ...]:
    """The same cell in the richer model: nothing is curved, and the slow branch is charged at once."""
    a, alpha1, fall1, alpha2, fall2, *recording = solution
    return a, 0.0, alpha1, INSTANT_S, fall1, alpha2, INSTANT_S, fall2, *recording


def _whole_as_m10(solution: tuple[float, ...], size: float) -> tuple[float, ...]:
    """The same cell in the richer model: hardly a chain breaks."""
    count = len(simulate.M10_PARAMETERS) - 2
    *branches, offset = solution[count:]
    return *solution[:count], 1e-3 * size, 30.0, *branches, *[0.0] * (len(branches) // 2), offset


def _too_slow(name: str, value: float, duration_s: float) -> bool:
    return name.endswith("_s") and value > duration_s / 2


def _predict(kind: _Kind, parameters: FloatArray, grid: _Grid) -> FloatArray:
    load = kind.felt(grid.load)
    predicted: FloatArray = kind.run(parameters[:-1, None], load, grid.dt_s)[:, 0] + parameters[-1]
    return predicted


def _solve(kind: _Kind, grid: _Grid, starts: list[tuple[float, ...]], lower: float) -> tuple[FloatArray, FloatArray]:
    """Least squares from every start; the best parameters (the offset last) and their covariance."""
    remembered = np.full(kind.begun, BEGUN * kind.size)
    low, high = np.array([*kind.low, *-remembered, -lower]), np.array([*kind.high, *remembered, 0.15])
    positive = low > 0
    fitted = slice(0, grid.fitted)
    load = kind.felt(grid.load[fitted])
    step = 1e-5

    def natural(q: FloatArray) -> FloatArray:
        return np.where(positive.reshape(-1, *(1,) * (q.ndim - 1)), np.exp(np.where(np.abs(q) < 700, q, 0)), q)

    def free(p: FloatArray) -> FloatArray:
        return np.where(positive, np.log(np.where(positive, p, 1.0)), p)

    def responses(q: FloatArray) -> FloatArray:
        p = natural(q)
        fit = kind.run(p[:-1], load, grid.dt_s) + p[-1]
        unusual = PRIOR * spread * (q - centre[:, None]) / width[:, None]
        return np.concatenate([fit, _falling(kind, p) * np.sqrt(grid.fitted) * 0.3, unusual])

    target = np.concatenate([grid.r[fitted], np.zeros(9 + len(low))])

    def residual(q: FloatArray) -> FloatArray:
        left: FloatArray = responses(q[:, None])[:, 0] - target
        return left

    def jacobian(q: FloatArray) -> FloatArray:
        tried = responses(np.column_stack([q, q[:, None] + step * np.eye(len(q))]))
        slopes: FloatArray = (tried[:, 1:] - tried[:, :1]) / step
        return slopes

    bounds = free(low), free(high)
    spread = float(np.ptp(grid.r[fitted]))
    centre = free(np.clip(_padded(kind.starts[0], len(low)), low, high))
    width = np.where(positive, PRIOR_LOG, PRIOR_PLAIN * np.abs(high))
    width[-1] = PRIOR_REST
    best: Any = None
    begins = []
    for start in starts:
        first = np.clip(_padded(start, len(low)), low, high)
        begins.append(np.clip(free(first), bounds[0] + 1e-6, bounds[1] - 1e-6))
    errors = ((responses(np.column_stack(begins)) - target[:, None]) ** 2).sum(axis=0)
    for place in np.argsort(errors)[:STARTS]:
        first = begins[place]
        found = least_squares(residual, first, jacobian, bounds=bounds, x_scale="jac", max_nfev=30)
        if best is None or found.cost < best.cost:
            best = found
    j = best.jac
    left = best.fun[: grid.fitted]
    scale = np.mean(left**2) * _correlation_length(left)
    covariance = np.linalg.pinv(j.T @ j) * scale
    value = natural(best.x)
    unit = np.where(positive, value, 1.0)
    return value, covariance * np.outer(unit, unit)


def _padded(start: tuple[float, ...], count: int) -> FloatArray:
    """Parameters followed by as many zeros as are missing."""
    return np.array([*start, *[0.0] * (count - len(start))])


def _correlation_length(left: FloatArray) -> float:
    """Samples per independent one: model error is not white, and standard errors that say so are wider."""
    around = left - left.mean()
    power = np.abs(np.fft.rfft(around, 2 * len(around))) ** 2
    correlation = np.fft.irfft(power)[: len(around)] / max(float(around @ around), 1e-300)
    until = int(np.argmax(correlation < 0.05)) or len(correlation)
    return float(1 + 2 * np.sum(correlation[1:until]))


def _falling(kind: _Kind, p: FloatArray) -> FloatArray:
    """(9, m) how much the equilibrium curve falls short of rising: it is what the static answer rests on."""
    if kind.kind not in ("m10", "whole"):
        return np.zeros((9, p.shape[1]))
    names = dict(zip(kind.names, p, strict=False))
    load = np.linspace(0, 1, 9)[:, None]
    slope = names["a"] + 2 * names["b"] * load + names["alpha1"] + names["alpha2"]
    shortfall: FloatArray = np.minimum(slope - FLATTEST * kind.size, 0.0)
    return shortfall


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


def _m10_kind(start: tuple[float, ...], size: float, begun: bool) -> _Kind:
    whole = _whole_kind(start, size, begun)
    count = len(simulate.M10_PARAMETERS)

    def run(parameters: FloatArray, load: FloatArray, dt: float) -> FloatArray:
        return simulate.m10(parameters[:count], _columns(load), dt, parameters[count:] if begun else None)

    _, graphical, slow = whole.starts
    return _Kind(
        kind="m10",
        names=simulate.M10_PARAMETERS,
        low=(*whole.low, 1e-4 * size, 1.0),
        high=(*whole.high, 3 * size, 300.0),
        starts=(
            (0.35 * size, -0.6 * size, size, 0.4, 5.0, 0.2 * size, RISE2_S, 100.0, 0.2 * size, 30.0),
            (*graphical, 0.1 * size, 5.0),
            (*slow, 0.01 * size, 30.0),
        ),
        size=size,
        run=run,
        begun=3 if begun else 0,
    )


def _whole_kind(start: tuple[float, ...], size: float, begun: bool) -> _Kind:
    """Kind m10 whose chains never break."""
    g1, g2, g3, t2, t3 = start
    count = len(simulate.M10_PARAMETERS) - 2

    def run(parameters: FloatArray, load: FloatArray, dt: float) -> FloatArray:
        none = np.zeros((2, parameters.shape[1]))
        none[1] = 30.0
        full = np.concatenate([parameters[:count], none])
        return simulate.m10(full, _columns(load), dt, _unbroken(parameters[count:]))

    return _Kind(
        kind="whole",
        names=simulate.M10_PARAMETERS[:-2],
        low=(-2 * size, -2 * size, 1e-4 * size, 0.02, 0.2, 1e-4 * size, 0.02, 3.0),
        high=(4 * size, 2 * size, 5 * size, 20.0, 100.0, 5 * size, 3000.0, 3000.0),
        starts=(
            (0.5 * size, 0.0, 0.3 * size, 0.4, 5.0, 0.2 * size, RISE2_S, 100.0),
            (g1, -0.05 * size, g2, 0.1, t2, g3, INSTANT_S, t3),
            (0.7 * size, 0.0, 0.2 * size, 3.0, 3.0, 0.2 * size, 60.0, 60.0),
        ),
        size=size,
        run=run,
        begun=2 if begun else 0,
    )


def _asymmetric_kind(start: tuple[float, ...], size: float, begun: bool) -> _Kind:
    g1, g2, g3, t2, t3 = start

    def run(parameters: FloatArray, load: FloatArray, dt: float) -> FloatArray:
        a, alpha1, fall1, alpha2, fall2 = parameters[:5]
        zero, instant = np.zeros_like(a), np.full_like(a, INSTANT_S)
        full = np.stack([a, zero, alpha1, instant, fall1, alpha2, instant, fall2, zero, instant])
        return simulate.m10(full, _columns(load), dt, _unbroken(parameters[5:]))

    return _Kind(
        kind="asymmetric",
        names=("gain1", "gain2", "fall2_s", "gain3", "fall3_s"),
        low=(1e-4 * size, 1e-4 * size, 0.2, 1e-4 * size, 3.0),
        high=(5 * size, 5 * size, 100.0, 5 * size, 3000.0),
        starts=((0.5 * size, 0.4 * size, 5.0, 0.1 * size, 100.0), (g1, g2, t2, g3, t3)),
        size=size,
        run=run,
        begun=2 if begun else 0,
    )


def _unbroken(begun: FloatArray) -> FloatArray | None:
    """What branches (2, m) or (0, m) remember at first, as :func:`.simulate.m10` takes it."""
    return np.concatenate([begun, np.zeros((1, begun.shape[1]))]) if len(begun) else None


def _paper_kind(start: tuple[float, ...], size: float) -> _Kind:
    g1, g2, g3, t2, t3 = start

    def felt(load: FloatArray) -> FloatArray:
        columns = _columns(load)
        noise = 4 * simulate.white_noise(columns[:, 0])  # would hand over at every sample
        return play_follow(columns, noise)

    def run(parameters: FloatArray, load: FloatArray, dt: float) -> FloatArray:
        return simulate.paper(parameters, _columns(load), dt)

    return _Kind(
        kind="paper",
        names=simulate.PAPER_PARAMETERS,
        low=(1e-4 * size, 1e-4 * size, 0.2, 1e-4 * size, 3.0, 1e-3, 0.1),
        high=(5 * size, 5 * size, 100.0, 5 * size, 3000.0, 3.0, 300.0),
        starts=((0.5 * size, 0.4 * size, 5.0, 0.1 * size, 100.0, 0.2, 5.0), (g1, g2, t2, g3, t3, 0.2, 5.0)),
        size=size,
        run=run,
        felt=felt,
    )


def _columns(load: FloatArray) -> FloatArray:
    return load[:, None] if load.ndim == 1 else load


def _model(kind: str, found: FloatArray, full_scale_kpa: float) -> Model:
    """The section of CELL.toml; gains are divided by 1 + offset, since r is taken from the corrected R0."""
    unit = 1 + found[-1]
    try:
        if kind in ("m10", "whole"):
            count = len(simulate.M10_PARAMETERS) - (2 if kind == "whole" else 0)
            values = dict(zip(simulate.M10_PARAMETERS[:count], map(float, found), strict=False))
            values.setdefault("k", 0.0)
            for name in ("a", "b", "alpha1", "alpha2", "k"):
                values[name] /= unit
            return M10Model.model_validate(values)
        g1, g2, t2, g3, t3 = found[:5]
        (g2, t2), (g3, t3) = sorted(((g2, t2), (g3, t3)), key=lambda branch: branch[1])
        e1, e2, e3 = (float(full_scale_kpa * unit / gain) for gain in (g1, g2, g3))
        burgers = {"e1_kpa": e1, "e2_kpa": e2, "e3_kpa": e3, "eta2_kpa_s": e2 * float(t2), "eta3_kpa_s": e3 * float(t3)}
        if kind == "asymmetric":
            return AsymmetricModel.model_validate(burgers | {"rise_s": INSTANT_S})
        eu1 = 1 / (1 / e1 + 1 / e2 + 1 / e3)
        etau2 = eu1 / float(found[5])
        rising = {"eu1_kpa": eu1, "etau2_kpa": etau2, "eu2_kpa_per_s": etau2 / float(found[6])}
        return PaperModel.model_validate(burgers | rising)
    except ValidationError as error:
        raise InputError(f"no {kind} cell fits the recording: {error.errors()[0]['msg']}") from error


def _valid_model(kind: _Kind, found: FloatArray, task: _Task) -> tuple[Model, float] | None:
    """The model and R0 in ohm, or None if the parameters make no valid cell."""
    try:
        return _model(kind.kind, found, task.full_scale_kpa), task.rest_ohm * (1 + float(found[-1]))
    except InputError:
        return None


def _simulation(kind: _Kind, found: FloatArray, rest: float) -> Simulation:
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


def _fit_contact(recording: Recording, full_scale_kpa: float, rest: float) -> Fit:
    """P2: log of the contact's conductance against log of the load, where the load is felt."""
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

    def simulation(rng: np.random.Generator, loads: FloatArray, dt: float) -> FloatArray:
        resistance: FloatArray = 1 / (1 / rest + np.maximum(loads, 0) ** found[0] / found[1])
        return resistance

    return Fit(
        model=model,
        rest_resistance_ohm=rest,
        parameters=tuple(
            Parameter(name, float(value), float(error), bool(error < 0.5 * abs(value)))
            for name, value, error in zip(("exponent", "full_scale_resistance_ohm"), found, std, strict=True)
        ),
        error=left(found, np.ones_like(felt)),
        fold_errors=tuple(errors),
        simulate=simulation,
        simulate_folds=(simulation,) * len(errors),
    )
