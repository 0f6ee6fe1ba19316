"""Transmission, faults and device of the emulator: time is an argument, no clock, no port."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from boards import DESIGN, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.emulator import Board, Device, Line, LineSettings, LinkFault, Scene, Transmission
from ohmskin.errors import InputError
from ohmskin.wire import (
    Command,
    Corrupt,
    Description,
    Event,
    Flag,
    FramePacket,
    Identity,
    Order,
    encode,
    host_protocol,
)

sizes = st.lists(st.integers(1, 200), min_size=1, max_size=20)


def data(size: int, seed: int = 1) -> bytes:
    return np.random.default_rng(seed).bytes(size)


@settings(max_examples=30)
@given(sizes, st.sampled_from([9600, 115_200, 1_000_000]), st.integers(1, 5000))
def test_a_uart_carries_a_byte_in_ten_bit_times(sizes: list[int], baud_rate: int, step_us: int) -> None:
    line = Transmission(LineSettings(baud_rate=baud_rate, board_buffer=10**6), 1)
    sent = b"".join(data(size, k) for k, size in enumerate(sizes))
    for k, size in enumerate(sizes):
        assert line.offer(data(size, k), 0.0)
    now_us, got = 0.0, b""
    while len(got) < len(sent):
        now_us += step_us
        line.advance(now_us)
        got += bytes(line.host)
        line.taken(len(line.host))
        assert abs(len(got) - min(now_us * baud_rate / 1e7, len(sent))) <= 1.0
    assert got == sent


def test_a_uart_that_is_too_slow_overflows_the_board_and_one_that_nobody_reads_the_host() -> None:
    line = Transmission(LineSettings(baud_rate=10_000, board_buffer=100, host_buffer=500), 1)
    taken = sum(line.offer(bytes([k]) * 50, 0.0) for k in range(10))
    assert taken == 2
    for second in range(1, 20):  # 1000 bytes/s at most; nobody reads
        now_us = 1e6 * second
        line.advance(now_us)
        line.offer(b"x" * 80, now_us)
    line.advance(1e9)
    assert len(line.host) == 500
    assert line.lost_bytes == 2 * 50 + 19 * 80 - 500


def test_a_usb_bridge_sends_full_packets_at_once_and_the_rest_when_its_timer_ends() -> None:
    line = Transmission(LineSettings(usb_packet=62, latency_s=0.016), 10**6)
    line.offer(data(200), 1000.0)
    line.advance(1000.0)
    assert len(line.host) == 186
    assert line.next_us(1000.0) == pytest.approx(17_000)
    line.advance(16_999.0)
    assert len(line.host) == 186
    line.advance(17_000.0)
    assert bytes(line.host) == data(200)
    assert line.next_us(17_000.0) == np.inf


def carried(kind: str, **keys: object) -> list[bytes]:
    fault = LinkFault.model_validate({"kind": kind, **keys})
    line = Line(LineSettings(), 3, [fault])
    return [line.carry(data(1000, k), k / 10) for k in range(100)]


@pytest.mark.parametrize(
    ("kind", "growth"), [("dropped-bytes", -1), ("inserted-bytes", 1), ("duplicated-bytes", 1), ("flipped-bits", 0)]
)
def test_byte_faults_come_at_their_rate_and_in_their_time(kind: str, growth: int) -> None:
    packets = carried(kind, probability=0.02, at_s=2.0, duration_s=3.0)
    clean = [data(1000, k) for k in range(100)]
    assert packets[:20] == clean[:20]
    assert packets[50:] == clean[50:]
    assert all(packet != good for packet, good in zip(packets[20:50], clean[20:50], strict=True))
    hits = sum(len(packet) - 1000 for packet in packets[20:50])
    if growth:
        assert hits * growth == pytest.approx(600, abs=120)
    else:
        errors = np.frombuffer(b"".join(packets), np.uint8) ^ np.frombuffer(b"".join(clean), np.uint8)
        assert int(np.unpackbits(errors).sum()) == pytest.approx(600, abs=120)
    assert packets == carried(kind, probability=0.02, at_s=2.0, duration_s=3.0)  # the seed's


def test_a_fault_without_probability_hits_its_count_once_in_each_period() -> None:
    packets = carried("dropped-bytes", at_s=1.05, every_s=2.0, count=3)
    short = {k: 1000 - len(packet) for k, packet in enumerate(packets) if len(packet) != 1000}
    assert short == {11: 3, 31: 3, 51: 3, 71: 3, 91: 3}


def test_whole_packets_are_dropped_or_doubled() -> None:
    assert [len(packet) for packet in carried("dropped-packets", at_s=0.15)[:4]] == [1000, 1000, 0, 1000]
    assert [len(packet) for packet in carried("duplicated-packets", at_s=0.15)[:4]] == [1000, 1000, 2000, 1000]


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"kind": "stall", "probability": 0.1}, "a fault of kind 'stall' has no probability"),
        ({"kind": "reset", "name": "x"}, "a fault of kind 'reset' has no name"),
        ({"kind": "stall", "duration_s": 3.0, "every_s": 2.0}, "lasts 3.0 s and comes every 2.0 s"),
        ({"kind": "stal"}, "kind"),
        ({"kind": "stall", "duration_s": float("nan")}, "duration_s"),
    ],
)
def test_a_fault_that_cannot_be_is_refused(fault: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        scene(link_fault=[fault])


def live(what: Scene, seconds: float, *, read: bool = True, seed: int = 0) -> tuple[Device, list[tuple[float, Event]]]:
    """A device for some seconds of line time, read every millisecond; the events and when they came."""
    device, host, heard = Device(what, Board(what, seed=seed), seed=seed), host_protocol("ohmskin"), []
    now_us = 0.0
    while now_us < 1e6 * seconds:
        while device.next_us <= now_us:
            device.tick(host_present=True)
        device.advance(now_us)
        if read:
            arrived = device.arrived()
            device.transmission.taken(len(arrived))
            heard += [(now_us, event) for event in host.feed(arrived, now_us)]
        now_us += 1000.0
    return device, heard


def frames(heard: list[tuple[float, Event]]) -> list[FramePacket]:
    return [event for _, event in heard if isinstance(event, FramePacket)]


def test_a_megabaud_line_cannot_carry_64_x_64_at_1_khz_and_says_so() -> None:
    """100 000 bytes/s hold 12 frames of 8218 bytes: of a thousand frames a second the others are overrun."""
    what = scene(
        skin={"design": DESIGN | {"array": {"rows": 64, "columns": 64}}},
        board={"frame_rate": 1000.0},
        line={"baud_rate": 1_000_000},
        contact=[],
    )
    device, heard = live(what, 2.0)
    got = frames(heard)
    assert len(got) == pytest.approx(2.0 * 100_000 / 8250, abs=3)
    assert not [event for _, event in heard if isinstance(event, Corrupt)]
    for before, after in pairwise(got):
        assert (Flag.OVERRUN in after.flags) == (after.sequence - before.sequence > 1)
    assert device.dropped == pytest.approx(2000 - len(got), abs=10)


def test_a_host_that_does_not_read_makes_a_counted_overflow_and_never_a_stall() -> None:
    for line in ({}, {"baud_rate": 1_000_000}):
        device, _ = live(scene(line=line, board={"frame_rate": 500.0}), 20.0, read=False)
        assert device.time_s == pytest.approx(20.0, abs=0.01)
        assert len(device.transmission) < 200_000
        assert (device.transmission.lost_bytes if line else device.dropped) > 0


def test_the_boards_clock_has_its_offset_and_its_drift() -> None:
    what = scene(clock={"offset_s": 50.0, "drift_ppm": 1000.0}, board={"frame_rate": 100.0})
    _, heard = live(what, 10.0)
    got = [(now_us, event) for now_us, event in heard if isinstance(event, FramePacket)]
    stamps = np.array([event.time_us for _, event in got])
    arrivals = np.array([now_us for now_us, _ in got])
    assert stamps[0] == 50_000_000
    slope = np.polyfit(arrivals, stamps, 1)[0]
    assert slope == pytest.approx(1.001, abs=5e-5)


def test_a_reset_is_a_new_boot_with_text_on_the_line() -> None:
    what = scene(link_fault=[{"kind": "reset", "at_s": 1.0, "duration_s": 0.5}], board={"frame_rate": 100.0})
    _, heard = live(what, 3.0)
    got = frames(heard)
    boots = [frame.boot_id for frame in got]
    assert sorted(set(boots)) == [1, 2]
    first = boots.index(2)
    assert (got[first].sequence, got[first - 1].sequence) == (0, 99)
    assert got[first].time_us == 500_000
    assert len([event for _, event in heard if isinstance(event, Description) and event.boot_id == 2]) == 1
    assert len([event for _, event in heard if isinstance(event, Identity) and event.boot_id == 2]) >= 1
    (text,) = [event for _, event in heard if isinstance(event, Corrupt)]
    assert text.size > 10


def test_a_stall_delivers_late_and_a_second_host_takes_bytes_away() -> None:
    what = scene(link_fault=[{"kind": "stall", "at_s": 1.0, "duration_s": 0.5}], board={"frame_rate": 100.0})
    _, heard = live(what, 3.0)
    quiet = [now_us for now_us, event in heard if isinstance(event, FramePacket) and 1.01e6 < now_us < 1.49e6]
    assert not quiet
    assert [frame.sequence for frame in frames(heard)] == list(range(300))

    what = scene(link_fault=[{"kind": "split-bytes", "at_s": 0.0, "duration_s": 9.0}], board={"frame_rate": 10.0})
    _, heard = live(what, 3.0)
    assert [frame.sequence for frame in frames(heard)][:5] == list(range(5))

    what = scene(link_fault=[{"kind": "second-host", "at_s": 1.0, "duration_s": 1.0}], board={"frame_rate": 100.0})
    device, host, heard = Device(what, Board(what)), host_protocol("ohmskin"), []
    while device.time_s < 3.0:
        device.tick(host_present=True)
        device.advance(device.next_us)
        device.steal()
        arrived = device.arrived()
        device.transmission.taken(len(arrived))
        heard += [(device.time_s, event) for event in host.feed(arrived, 0.0)]
    numbers = [frame.sequence for frame in frames(heard)]
    assert set(range(98)) <= set(numbers)
    assert len([number for number in numbers if 100 <= number < 200]) < 90
    assert set(range(210, 300)) <= set(numbers)


def test_the_same_seed_gives_the_same_bytes() -> None:
    what = scene(
        board={"noise": 0.001, "frame_rate": 200.0},
        line={"bit_errors": 1e-5},
        clock={"jitter_s": 0.001},
        link_fault=[{"kind": "dropped-bytes", "probability": 1e-3}, {"kind": "reset", "at_s": 0.5}],
    )
    once, again, other = (live(what, 1.0, seed=seed)[1] for seed in (4, 4, 5))
    assert once == again != other


def test_a_flood_of_commands_by_a_host_that_does_not_read_grows_nothing_and_stops_no_clock() -> None:
    board = Board(scene(board={"frame_rate": 100.0}))
    device = Device(board.scene, board)
    flood = encode(Command(Order.DESCRIBE)) * 200 + encode(Command(Order.SELF_TEST)) * 200
    while device.time_s < 3.0:
        device.tick(host_present=True)
        device.receive(flood, device.next_us)
        device.advance(device.next_us)
        assert len(device.transmission) < 30_000
