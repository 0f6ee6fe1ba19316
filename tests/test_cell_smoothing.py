"""Readings without their noise: a line through the recent ones, against least squares done the long way."""

import numpy as np
import pytest

from ohmskin.cell._simulate import step_noise, white_noise
from ohmskin.cell._smoothing import STEADY_S, Smoother

NOISE = 0.005


def smoothed(smoother: Smoother, time: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    memory, found, std = smoother.begin(r[0]), [r[0]], [np.zeros_like(r[0])]
    for dt, reading in zip(np.diff(time), r[1:], strict=True):
        memory, level = smoother.advance(memory, float(dt), reading)
        found.append(level)
        std.append(memory["std"])
    return np.array(found), np.array(std)


def readings(truth: np.ndarray, cells: int = 200) -> np.ndarray:
    noise = np.random.default_rng(1).standard_normal((len(truth), cells))
    return truth[:, None] + NOISE * (1 + truth[:, None]) * noise


def test_without_noise_readings_pass_as_they_are() -> None:
    r = np.random.default_rng(0).random((50, 3))
    found, std = smoothed(Smoother(0.0), np.arange(50.0), r)
    assert (found == r).all()
    assert not std.any()


def test_it_is_weighted_least_squares_at_irregular_times() -> None:
    """The end of a line through all readings, weights exp(-age), its slope held down by STEADY_S^2."""
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.01, 0.3, 40))
    r = 0.3 + 0.01 * time[:, None] + 0.1 * NOISE * rng.standard_normal((40, 1))
    found, _ = smoothed(Smoother(NOISE), time, r)
    for n in (1, 2, 10, 39):
        age = time[n] - time[: n + 1]
        line = np.column_stack([np.ones_like(age), age])
        weight = np.exp(-age)
        normal = line.T @ (weight[:, None] * line) + np.diag([0.0, STEADY_S**2])
        end = np.linalg.solve(normal, line.T @ (weight * r[: n + 1, 0]))[0]
        assert found[n, 0] == pytest.approx(end, abs=1e-12)


@pytest.mark.parametrize("dt", [0.01, 0.1])
@pytest.mark.parametrize("slope", [0.0, 0.01, 0.1])
def test_ramps_pass_without_lag_and_with_the_stated_noise(dt: float, slope: float) -> None:
    time = np.arange(0, 6, dt)
    truth = slope * time
    found, std = smoothed(Smoother(NOISE), time, readings(truth))
    late = time > 3
    error = (found - truth[:, None])[late]
    assert abs(error.mean()) < 0.2 * NOISE
    assert np.sqrt(np.mean(error**2)) < 0.7 * NOISE
    assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(std[late] ** 2)) < 1.3


def test_a_jump_is_seen_in_its_own_sample() -> None:
    time = np.arange(0, 10, 0.05)
    truth = np.where(time < 5, 0.0, 0.4)
    found, _ = smoothed(Smoother(NOISE), time, readings(truth))
    assert np.abs(found - truth[:, None]).max() < 6 * NOISE * 1.4
    quiet = np.std((found - truth[:, None])[time > 8])
    assert quiet < 0.5 * NOISE * 1.4


def test_readings_coarser_than_their_noise_have_that_of_their_steps() -> None:
    fine = 10e3 + 3e3 * np.sin(np.linspace(0, 20, 5000))
    coarse = 200.0 * np.round(fine / 200.0)
    assert white_noise(coarse) == 0
    assert step_noise(coarse) == pytest.approx(np.std(coarse - fine), rel=0.05)
    assert step_noise(np.full(10, 3.0)) == 0
