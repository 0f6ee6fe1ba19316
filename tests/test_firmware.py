"""The reference board's program on an emulated processor, against the circuit, the protocol and its own documents.

Transport is in process, so that a run depends on nothing but its inputs; ``tests/conformance`` uses pyserial."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import MemoryPort, lossless, until
from cobs import cobs
from needs import need

from ohmskin.cell import Cell
from ohmskin.circuits import Design, Settling, adc_codes, scan
from ohmskin.driver import Skin
from ohmskin.emulator import PtyPort, Sample, Scene, running
from ohmskin.emulator.firmware import (
    AVR8JS,
    REFERENCE_BOARDS,
    BoardKind,
    BoardSettings,
    Engine,
    FirmwareBoard,
    Processor,
    check_scene,
    missing_for,
)
from ohmskin.errors import InputError, LinkError, MissingExtra
from ohmskin.verification import verify
from ohmskin.wire import Corrupt, Description, Event, FramePacket, LineState, Order, SelfTest, host_protocol

ROOT = Path(__file__).parents[1]
FIRMWARE = ROOT / "firmware"
SMALL, LARGE = REFERENCE_BOARDS


@pytest.fixture(autouse=True)
def engine(request: pytest.FixtureRequest) -> None:
    if "without_node" not in request.keywords:
        need(missing_for())


def scene(name: str = "4x4", *, replace: dict[str, Any] | None = None, **tables: Any) -> Scene:
    design = Design.load(ROOT / "examples" / f"board-{name}.toml").replace(**replace or {})
    given = {"skin": {"design": design.model_dump(exclude_unset=True)}, **tables}
    return Scene.from_tables(given, source="scene", directory=ROOT)


def of(kind: type[Any], events: list[Event]) -> list[Any]:
    return [event for event in events if isinstance(event, kind)]


class Host:
    """The host's end of the protocol, without a driver."""

    def __init__(self, board: FirmwareBoard) -> None:
        self.board = board
        self.protocol = host_protocol("ohmskin")

    def hear(self, seconds: float) -> list[Event]:
        return self.protocol.feed(self.board.run(seconds), self.board.time_s)

    def ask(self, order: Order, seconds: float = 0.03, *, period_us: int = 0) -> list[Event]:
        self.board.send(self.protocol.request(order, period_us=period_us))
        return self.hear(seconds)


class FirmwareWire(MemoryPort):
    """The host's end of the serial line without port or thread: whoever reads lets board time pass."""

    name = "firmware"

    def __init__(self, board: FirmwareBoard) -> None:
        super().__init__()
        self.board = board

    def ready(self) -> bool:
        return True

    def next_bytes(self) -> bytes:
        return self.board.run(5e-3) or b"\0"

    def write(self, data: bytes) -> None:
        self.board.send(data)


# ---- the program and its documents


@pytest.mark.parametrize("kind", REFERENCE_BOARDS, ids=lambda kind: kind.name)
def test_the_program_describes_the_design_that_is_shipped(kind: Any) -> None:
    """Both ways: the header is what the script makes of the design, and the board says what the design says."""
    spec = importlib.util.spec_from_file_location("describe", FIRMWARE / "describe.py")
    assert spec is not None
    assert spec.loader is not None
    describe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(describe)
    design = Design.load(ROOT / "examples" / f"board-{kind.name}.toml")
    header = FIRMWARE / "src" / f"description_{kind.name}.h"
    assert header.read_text() == describe.header(design, Cell.example())
    with FirmwareBoard(scene(kind.name)) as board:
        heard = Host(board).hear(0.35)
    (description,) = of(Description, heard)
    assert Design.model_validate(description.design) == Design.model_validate(
        design.model_dump(exclude_defaults=True, exclude=describe.NOT_SENT)
    )
    assert Cell.model_validate(description.cell) == Cell.example()
    assert not of(Corrupt, heard)


def compiler() -> str | None:
    """What the byte-for-byte comparison lacks: it holds for the compiler that made the shipped files."""
    if shutil.which("avr-gcc") is None or shutil.which("make") is None:
        return "avr-gcc is not installed: gcc-avr and avr-libc from Debian"
    version = subprocess.run(["avr-gcc", "-dumpversion"], capture_output=True, text=True, check=True).stdout.strip()
    return None if version == "5.4.0" else f"avr-gcc is {version}; the shipped files are from 5.4.0"


@pytest.mark.without_node
def test_the_sources_give_the_shipped_program_byte_for_byte(tmp_path: Path) -> None:
    need(compiler())
    copy = tmp_path / "elsewhere"
    shutil.copytree(FIRMWARE, copy, ignore=shutil.ignore_patterns("build"))
    done = subprocess.run(["make", "-C", copy, "check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# ---- what it reads


@pytest.mark.parametrize("kind", REFERENCE_BOARDS, ids=lambda kind: kind.name)
def test_every_count_is_that_of_the_voltage_at_its_sample_instant(kind: Any) -> None:
    """From the converter over the serial line to the host; and with the usual dwell the voltage is the settled one."""
    press = {"cells": [[1, 2]], "load_kpa": [[0.0, 0.0], [0.01, 15.0]]}
    samples: list[Sample] = []
    with FirmwareBoard(scene(kind.name, contact=[press], board={"noise": 1e-3}), record=samples.append) as board:
        frames = of(FramePacket, Host(board).hear(0.115))
    assert len(frames) == len(samples) >= 5
    for frame, sample in zip(frames, samples, strict=True):
        assert (frame.sequence, frame.time_us / 1e6) == (sample.sequence, sample.time_s)
        np.testing.assert_array_equal(frame.counts, sample.counts)
    settled = scan(board.scene.skin.design, samples[-1].resistance_ohm).volts
    assert np.abs(samples[-1].volts - settled).max() < 6e-3
    assert samples[-1].counts[1, 2] < samples[0].counts[1, 2] - 100


def test_too_short_a_dwell_shows_as_the_error_that_settling_predicts() -> None:
    """Rows of open cells between the others make every step one from rest; the instants are those of the program."""
    cells = np.array([[12e3, 9e3, 17e3, 11e3], [np.inf] * 4, [8e3, 10e3, 14e3, 20e3], [np.inf] * 4])
    movie = scene(replace={"readout": {"offset_voltage": 0.0}})
    errors = []
    for dwell_us in (20, 40, 100):
        samples: list[Sample] = []
        with FirmwareBoard(movie, settings=BoardSettings(dwell_us=dwell_us), record=samples.append) as board:
            board.hold_cells(cells)
            board.run(0.05)
        acquisition = 2e-6  # s: long enough for the capacitor; Settling has the conversions follow each other
        design = movie.skin.design.replace(adc={"acquisition_time": acquisition})
        settling = Settling(design, cells)
        selected = {row: time for time, row in board.row_switches}
        for time, row, column in board.sample_instants:
            if row in (0, 2):
                period = time - selected[row] + (3 - column) * acquisition
                predicted = settling.sampled_from_rest(period)[row, column]
                assert samples[-1].volts[row, column] == pytest.approx(predicted, abs=1e-5)
        errors.append(np.abs(samples[-1].volts - settling.settled)[0, 0])
        first = [time - selected[row] for time, row, column in board.sample_instants if column == 0]
        # Never shorter than asked for; the program itself needs 31 us from one row to the next.
        assert all(dwell_us + 12 <= 1e6 * time < max(dwell_us + 5, 35) + 12 for time in first)
    assert errors[0] > 0.2
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 5e-3 / 2


def test_the_driver_reads_pressures_off_the_program() -> None:
    press = {"cells": [[2, 1]], "load_kpa": [[0.0, 0.0], [0.3, 0.0], [0.4, 12.0]]}
    truth: list[Sample] = []
    with FirmwareBoard(scene(contact=[press]), record=truth.append) as board:
        wire = FirmwareWire(board)
        with lossless(wire) as skin:
            frames = [next(skin) for _ in range(45)]
        until(lambda: wire.closed)  # by its reader, which may wait for the emulated processor
    by_number = {sample.sequence: sample.pressure_kpa for sample in truth}
    applied = np.array([by_number[frame.sequence] for frame in frames])
    estimated = np.array([frame.pressure for frame in frames])
    assert sum(frame.lost_before for frame in frames) == 0
    assert applied[:, 2, 1].max() == 12.0
    assert np.sqrt(np.mean((estimated - applied) ** 2)) < 0.3
    assert np.abs(frames[-1].pressure[2, 1] - 12.0) < 1.0


# ---- what it is ordered


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "rows", "columns"),
    [
        (None, {}, {}),
        ({"kind": "broken-row", "place": [2, 0]}, {2: LineState.OPEN}, {}),
        ({"kind": "broken-column", "place": [3, 1]}, {}, {1: LineState.OPEN}),
        ({"kind": "bridged-columns", "place": [1, 2]}, {}, {2: LineState.SHORTED, 3: LineState.SHORTED}),
    ],
    ids=["none", "broken row", "broken column", "bridged columns"],
)
def test_the_self_test_names_the_broken_line(fault: Any, rows: Any, columns: Any) -> None:
    with FirmwareBoard(scene(replace={"fault": [fault] if fault else []})) as board:
        host = Host(board)
        host.hear(0.05)
        (result,) = of(SelfTest, host.ask(Order.SELF_TEST, 0.05))
        frames = of(FramePacket, host.hear(0.1))
    assert result.rows == tuple(rows.get(row, LineState.GOOD) for row in range(4))
    assert result.columns == tuple(columns.get(column, LineState.GOOD) for column in range(4))
    for number, (nominal, measured) in enumerate(result.references):
        assert nominal == (15e3 if number % 2 else 10e3)
        assert (abs(measured / nominal - 1) < 0.01) == (number not in columns)
    assert len(frames) == 5  # the test delays frames, and loses none


def test_the_self_test_of_the_large_board_sees_its_reference_resistors() -> None:
    with FirmwareBoard(scene("16x16")) as board:
        host = Host(board)
        host.hear(0.03)
        (result,) = of(SelfTest, host.ask(Order.SELF_TEST, 0.08))
    assert set(result.rows) == set(result.columns) == {LineState.GOOD}
    assert all(measured == pytest.approx(nominal, rel=0.01) for nominal, measured in result.references)


# ---- what goes wrong


def test_a_run_repeats_byte_for_byte() -> None:
    runs = []
    for _ in range(2):
        with FirmwareBoard(scene(board={"noise": 2e-3}), seed=3) as board:
            board.send(host_protocol("ohmskin").request(Order.SELF_TEST))
            runs.append(board.run(0.08))
    assert runs[0] == runs[1]
    assert len(runs[0]) > 1000


def test_faults_of_the_line_are_counted_and_survived(tmp_path: Path) -> None:
    """Over a pseudo-terminal: flipped, dropped, inserted and doubled bytes, lost packets, and a stall."""
    kinds = ["flipped-bits", "dropped-bytes", "inserted-bytes", "duplicated-bytes", "dropped-packets"]
    faults = [{"kind": kind, "at_s": 0.6 + 0.3 * number} for number, kind in enumerate(kinds)]
    stall = {"kind": "stall", "at_s": 2.2, "duration_s": 0.3}
    split = {"kind": "split-bytes", "at_s": 0.2, "duration_s": 0.1}
    faulty = scene(link_fault=[*faults, stall, split])
    truth = tmp_path / "truth.npz"
    with (
        PtyPort() as port,
        running(faulty, port, engine="firmware", clock="fast", duration_s=3.0, truth=truth),
        Skin.open(port.name, delivery="lossless", timeout=60.0) as skin,
    ):
        frames = list(islice(skin, 135))
    with np.load(truth) as arrays:
        codes = adc_codes(faulty.skin.design, arrays["volts"])
        place = {number: k for k, number in enumerate(arrays["sequence"].tolist())}
    assert 4 <= sum(frame.lost_before or 0 for frame in frames) <= 8
    for frame in frames:
        np.testing.assert_array_equal(frame.counts, codes[place[frame.sequence]])


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_the_end_of_a_finite_run_is_an_end_and_no_pulled_cable(loss: float, tmp_path: Path) -> None:
    """No firmware says that it is over; the emulator does in its place, on a lossy line again and again."""
    truth = tmp_path / "truth.npz"
    with (
        PtyPort() as port,
        running(scene(line={"packet_loss": loss}), port, engine="firmware", clock="fast", duration_s=6.0, truth=truth),
        Skin.open(port.name, delivery="lossless", timeout=60.0) as skin,
    ):
        first, *others = skin  # a LinkError, if the end were not announced
        stats = skin.stats()
    with np.load(truth) as arrays:
        sent = arrays["sequence"][-1] + 1
    assert stats.lost is not None
    assert first.sequence is not None
    assert first.lost_before is not None
    before = first.sequence - first.lost_before  # it began to scan before it was known
    assert (before + 1 + len(others) + stats.lost, stats.reconnects, stats.reboots) == (sent, 0, 0)
    assert (stats.lost > 0) == (loss > 0)


def test_a_conversion_that_never_ends_is_ended_by_the_watchdog() -> None:
    with FirmwareBoard(scene(), boot_id=7) as board:
        host = Host(board)
        before = of(FramePacket, host.hear(0.1))
        board.conversions_hang = True
        assert not of(FramePacket, host.hear(0.2))
        after = of(FramePacket, host.hear(0.2))
    assert board.resets == 1
    assert {frame.boot_id for frame in before} == {7}
    assert {frame.boot_id for frame in after} == {8}
    assert [frame.sequence for frame in after[:2]] == [0, 1]
    assert after[0].time_us < 20_000


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"baud": 0}, "baud rate 0; expected 2 000 000 divided by"),
        ({"baud": 921_600}, "baud rate 921600"),
        ({"serial_number": "a number that is too long"}, "expected at most 15 bytes"),
        ({"dwell_us": 40_000}, "dwell 40000 us"),
        ({"adc_prescaler_log2": 2}, "prescaler 2^2"),
        ({"period_us": 0}, "period 0 us"),
    ],
)
@pytest.mark.without_node
def test_settings_that_no_board_can_have_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        BoardSettings(**settings).eeprom(SMALL)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("replace", "message"),
    [
        ({"array": {"rows": 3}}, "3 x 4 cells; the firmware is built for 4x4 and 16x16"),
        ({"adc": {"bits": 12}}, "12 bits from 0.0 V; the chip that runs the firmware converts 10 bits"),
        ({"readout": {"circuit": "voltage-divider"}}, 'the firmware\'s board has "inverting-amplifier"'),
    ],
)
@pytest.mark.without_node
def test_a_scene_that_no_firmware_fits_is_refused(replace: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        check_scene(scene(replace=replace))
    assert message in str(caught.value)


@pytest.mark.without_node
def test_without_node_the_engine_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    missing_for.cache_clear()
    try:
        with pytest.raises(MissingExtra, match=r"the firmware engine needs Node\.js"):
            FirmwareBoard(scene())
    finally:
        missing_for.cache_clear()


class Nothing:
    """A chip with nothing around it."""

    def port_written(self, cycle: float, port: str, output: int, direction: int) -> None: ...

    def conversion_started(self, cycle: float, channel: int) -> None: ...

    def conversion_sampled(self, cycle: float, channel: int) -> float | None:
        return 0.5

    def chip_reset(self, cycle: float) -> None: ...


def program(path: Path, words: list[int]) -> Path:
    """A .hex file of these instructions."""
    data = b"".join(word.to_bytes(2, "little") for word in words)
    record = bytes([len(data), 0, 0, 0]) + data
    path.write_text(f":{record.hex()}{-sum(record) & 0xFF:02x}\n:00000001ff\n")
    return path


def test_a_program_that_uses_what_is_not_modelled_is_named(tmp_path: Path) -> None:
    # ldi r16, 0xA0; sts ADCSRA, r16: switches the ADC on with auto-trigger
    file = program(tmp_path / "auto.hex", [0xEA00, 0x9300, 0x007A, 0xCFFF])
    with (
        Processor(AVR8JS, file, b"", Nothing()) as chip,
        pytest.raises(LinkError, match=r"wrote 0xa0 to the register at 0x7a, which .* not modelled"),
    ):
        chip.run(1000)


def test_the_command_runs_the_firmware_and_writes_the_truth(tmp_path: Path) -> None:
    truth = tmp_path / "truth.npz"
    arguments = ["emulate", "board-fingers.toml", "--engine", "firmware", "--duration", "0.2", "--truth", str(truth)]
    done = subprocess.run(
        [sys.executable, "-m", "ohmskin", *arguments],
        cwd=ROOT / "examples",
        capture_output=True,
        text=True,
        env=os.environ,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with np.load(truth) as arrays:
        np.testing.assert_array_equal(arrays["sequence"], np.arange(10))
        assert np.diff(arrays["time_s"]) == pytest.approx(0.02, abs=5e-4)
        settled = scan(scene().skin.design, arrays["resistance_ohm"][-1]).volts
        assert np.abs(arrays["volts"][-1] - settled).max() < 5e-3


@pytest.mark.slow
def test_the_report_on_the_firmware_passes_and_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim P14 of `ohmskin verify --target firmware`, with few of its points."""
    for name, few in (("FRAMES", 60), ("DWELLS_US", (60,))):
        monkeypatch.setattr(f"ohmskin.verification._whole_skin.{name}", few)
    (claim,) = verify(scene().skin.design, only=["P14"], target="firmware").claims
    assert {str(check.outcome) for check in claim.finding.checks} == {"pass"}
    (claim,) = verify(scene(replace={"adc": {"bits": 12}}).skin.design, only=["P14"], target="firmware").claims
    (check,) = claim.finding.checks
    assert str(check.outcome) == "not run"
    assert "converts 10 bits" in check.reason


# Two emulators of the processor against each other and against the data sheet: avr8js, and simavr as a second opinion


SOURCE = Path(__file__).parent / "simavr" / "processor.c"


@pytest.fixture(scope="module")
def simavr(tmp_path_factory: pytest.TempPathFactory) -> Engine:
    program = tmp_path_factory.mktemp("simavr") / "processor"
    compiler = shutil.which("gcc")
    need(None if compiler else "gcc is not installed")
    need(None if Path("/usr/include/simavr/sim_avr.h").exists() else "libsimavr-dev is not installed")
    done = subprocess.run(
        ["gcc", "-O2", "-Wall", "-Wextra", "-Werror", "-o", program, SOURCE, "-lsimavr", "-lelf"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return Engine("simavr", (str(program),), lambda: None)


@pytest.fixture
def avr8js() -> Engine:
    need(missing_for())
    return AVR8JS


@pytest.mark.parametrize("kind", REFERENCE_BOARDS, ids=lambda kind: kind.name)
def test_both_emulators_send_the_same_frames(avr8js: Engine, simavr: Engine, kind: BoardKind) -> None:
    """Byte for byte, time stamps and checksums included. Other packets differ in the time at which the line was free:
    simavr's transmitter has no buffer behind its shift register, and its receiver is slower than the line."""
    design = Design.load(ROOT / "examples" / f"board-{kind.name}.toml")
    skin = {"design": design.model_dump(exclude_unset=True)}
    scene = Scene.from_tables({"skin": skin}, source="scene", directory=ROOT)
    cells = np.random.default_rng(4).uniform(8e3, 30e3, design.array.shape)
    frames, others = [], []
    for engine in (avr8js, simavr):
        with FirmwareBoard(scene, engine=engine) as board:
            board.hold_cells(cells)
            sent = board.run(0.317)
            board.send(host_protocol("ohmskin").request(Order.SELF_TEST))
            sent += board.run(0.06)
        whole = [cobs.decode(packet) for packet in sent.split(b"\0")[:-1] if packet]
        frames.append([packet for packet in whole if packet[0] == 1][:15])
        others.append([packet[:6] + packet[18:-4] for packet in whole if packet[0] != 1])
    assert frames[0] == frames[1]
    assert len(frames[0]) == 15
    assert others[0] == others[1]
    assert {packet[0] for packet in others[0]} == {2, 3, 4}
