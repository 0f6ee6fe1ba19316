"""Whole recordings of many cells at once: what identification and training spend their time on.

The same equations as :mod:`.forward`, on a uniform time grid and with the change-over of an asymmetric lag placed
at the end of a step instead of inside it, which is an order of magnitude faster; a test holds the two together.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from . import lag
from .lag import FloatArray

M10_PARAMETERS = ("a", "b", "alpha1", "rise1_s", "fall1_s", "alpha2", "rise2_s", "fall2_s", "k", "tau_s")


def m10(parameters: FloatArray, load: FloatArray, dt_s: float) -> FloatArray:
    """Normalised resistance (n, m) of m cells of kind m10, settled at their first load.

    Args:
        parameters: (10, m), in the order of ``M10_PARAMETERS``.
        load: (n, m) or (n, 1), pressure / full scale.
        dt_s: the time between samples.
    """
    a, b, alpha1, rise1, fall1, alpha2, rise2, fall2, k, tau = parameters
    samples, cells = len(load), parameters.shape[1]
    alpha = np.stack([alpha1, alpha2])
    up, up_ramp = lag.weights(dt_s, np.stack([rise1, rise2]))
    down, down_ramp = lag.weights(dt_s, np.stack([fall1, fall2]))
    stay_up, stay_down = 1 - up, 1 - down
    target = alpha * load[:, None, :]  # (n, 2, m)
    into_up = target[:-1] * (up - up_ramp) + target[1:] * up_ramp
    into_down = target[:-1] * (down - down_ramp) + target[1:] * down_ramp
    branches = np.empty((samples, 2, cells))
    x = branches[0] = np.broadcast_to(target[0], (2, cells))
    for n in range(1, samples):
        x = np.where(target[n] > x, x * stay_up + into_up[n - 1], x * stay_down + into_down[n - 1])
        branches[n] = x
    gone, ramp = lag.weights(dt_s, tau)
    moved = np.abs(np.diff(load, axis=0, prepend=load[:1])) * (k * (1 - ramp))
    broken = np.empty((samples, cells))
    for cell in range(cells):
        broken[:, cell] = lfilter([1.0], [1.0, gone[cell] - 1], moved[:, cell])
    r: FloatArray = a * load + b * load**2 + branches.sum(axis=1) + broken
    return r


def random_loads(rng: np.random.Generator, samples: int, cells: int, dt_s: float) -> FloatArray:
    """Normalised loads (n, m): random ramps to nothing, full scale or anywhere, some cells with holds, some without.

    Ramps take 1 to 40 s per full scale, holds 1 to 160 s. Every cell rests first.
    """
    loads = np.empty((samples, cells))
    end = samples * dt_s
    for cell in range(cells):
        times, levels = [0.0, rng.uniform(1, 20)], [0.0, 0.0]
        holds = rng.choice([0.0, 0.3, 1.0])
        while times[-1] < end:
            kind = rng.random()
            level = 0.0 if kind < 0.25 else 1.0 if kind < 0.45 else rng.uniform(-0.05, 1.2)
            seconds_per_full_scale = np.exp(rng.uniform(np.log(1), np.log(40)))
            times.append(times[-1] + max(0.2, abs(level - levels[-1]) * seconds_per_full_scale))
            levels.append(level)
            if holds:
                times.append(times[-1] + holds * np.exp(rng.uniform(np.log(1), np.log(160))))
                levels.append(level)
        loads[:, cell] = np.interp(np.arange(samples) * dt_s, times, levels)
    return loads


def varied_loads(
    rng: np.random.Generator, samples: int, cells: int, dt_s: float, recorded: FloatArray, recorded_dt_s: float
) -> FloatArray:
    """Normalised loads (n, m) with the texture of a recorded one: pieces of it, slower or faster by up to two,
    scaled, shifted, reversed in time or upside down, joined by ramps.
    """
    loads = np.empty((samples, cells))
    shortest = min(len(recorded), round(20 / recorded_dt_s))
    for cell in range(cells):
        pieces: list[FloatArray] = [np.zeros(round(rng.uniform(1, 20) / dt_s))]
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
    """Stationary noise (n, m) that forgets itself in ``seconds``: what a model leaves unexplained."""
    keep = np.exp(-dt_s / seconds)
    white = std * rng.standard_normal((samples, cells))
    white[1:] *= np.sqrt(1 - keep**2)
    noise: FloatArray = lfilter([1.0], [1.0, -keep], white, axis=0)
    return noise


def white_noise(signal: FloatArray) -> float:
    """Standard deviation of what changes from sample to sample: robust second differences of (n,)."""
    return float(np.median(np.abs(np.diff(signal, 2))) / 0.6745 / np.sqrt(6)) if len(signal) > 2 else 0.0


def smoothing_s(load: FloatArray, dt_s: float) -> float:
    """Over how long a force gauge's signal must be smoothed: its noise would add up in the integral of |ds|.

    Not at all if that is less than 5 % of the load's range in ten seconds.
    """
    return 0.5 if white_noise(load) * 10 / dt_s > 0.05 * np.ptp(load) else 0.0


def smoothed(signal: FloatArray, dt_s: float, seconds: float) -> FloatArray:
    """A signal (n,) behind a Gaussian window of that standard deviation."""
    width = seconds / dt_s
    result: FloatArray = gaussian_filter1d(signal, width) if width > 0.3 else signal
    return result
