"""Fast simulation of whole recordings for many cells at once, for identification and training; random loads and noise.

The steps are those of :mod:`._steps`, on a uniform time grid, with other parameters for each cell.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import FloatArray, scatter
from ...common.compiled import Row, Rows, loop, zeros
from ._forward import m10_cells, paper_cells
from ._steps import M10Memory, PaperMemory, run_m10, run_paper

LONGEST_SMOOTHING_S = 0.5
"""standard deviation in seconds of the longest Gaussian window for the signal of a force gauge"""


def m10(parameters: FloatArray, load: FloatArray, dt_s: float, begun: FloatArray | None = None) -> FloatArray:
    """Normalised resistance (n, m) of m cells of kind m10.

    Args:
        parameters: (10, m), in the order of ``M10_PARAMETERS``.
        load: (n, m) or (n, 1), pressure / full scale.
        dt_s: the time between samples.
        begun: (3, m) initial state: excess of each branch over its equilibrium at the first load, and contribution of
            broken chains; 0: settled.
    """
    cells = m10_cells(parameters)
    memory = zeros(M10Memory, cells.size)
    loads = np.require(np.broadcast_to(load, (len(load), cells.size)), requirements=["C", "W"])
    memory["load"] = loads[0]
    memory["x"] = cells["alpha"] * loads[0][:, None]
    if begun is not None:
        memory["x"] += begun[:2].T
        memory["broken"] = begun[2]
    found, steps = np.empty(loads.shape), np.full(len(loads), dt_s)
    steps[0] = 0.0
    run_m10.unchecked(cells, memory, steps, loads, found)
    return found


PAPER_PARAMETERS = ("gain1", "gain2", "fall2_s", "gain3", "fall3_s", "overshoot", "settle_s")


def paper(parameters: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Normalised resistance (n, m) of m cells of kind paper, settled at their first load.

    Args:
        parameters: (7, m), in the order of ``PAPER_PARAMETERS``; gains are r at full scale.
        load: (n, m) or (n, 1), pressure / full scale.
        dt_s: the time between samples.
    """
    gain1, gain2, fall2, gain3, fall3, overshoot, settle = parameters
    total, cells = gain1 + gain2 + gain3, parameters.shape[1]
    times_s = np.stack([settle, fall2, fall3], axis=1)
    made = paper_cells(cells, 1 / total, 1 / (overshoot * total), 1 / gain1, 1 / gain2, 1 / gain3, times_s)
    memory = zeros(PaperMemory, cells)
    loads = np.require(np.broadcast_to(load, (len(load), cells)), requirements=["C", "W"])
    memory["load"], memory["settled"], memory["rising"] = loads[0], loads[0], 1.0
    memory["x2"], memory["x3"], memory["r"] = gain2 * loads[0], gain3 * loads[0], total * loads[0]
    found, steps = np.empty(loads.shape), np.full(len(loads), dt_s)
    steps[0] = 0.0
    run_paper.unchecked(made, memory, steps, loads, found)
    return found


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
    found = np.ascontiguousarray(into).copy()
    _filter_columns.unchecked(found, keep, before)
    return found


@loop
def _filter_columns(signal: Rows, keep: Row, before: Row) -> None:
    """:func:`_recursions` in place."""
    for k in range(signal.shape[0]):
        for place in range(signal.shape[1]):
            last = signal[k - 1, place] if k else before[place]
            signal[k, place] += keep[place] * last


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
