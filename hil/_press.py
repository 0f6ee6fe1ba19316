"""Known loads on the skin under test: set on an emulated skin, or asked of a person."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ..common.arrays import FloatArray
from ..driver import Frame, Skin
from ..errors import LinkTimeout
from ._board import BoardInService, TargetMissing

MOST_FRAMES = 100_000
"""frames to look through for the first one under a load"""

Ask = Callable[[str], None]
"""shows a person what to do, and returns when it is done"""


@dataclass(frozen=True)
class Load:
    """A load that lies on the skin."""

    pressure_kpa: FloatArray
    """(rows, columns)"""
    since_s: float
    """board time from which the load is in force; -inf: frames tell no time, or a person pressed before now"""

    def read(self, skin: Skin) -> Frame:
        """The next frame of which the whole scan was under this load.

        Raises:
            LinkTimeout: no such frame came; and what ``skin.read()`` raises.

        """
        for _ in range(MOST_FRAMES):
            frame = skin.read()
            if frame.device_time is None or frame.device_time >= self.since_s:
                return frame
        raise LinkTimeout(f"{skin.port_name}: no frame since board time {self.since_s} s")


class Press:
    """Puts loads on the skin of a board in service.

    ::

        with press(10.0, cells=[(1, 2)]) as load:
            frame = load.read(skin)
    """

    def __init__(self, board: BoardInService, shape: tuple[int, int], ask: Ask | None) -> None:
        """``ask`` is for a board without a hand; None: nobody is there."""
        self._board = board
        self._shape = shape
        self._ask = ask

    @contextmanager
    def __call__(self, kpa: float, cells: Sequence[tuple[int, int]]) -> Iterator[Load]:
        """Press ``cells`` [(row, column), ...] with ``kpa`` each for the time of the block, and nothing else.

        Raises:
            TargetMissing: the board has no hand, and nobody is there to press.
            InputError: a negative pressure.
            LinkTimeout: the emulated board does not take the load.

        """
        pressure = np.zeros(self._shape)
        for cell in cells:
            pressure[cell] = kpa
        since_s = self._put_on(pressure, kpa, cells)
        try:
            yield Load(pressure, since_s)
        finally:
            self._take_off()

    def _put_on(self, pressure: FloatArray, kpa: float, cells: Sequence[tuple[int, int]]) -> float:
        if self._board.hand is not None:
            return self._board.hand.press(pressure)
        if self._ask is None:
            raise TargetMissing(
                f"nobody is there to press on the board at {self._board.target}: run pytest in a terminal, "
                "or without this test"
            )
        self._ask(f"Press with {kpa:g} kPa on each of the cells (row, column) {list(cells)}, and hold")
        return -np.inf

    def _take_off(self) -> None:
        if self._board.hand is not None:
            self._board.hand.press(0.0)
        elif self._ask is not None:
            self._ask("Take everything off the skin")
