"""The board core, the spoiled line, the transmit buffer and the truth file: all without a port."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from boards import DESIGN, scene
from patience import HANG_S, TURN_S, Patience

from ohmskin.cell import Cell
from ohmskin.circuits import Design
from ohmskin.common.arrays import IntArray
from ohmskin.common.config import parse
from ohmskin.emulator import Board, FrameBlock, Line, LineSettings, PairPort, Sample, Scene, running
from ohmskin.emulator._skin import ScenePhysics
from ohmskin.wire import (
    Command,
    Description,
    Event,
    FramePacket,
    Identity,
    LineState,
    Order,
    Reply,
    SelfTest,
    encode,
    host_protocol,
)


def events(packets: list[bytes]) -> list[Event]:
    return host_protocol("ohmskin").feed(b"".join(packets), 0.0)


def live(board: Board, ticks: int) -> list[Event]:
    return events([packet for _ in range(ticks) for packet in board.tick()])


def ask(board: Board, order: Order, **values: int) -> list[Event]:
    board.receive(encode(Command(order, **values)))
    return events(board.answers())


def test_the_description_is_the_scene_again() -> None:
    what = scene(board={"serial_number": "A7"})
    identity, sheet, *_ = live(Board(what, boot_id=77), 1)
    assert isinstance(identity, Identity)
    assert (identity.serial_number, identity.boot_id, identity.rows, identity.columns) == ("A7", 77, 3, 2)
    assert isinstance(sheet, Description)
    assert sheet.design is not None
    assert sheet.cell is not None
    assert parse(sheet.design, Design, source="design") == what.skin.design
    assert parse(sheet.cell, Cell, source="cell") == what.skin.cell


def test_a_stopped_board_is_silent_but_its_skin_lives_on() -> None:
    stopped, straight = Board(scene(board={"frame_rate": 10.0})), Board(scene(board={"frame_rate": 10.0}))
    live(stopped, 5)
    stopped.receive(encode(Command(Order.STOP)))
    assert [type(event) for event in live(stopped, 20)] == [Reply, Identity, Identity]
    stopped.receive(encode(Command(Order.START)))
    after = live(stopped, 1)[-1]
    there = [event for event in live(straight, 26) if isinstance(event, FramePacket)][-1]
    assert isinstance(after, FramePacket)
    assert after.sequence == 5  # what was not scanned is not lost
    assert (after.time_us, after.payload) == (there.time_us, there.payload)


def test_a_flood_of_commands_gets_one_answer_of_each_kind() -> None:
    board = Board(scene())
    live(board, 1)
    for order in (Order.DESCRIBE, Order.IDENTIFY, Order.SELF_TEST, Order.START):
        board.receive(encode(Command(order)) * 5000)
    assert sorted(type(event).__name__ for event in events(board.answers())) == [
        "Description",
        "Identity",
        "Reply",
        "SelfTest",
    ]
    assert not board.answers()


def test_the_self_test_finds_broken_and_joined_lines_and_reads_its_resistors() -> None:
    faults = [{"kind": "broken-row", "place": [0, 0]}, {"kind": "bridged-columns", "place": [1, 2], "resistance": 10.0}]
    big = {**DESIGN, "array": {"rows": 3, "columns": 5}, "fault": faults}
    board = Board(scene(skin={"design": big}, board={"reference_resistances": [10e3, 30e3]}))
    live(board, 1)
    (result,) = ask(board, Order.SELF_TEST)
    assert isinstance(result, SelfTest)
    good, joined = LineState.GOOD, LineState.SHORTED
    assert result.rows == (LineState.OPEN, good, good)
    assert result.columns == (good, good, joined, joined, good)
    for nominal, measured in result.references:
        assert measured == pytest.approx(nominal, rel=0.01)
        assert measured != nominal  # it went through the converter


def test_noise_has_its_size_and_its_seed() -> None:
    quiet, noisy = scene(contact=[]), scene(contact=[], board={"noise": 0.01})

    def volts(what: Scene, seed: int) -> np.ndarray:
        taken: list[Sample] = []
        board = Board(what, seed=seed, record=taken.append)
        for _ in range(400):
            board.tick()
        return np.array([sample.volts for sample in taken])

    noise = volts(noisy, 1) - volts(quiet, 1)
    assert noise.std() == pytest.approx(0.01, rel=0.05)
    np.testing.assert_array_equal(volts(noisy, 1), volts(noisy, 1))
    assert (volts(noisy, 1) != volts(noisy, 2)).any()


def test_a_lossy_line_loses_whole_packets_at_its_rate() -> None:
    line = Line(LineSettings(packet_loss=0.25), seed=3)
    carried = [line.carry(b"packet\0") for _ in range(4000)]
    assert set(carried) == {b"", b"packet\0"}
    assert carried.count(b"") / 4000 == pytest.approx(0.25, abs=0.03)


def test_a_noisy_line_flips_bits_at_its_rate() -> None:
    line = Line(LineSettings(bit_errors=0.01), seed=3)
    packet = bytes(range(256)) * 40
    flipped = np.unpackbits(np.frombuffer(line.carry(packet), np.uint8) ^ np.frombuffer(packet, np.uint8))
    assert flipped.mean() == pytest.approx(0.01, rel=0.15)


def test_a_board_describes_the_pitch_that_its_scene_gives_the_cells() -> None:
    """Else a host would find contacts in the wrong places, and forces of the wrong size."""
    spread_out = scene(skin={"design": DESIGN, "pitch_mm": 5.0}).skin
    assert spread_out.described_design.sheet.pitch == pytest.approx(0.005)
    assert scene().skin.described_design == scene().skin.design


def test_no_frame_waits_for_the_compiler() -> None:
    """Before a host may come, all is compiled that frames of the scene are computed with; loads come later here."""
    code = """
from ohmskin.common import compiled
from ohmskin.emulator import DEMO, Board, PairPort, Scene, Stop, emulate
late = []
def watch():
    load = compiled.Loop.load
    compiled.Loop.load = lambda kernel: (late.append(kernel.__qualname__), load(kernel))
scene, port, stop = Scene.load(DEMO), PairPort("pair"), Stop()
stop.set()
emulate(scene, port, stop=stop, ready=watch)
board = Board(scene)
for tick in range(400):
    board.tick()
print(late, board.skin.block.pressure_kpa.max() > 1.0)
"""
    environment = {**os.environ, "OHMSKIN_COMPILED": "off"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("[] True\n", "")


def test_a_board_answers_while_frames_are_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long that takes: a host that gives orders meanwhile would find the line full, or the board dead."""
    run, computed = ScenePhysics.run, threading.Event()

    def slow(physics: ScenePhysics, time_us: IntArray) -> FrameBlock:
        assert len(time_us) <= 3 or computed.wait(HANG_S)
        return run(physics, time_us)

    monkeypatch.setattr(ScenePhysics, "run", slow)
    port, patience, host = PairPort(), Patience(), host_protocol("ohmskin")
    with port.host_end as line, running(scene(board={"frame_rate": 1000.0}), port):
        try:
            line.settimeout(TURN_S)
            heard: list[Event] = []
            for _ in range(3):
                line.sendall(encode(Command(Order.SELF_TEST)))
                while not any(isinstance(event, SelfTest) for event in heard):  # frames may have come with it
                    patience.spend(heard[-3:])
                    with contextlib.suppress(TimeoutError):
                        heard += host.feed(line.recv(4096), 0.0)
                heard.clear()
        finally:
            computed.set()
