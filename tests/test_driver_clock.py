"""Board time to host time: laws of the map, and delays that a simulated line adds."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from ohmskin.driver._clock import STEP_S, ClockMap, lower_hull


def delays(rng: np.random.Generator, count: int) -> np.ndarray:
    """Delays of a busy line: mostly small, some of 20 ms, in s."""
    return rng.exponential(0.001, count) + np.where(rng.random(count) < 0.1, rng.uniform(0, 0.02, count), 0.0)


def mapped(clock: ClockMap, device_s: np.ndarray, received_s: np.ndarray) -> np.ndarray:
    return np.array([clock.add(x, y) for x, y in zip(device_s.tolist(), received_s.tolist(), strict=True)])


@given(
    st.lists(st.tuples(st.floats(0, 3), st.floats(-0.05, 2)), min_size=1, max_size=200),
    st.floats(0, 1e6),
    st.floats(0, 1e6),
)
def test_no_frame_is_said_to_have_come_later_than_it_did(
    steps: list[tuple[float, float]], device_s: float, host_s: float
) -> None:
    clock = ClockMap()
    for step, delay in steps:
        device_s += step
        received_s = host_s + device_s + delay
        assert clock.add(device_s, received_s) <= received_s + 1e-9 * max(1.0, received_s)


@pytest.mark.parametrize("drift_ppm", [-300.0, -20.0, 0.0, 80.0, 5000.0])
def test_offset_and_drift_are_found_below_the_delays(drift_ppm: float) -> None:
    rng = np.random.default_rng(5)
    device_s = np.arange(0, 90, 0.01)
    sent_s = 1e5 + device_s * (1 + drift_ppm / 1e6)
    clock = ClockMap()
    found = mapped(clock, device_s, sent_s + delays(rng, len(sent_s)))
    settled = device_s > 20
    np.testing.assert_allclose(found[settled], sent_s[settled], atol=2e-4 + 0.005 * abs(drift_ppm) / 1e4)
    assert clock.drift_ppm == pytest.approx(drift_ppm, abs=10 + 0.01 * abs(drift_ppm))
    assert clock.steps == 0


def test_the_line_is_the_best_of_all_lines_below_the_arrivals() -> None:
    """Moon's linear program, solved by another method: the line below all points with the least sum of distances."""
    rng = np.random.default_rng(2)
    device_s = np.arange(0, 30, 0.5001)  # one frame in each bucket, so that nothing is thinned out
    received_s = device_s * (1 + 2e-4) + delays(rng, len(device_s))
    clock = ClockMap()
    mapped(clock, device_s, received_s)
    x = device_s[:-1] - device_s[0]
    y = received_s[:-1] - received_s[0] - x
    best = linprog([-len(x), -x.sum()], A_ub=np.column_stack([np.ones_like(x), x]), b_ub=y, bounds=[(None, None)] * 2)
    assert clock.drift_ppm == pytest.approx(1e6 * best.x[1], rel=1e-6, abs=1e-6)


def test_a_clock_that_pauses_is_followed_after_three_seconds() -> None:
    """An emulated board on a machine that was too slow for half a second."""
    device_s = np.arange(0, 20, 0.01)
    received_s = device_s + np.where(device_s > 10, 0.5, 0.0)
    clock = ClockMap()
    late = received_s - mapped(clock, device_s, received_s)
    assert late[device_s < 10].max() < 1e-9
    assert late[(device_s > 10.1) & (device_s < 12)].min() > 0.4  # could be a delay: frames are then old, not new
    assert late[device_s > 14.5].max() < STEP_S / 10
    assert clock.steps == 1


def test_a_board_that_runs_faster_than_time_has_frames_that_are_new() -> None:
    """An emulated board at the fast clock: what counts is when frames came."""
    device_s = np.arange(0, 1000, 0.02)
    received_s = device_s / 100
    assert (received_s - mapped(ClockMap(), device_s, received_s)).max() < 0.02


@given(st.lists(st.tuples(st.floats(0.01, 10), st.floats(-10, 10)), min_size=1, max_size=60))
def test_the_hull_is_convex_and_below_all_points(steps: list[tuple[float, float]]) -> None:
    xs = np.cumsum([step for step, _ in steps]).tolist()
    points = [(x, y) for x, (_, y) in zip(xs, steps, strict=True)]
    hull = lower_hull(points)
    assert (hull[0], hull[-1]) == (points[0], points[-1])
    assert set(hull) <= set(points)
    below = np.interp(xs, [x for x, _ in hull], [y for _, y in hull])
    assert (below <= np.array([y for _, y in points]) + 1e-9).all()
    slopes = [(y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in itertools.pairwise(hull)]
    assert all(after > before - 1e-9 for before, after in itertools.pairwise(slopes))
