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
from ohmskin.emulator.firmware import AVR8JS, REFERENCE_BOARDS, BoardKind, Engine, FirmwareBoard, Processor, missing_for
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


# Cycles from the instruction set manual (Atmel 0856), for a program counter of 16 bits.
CYCLES = {
    "nop": ([0x0000], 1),
    "sbi": ([0x9A28], 2),
    "cbi": ([0x9828], 2),
    "lds": ([0x9100, 0x0200], 2),
    "sts": ([0x9300, 0x0200], 2),
    "ld X+": ([0x910D], 2),
    "ldd Y+3": ([0x810B], 2),
    "lpm": ([0x9104], 3),
    "adiw": ([0x9610], 2),
    "push": ([0x930F], 2),
    "mul": ([0x9F01], 2),
    "rjmp": ([0xC000], 2),
    "in": ([0xB70F], 1),
}


class Ports:
    """Cycles of the writes to port D."""

    def __init__(self) -> None:
        self.written: dict[int, float] = {}

    def port_written(self, cycle: float, port: str, output: int, direction: int) -> None:
        if port == "D" and direction:
            self.written[output] = cycle

    def conversion_started(self, cycle: float, channel: int) -> None: ...

    def conversion_sampled(self, cycle: float, channel: int) -> float | None:
        return None

    def chip_reset(self, cycle: float) -> None: ...


@pytest.mark.parametrize("name", CYCLES)
def test_instructions_take_the_cycles_of_the_manual(name: str, avr8js: Engine, simavr: Engine, tmp_path: Path) -> None:
    words, cycles = CYCLES[name]
    set_up = [0xE0B2, 0xE0A0, 0xE0D3, 0xE0C0, 0xE0F0, 0xE0E0, 0xEF5F, 0xB95A]  # X, Y, Z into memory; DDRD = 0xff
    mark = [0xE051, 0xB95B, 0xE052]  # PORTD = 1, then 2 behind what is measured
    data = b"".join(word.to_bytes(2, "little") for word in [*set_up, *mark, *words * 10, 0xB95B, 0xCFFF])
    lines = []
    for start in range(0, len(data), 16):
        piece = data[start : start + 16]
        record = bytes([len(piece), 0, start, 0]) + piece
        lines.append(f":{record.hex()}{-sum(record) & 0xFF:02x}")
    file = tmp_path / "program.hex"
    file.write_text("\n".join([*lines, ":00000001ff"]) + "\n")
    for engine in (avr8js, simavr):
        ports = Ports()
        with Processor(engine, file, b"", ports) as chip:
            chip.run(1000)
        assert ports.written[2] - ports.written[1] - 2 == 10 * cycles, engine.name
