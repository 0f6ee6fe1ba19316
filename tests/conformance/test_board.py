"""What docs/wire.md asks of a board, seen from a serial port: for the emulator now, for any board later."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest
import serial

from ohmskin.wire import Command, Corrupt, Decoder, DescriptionPacket, Event, Flag, FramePacket, Order, encode


class Host:
    """A bare serial program: pyserial and the codec, no driver."""

    def __init__(self, port: str) -> None:
        self.serial = serial.serial_for_url(port, 1_000_000, timeout=0.02)
        self.decoder = Decoder()

    def listen(self, until: Callable[[list[Event]], bool], timeout_s: float = 5.0) -> list[Event]:
        """The events up to the one that makes ``until`` true."""
        events: list[Event] = []
        deadline = time.monotonic() + timeout_s
        while not until(events):
            assert time.monotonic() < deadline, events
            events += self.decoder.feed(self.serial.read(1024))
        return events

    def tell(self, order: Order) -> None:
        self.serial.write(b"\0" + encode(Command(order)))


@pytest.fixture
def host(port: str) -> Iterator[Host]:
    host = Host(port)
    yield host
    host.serial.close()


def frames(events: list[Event]) -> list[FramePacket]:
    return [event for event in events if isinstance(event, FramePacket)]


def sheets(events: list[Event]) -> list[DescriptionPacket]:
    return [event for event in events if isinstance(event, DescriptionPacket)]


def test_it_streams_to_whoever_listens_and_describes_itself_once_a_second(host: Host) -> None:
    events = host.listen(lambda events: len(sheets(events)) == 2)
    first, second = sheets(events)
    assert second.time_us - first.time_us == pytest.approx(1e6, abs=1e5)
    assert (first.serial_number, first.firmware, first.design, first.cell) == (
        second.serial_number,
        second.firmware,
        second.design,
        second.cell,
    )
    # A host that joins in the middle may see the end of a packet first, and nothing wrong after that.
    assert not any(isinstance(event, Corrupt) for event in events[1:])
    seen = frames(events)
    assert len(seen) > 10
    for before, after in pairwise(seen):
        assert after.sequence == (before.sequence + 1) % 2**32
        assert after.time_us > before.time_us
    assert {(frame.rows, frame.columns) for frame in seen} == {
        (first.design["array"]["rows"], first.design["array"]["columns"])
    }
    assert max(int(frame.counts.max()) for frame in seen) < 2 ** first.design["adc"]["bits"]


def test_the_number_in_a_description_is_that_of_the_next_frame(host: Host) -> None:
    host.tell(Order.DESCRIBE)
    events = host.listen(lambda events: bool(sheets(events) and isinstance(events[-1], FramePacket)))
    sheet = events.index(sheets(events)[-1])
    after = frames(events[sheet:])[0]
    assert after.sequence == sheets(events)[-1].sequence
    assert after.time_us >= sheets(events)[-1].time_us


def test_it_describes_itself_when_asked(host: Host) -> None:
    host.listen(lambda events: len(sheets(events)) == 1)  # the next one by itself is a second away
    host.tell(Order.DESCRIBE)
    host.listen(lambda events: len(sheets(events)) == 1, timeout_s=0.7)


def test_stop_stops_frames_and_start_starts_them(host: Host) -> None:
    host.listen(lambda events: len(frames(events)) > 3)
    host.tell(Order.STOP)
    host.tell(Order.DESCRIBE)
    rest = host.listen(lambda events: bool(sheets(events)))
    while not isinstance(rest[-1], DescriptionPacket):  # what was on its way
        rest = host.listen(lambda events: bool(sheets(events)))
    start = time.monotonic()
    silent = host.listen(lambda events: time.monotonic() > start + 0.5)
    assert not frames(silent)
    host.tell(Order.START)
    host.tell(Order.START)
    assert len(frames(host.listen(lambda events: len(frames(events)) > 3))) > 3


def test_noise_from_the_host_does_no_harm(host: Host) -> None:
    host.serial.write(bytes(range(256)) * 4)
    host.serial.write(encode(FramePacket(0, 0, 1, 1, b"\1\2")))
    host.tell(Order.DESCRIBE)
    host.listen(lambda events: bool(sheets(events)) and len(frames(events)) > 10)


def test_it_serves_one_host_after_another(port: str) -> None:
    numbers = []
    for _ in range(2):
        host = Host(port)
        numbers.append([frame.sequence for frame in frames(host.listen(lambda events: len(frames(events)) > 5))])
        host.serial.close()
        time.sleep(0.05)
    assert numbers[1][0] > numbers[0][-1]


def test_a_host_that_does_not_read_costs_whole_frames_and_is_told(host: Host) -> None:
    """No packet is cut, and a frame that speaks of an overrun has a gap in the numbers before it."""
    time.sleep(1.0)
    events = host.listen(lambda events: len(frames(events)) > 80)
    assert not any(isinstance(event, Corrupt) for event in events[1:])
    for before, after in pairwise(frames(events)):
        if Flag.OVERRUN in after.flags:
            assert after.sequence > before.sequence + 1
