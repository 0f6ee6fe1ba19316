"""Board time to host time: laws of the map, and delays that a simulated line adds."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from boards import Flow, frame, identity, sheet
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from ohmskin.driver import Skin
from ohmskin.driver._clock import ClockMap, Pace
from ohmskin.driver._spacing import ArrivalTimes
from ohmskin.driver._tuning import BUCKET_S, LARGEST_DRIFT, REMEMBERED, STEP_S
from ohmskin.wire import BOARDS, FramePacket, board_protocol


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


@pytest.mark.parametrize("pace", [1.3, 50.0])
def test_a_time_that_no_clock_keeps_has_no_drift(pace: float) -> None:
    """As at the emulator's fast clock. Frames are taken for delayed by no more than what counts as a step."""
    clock, delays = ClockMap(), []
    for k in range(5000):
        arrived_s = 0.01 * k / pace
        delays.append(arrived_s - clock.add(0.01 * k, arrived_s))
    assert math.isnan(clock.drift_ppm)
    assert max(delays) < STEP_S + 0.01


@given(st.sampled_from([0.0, 0.5, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.2, 2.0, 50.0]), st.integers(0, 2**32 - 1))
def test_ages_stay_true_at_every_pace_of_the_board_s_time(pace: float, seed: int) -> None:
    """Of an oscillator that is off by up to 10 %, and of a time that no oscillator keeps, once a second has passed."""
    rng = np.random.default_rng(seed)
    sent_s = np.sort(rng.uniform(0, 20, 2000))
    received_s = sent_s + delays(rng, len(sent_s))
    received_s = np.maximum.accumulate(received_s)
    clock = ClockMap()
    late_s = received_s - mapped(clock, pace * sent_s, received_s)
    assert (late_s - (received_s - sent_s))[sent_s > 1.5].max() < 0.005  # by its own delay, and the noise of the others
    is_clock = 0.9 <= pace <= 1.1
    assert (clock.pace is Pace.EVEN) == is_clock
    assert math.isnan(clock.drift_ppm) != is_clock
    if is_clock:
        assert clock.drift_ppm == pytest.approx(1e6 * (1 / pace - 1), abs=300)


def test_a_clock_that_goes_again_is_used_again() -> None:
    device_s, received_s = 0.0, 0.0
    clock, paces = ClockMap(), []
    for moving in (True, False, True):
        for _ in range(500):
            received_s += 0.01
            device_s += 0.01 * moving
            clock.add(device_s, received_s)
        paces.append(clock.pace)
    assert paces == [Pace.EVEN, Pace.SLOW, Pace.EVEN]
    assert received_s + 0.04 - clock.add(device_s, received_s + 0.04) == pytest.approx(0.04, abs=0.01)


@pytest.mark.parametrize("factor", [0.0, 0.5])
def test_a_board_whose_clock_is_none_is_named_and_its_frames_are_new(factor: float) -> None:
    """The estimator sees time pass, too."""
    port = Flow(identity() + sheet(), lambda k: frame(k, us=int(1e4 * k * factor)), 0.01, at_once=10**6)
    port.is_simulated = False
    with Skin(port, delivery="every", timeout=60.0) as skin, warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(300):
            port.work(0.01 + 1e-9)
            age_s = skin.read().age
        state = skin.stats()
    assert age_s < 0.02
    (notice,) = told
    assert ("stands" if factor == 0 else "advances by 0.5 s in a second") in str(notice.message)
    assert math.isnan(state.drift_ppm)
    assert "which no oscillator does" in (state.remark or "")
    assert state.rate_hz == pytest.approx(100.0, rel=0.2)


@pytest.mark.parametrize(("pace", "pause_s"), [(4.0, 4.0), (0.6, 0.0)])
def test_a_time_that_no_clock_keeps_is_never_set(pace: float, pause_s: float) -> None:
    """Neither a host that pauses for seconds, nor one that is slower than the board's time, sets a fast clock."""
    clock = ClockMap()
    for k in range(6000):
        clock.add(0.01 * k, 0.01 * k / pace + pause_s * (k // 2000))
    assert clock.steps == 0


@pytest.mark.parametrize("drift_ppm", [-300.0, 0.0, 5000.0])
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


@given(st.floats(-0.18, 0.12), st.floats(1e-5, 0.02), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_the_line_lies_below_all_arrivals_and_touches_one(drift: float, delay_s: float, seed: int) -> None:
    """Also beyond the steepest slope that counts, where the edge of the hull is not the line. A frame per bucket."""
    random = np.random.default_rng(seed)
    device_s = np.cumsum(random.uniform(0.31, 0.45, 60))
    received_s = 7.0 + device_s * (1.0 + drift) + random.uniform(0.0, delay_s, 60)
    clock, x, y = ClockMap(), device_s - device_s[0], received_s - received_s[0] - (device_s - device_s[0])
    for n in range(60):
        clock.add(device_s[n].item(), received_s[n].item())
        if clock.pace is not Pace.EVEN or clock.steps:
            return
        off = y[: n + 1] - [clock._line(each) for each in x[: n + 1].tolist()]
        if clock._drift is None:
            assert x[max(n - 1, 0)] - x[0] < 2.0 * BUCKET_S
            continue
        assert abs(clock._drift) <= LARGEST_DRIFT
        assert off.min() == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-0.1, 0.1), st.floats(1e-4, 0.02), st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_frame_that_the_line_touches_stays_above_the_next_line(drift: float, delay_s: float, seed: int) -> None:
    """Though buckets keep the frame with the least delay by a level line, which need not be that one."""
    random = np.random.default_rng(seed)
    device_s = np.cumsum(random.uniform(0.01, 0.1, 600))
    clock = ClockMap()
    for x, y in zip(device_s, 7.0 + device_s * (1.0 + drift) + random.uniform(0.0, delay_s, 600), strict=True):
        touched = clock._anchor
        clock.add(x.item(), y.item())
        assert clock._line(touched[0]) <= touched[1] + 1e-9


def test_a_pause_of_the_clock_leaves_its_drift_as_it_was() -> None:
    """Until the line has been found over as long a time as before: three seconds of delays say little of a drift."""
    random = np.random.default_rng(4)
    device_s = np.arange(0.0, 33.0, 0.01)
    received_s = device_s * 1.0002 + np.where(device_s > 30.0, 0.5, 0.0) + delays(random, device_s.size)
    clock, drift = ClockMap(), 0.0
    for x, y in zip(device_s.tolist(), received_s.tolist(), strict=True):
        drift = clock.drift_ppm if x < 29.5 else drift
        clock.add(x, y)
    mapped(clock, device_s[-1] + 0.01 * np.arange(1.0, 100.0), received_s[-1] + 0.01 * np.arange(1.0, 100.0))
    assert clock.steps == 1
    assert clock.drift_ppm == pytest.approx(drift, abs=20.0)


@pytest.mark.parametrize("pause_s", [0.5, 0.04])
def test_a_clock_that_pauses_is_followed_after_three_seconds(pause_s: float) -> None:
    """An emulated board on a machine that was too slow for half a second. Pauses below 50 ms could be delays."""
    device_s = np.arange(0, 20, 0.01)
    received_s = device_s + np.where(device_s > 10, pause_s, 0.0)
    clock = ClockMap()
    late = received_s - mapped(clock, device_s, received_s)
    assert late[device_s < 10].max() < 1e-9
    # could be a delay: frames are then old, not new
    assert late[(device_s > 10.1) & (device_s < 12)].min() > 0.8 * pause_s
    assert clock.steps == (pause_s > 0.05)
    if clock.steps:
        assert late[device_s > 14.5].max() < STEP_S / 10


def test_a_drift_that_changes_is_followed_within_a_minute() -> None:
    drift_ppm = 300.0
    device_s = np.arange(0, 260, 0.05)
    received_s = device_s + 1e-6 * drift_ppm * np.abs(device_s - 180)
    clock = ClockMap()
    late = received_s - mapped(clock, device_s, received_s)
    assert late[device_s > 241].max() < 1e-5
    assert clock.drift_ppm == pytest.approx(drift_ppm, rel=1e-3)


def spread(arrivals: list[tuple[float, int]]) -> np.ndarray:
    """Times of the frames of arrivals (time, frames), from a board without a clock."""
    times = ArrivalTimes()
    found = []
    for received_s, frames in arrivals:
        times.arrive(received_s, frames)
        found += [times.next(received_s) for _ in range(frames)]
    return np.array(found)


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 5)), min_size=1, max_size=200))
@settings(max_examples=30)
def test_frames_of_an_arrival_are_spread_backwards_by_the_usual_interval(steps: list[tuple[float, int]]) -> None:
    """The median of the last intervals, this one's at most; a frame beyond those that came has come now."""
    times, received_s, intervals = ArrivalTimes(), 5.0, []
    assert times.next(received_s) == received_s
    assert times.usual_s == 0.0
    for number, (step_s, frames) in enumerate(steps):
        received_s += step_s
        times.arrive(received_s, frames)
        apart_s = 0.0
        if number:
            intervals.append(step_s / frames)
            apart_s = min(intervals[-1], np.median(intervals[-REMEMBERED:]))
            assert times.usual_s == pytest.approx(np.median(intervals[-REMEMBERED:]), rel=1e-9, abs=1e-12)
        found = [times.next(received_s) for _ in range(frames + 1)]
        expected = received_s - apart_s * np.r_[np.arange(frames - 1, -1, -1), 0]
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
        times.arrive(received_s + 0.5, 0)  # bytes without a frame are no arrival
        assert times.next(received_s + 0.5) == received_s + 0.5


def test_a_host_that_reads_now_and_then_finds_the_board_s_frame_rate() -> None:
    """A board at 100 Hz, read every 1 to 80 ms, and once after half a second in which it sent nothing."""
    rng = np.random.default_rng(3)
    sent_s = 5.0 + 0.01 * np.arange(2000)
    sent_s[1200:] += 0.5
    read_s = 5.0 + np.cumsum(rng.uniform(0.001, 0.08, 700))
    counts = np.diff(np.searchsorted(sent_s, read_s), prepend=0)
    found = spread(list(zip(read_s.tolist(), counts.tolist(), strict=True)))
    late_s = found - sent_s[: len(found)]
    assert np.median(np.diff(found)) == pytest.approx(0.01, rel=0.05)
    assert np.abs(late_s[50:]).max() < 0.09
    assert np.median(np.abs(late_s[50:])) < 0.02


def test_a_family_without_a_clock_has_times_between_its_frames() -> None:
    """Ten frames in each read, 0.1 s apart."""
    board = BOARDS["m1616"]
    shape = (board.layout.rows, board.layout.columns)
    packet = board_protocol(board).frame(FramePacket.of(np.full(shape, 100), sequence=None, time_us=None))
    port = Flow(b"", lambda _: 10 * packet, 0.1, at_once=10**6)
    with Skin(port, board=board, delivery="every", timeout=60.0) as skin:
        frames = []
        for _ in range(20):
            port.work(0.1 + 1e-12)
            frames += [skin.read() for _ in range(10)]
        assert skin.stats().rate_hz == pytest.approx(100.0, rel=0.15)
    np.testing.assert_allclose(np.diff([one.monotonic_time for one in frames])[20:], 0.01, rtol=0.2)
