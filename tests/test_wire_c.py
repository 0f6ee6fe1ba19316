"""The reference encoder in C (examples/ohmskin_wire.h) against the codec in Python and the literal packets."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from needs import need
from test_wire import LITERAL, payload_of

from ohmskin.wire import Command, DescriptionPiece, FramePacket, Order, Packet, PacketDecoder, encode

EXAMPLES = Path(__file__).parents[1] / "examples"
STRICT = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic"]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc")
    need(None if compiler else "no C compiler 'cc' is installed")
    target = tmp_path_factory.mktemp("c") / "ohmskin_wire"
    subprocess.run([str(compiler), *STRICT, "-o", str(target), str(EXAMPLES / "ohmskin_wire.c")], check=True)
    return target


def lines_of(packets: list[Packet]) -> str:
    lines = []
    for packet in packets:
        kind, payload = payload_of(packet)
        boot_id = 0 if isinstance(packet, Command) else packet.boot_id
        lines.append(f"{kind} {boot_id} {packet.sequence} {packet.time_us} {payload.hex()}\n")
    return "".join(lines)


def encoded(program: Path, packets: list[Packet]) -> bytes:
    done = subprocess.run([str(program)], input=lines_of(packets).encode(), capture_output=True, check=True)
    return done.stdout


def test_it_encodes_the_literal_packets(program: Path) -> None:
    packets = list(LITERAL.values())
    assert encoded(program, packets) == b"".join(map(encode, packets))


def test_it_encodes_any_packet_as_python_does(program: Path) -> None:
    """Payloads of every length around the blocks of COBS, with no, some and many zeros."""
    random = np.random.default_rng(3)
    packets: list[Packet] = []
    for size in [*range(1, 30), *range(220, 280), *range(480, 540), 3000]:
        for zeros in (0.0, 0.01, 0.5):
            data = random.integers(1, 256, size, dtype=np.uint8)
            data[random.random(size) < zeros] = 0
            number, time_us, boot_id = (int(value) for value in random.integers(0, 2**32, 3))
            packets.append(DescriptionPiece(number, time_us * 1000, 0, size, data.tobytes(), boot_id))
    counts = random.integers(0, 4096, (16, 16))
    packets.append(FramePacket.of(counts, sequence=2**32 - 1, time_us=2**64 - 1, boot_id=2**32 - 1))
    line = encoded(program, packets)
    assert PacketDecoder().feed(line) == packets
    assert line == b"".join(map(encode, packets))


def test_it_receives_commands_and_nothing_else(program: Path) -> None:
    random = np.random.default_rng(4)
    commands = [
        Command(order, int(random.integers(0, 2**32)) if order is Order.RATE else 0, sequence=int(number))
        for order in Order
        for number in random.integers(0, 2**32, 20)
    ]
    line, expected = b"", ""
    for command in commands:
        noise = random.bytes(int(random.integers(0, 80)))
        good = encode(command)
        damaged = bytearray(good)
        damaged[int(random.integers(0, len(good) - 1))] ^= int(random.integers(1, 256))
        line += noise + b"\0" + bytes(damaged) + b"\0" + good
        size = 4 if command.order is Order.RATE else 0
        expected += f"{command.order.value} 2 {command.sequence} {size} {command.period_us}\n"
    done = subprocess.run([str(program), "receive"], input=line, capture_output=True, check=True)
    assert done.stdout.decode().splitlines() == expected.splitlines()


def test_a_small_microcontroller_can_hold_it(tmp_path: Path) -> None:
    """Compiled for the ATmega328P, which has 2048 bytes of RAM: encoder and receiver take less than 400."""
    compiler = shutil.which("avr-gcc")
    need(None if compiler else "no compiler 'avr-gcc' is installed")
    source = tmp_path / "main.c"
    source.write_text(
        '#include "ohmskin_wire.h"\n'
        "static void ohmskin_send(uint8_t byte) { *(volatile uint8_t *)0xc6 = byte; }\n"
        "ohmskin_encoder encoder; ohmskin_receiver receiver; ohmskin_command command;\n"
        "int main(void) { if (ohmskin_receive(&receiver, 1, &command)) {\n"
        "ohmskin_begin(&encoder, OHMSKIN_REPLY, 1, 2, 3); ohmskin_end(&encoder); } }\n"
    )
    target = tmp_path / "main.elf"
    subprocess.run(
        [
            str(compiler),
            "-mmcu=atmega328p",
            "-Os",
            "-std=c99",
            "-Wall",
            "-Werror",
            f"-I{EXAMPLES}",
            "-o",
            target,
            source,
        ],
        check=True,
    )
    report = subprocess.run(["avr-size", "-A", target], capture_output=True, check=True, text=True).stdout
    sizes = dict(re.findall(r"^(\.\w+) +(\d+)", report, flags=re.MULTILINE))
    assert int(sizes[".bss"]) + int(sizes.get(".data", 0)) < 400
