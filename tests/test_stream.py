"""Numbers, losses and times of frames that a line loses, doubles, and lets overtake each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.driver._port import Arrival
from ohmskin.driver._statistics import Counters
from ohmskin.driver._stream import FrameStream, RawFrame
from ohmskin.wire import Flag, FramePacket

COUNTS = np.zeros((1, 1), dtype=np.uint16)
PERIOD_US = 10_000


def packet(number: int, time_us: int, boot_id: int = 1, flags: Flag = Flag.NONE) -> FramePacket:
    return FramePacket.of(COUNTS, sequence=number % 2**32, time_us=time_us, boot_id=boot_id, flags=flags)


class Line:
    """A stream, and the host's time, at which each packet arrives."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.stream = FrameStream("line", self.counters)
        self.host_s = 100.0

    def bring(self, of: FramePacket) -> RawFrame | None:
        self.stream.arrive(arrival := Arrival(b"", self.host_s, 1e9 + self.host_s), 1)
        return self.stream.add(of, arrival)


@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.tuples(st.sampled_from(["next", "lost", "twice", "late", "overrun"]), st.integers(1, 60)), max_size=60),
    st.integers(0, 50),
)
def test_every_packet_is_counted_once_whatever_the_line_does(
    first: int, fates: list[tuple[str, int]], at_end: int
) -> None:
    """Frames pass in order with the board's time; the numbers may wrap, and a late frame stays among the lost."""
    line, number, time_us = Line(), first, 5_000_000
    line.stream.announce(first % 2**32, 1)
    lost = doubled = late = overruns = taken = 0
    times: list[tuple[float, int]] = []
    for fate, many in fates:
        if fate in ("lost", "late"):
            number, time_us, lost = number + many, time_us + many * PERIOD_US, lost + many
        line.host_s = 100.0 + time_us / 1e6
        found = line.bring(packet(number, time_us, flags=Flag.OVERRUN if fate == "overrun" else Flag.NONE))
        assert found is not None
        taken, overruns = taken + 1, overruns + (fate == "overrun")
        assert (found.index, found.sequence, found.lost, found.overruns) == (taken, number % 2**32, lost, overruns)
        times.append((found.time_s, time_us))
        if fate == "twice":
            assert line.bring(packet(number, time_us)) is None
            doubled += 1
        if fate == "late":
            assert line.bring(packet(number - 1, time_us - PERIOD_US)) is None
            late += 1
        number, time_us = number + 1, time_us + PERIOD_US
    steps = np.diff([time_s for time_s, _ in times])
    np.testing.assert_allclose(steps, np.diff([of_us for _, of_us in times]) / 1e6, rtol=1e-9, atol=1e-12)
    line.stream.end((number + at_end) % 2**32, 1, time_us + at_end * PERIOD_US)
    counters = line.counters
    assert (counters.frames, counters.lost) == (taken, lost + at_end)
    assert (counters.duplicates, counters.late) == (doubled, late)
    assert (counters.reboots, counters.resyncs, counters.clock_steps) == (0, 0, 0)


@pytest.mark.parametrize("changes", [True, False])
@pytest.mark.parametrize("missed", [0, 3])
def test_a_board_that_restarts_counts_from_nought(changes: bool, missed: int) -> None:
    """By another boot id; or, of a board that never changes its own, by numbers and time that go far back."""
    line = Line()
    for k in range(200):
        line.host_s += 0.01
        line.bring(packet(k, 1_000_000 + k * PERIOD_US, boot_id=7))
    line.host_s += 2.0
    found = line.bring(packet(missed, 1_000 + missed * PERIOD_US, boot_id=8 if changes else 7))
    assert found is not None
    assert (found.lost, found.reboots) == (missed, 1)
    assert found.time_s == pytest.approx(1.99 + 2.0, abs=0.05)  # by the host's time, which goes through
    line.host_s += 0.01
    after = line.bring(packet(missed + 1, 1_000 + (missed + 1) * PERIOD_US, boot_id=8 if changes else 7))
    assert after is not None
    assert after.time_s - found.time_s == pytest.approx(0.01)


def test_a_board_that_restarts_and_ends_at_once_has_lost_what_it_sent_since() -> None:
    line = Line()
    for k in range(20):
        line.host_s += 0.01
        line.bring(packet(k, 1_000_000 + k * PERIOD_US, boot_id=7))
    line.stream.end(5, 8, 60_000)
    assert (line.counters.reboots, line.counters.lost) == (1, 5)


@pytest.mark.parametrize("restarts", [True, False])
def test_a_board_has_lost_at_its_end_what_it_can_have_sent_in_its_time(restarts: bool) -> None:
    """At up to ten times its usual rate, and ten seconds more in buffers: since its start, or since the last frame."""
    line = Line()
    for k in range(20):
        line.host_s += 0.01
        line.bring(packet(k, 25_000_000 + k * PERIOD_US, boot_id=7))
    numbers, time_us = (30_000, 30_000_000) if restarts else (20 + 30_000, 25_190_000 + 30_000_000)
    line.stream.end(numbers, 8 if restarts else 7, time_us)
    assert line.counters.lost == 30_000
    line.stream.end(numbers + 1_000_000, 8 if restarts else 7, time_us)
    assert line.counters.lost == 30_000


def test_the_end_of_a_board_whose_numbers_no_time_explains_is_no_loss() -> None:
    line = Line()
    for k in range(20):
        line.host_s += 0.01
        line.bring(packet(k, 1_000_000 + k * PERIOD_US))
    line.stream.end(2**30, 1, 1_000_000 + 20 * PERIOD_US)
    assert line.counters.lost == 0


@pytest.mark.parametrize(
    ("lost", "passed_s", "host_s", "is_set"),
    [
        (50, 0.51, 0.51, False),  # as usual
        (10, 5.0, 0.01, False),  # a slower rate, whose bytes have waited
        (0, 1.5, 1.0, False),  # a pause
        (0, 0.51, 0.01, False),  # less than a second may be a buffer
        (0, 1.5, 0.01, True),
    ],
)
def test_a_clock_is_set_forward_if_neither_the_host_nor_the_usual_rate_explains_its_time(
    lost: int, passed_s: float, host_s: float, is_set: bool
) -> None:
    """Also after frames were lost, which do not make the usual time between two frames longer."""
    line = Line()
    for k in range(20):
        line.host_s += 0.01
        line.bring(packet(k, 1_000_000 + k * PERIOD_US))
    number, time_us = 19 + 1 + lost, 1_190_000 + round(1e6 * passed_s)
    line.host_s += host_s
    line.bring(packet(number, time_us))
    assert line.counters.clock_steps == is_set
    if lost == 50:
        line.host_s += 0.01
        line.bring(packet(number + 1, time_us + 30_000_000))
        assert line.counters.clock_steps == 1


def test_numbers_that_jump_farther_than_a_board_can_have_sent_are_new_ones() -> None:
    line = Line()
    for k in range(20):
        line.host_s += 0.01
        line.bring(packet(k, 1_000_000 + k * PERIOD_US))
    line.host_s += 0.01
    found = line.bring(packet(10_000, 1_000_000 + 20 * PERIOD_US))
    assert found is not None
    assert (found.lost, line.counters.resyncs) == (0, 1)
    line.host_s += 10.0  # a thousand frames at its usual rate
    found = line.bring(packet(10_900, 1_000_000 + 1020 * PERIOD_US))
    assert found is not None
    assert (found.lost, line.counters.resyncs) == (899, 1)
