"""The driver against a board in memory: conversion, losses, restarts, noise and silence."""

from __future__ import annotations

import itertools
import re
from dataclasses import FrozenInstanceError, replace
from itertools import islice

import numpy as np
import pytest
from boards import DESIGN, Script, Wire, gone, lossless, scene, sheet
from boards import frame as packet
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.cell import Cell
from ohmskin.circuits import Design, Reason, adc_codes, apparent_resistance, ideal_volts, scan
from ohmskin.common.config import parse
from ohmskin.driver import CountReader, Frame, Measurement
from ohmskin.emulator import Board, Line, Sample
from ohmskin.errors import InputError, LinkError, LinkTimeout, ProtocolError
from ohmskin.wire import (
    BOARDS,
    Corrupt,
    DescriptionPiece,
    Event,
    FramePacket,
    HostProtocol,
    Order,
    encode,
    write_description,
)


def design(**tables: object) -> Design:
    return parse({**DESIGN, **tables}, Design, source="design")


def test_frames_are_what_the_board_sent() -> None:
    taken: list[Sample] = []
    with lossless(Wire(Board(scene(), record=taken.append))) as skin:
        frames = list(islice(skin, 200))
    assert skin.description is not None
    assert skin.design == scene().skin.design
    assert skin.cell == Cell.example()
    for frame, sample in zip(frames, taken, strict=False):
        assert (frame.sequence, frame.lost_before) == (sample.sequence, 0)
        assert frame.device_time == pytest.approx(sample.time_s, abs=1e-9)
        np.testing.assert_array_equal(frame.counts, sample.counts)
        assert frame.valid.all()
    assert all(after.host_time >= before.host_time for before, after in itertools.pairwise(frames))


def test_a_frame_cannot_be_changed() -> None:
    with lossless(Wire(Board(scene()))) as skin:
        frame = next(skin)
    with pytest.raises(FrozenInstanceError):
        frame.sequence = 3  # type: ignore[misc]  # the point of the test
    for array in (frame.counts, frame.valid, frame.resistance, frame.pressure):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


def test_leaving_the_block_closes_the_port_and_so_does_a_failed_start() -> None:
    port = Wire(Board(scene()))
    with lossless(port):
        assert not port.closed
    assert port.closed
    port = Wire(Board(scene()))
    with pytest.raises(InputError, match="estimator"):
        lossless(port, estimator="crystal ball")
    assert port.closed


@given(st.floats(2e4, 1e6))
def test_counts_become_the_ohms_that_gave_them(ohms: float) -> None:
    """An ideal circuit: back within half a code, whose width in ohm is R^2 dV / (Vin Rref)."""
    plain = design(array={"rows": 3, "columns": 2})
    cells = np.full((3, 2), ohms)
    read, codes = CountReader(plain), adc_codes(plain, ideal_volts(plain, cells))
    reading = read(codes)
    assert plain.adc is not None
    step = ohms**2 * plain.adc.step / 20e3
    assert reading.valid.all()
    np.testing.assert_allclose(reading.resistance, cells, atol=0.5 * step / (1 - 0.5 * step / ohms) * (1 + 1e-9))
    own = step / ohms / 12**0.5 * reading.resistance / ohms  # of the conductance that was read
    np.testing.assert_allclose(settled(read, codes).steps_std, own, rtol=0.05)


def settled(read: CountReader, counts: np.ndarray) -> Measurement:
    """The last of many equal frames, which say that there is hardly a noise; in the first, half a step is assumed."""
    for _ in range(40):
        read(counts)
    return read(counts)


@pytest.mark.parametrize(
    ("drive", "counts", "valid"),
    [
        # Upwards from 1.65 V. Six quiet readings do not exclude a noise that moves a limit by a code.
        (-1.0, [2100, 3000, 3721, 3723, 3724, 4095], [True, True, True, False, False, False]),
        (+1.0, [2000, 1000, 250, 248, 247, 0], [True, True, True, False, False, False]),
        (-1.0, [2000, 1000, 249, 248, 247, 0], [False] * 6),  # the wrong side of the reference: no resistance does that
    ],
)
def test_clipped_and_impossible_readings_are_not_valid(drive: float, counts: list[int], valid: list[bool]) -> None:
    """An output swing of 0.2 ... 3.0 V ends within codes 248 and 3723 of the converter's 0 ... 3.3 V."""
    swing = design(
        array={"rows": 3, "columns": 2},  # over leads, three cells that may be shorts would cost the others
        drive={"voltage": drive},
        readout=DESIGN["readout"] | {"reference_voltage": 1.65, "supply": [0.2, 3.0]},
    )
    reading = settled(CountReader(swing), np.reshape(counts, (3, 2)))
    np.testing.assert_array_equal(reading.valid.ravel(), valid)
    np.testing.assert_array_equal(np.isnan(reading.resistance), ~reading.valid)


@pytest.mark.parametrize(("count", "valid"), [(0, False), (2, True), (4094, True), (4095, False)])
def test_the_ends_of_the_converter_are_not_valid(count: int, valid: bool) -> None:
    unlimited = design(readout={"circuit": "inverting-amplifier", "reference_resistance": 20e3})
    assert (settled(CountReader(unlimited), np.full((3, 2), count)).valid == valid).all()


@pytest.mark.parametrize(("drive", "weak"), [(1.0, 1e7), (-1.0, np.inf)])
def test_a_cell_under_the_range_costs_no_other_with_a_reference_in_mid_supply(drive: float, weak: float) -> None:
    """Its code may lie on the wrong side of the reference: no current is less than none."""
    board = design(
        array={"rows": 4, "columns": 4, "row_lead": 25.0, "column_lead": 25.0},
        drive={"voltage": drive},
        readout={
            "circuit": "inverting-amplifier",
            "reference_resistance": 1e3,
            "reference_voltage": 1.65,
            "supply": [0.0, 3.3],
        },
    )
    cells = np.full((4, 4), 1e4)
    cells[3, 3] = weak
    volts, noise = scan(board, cells).volts, np.random.default_rng(4)
    assert board.adc is not None
    read = CountReader(board)
    for _ in range(20):
        reading = read(adc_codes(board, volts + noise.normal(scale=board.adc.step / 2, size=volts.shape)))
        assert (reading.reason != Reason.UNSOLVED).all()
        assert reading.valid.ravel()[:-1].all()
        np.testing.assert_allclose(reading.resistance.ravel()[:-1], 1e4, rtol=0.03)


@pytest.mark.parametrize("lead", [0.0, 1.0])
def test_a_short_costs_the_cells_that_it_makes_wrong_and_no_others(lead: float) -> None:
    """Over leads of 1 ohm its column reads half of its current, without leads what it should."""
    board = design(
        array={"rows": 5, "columns": 4, "row_lead": lead, "column_lead": lead},
        readout={"circuit": "inverting-amplifier", "reference_resistance": 1e3, "supply": [-0.2, 3.3]},
    )
    cells = np.full((5, 4), 5e3)
    cells[2, 1] = 1e-3
    volts = scan(board, cells, method="exact").volts
    raw = apparent_resistance(board, volts)[[0, 1, 3, 4], 1]
    np.testing.assert_allclose(raw, 1e4 if lead else 5e3, rtol=0.01)
    reading = settled(CountReader(board), adc_codes(board, volts))
    expected = np.ones((5, 4), dtype=bool)
    expected[2, 1] = False
    if lead:
        expected[:, 1] = False
    np.testing.assert_array_equal(reading.valid, expected)
    np.testing.assert_allclose(reading.resistance[reading.valid], 5e3, rtol=0.01)
    others = np.delete(reading.uncertainty, 2, axis=0)[:, [0, 2, 3]]
    assert (others < 0.01).all()
    assert (reading.uncertainty[2, [0, 2, 3]] < 0.03).all()  # over leads their row has half of its voltage
    assert (reading.uncertainty[~expected] > 0.2).all()


def test_readings_that_no_cells_can_give_are_counted_and_not_valid() -> None:
    """In a floating divider no cell can read more than any way around it in series."""
    loaded = design(
        drive={"voltage": 3.3, "idle_rows": "float"},
        readout={"circuit": "voltage-divider", "reference_resistance": 1e3},
    )
    counts = np.full((3, 2), 4000)
    counts[0, 0] = 10
    sent = [encode(FramePacket.of(counts, sequence=n, time_us=1000 * n)) for n in range(8)]
    with lossless(Script(*sent), design=loaded, cell=Cell.example()) as skin:
        frames = list(islice(skin, 8))
        assert skin.stats().unsolved >= 1  # how many frames it takes to be sure depends on the one before
    for frame in frames:
        assert not frame.valid.any()
        assert np.isnan(frame.resistance).all()


def test_a_skin_without_a_valid_cell_says_once_why_and_what_would_help() -> None:
    """After 50 frames; the accuracy that the remark proposes makes cells valid."""
    sent = [encode(FramePacket.of(np.full((3, 2), 2000), sequence=n, time_us=1000 * n)) for n in range(120)]
    with lossless(Script(*sent), design=design(), cell=Cell.example(), accuracy=1e-5) as skin:
        assert not any(frame.valid.any() for frame in islice(skin, 49))
        assert skin.stats().remark is None
        with pytest.warns(RuntimeWarning, match=r"no cell was valid in the first 50 frames") as said:
            list(islice(skin, 71))
        assert len(said) == 1
        remark = skin.stats().remark
    assert remark is not None
    assert remark == str(said[0].message)
    assert "0.001 % was asked for" in remark
    proposed = re.search(r"accuracy=([\d.e-]+)\)", remark)
    assert proposed is not None
    with lossless(Script(*sent), design=design(), cell=Cell.example(), accuracy=float(proposed[1])) as skin:
        frames = list(islice(skin, 60))
        assert "accuracy" not in (skin.stats().remark or "")  # that cells differ without a tare may still be said
    assert frames[-1].valid.any()


def test_a_data_sheet_in_another_unit_is_told_once_and_by_what_factor() -> None:
    """After 50 frames; and a tare, which measures the rest resistances, ends it."""
    cell, unit = Cell.example(), 1e-3
    sent = [encode(FramePacket.of(np.full((3, 2), 2000), sequence=n, time_us=1000 * n)) for n in range(120)]
    with lossless(Script(*sent), design=design(), cell=cell) as skin:
        rest_ohm = float(next(skin).resistance[0, 0])
    told = cell.replace(rest_resistance_ohm=unit * rest_ohm)
    with lossless(Script(*sent), design=design(), cell=told) as skin:
        list(islice(skin, 49))
        with pytest.warns(
            RuntimeWarning, match=f"{1 / unit:.2g} times the {unit * rest_ohm:.4g} ohm".replace("+", r"\+")
        ) as said:
            list(islice(skin, 31))
        assert len(said) == 1
        assert skin.stats().remark == str(said[0].message)
        skin.tare(force=True)
        assert skin.stats().remark is None
    with lossless(Script(*sent), design=design(), cell=cell.replace(rest_resistance_ohm=rest_ohm)) as skin:
        list(islice(skin, 60))
        assert skin.stats().remark is None


def test_an_invalid_cell_keeps_its_last_pressure() -> None:
    """Pressed so hard that the divider's output leaves the converter's range."""
    narrow = DESIGN | {"adc": {"bits": 12, "range": [1.5, 3.3]}}
    with lossless(Wire(Board(scene(skin={"design": narrow})))) as skin:
        frames = list(islice(skin, 100))
    invalid = [k for k, frame in enumerate(frames) if not frame.valid[1, 1]]
    assert len(invalid) > 20
    held = frames[invalid[0] - 1].pressure[1, 1]
    for k in invalid:
        assert np.isnan(frames[k].resistance[1, 1])
        assert frames[k].pressure[1, 1] == held
        assert frames[k].valid.sum() == 5


def total_lost(frames: list[Frame]) -> int:
    return sum(frame.lost_before or 0 for frame in frames)


def test_what_the_line_spoils_is_counted_as_lost_and_never_believed() -> None:
    taken: dict[int, Sample] = {}
    board = Board(scene(), record=lambda sample: taken.__setitem__(sample.sequence, sample))
    port = Wire(board, frames=1000)
    frames: list[Frame] = []
    with lossless(port) as skin:
        port.line = Line(scene(line={"bit_errors": 3e-4}).line, seed=5)
        with pytest.raises(LinkError, match="gone"):
            frames.extend(skin)
    assert skin.stats().corrupt > 50
    first = frames[0].sequence - frames[0].lost_before  # the description may have come late
    assert total_lost(frames) + len(frames) == frames[-1].sequence - first + 1
    assert total_lost(frames) > 50
    for frame in frames:
        np.testing.assert_array_equal(frame.counts, taken[frame.sequence].counts)


TURNED = encode(FramePacket.of(np.full((2, 3), 2000), sequence=0, time_us=0, boot_id=1))


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        (TURNED, "the board sends 2 x 3 cells; its design has 3 x 2"),
        (packet(0, level=4096), "the board sends a count of 4096; its ADC has 12 bits"),
    ],
)
def test_frames_that_contradict_the_board_are_protocol_errors(piece: bytes, message: str) -> None:
    with lossless(Script(sheet(), piece)) as skin, pytest.raises(ProtocolError, match=re.escape(message)):
        next(skin)


def test_a_description_that_is_no_design_is_a_protocol_error() -> None:
    text = write_description({"array": {"rows": 3}}, {})
    wrong = encode(DescriptionPiece(0, 0, 0, len(text), text))
    with pytest.raises(ProtocolError, match=re.escape("script: the board describes itself wrongly: design: missing")):
        lossless(Script(wrong))


def test_a_design_given_goes_before_the_description() -> None:
    ideal = design(array={"rows": 3, "columns": 2})
    other = design(array={"rows": 3, "columns": 2}, readout=DESIGN["readout"] | {"reference_resistance": 10e3})
    with lossless(Script(sheet(), packet(0)), design=other) as skin:
        theirs = next(skin).resistance
    with lossless(Script(sheet(), packet(0)), design=ideal) as skin:
        np.testing.assert_allclose(next(skin).resistance, 2 * theirs)


@pytest.mark.parametrize("noise", [b"hello, world\r\n", bytes([1, 0, 7, 9]) * 50])
def test_noise_is_named_within_the_timeout(noise: bytes) -> None:
    port = Script(last=lambda: noise)
    with pytest.raises((ProtocolError, LinkTimeout), match=r"no description within 0\.3 s"):
        lossless(port, timeout=0.3)
    assert port.closed


def test_a_board_that_only_describes_itself_is_told_apart_from_noise() -> None:
    said = r"no frame within 1 s: the board is there, but sends none"
    with lossless(Script(sheet(), last=sheet), timeout=1.0) as skin, pytest.raises(LinkTimeout, match=said):
        next(skin)


class TextLines(HostProtocol):
    """A foreign board as an example: each line a frame of decimals, no numbers, no time, no description."""

    rest = b""

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        *lines, self.rest = (self.rest + data).split(b"\n")
        return [self.read(line, received_at) for line in lines]

    def read(self, line: bytes, received_at: float) -> Event:
        try:
            counts = np.array([int(word) for word in line.split()]).reshape(-1, self.layout.columns)
        except ValueError as error:
            return Corrupt(len(line), str(error))
        return FramePacket.of(counts, sequence=None, time_us=None)

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return b"a" if order is Order.START else b""


def test_another_family_of_boards_needs_another_protocol_only() -> None:
    what = scene().skin
    port = Script(b"2000 2001 2002 20", b"03 2004 2005\n20 x\n0 100 200 300 400 4095\n")
    family = replace(
        BOARDS["ohmskin"], name="text", host=TextLines, has_description=False, has_sequence=False, has_device_time=False
    )
    with lossless(port, design=what.design, cell=what.cell, board=family) as skin:
        first, second = islice(skin, 2)
    np.testing.assert_array_equal(first.counts, np.arange(2000, 2006).reshape(3, 2))
    np.testing.assert_array_equal(second.valid, [[False, True], [True, True], [True, False]])
    assert skin.stats().corrupt == 1
    assert first.pressure.shape == (3, 2)
    assert (first.sequence, second.lost_before) == (None, None)


@settings(max_examples=30)
@given(st.lists(st.binary(max_size=200), max_size=8))
def test_whatever_arrives_ends_in_a_frame_or_a_link_or_protocol_error(pieces: list[bytes]) -> None:
    with lossless(Script(sheet(), *pieces, b"\0" + packet(0), last=gone)) as skin:
        assert next(skin).sequence == 0
        with pytest.raises(LinkError, match="gone"):
            next(skin)


def test_a_short_beside_an_open_cell_does_not_void_the_skin() -> None:
    """The open cell reads now more, now less than the offset; what that does to its column voids no other one."""
    cells = {
        "array": {"rows": 8, "columns": 8, "row_lead": 4.0, "column_lead": 2.0, "row_segment": 0.2},
        "readout": {**DESIGN["readout"], "reference_resistance": 4700.0, "open_loop_gain": 2e5, "offset_voltage": 5e-4},
        "fault": [{"kind": "shorted-cell", "place": [3, 3]}, {"kind": "open-cell", "place": [6, 6]}],
    }
    design = parse({**DESIGN, **cells}, Design, source="board")
    true = np.full((8, 8), 10e3)
    read = CountReader(design)
    for count in range(5):
        counts = adc_codes(design, scan(design, true).volts)
        counts[6, 6] = count
        reading = read(counts)
        assert reading.valid.sum() == 48  # all but the row and the column of the short, and the open cell
        np.testing.assert_allclose(reading.resistance[reading.valid], 10e3, rtol=0.02)
