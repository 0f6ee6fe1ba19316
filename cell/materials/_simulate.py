"""Fast simulation of whole recordings for many cells at once, for identification and training; random loads and noise.

The equations are those of :mod:`._forward`, on a uniform time grid. An asymmetric lag changes over at the end of a step
instead of within it, which is an order of magnitude faster. A test compares both implementations.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, scatter
from ...common.compiled import Row, Rows, loop
from . import _lag as lag

FEW_CELLS = 8
"""number of cells up to which stepping them one by one is faster than stepping them together, without compiled loops"""
LONGEST_SMOOTHING_S = 0.5
"""standard deviation in seconds of the longest Gaussian window for the signal of a force gauge"""

M10_PARAMETERS = ("a", "b", "alpha1", "rise1_s", "fall1_s", "alpha2", "rise2_s", "fall2_s", "k", "tau_s")


def m10(parameters: FloatArray, load: FloatArray, dt_s: float, begun: FloatArray | None = None) -> FloatArray:
    """Normalised resistance (n, m) of m cells of kind m10.

    Args:
        parameters: (10, m), in the order of ``M10_PARAMETERS``.
        load: (n, m) or (n, 1), pressure / full scale.
        dt_s: the time between samples.
        begun: (3, m) initial state: excess of each branch over its equilibrium at the first load, and contribution of
            broken chains; 0: settled.
    """
    a, b, alpha1, rise1, fall1, alpha2, rise2, fall2, k, tau = parameters
    samples, cells = len(load), parameters.shape[1]
    alpha = np.stack([alpha1, alpha2])
    up, up_ramp = lag.weights(dt_s, np.stack([rise1, rise2]))
    down, down_ramp = lag.weights(dt_s, np.stack([fall1, fall2]))
    gone, ramp = np.stack([up, down]), np.stack([up_ramp, down_ramp])  # (2, 2, m): charging or not, branch, cell
    stay = 1 - gone
    compiled = _step_cells.machine_code()
    if compiled is not None:
        gone_chains, ramp_chains = lag.weights(dt_s, tau)
        state = np.zeros((3, cells))
        state[:2] = alpha * load[0]
        if begun is not None:
            state[:2] += begun[:2]
            state[2] = begun[2]
        found = np.empty((samples, cells))
        weights = np.stack([gone - ramp, ramp, stay]).reshape(12, cells)
        chains = np.stack([k * (1 - ramp_chains), 1 - gone_chains])
        compiled(np.stack([a, b, alpha1, alpha2]), weights, chains, np.ascontiguousarray(load), state, found)
        return found
    target = np.multiply(alpha, load[:, None, :])  # (n, 2, m)
    into = target[:-1, None] * (gone - ramp) + target[1:, None] * ramp
    branches = np.empty((samples, 2, cells))
    begun = np.zeros((3, cells)) if begun is None else begun
    branches[0] = target[0] + begun[:2]
    if cells <= FEW_CELLS:
        for branch, cell in np.ndindex(2, cells):
            charging, discharging = into[:, :, branch, cell].T
            branches[:, branch, cell] = _one_branch(
                float(branches[0, branch, cell]),
                target[1:, branch, cell],
                charging,
                discharging,
                stay[:, branch, cell],
            )
    else:
        _all_branches(target, into, stay, branches)
    gone, ramp = lag.weights(dt_s, tau)
    moved = np.abs(np.diff(load, axis=0, prepend=load[:1])) * (k * (1 - ramp))
    moved[0] = begun[2]
    broken = _recursions(moved, 1 - gone, np.zeros(cells))
    r: FloatArray = a * load + b * load**2 + branches.sum(axis=1) + broken
    return r


@loop
def _step_cells(static: Rows, weights: Rows, chains: Rows, load: Rows, state: Rows, found: Rows) -> None:
    """:func:`m10` as a loop.

    Args:
        static: (4, m) a, b, alpha1 and alpha2.
        weights: (12, m) weights of the target before, of the target now, and of the branch; each for charging and
            discharging, and in these for both branches.
        chains: (2, m) chains that break per load, and the share of them that stays.
        load: (n, m) or (n, 1).
        state: (3, m) branches and broken chains at the first load, changed.
        found: (n, m) is written.
    """
    shared = load.shape[1] == 1
    for n in range(found.shape[0]):
        for i in range(found.shape[1]):
            now = load[n, 0 if shared else i]
            if n:
                before = load[n - 1, 0 if shared else i]
                for branch in range(2):
                    alpha, x = static[2 + branch, i], state[branch, i]
                    way = branch if alpha * now > x else 2 + branch
                    into = alpha * before * weights[way, i] + alpha * now * weights[4 + way, i]
                    state[branch, i] = x * weights[8 + way, i] + into
                state[2, i] = chains[1, i] * state[2, i] + abs(now - before) * chains[0, i]
            found[n, i] = static[0, i] * now + static[1, i] * (now * now) + (state[0, i] + state[1, i]) + state[2, i]


def _all_branches(target: FloatArray, into: FloatArray, stay: FloatArray, branches: FloatArray) -> None:
    """Step both branches of all cells, sample by sample; writes ``branches`` (n, 2, m) from sample 1 on."""
    either, charging = np.empty(stay.shape), np.empty(stay.shape[1:], dtype=bool)
    for now, then, x, to in zip(target[1:], into, branches[:-1], branches[1:], strict=True):
        np.multiply(x, stay, out=either)
        either += then
        np.greater(now, x, out=charging)
        to[:] = either[1]
        np.copyto(to, either[0], where=charging)


def _one_branch(
    first: float, target: FloatArray, charging: FloatArray, discharging: FloatArray, stay: FloatArray
) -> list[float]:
    """One branch of one cell (n,), starting from ``first``; the same numbers as by :func:`_all_branches`.

    NumPy takes some microseconds per operation, even for small arrays; plain numbers are ten times faster.
    """
    x = first
    up, down = stay.tolist()
    states = [x]
    for now, rise, fall in zip(target.tolist(), charging.tolist(), discharging.tolist(), strict=True):
        x = x * up + rise if now > x else x * down + fall
        states.append(x)
    return states


PAPER_PARAMETERS = ("gain1", "gain2", "fall2_s", "gain3", "fall3_s", "overshoot", "settle_s")


def paper(parameters: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Normalised resistance (n, m) of m cells of kind paper, settled at their first load.

    Phases switch as in :class:`._forward.PaperForward`. The switches depend on the loads alone, and are known before.

    Args:
        parameters: (7, m), in the order of ``PAPER_PARAMETERS``; gains are r at full scale.
        load: (n, m) or (n, 1), pressure / full scale.
        dt_s: the time between samples.
    """
    gain1, gain2, fall2, gain3, fall3, overshoot, settle = parameters
    samples, cells = len(load), parameters.shape[1]
    load = np.broadcast_to(load, (samples, cells))
    total = gain1 + gain2 + gain3
    jump = overshoot * total  # 1/etau2, loads in full scales

    gone_u, ramp_u = lag.weights(dt_s, settle)
    gone2, ramp2 = lag.weights(dt_s, fall2)
    gone3, ramp3 = lag.weights(dt_s, fall3)
    into_u = load[:-1] * (gone_u - ramp_u) + load[1:] * ramp_u
    into2 = gain2 * (load[:-1] * (gone2 - ramp2) + load[1:] * ramp2)
    into3 = gain3 * (load[:-1] * (gone3 - ramp3) + load[1:] * ramp3)
    stay_u, stay2 = 1 - gone_u, 1 - gone2
    into3 = np.concatenate([gain3 * load[:1], into3])
    x3 = _recursions(into3, 1 - gone3, np.zeros(cells))

    # Direction of the last change of each load; upwards before the first change.
    sign = np.sign(np.diff(load, axis=0, prepend=load[:1] - 1))
    moved = np.maximum.accumulate(np.where(sign != 0, np.arange(samples)[:, None], 0), axis=0)
    rising: BoolArray = np.take_along_axis(sign, moved, axis=0) > 0
    starts, ends = rising[1:] & ~rising[:-1], ~rising[1:] & rising[:-1]

    # One free state: that of the rising phase, or the fast branch of recovery. A switch is linear in this state, since
    # the resistance is continuous. Hence state[n] = keep[n] state[n-1] + driven[n] throughout.
    before, slow = load[:-1], x3[:-1]
    start = before + ((total - gain1) * before - slow) / jump
    end = (total + jump - gain1) * before - slow
    risen = rising[1:]
    stay = np.where(risen, stay_u, stay2)
    keep = stay * np.where(starts, -1 / jump, np.where(ends, -jump, 1.0))
    driven = stay * np.where(starts, start, np.where(ends, end, 0.0)) + np.where(risen, into_u, into2)
    state = np.empty((samples, cells))
    state[0] = load[0]
    _follow(keep, driven, state)
    r: FloatArray = np.where(rising, total * load + jump * (load - state), gain1 * load + state + x3)
    return r


def _follow(keep: FloatArray, driven: FloatArray, state: FloatArray) -> None:
    """state[n] = keep[n-1] state[n-1] + driven[n-1], each (n, m); writes ``state`` from row 1 on."""
    compiled = _follow_cells.machine_code()
    if compiled is not None:
        compiled(keep, driven, state)
        return
    for factor, add, last, to in zip(keep, driven, state[:-1], state[1:], strict=True):
        np.multiply(factor, last, out=to)
        np.add(to, add, out=to)


@loop
def _follow_cells(keep: Rows, driven: Rows, state: Rows) -> None:
    for n in range(1, state.shape[0]):
        for cell in range(state.shape[1]):
            state[n, cell] = keep[n - 1, cell] * state[n - 1, cell] + driven[n - 1, cell]


def random_loads(rng: np.random.Generator, samples: int, cells: int, dt_s: float) -> FloatArray:
    """Normalised random loads (n, m): ramps to no load, full scale or any level, for some cells with holds between.

    Ramps take 0.2 to 40 s per full scale. Holds last 1 to 160 s, or 0.3 times as long. Every cell rests first.
    """
    loads = np.empty((samples, cells))
    end = samples * dt_s
    for cell in range(cells):
        times, levels = [0.0, rng.uniform(1, 20)], [0.0, 0.0]
        holds = rng.choice([0.0, 0.3, 1.0])
        while times[-1] < end:
            kind = rng.random()
            level = 0.0 if kind < 0.25 else 1.0 if kind < 0.45 else rng.uniform(-0.05, 1.2)
            seconds_per_full_scale = np.exp(rng.uniform(np.log(0.2), np.log(40)))
            times.append(times[-1] + max(0.1, abs(level - levels[-1]) * seconds_per_full_scale))
            levels.append(level)
            if holds:
                times.append(times[-1] + holds * np.exp(rng.uniform(np.log(1), np.log(160))))
                levels.append(level)
        loads[:, cell] = np.interp(np.arange(samples) * dt_s, times, levels)
    return loads


def varied_loads(
    rng: np.random.Generator, samples: int, cells: int, dt_s: float, recorded: FloatArray, recorded_dt_s: float
) -> FloatArray:
    """Normalised loads (n, m) made of pieces of a recorded load, joined by ramps (data augmentation).

    The pieces are slowed down or sped up by a factor up to two, scaled, shifted, and sometimes reversed in time or
    turned upside down.
    """
    loads = np.empty((samples, cells))
    shortest = min(len(recorded), max(2, round(20 / recorded_dt_s)))
    for cell in range(cells):
        pieces: list[FloatArray] = [np.zeros(max(1, round(rng.uniform(1, 20) / dt_s)))]
        while sum(map(len, pieces)) < samples:
            length = rng.integers(shortest, len(recorded) + 1)
            start = rng.integers(0, len(recorded) - length + 1)
            piece = recorded[start : start + length]
            piece = piece[::-1] if rng.random() < 0.3 else piece
            piece = 1 - piece if rng.random() < 0.2 else piece
            step = dt_s / recorded_dt_s * np.exp(rng.uniform(-np.log(2), np.log(2)))
            scale = rng.uniform(0.5, 1.1)
            piece = np.interp(np.arange(0, length - 1, step), np.arange(length), piece) * scale
            piece = piece + rng.uniform(-0.05, 1.05 - 0.9 * scale)
            pieces += [np.linspace(pieces[-1][-1], piece[0], round(rng.uniform(1, 10) / dt_s)), piece]
        loads[:, cell] = np.concatenate(pieces)[:samples]
    return loads


def wandering(
    rng: np.random.Generator, samples: int, cells: int, dt_s: float, seconds: float, std: float
) -> FloatArray:
    """Stationary AR(1) noise (n, m) with correlation time ``seconds`` and standard deviation ``std``: model error."""
    keep = np.exp(-dt_s / seconds)
    white = std * rng.standard_normal((samples, cells))
    white[1:] *= np.sqrt(1 - keep**2)
    return _recursions(white, np.full(cells, keep), np.zeros(cells))


def lagging(load: FloatArray, dt_s: float, seconds: FloatArray, first: FloatArray) -> FloatArray:
    """Loads (n, m) filtered by lags of ``seconds`` (m,) with initial states ``first`` (m,): a model of slow creep."""
    keep = np.exp(-dt_s / seconds)
    return _recursions((1 - keep) * load, keep, first)


def _recursions(into: FloatArray, keep: FloatArray, before: FloatArray) -> FloatArray:
    """First-order recursive filters (n, m) along axis 0: ``y[k] = keep y[k-1] + into[k]``, with ``y[-1] = before``.

    Args:
        into: (n, m).
        keep: (m,).
        before: (m,).
    """
    found = np.empty(into.shape)
    compiled = _filter_columns.machine_code()
    if compiled is not None:
        compiled(np.ascontiguousarray(into), keep, before, found)
        return found
    from scipy.signal import lfilter  # loads scipy.stats, which takes as long as all else of this package

    for place, (stay, last) in enumerate(zip(keep, before, strict=True)):
        found[:, place] = lfilter([1.0], [1.0, -stay], into[:, place], zi=[stay * last])[0]
    return found


@loop
def _filter_columns(into: Rows, keep: Row, before: Row, found: Rows) -> None:
    """:func:`_recursions` as a loop; writes ``found``."""
    for k in range(into.shape[0]):
        for place in range(into.shape[1]):
            last = found[k - 1, place] if k else before[place]
            found[k, place] = keep[place] * last + into[k, place]


def white_noise(signal: FloatArray) -> float:
    """Standard deviation of the white noise of a signal (n,), by a robust scatter of its second differences."""
    return scatter(np.diff(signal, 2)) / math.sqrt(6.0) if len(signal) > 2 else 0.0


def step_noise(signal: FloatArray) -> float:
    """Standard deviation by quantisation of a signal (n,) coarser than its noise: smallest step / sqrt(12)."""
    steps = np.abs(np.diff(signal))
    return float(np.min(steps, where=steps > 0, initial=np.inf) / np.sqrt(12)) if steps.any() else 0.0


def smoothing_s(load: FloatArray, dt_s: float) -> float:
    """Standard deviation in seconds of the Gaussian window for a force gauge's signal.

    Noise of the signal adds up in the integral of |ds|. The window limits this sum to 5 % of the load's range in ten
    seconds. It is 0 for little noise, and at most :data:`LONGEST_SMOOTHING_S`. A longer window would blur fast edges,
    to which cells respond differently than to slow ones.
    """
    added, allowed = white_noise(load) * 10 / dt_s, 0.05 * np.ptp(load)
    if added <= allowed:
        return 0.0
    if not allowed:
        return LONGEST_SMOOTHING_S
    # A Gaussian window of w samples reduces the change of white noise from sample to sample by the factor
    # 1 / (2 sqrt(2) pi^(1/4) w^1.5).
    samples = (added / allowed / (2 * math.sqrt(2) * math.pi**0.25)) ** (2 / 3)
    return min(float(samples) * dt_s, LONGEST_SMOOTHING_S)


def smoothed(signal: FloatArray, dt_s: float, seconds: float) -> FloatArray:
    """A signal (n,) smoothed by a Gaussian window with the standard deviation ``seconds``."""
    from scipy.ndimage import gaussian_filter1d

    width = seconds / dt_s
    result: FloatArray = gaussian_filter1d(signal, width) if width > 0.3 else signal
    return result
