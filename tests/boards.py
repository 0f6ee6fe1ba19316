"""Emulated boards for the tests: scenes, and a board without a port."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ohmskin.emulator import Board, Line, Scene
from ohmskin.errors import LinkError

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


class Wire:
    """The host's end of a board without clock, port or thread: whoever reads makes it tick."""

    def __init__(self, board: Board, line: Line | None = None, *, frames: int = 10**9) -> None:
        self.name = "wire"
        self.board = board
        self.frames = frames
        """after which the board is gone"""
        self.closed = False
        self.line = line
        """what spoils the packets from now on"""
        self._pending = [b"\0"]

    def read(self, wait_s: float) -> bytes:
        if self._pending:
            return self._pending.pop(0)
        if self.frames <= 0:
            raise LinkError("wire: gone")
        self.frames -= 1
        return b"".join(map(self._carry, self.board.tick()))

    def write(self, data: bytes) -> None:
        self.board.receive(data)
        self._pending += map(self._carry, self.board.answers())

    def close(self) -> None:
        self.closed = True

    def _carry(self, packet: bytes) -> bytes:
        return packet if self.line is None else self.line.carry(packet)
