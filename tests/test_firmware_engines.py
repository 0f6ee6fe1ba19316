"""Two emulators of the processor against each other and against the data sheet: avr8js, and simavr as a second opinion.

simavr is GPL: its process is compiled here, for the tests only.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from needs import need

from ohmskin.circuits import Design
from ohmskin.emulator import Scene
from ohmskin.emulator.firmware import AVR8JS, REFERENCE_BOARDS, BoardKind, Engine, FirmwareBoard, missing_for
from ohmskin.wire import Order, host_protocol

ROOT = Path(__file__).parents[1]
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
