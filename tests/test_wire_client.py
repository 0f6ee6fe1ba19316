"""A client written from docs/wire.md with nothing but pyserial and the standard library, against the emulated board.

Nothing of ohmskin is used on the client's side: what the document says must be enough.
"""

from __future__ import annotations

import json
import struct
import time
import zlib
from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import serial
from boards import PRESS, scene

from ohmskin.emulator import PtyPort, running

FRAME, DESCRIPTION, IDENTITY, SELF_TEST_RESULT, REPLY = 1, 2, 3, 4, 5
DESCRIBE, START, STOP, IDENTIFY, ONE_FRAME, RATE, SELF_TEST = range(0x81, 0x88)
TAKEN, UNKNOWN_ORDER, BAD_PAYLOAD, OUT_OF_RANGE = range(4)


class Packet(NamedTuple):
    kind: int
    boot_id: int
    sequence: int
    time_us: int
    payload: bytes


def unstuff(data: bytes) -> bytes:
    out, at = bytearray(), 0
    while at < len(data):
        code = data[at]
        assert at + code <= len(data)
        out += data[at + 1 : at + code]
        at += code
        if code < 255 and at < len(data):
            out.append(0)
    return bytes(out)


def stuff(command: bytes) -> bytes:
    """Commands are shorter than a block of COBS."""
    return b"".join(bytes([len(part) + 1]) + part for part in command.split(b"\0"))


def read_packet(stretch: bytes) -> Packet | None:
    """The packet between two zeros; None for the end of one that this client has not seen from its beginning."""
    try:
        raw = unstuff(stretch)
    except AssertionError:
        return None
    if len(raw) < 22 or zlib.crc32(raw[:-4]) != struct.unpack("<I", raw[-4:])[0]:
        return None
    kind, version, boot_id, sequence, time_us = struct.unpack_from("<BBIIQ", raw)
    assert version == 2
    return Packet(kind, boot_id, sequence, time_us, raw[18:-4])


class Client:
    def __init__(self, port: str) -> None:
        self.line = serial.Serial(port, 1_000_000, timeout=0.1)
        self.rest = b""
        self.stretches: deque[bytes] = deque()
        self.commands = 0
        self.in_step = False
        """a whole packet has come: from now on every stretch between two zeros must be one"""

    def send(self, kind: int, payload: bytes = b"") -> int:
        self.commands += 1
        body = struct.pack("<BBIIQ", kind, 2, 0, self.commands, 0) + payload
        self.line.write(b"\0" + stuff(body + struct.pack("<I", zlib.crc32(body))) + b"\0")
        return self.commands

    def packets(self) -> Iterator[Packet]:
        """The packets that come, each one once, however often this is called."""
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            while self.stretches:
                stretch = self.stretches.popleft()
                packet = read_packet(stretch)
                if packet is None:
                    assert not self.in_step, f"damaged packet of {len(stretch)} bytes: {stretch.hex()}"
                    continue
                self.in_step = True
                yield packet
            *stretches, self.rest = (self.rest + self.line.read(256)).split(b"\0")
            self.stretches.extend(stretch for stretch in stretches if stretch)
        raise AssertionError("nothing within 30 s")

    def hear(self, kind: int) -> Packet:
        return next(packet for packet in self.packets() if packet.kind == kind)

    def reply(self, number: int) -> tuple[int, int]:
        for packet in self.packets():
            if packet.kind == REPLY:
                order, status, command = struct.unpack("<BBI", packet.payload)
                if command == number:
                    return order, status
        raise AssertionError

    def description(self) -> dict[str, Any]:
        self.send(DESCRIBE)
        text, total = b"", 1
        for packet in self.packets():
            if packet.kind == DESCRIPTION:
                offset, total = struct.unpack_from("<II", packet.payload)
                if offset != len(text):
                    text = b""
                    continue
                text += packet.payload[8:]
            if len(text) == total:
                break
        tables: dict[str, Any] = json.loads(text)
        return tables


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    port = PtyPort()
    what = scene(board={"frame_rate": 200.0, "serial_number": "C1", "reference_resistances": [15e3]}, contact=[PRESS])
    with running(what, port, truth=tmp_path / "truth.npz"):
        client = Client(port.name)
        yield client
        client.line.close()


def test_a_client_written_from_the_document_alone(client: Client, tmp_path: Path) -> None:
    """Identity, description, frames to ohms by the document's rule, commands and their replies, the self-test."""
    client.send(IDENTIFY)
    identity = client.hear(IDENTITY)
    rows, columns, bits, streaming, period_us, _ = struct.unpack_from("<HHBBII", identity.payload)
    serial_number, _firmware, *_ = identity.payload[14:].split(b"\0")
    assert (rows, columns, bits, streaming, period_us, serial_number) == (3, 2, 12, 1, 5000, b"C1")

    design = client.description()["design"]
    assert (design["array"]["rows"], design["adc"]["bits"]) == (3, 12)
    low, high = design["adc"]["range"]
    step = (high - low) / 2**bits
    reference = design["readout"]["reference_resistance"]
    drive = design["drive"]["voltage"]

    numbers = []
    for packet in client.packets():
        if packet.kind != FRAME:
            continue
        assert packet.boot_id == identity.boot_id
        frame_rows, frame_columns, flags = struct.unpack_from("<HHH", packet.payload)
        codes = struct.unpack(f"<{frame_rows * frame_columns}H", packet.payload[6:])
        numbers.append((packet.sequence, flags))
        volts = [low + (code + 0.5) * step for code in codes]
        ohms = [-drive * reference / volt for volt in volts]
        # Resting cells have 10 kohm, behind 70 ohm of the switches.
        assert ohms[0] == pytest.approx(10_070, rel=0.01)
        if len(numbers) == 50:
            break
    for (before, _), (after, flags) in pairwise(numbers):
        assert after == before + 1 or flags & 1, numbers

    assert client.reply(client.send(STOP)) == (STOP, TAKEN)
    assert client.reply(client.send(RATE, struct.pack("<I", 20_000))) == (RATE, TAKEN)
    assert client.reply(client.send(RATE, struct.pack("<I", 0))) == (RATE, OUT_OF_RANGE)
    assert client.reply(client.send(RATE)) == (RATE, BAD_PAYLOAD)
    assert client.reply(client.send(0x99)) == (0x99, UNKNOWN_ORDER)
    client.send(ONE_FRAME)
    one = client.hear(FRAME)
    client.send(SELF_TEST)
    result = client.hear(SELF_TEST_RESULT)
    assert result.sequence == one.sequence + 1
    tested_rows, tested_columns, references = struct.unpack_from("<HHH", result.payload)
    states = result.payload[6 : 6 + tested_rows + tested_columns]
    assert (tested_rows, tested_columns, references, set(states)) == (3, 2, 1, {0})
    nominal, measured = struct.unpack_from("<ff", result.payload, 6 + tested_rows + tested_columns)
    assert measured == pytest.approx(nominal, rel=0.01)
    assert nominal == 15e3
    assert client.reply(client.send(START)) == (START, TAKEN)
    assert client.hear(FRAME).sequence == one.sequence + 1


def test_the_rule_from_code_to_volts_is_that_of_the_converter(client: Client, tmp_path: Path) -> None:
    """Codes of the frames against the volts of the truth file: floor((volts - low) / step), with 2^bits steps."""
    seen = {}
    for packet in client.packets():
        if packet.kind == FRAME:
            seen[packet.sequence] = struct.unpack("<6H", packet.payload[6:])
        if len(seen) == 20:
            break
    client.line.close()
    volts = {}
    deadline = time.monotonic() + 30
    while not volts and time.monotonic() < deadline:
        spool = tmp_path / "truth.npz.spool.npy"
        if spool.exists():
            frames = np.load(spool)
            volts = {int(row["sequence"]): row["volts"] for row in frames if int(row["sequence"]) in seen}
        time.sleep(0.05)
    assert volts
    for sequence, truth in volts.items():
        codes = np.clip(np.floor((truth.ravel() - 0.0) / (3.3 / 4096)), 0, 4095)
        np.testing.assert_array_equal(seen[sequence], codes)
