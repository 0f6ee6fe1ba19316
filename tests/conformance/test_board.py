"""What docs/wire.md asks of a board, seen from a serial port: for the emulator now, for any board later."""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TypeVar

import pytest
import serial
from cobs import cobs
from patience import HANG_S, TURN_S, Patience

from ohmskin.wire import (
    Corrupt,
    Description,
    Event,
    Flag,
    FramePacket,
    Identity,
    Order,
    Reply,
    SelfTest,
    Status,
    encode,
    host_protocol,
)

E = TypeVar("E")
MOST_EVENTS = 20_000
"""of a board within a test: minutes of its time. While it speaks, its time counts, not that of a busy machine"""


class Host:
    """A bare serial program: pyserial and the protocol object, no driver."""

    def __init__(self, port: str) -> None:
        patient = f"{port}?timeout={HANG_S}" if port.startswith("rfc2217://") else port  # of pyserial's negotiation
        self.serial = serial.serial_for_url(patient, 1_000_000, timeout=TURN_S)
        self.protocol = host_protocol("ohmskin")
        self._heard = 0

    def _more(self, patience: Patience, what: object) -> list[Event]:
        """What has come since the last call; a turn of silence is spent."""
        events = self.protocol.feed(self.serial.read(1024), time.monotonic())
        self._heard += len(events)
        assert self._heard < MOST_EVENTS, what
        if not events:
            patience.spend(what)
        return events

    def listen(self, until: Callable[[list[Event]], bool]) -> list[Event]:
        """The events up to those that make ``until`` true."""
        events: list[Event] = []
        patience = Patience()
        while not until(events):
            events += self._more(patience, events[-3:])
        return events

    def hear(self, kind: type[E], count: int = 1) -> list[E]:
        """The next ``count`` events of one kind."""
        found = self.listen(lambda events: len(of(kind, events)) >= count)
        return of(kind, found)

    def tell(self, order: Order, *, period_us: int = 0) -> None:
        self.serial.write(self.protocol.request(order, period_us=period_us))

    def ask(self, order: Order, answer: type[E], *, period_us: int = 0) -> E:
        """Give an order, again as a host does that may have been overheard, and wait for the answer."""
        events: list[Event] = []
        patience = Patience()
        while not of(answer, events):
            self.tell(order, period_us=period_us)
            again = Patience(1.0)
            while not (of(answer, events) or again.is_over):
                again.count()
                events += self._more(patience, f"no {answer.__name__} of {order.name}")
        return of(answer, events)[-1]

    def taken(self, order: Order, *, period_us: int = 0) -> Reply:
        """Give an order until its own reply comes: the one that repeats its number, however late others come."""
        mine: set[int] = set()
        patience = Patience()
        while True:
            self.tell(order, period_us=period_us)
            mine.add(self.protocol.commands)
            again = Patience(1.0)
            while not again.is_over:
                again.count()
                for reply in of(Reply, self._more(patience, order)):
                    if reply.command_sequence in mine:
                        assert reply.order == order.value
                        return reply


@pytest.fixture
def host(port: str) -> Iterator[Host]:
    host = Host(port)
    yield host
    host.serial.close()


def of(kind: type[E], events: list[Event]) -> list[E]:
    return [event for event in events if isinstance(event, kind)]


def test_it_streams_to_whoever_listens_and_says_once_a_second_who_it_is(host: Host) -> None:
    events = host.listen(lambda events: len(of(Identity, events)) == 2)
    first, second = of(Identity, events)
    seen = of(FramePacket, events)
    # A host that was kept from reading has lost packets, and is told so.
    overrun = any(Flag.OVERRUN in frame.flags for frame in seen)
    seconds = round((second.time_us - first.time_us) / 1e6)
    assert second.time_us - first.time_us == pytest.approx(1e6 * seconds, abs=1e5)
    assert seconds == 1 or overrun
    assert (first.serial_number, first.firmware, first.boot_id) == (
        second.serial_number,
        second.firmware,
        second.boot_id,
    )
    # A host that joins in the middle may see the end of a packet first, and nothing wrong after that.
    assert not of(Corrupt, events[1:])
    assert len(seen) > 10
    for before, after in pairwise(seen):
        assert after.sequence == (before.sequence + 1) % 2**32 or Flag.OVERRUN in after.flags
        assert after.time_us > before.time_us
    assert {(frame.rows, frame.columns) for frame in seen} == {(first.rows, first.columns)}
    assert {frame.boot_id for frame in seen} == {first.boot_id}
    assert max(int(frame.counts.max()) for frame in seen) < 2**first.adc_bits


def test_every_packet_carries_the_number_of_the_next_frame(host: Host) -> None:
    host.tell(Order.DESCRIBE)
    host.tell(Order.IDENTIFY)
    events = host.listen(
        lambda events: bool(of(Description, events) and of(Identity, events) and isinstance(events[-1], FramePacket))
    )
    for kind in (Description, Identity):
        place = events.index(of(kind, events)[-1])
        after = of(FramePacket, events[place:])[:1]
        assert all(frame.sequence == events[place].sequence for frame in after)
        assert all(frame.time_us >= events[place].time_us for frame in after)


def test_the_description_is_that_of_the_identity(host: Host) -> None:
    identity = host.ask(Order.IDENTIFY, Identity)
    if not identity.description_bytes:
        assert host.taken(Order.DESCRIBE).status is Status.NOT_SUPPORTED
        return
    description = host.ask(Order.DESCRIBE, Description)
    assert description.design is not None
    assert description.boot_id == identity.boot_id
    array, adc = description.design["array"], description.design["adc"]
    assert (array["rows"], array["columns"], adc["bits"]) == (identity.rows, identity.columns, identity.adc_bits)


def test_stop_stops_frames_and_start_starts_them(host: Host) -> None:
    host.hear(FramePacket, 3)
    assert host.taken(Order.STOP).status is Status.TAKEN
    assert not host.ask(Order.IDENTIFY, Identity).streaming
    start = time.monotonic()
    silent = host.listen(lambda events: time.monotonic() > start + 0.5)
    assert not of(FramePacket, silent)
    assert host.taken(Order.START).status is Status.TAKEN
    host.tell(Order.START)
    assert len(host.hear(FramePacket, 3)) >= 3


def test_a_stopped_board_sends_one_frame_when_asked(host: Host) -> None:
    host.taken(Order.STOP)
    frames = []
    for _ in range(3):
        host.tell(Order.ONE_FRAME)
        frames += host.hear(FramePacket)
        start = time.monotonic()
        frames += of(FramePacket, host.listen(lambda events, start=start: time.monotonic() > start + 0.3))
    assert len(frames) == 3
    assert [frame.sequence - frames[0].sequence for frame in frames] == [0, 1, 2]
    host.taken(Order.START)


def test_the_rate_is_that_which_was_asked_for(host: Host) -> None:
    usual = host.ask(Order.IDENTIFY, Identity).period_us
    reply = host.taken(Order.RATE, period_us=50_000)
    assert reply.status is Status.TAKEN
    assert host.ask(Order.IDENTIFY, Identity).period_us == 50_000
    frames = host.hear(FramePacket, 6)[-5:]
    for before, after in pairwise(frames):  # a slow host may lose some
        periods = (after.sequence - before.sequence) % 2**32
        assert after.time_us - before.time_us == pytest.approx(50_000 * periods, abs=100)
    assert host.taken(Order.RATE, period_us=0).status is Status.OUT_OF_RANGE
    assert host.taken(Order.RATE, period_us=usual).status is Status.TAKEN


def test_the_self_test_reports_every_line(host: Host) -> None:
    identity = host.ask(Order.IDENTIFY, Identity)
    host.tell(Order.SELF_TEST)
    heard = host.listen(
        lambda events: bool(
            of(SelfTest, events) or any(one.order == Order.SELF_TEST.value for one in of(Reply, events))
        )
    )
    if not of(SelfTest, heard):
        assert of(Reply, heard)[-1].status is Status.NOT_SUPPORTED
        return
    result = of(SelfTest, heard)[-1]
    assert (len(result.rows), len(result.columns)) == (identity.rows, identity.columns)
    for nominal, measured in result.references:
        assert measured == pytest.approx(nominal, rel=0.1)


def test_a_command_that_cannot_be_taken_gets_an_error_reply(host: Host) -> None:
    for sequence, (kind, payload, version, status) in enumerate(
        (
            (0xFF, b"", 2, Status.UNKNOWN_ORDER),
            (Order.STOP.value, b"!", 2, Status.BAD_PAYLOAD),
            (Order.STOP.value, b"", 1, Status.WRONG_VERSION),
        ),
        start=9,
    ):
        # A busy board may answer a command late, and so also its repetition, after the next command has been sent.
        def answers(events: list[Event], sequence: int = sequence) -> list[Reply]:
            return [reply for reply in of(Reply, events) if reply.command_sequence == sequence]

        events: list[Event] = []
        patience = Patience()
        while not answers(events):
            host.serial.write(b"\0" + stuffed(kind, sequence, payload, version=version))
            again = Patience(1.0)
            while not (answers(events) or again.is_over):
                patience.spend(events)
                again.count()
                events += host.protocol.feed(host.serial.read(1024), time.monotonic())
        replies = answers(events)
        assert [(reply.order, reply.status) for reply in replies[:1]] == [(kind, status)]
    host.hear(FramePacket, 2)


def stuffed(kind: int, sequence: int, payload: bytes, *, version: int = 2) -> bytes:
    """A command packet, right or wrong, with its delimiter."""
    body = struct.pack("<BBIIQ", kind, version, 0, sequence, 0) + payload
    return bytes(cobs.encode(body + struct.pack("<I", zlib.crc32(body)))) + b"\0"


def test_noise_from_the_host_does_no_harm(host: Host) -> None:
    host.serial.write(bytes(range(256)) * 4)
    host.serial.write(encode(FramePacket(0, 0, 1, 1, b"\1\2")))
    host.ask(Order.IDENTIFY, Identity)
    host.hear(FramePacket, 10)


def test_it_serves_one_host_after_another(port: str) -> None:
    """A board that a host's coming has not restarted goes on counting."""
    seen = []
    for _ in range(2):
        host = Host(port)
        seen.append(host.hear(FramePacket, 5))
        host.serial.close()
        time.sleep(0.05)
    if seen[0][-1].boot_id == seen[1][0].boot_id:
        assert seen[1][0].sequence > seen[0][-1].sequence


def test_a_host_that_does_not_read_costs_whole_frames_and_is_told(host: Host) -> None:
    """No packet is cut, and a frame that speaks of an overrun has a gap in the numbers before it."""
    time.sleep(1.0)
    events = host.listen(lambda events: len(of(FramePacket, events)) > 80)
    assert not of(Corrupt, events[1:])
    for before, after in pairwise(of(FramePacket, events)):
        if Flag.OVERRUN in after.flags:
            assert after.sequence > before.sequence + 1
