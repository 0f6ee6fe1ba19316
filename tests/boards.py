"""Emulated boards for the tests: scenes, and a board without a port."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from patience import Patience

from ohmskin.driver import Arrival, BytePort, Skin
from ohmskin.emulator import Board, Line, Scene
from ohmskin.errors import LinkError
from ohmskin.wire import DescriptionPiece, Flag, FramePacket, Identity, encode, write_description

EXAMPLES = Path(__file__).parents[1] / "examples"
DESIGN: dict[str, Any] = {
    "array": {"rows": 3, "columns": 2, "row_lead": 70.0},
    "drive": {"voltage": -1.0},
    "readout": {"circuit": "inverting-amplifier", "reference_resistance": 20e3, "supply": [0.0, 3.3]},
    "adc": {"bits": 12, "range": [0.0, 3.3]},
}
PRESS = {"cells": [[1, 1]], "load_kpa": [[0.0, 0.0], [1.0, 0.0], [1.05, 15.5], [3.0, 15.5], [3.1, 0.0]]}


def scene(**tables: Any) -> Scene:
    """A 3 x 2 skin, pressed on one cell, with the given sections of SCENE.toml besides or instead."""
    given = {"skin": {"design": DESIGN}, "contact": [PRESS], **tables}
    return Scene.from_tables(given, source="scene", directory=Path())


WHAT = scene().skin


def sheet(boot_id: int = 1, *, cell: bool = True, sequence: int = 0) -> bytes:
    """The packet in which that board describes itself."""
    text = write_description(WHAT.design.model_dump(), WHAT.cell.model_dump() if cell else None)
    return encode(DescriptionPiece(sequence, 0, 0, len(text), text, boot_id))


def identity(
    boot_id: int = 1, *, serial_number: str = "A1", sequence: int = 0, rows: int = 3, over: bool = False
) -> bytes:
    """The packet in which that board says who it is; ``over`` is its end."""
    return encode(Identity(sequence, 0, rows, 2, 12, not over, 1000, 100, serial_number, "test", boot_id, over))


def frame(
    sequence: int,
    *,
    boot_id: int = 1,
    level: int | list[int] | NDArray[np.int64] = 2000,
    flags: Flag = Flag.NONE,
    us: int | None = None,
) -> bytes:
    """A frame of that board, with counts ``level`` in all cells or rows, at ``us`` or its number in ms."""
    counts, time_us = np.full((3, 2), level), 1000 * sequence if us is None else us
    return encode(FramePacket.of(counts, sequence=sequence, time_us=time_us, boot_id=boot_id, flags=flags))


def described(*pieces: bytes, last: Callable[[], bytes] | None = None) -> Script:
    """A port whose board has said all of itself before ``pieces``."""
    return Script(identity(), sheet(), *pieces, last=last)


def until(condition: Callable[[], bool], limit_s: float = 120.0) -> None:
    """Wait for another thread."""
    patience = Patience(limit_s)
    while not condition():
        patience.spend()
        time.sleep(0.002)


class MemoryPort:
    """A port in memory; subclasses say what comes. Time is real."""

    name = "memory"
    is_simulated = True
    """the time in its packets is what the test says, at whatever pace"""

    def __init__(self) -> None:
        self.closed = False
        self.later_s = 0.0
        """by how much its clock is ahead: a test that lets hours pass"""
        self.written: list[bytes] = []
        self._interrupted = threading.Event()

    def next_bytes(self) -> bytes:
        """What has come since the last call; LinkError when the port is gone."""
        return b""

    def ready(self) -> bool:
        """Whether a read would bring bytes, or an error."""
        return False

    def wait(self, timeout_s: float) -> bool:
        until = time.monotonic() + timeout_s
        while not self.ready() and (left := until - time.monotonic()) > 0:
            if self._interrupted.wait(min(left, 0.002)):
                self._interrupted.clear()
                return False
        return self.ready()

    def read(self) -> Arrival:
        return Arrival(self.next_bytes(), self.now(), time.time() + self.later_s)

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def interrupt(self) -> None:
        self._interrupted.set()

    def now(self) -> float:
        return time.monotonic() + self.later_s

    def close(self) -> None:
        self.closed = True


class Wire(MemoryPort):
    """The host's end of a board without clock, port or thread: whoever reads makes it tick."""

    name = "wire"

    def __init__(self, board: Board, line: Line | None = None, *, frames: int = 10**9) -> None:
        super().__init__()
        self.board = board
        self.frames = frames
        """after which the board is gone"""
        self.line = line
        """what spoils the packets from now on"""
        self._pending = [b"\0"]

    def ready(self) -> bool:
        return True

    def next_bytes(self) -> bytes:
        if self._pending:
            return self._pending.pop(0)
        if self.frames <= 0:
            raise LinkError("wire: gone")
        self.frames -= 1
        return b"".join(map(self._carry, self.board.tick())) or b"\0"

    def write(self, data: bytes) -> None:
        super().write(data)
        self.board.receive(data)
        self._pending += map(self._carry, self.board.answers())

    def _carry(self, packet: bytes) -> bytes:
        return packet if self.line is None else self.line.carry(packet)


class Script(MemoryPort):
    """A port that says what it is told to, one piece for each read, and then ``last`` again and again."""

    name = "script"

    def __init__(self, *pieces: bytes, last: Callable[[], bytes] | None = None) -> None:
        super().__init__()
        self._pieces = deque(pieces)
        self._last = last

    def say(self, *pieces: bytes) -> None:
        """Let more come."""
        self._pieces.extend(pieces)

    def ready(self) -> bool:
        return bool(self._pieces) or self._last is not None

    def next_bytes(self) -> bytes:
        if self._pieces:
            return self._pieces.popleft()
        if self._last is None:
            return b""
        time.sleep(0.001)
        return self._last()


class Flow(MemoryPort):
    """A board that sends a frame every ``period_s``, byte by byte, on a clock that the test moves on."""

    name = "flow"

    def __init__(self, handshake: bytes, packet: Callable[[int], bytes], period_s: float, *, at_once: int) -> None:
        """``packet(k)`` is frame k. A read brings at most ``at_once`` bytes, as of a terminal."""
        super().__init__()
        self.time_s = 0.0
        self.deaf = False
        """the reader thread is not woken any more"""
        self._waiting = bytearray(handshake)
        self._packet, self._period_s, self._at_once = packet, period_s, at_once
        self._sent = 0.0
        """frames sent so far, and the part of the next one"""

    def work(self, seconds: float) -> None:
        """Let time pass."""
        self.time_s += seconds
        until = self.time_s / self._period_s
        while self._sent < until:
            number = int(self._sent)
            packet, end = self._packet(number), min(until, number + 1.0)
            share = slice(*(int((at - number) * len(packet)) for at in (self._sent, end)))
            self._waiting += packet[share]
            self._sent = end

    @property
    def newest(self) -> int:
        """Number of the last frame that has come in full."""
        return int(self._sent) - 1

    def ready(self) -> bool:
        return bool(self._waiting) and not self.deaf

    def now(self) -> float:
        return self.time_s

    def read(self) -> Arrival:
        data = bytes(self._waiting[: self._at_once])
        del self._waiting[: len(data)]
        return Arrival(data, self.time_s, 1e9 + self.time_s)


def gone() -> bytes:
    """For ``last``: the port goes away after its last piece."""
    raise LinkError("gone")


def lossless(port: BytePort, **options: Any) -> Skin:
    """A skin that misses no frame, however slow its reader."""
    return Skin(port, delivery="lossless", **options)
