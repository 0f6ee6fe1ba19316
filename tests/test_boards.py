"""The families of boards: literal bytes, any cut, damage, and each one's known fault."""

from __future__ import annotations

import re
import struct
import tracemalloc
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from boards import EXAMPLES, scene
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ohmskin.cell import Cell
from ohmskin.driver import Skin
from ohmskin.emulator import PtyPort, running
from ohmskin.errors import InputError
from ohmskin.wire import (
    BOARDS,
    BoardProtocol,
    Command,
    Corrupt,
    Event,
    FramePacket,
    HostProtocol,
    Order,
    board_protocol,
    host_protocol,
)

FOREIGN = [name for name in BOARDS if name != "ohmskin"]
SMALL = [name for name in FOREIGN if BOARDS[name].layout.rows * BOARDS[name].layout.columns <= 256]
Counts = NDArray[np.uint16]


def ends(name: str) -> tuple[HostProtocol, BoardProtocol]:
    return host_protocol(name), board_protocol(name)


def picture(name: str, seed: int) -> Counts:
    """Counts over the whole range of the family's converter."""
    layout = BOARDS[name].layout
    random = np.random.default_rng(seed)
    return random.integers(0, 2**layout.adc_bits, (layout.rows, layout.columns)).astype(np.uint16)


def stream(board: BoardProtocol, pictures: list[Counts]) -> bytes:
    return b"".join(
        board.frame(FramePacket.of(counts, sequence=k, time_us=20_000 * k)) for k, counts in enumerate(pictures)
    )


def frames(events: list[Event]) -> list[FramePacket]:
    return [event for event in events if isinstance(event, FramePacket)]


# Literal frames, assembled here by hand from the description of each format.
RAMP8 = np.arange(256, dtype=np.uint16).reshape(16, 16)


def _with_ends(rows: int, columns: int) -> Counts:
    cells = np.zeros((rows, columns), dtype=np.uint16)
    cells[0, 0], cells[-1, -1] = 0x0102, 0x0FFF
    return cells


LITERAL: dict[str, tuple[Counts, bytes]] = {
    "flexitac": (
        (np.arange(512) % 100).astype(np.uint16).reshape(16, 32),
        bytes.fromhex("aa 55") + bytes(k % 100 for k in range(512)),
    ),
    "vitac": (RAMP8, b"".join(b"%d " % k + b"\r\n" * (k % 16 == 15) for k in range(256)) + b"\r\n"),
    "snowboard": (
        np.arange(160, dtype=np.uint16).reshape(10, 16),
        ",".join(map(str, range(160))).encode() + b"\r\n",
    ),
    "capstone": (
        _with_ends(12, 20),
        bytes.fromhex("aa 55 02 01") + bytes(2 * 238) + bytes.fromhex("ff 0f 11 01 0d 0a"),
    ),
    "m1616": (
        _with_ends(16, 16),
        bytes.fromhex("aa ab ac 01 02") + bytes(2 * 254) + bytes.fromhex("0f ff 00 00 00 00"),
    ),
}


@pytest.mark.parametrize("name", LITERAL)
def test_frames_in_literal_bytes(name: str) -> None:
    """Written, and read by a host that has heard a whole frame before."""
    cells, line = LITERAL[name]
    host, board = (make(name, shape=cells.shape) for make in (host_protocol, board_protocol))
    assert board.frame(FramePacket.of(cells, sequence=0, time_us=0)) == line
    seen = frames(host.feed(line * 3, 4.5))
    np.testing.assert_array_equal(seen[-1].counts, cells)
    assert (seen[-1].sequence, seen[-1].time_us) == (None, None)


@pytest.mark.parametrize(("bits", "value", "pair"), [(10, 0x3E5, (0x1F, 0x05)), (12, 0xFC5, (0x3F, 0x05))])
def test_actionsense_in_literal_bytes(bits: int, value: int, pair: tuple[int, int]) -> None:
    cells = np.zeros((32, 32), dtype=np.uint16)
    cells[0, 1] = value
    high, low = pair
    line = bytes([11, 11, 11, high + 11, low + 11]) + bytes([11]) * (2 * 1022) + b"\n"
    assert len(line) == 2050
    board = board_protocol("actionsense", adc_bits=bits)
    assert board.frame(FramePacket.of(cells, sequence=0, time_us=0)) == line
    host = host_protocol("actionsense", adc_bits=bits)
    np.testing.assert_array_equal(frames(host.feed(line, 0.0))[0].counts, cells)
    rows = b"".join(bytes([14, 11 + row]) + line[1 + 64 * row : 65 + 64 * row] + b"\n" for row in range(32))
    np.testing.assert_array_equal(frames(host.feed(rows, 0.0))[0].counts, cells)
    assert isinstance(host.feed(rows[:67] + rows[: 67 * 2], 0.0)[0], Corrupt)


def test_fsr_array_in_literal_bytes() -> None:
    cells = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 0xFFF]], dtype=np.uint16)
    line = bytes.fromhex("40 42 0f 00 28 46 0f 00 01 00 02 00 03 00 04 00 05 00 06 00 07 00 08 00 ff 0f")
    host, board = (make("fsr-array", shape=(3, 3)) for make in (host_protocol, board_protocol))
    assert host.request(Order.ONE_FRAME) == b"\x03"
    assert board.feed(b"\x03\x09") == [Command(Order.ONE_FRAME)]
    assert board.frame(FramePacket.of(cells, sequence=0, time_us=1_000_000)) == line
    (frame,) = frames(host.feed(line, 0.0))
    np.testing.assert_array_equal(frame.counts, cells)
    assert (frame.sequence, frame.time_us) == (None, 1_000_000)
    two = [make("fsr-array", shape=(4, 2)) for make in (host_protocol, board_protocol)]
    layers = np.array([[1, 2], [3, 4], [5, 6], [7, 8]], dtype=np.uint16)
    line = two[1].frame(FramePacket.of(layers, sequence=0, time_us=0))
    assert struct.unpack("<8H", line[8:]) == (1, 2, 5, 6, 3, 4, 7, 8)
    np.testing.assert_array_equal(frames(two[0].feed(line, 0.0))[0].counts, layers)
    assert two[0].request(Order.ONE_FRAME) == b"\x42"


def test_the_time_of_an_fsr_array_goes_on_beyond_32_bits() -> None:
    host, board = (make("fsr-array", shape=(1, 1)) for make in (host_protocol, board_protocol))
    stamps = [2**32 - 40_000, 2**32 - 20_000, 2**32, 2**32 + 20_000]
    line = b"".join(board.frame(FramePacket.of([[5]], sequence=0, time_us=stamp)) for stamp in stamps)
    assert [frame.time_us for frame in frames(host.feed(line, 0.0))] == stamps


def wiresens_packet(first: int, readings: list[int], number: int) -> bytes:
    return struct.pack("<bH120HI", 1, first, *readings, number) + b"wr"


def test_wiresens_in_literal_bytes() -> None:
    """Three packets carry one frame of 256 cells and the beginning of the next."""
    cells = list(range(256)) + [4095] * 104
    line = b"".join(wiresens_packet(120 * k % 256, cells[120 * k : 120 * k + 120], k) for k in range(3))
    assert len(line) == 3 * 249
    assert line[:7] == bytes.fromhex("01 00 00 00 00 01 00")
    board = board_protocol("wiresens")
    ramp, full = RAMP8, np.full((16, 16), 4095, dtype=np.uint16)
    assert stream(board, [ramp, full])[: len(line)] == line
    (frame,) = frames(host_protocol("wiresens").feed(line, 0.0))
    np.testing.assert_array_equal(frame.counts, ramp)
    assert (frame.sequence, frame.time_us) == (0, None)


def test_wiresens_sends_changes_as_pairs() -> None:
    host = host_protocol("wiresens")
    cells = list(range(256)) + [0] * 104
    host.feed(b"".join(wiresens_packet(120 * k % 256, cells[120 * k : 120 * k + 120], k) for k in range(3)), 0.0)
    pairs = [0, 4000] * 59 + [255, 77]
    (frame,) = frames(host.feed(wiresens_packet(20000, pairs, 3), 0.0))
    assert (frame.counts[0, 0], frame.counts[15, 15], frame.counts[10, 10]) == (4000, 77, 170)
    assert frame.sequence is None


@pytest.mark.parametrize("name", list(BOARDS))
@given(st.lists(st.binary(max_size=300), max_size=10))
@settings(max_examples=20)
def test_any_bytes_are_events_and_never_errors(name: str, pieces: list[bytes]) -> None:
    host, board = ends(name)
    for piece in pieces:
        host.feed(piece, 0.0)
        board.feed(piece)


# Known faults


def test_a_false_header_of_flexitac_is_seen_through() -> None:
    """Cells of 170 and 85 side by side, for as long as you like, and bytes that are lost meanwhile."""
    host, board = ends("flexitac")
    random = np.random.default_rng(8)
    base = random.integers(5, 60, (16, 32)).astype(np.uint16)
    plain = [base + random.integers(0, 3, (16, 32)).astype(np.uint16) for _ in range(20)]
    pressed = [counts.copy() for counts in plain]
    for counts in pressed:
        counts[4, 10:12] = 170, 85
    line = stream(board, [*plain, *pressed * 10])
    lost = 514 * 25 + 100
    events = host.feed(line[:lost] + line[lost + 130 :], 0.0)  # the loss ends at the false header
    seen = [frame.counts for frame in frames(events)]
    good = [any(np.array_equal(one, counts) for counts in [*plain, *pressed]) for one in seen]
    assert sum(good) >= 20 + 200 - 4
    assert good.count(False) <= 1  # the frame that lost its bytes cannot be told from a good one
    assert [event for event in events if isinstance(event, Corrupt)]


def test_a_packet_number_of_wiresens_that_contains_the_terminator_costs_nothing() -> None:
    """Numbers around 0x7277 and from 0x727700 on have "wr" in them."""
    for start in (0x7270, 0x727700, 0x72770000, 0x7277 << 8):
        host, events = host_protocol("wiresens"), list[Event]()
        random = np.random.default_rng(start)
        first = 0
        for number in range(start, start + 300):
            events += host.feed(wiresens_packet(first, random.integers(0, 4096, 120).tolist(), number), 0.0)
            first = (first + 120) % 256
        assert not [event for event in events if isinstance(event, Corrupt)]
        assert len(frames(events)) >= 300 * 120 // 256 - 1
        for before, after in pairwise(frames(events)):
            assert before.sequence is not None
            assert after.sequence == before.sequence + 1


def test_lost_packets_of_wiresens_are_frames_that_are_missing_by_number() -> None:
    board, host = board_protocol("wiresens"), host_protocol("wiresens")
    line = stream(board, [picture("wiresens", seed) for seed in range(40)])
    packets = [line[k : k + 249] for k in range(0, len(line), 249)]
    kept = b"".join(packet for k, packet in enumerate(packets) if k not in {10, 30, 31})
    seen = frames(host.feed(kept, 0.0))
    for frame in seen:
        assert frame.sequence is not None
        np.testing.assert_array_equal(frame.counts, picture("wiresens", frame.sequence))
    numbers = [frame.sequence for frame in seen]
    missing = {packet * 120 // 256 for packet in (10, 30, 31)} | {
        (packet * 120 + 119) // 256 for packet in (10, 30, 31)
    }
    assert set(range(len(line) // 249 * 120 // 256)) - set(numbers) == missing


# With driver and emulator


PRESS = {"cells": [[1, 1]], "load_kpa": [[0.0, 0.0], [0.05, 12.0]]}


@pytest.mark.parametrize("name", SMALL)
def test_the_driver_makes_pressures_of_what_the_emulator_speaks(name: str) -> None:
    port, cell = PtyPort(), Cell.example()
    what = scene(skin={"design": BOARDS[name].design}, contact=[PRESS], board={"frame_rate": 40.0})
    with running(what, port, family=name), Skin.open(port.name, board=name, cell=cell, timeout=60.0) as skin:
        taken = list(islice(skin, 60))
    for frame in taken:
        assert (frame.sequence is not None) == BOARDS[name].has_sequence
        assert (frame.lost_before is not None) == BOARDS[name].has_sequence
        assert (frame.device_time is not None) == BOARDS[name].has_device_time
    assert max(frame.pressure[1, 1] for frame in taken) > 6.0


def test_a_board_that_a_family_does_not_have_is_refused() -> None:
    for name, shape, message in (
        ("wiresens", (3, 3), "a board 'wiresens' of 3 x 3 cells; the family has 16 x 16, 32 x 32"),
        ("fsr-array", (16, 17), "the family has n x n or, in two layers, 2n x n"),
    ):
        for make in (host_protocol, board_protocol):
            with pytest.raises(InputError, match=re.escape(message)):
                make(name, shape=shape)
    with pytest.raises(InputError, match="an ADC of 12 bits; its format carries at most 8"):
        board_protocol("flexitac", adc_bits=12)


@pytest.mark.parametrize("board", [*BOARDS, *sorted((EXAMPLES / "boards").glob("*.toml"))], ids=str)
def test_noise_without_end_takes_bounded_memory(board: str | Path) -> None:
    host, random = host_protocol(board), np.random.default_rng(5)
    held = []
    tracemalloc.start()
    try:
        for number in range(20):
            host.feed(random.bytes(10_000), float(number))
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert held[-1] - held[9] < 30_000  # of the 100,000 bytes since then
