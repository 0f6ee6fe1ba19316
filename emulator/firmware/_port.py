"""A firmware board as a serial port in the same process: reading lets board time pass, so that runs repeat exactly."""

from __future__ import annotations

from ...errors import LinkError
from ._board import FirmwareBoard

_SLICE_S = 1e-3
"""s of board time between two looks at what the board has sent"""


class FirmwarePort:
    """The host's end of the serial line, as :class:`ohmskin.driver.Skin` wants a port.

    Example::

        with FirmwareBoard(scene) as board:
            skin = Skin(FirmwarePort(board))
    """

    def __init__(self, board: FirmwareBoard, name: str = "firmware") -> None:
        self.name = name
        self._board = board
        self._closed = False

    def read(self, wait_s: float) -> bytes:
        """The bytes of the board, waiting up to ``wait_s`` of board time for the first."""
        if self._closed:
            raise LinkError(f"{self.name}: the port is closed")
        deadline = self._board.time_s + max(wait_s, _SLICE_S)
        while self._board.time_s < deadline:
            data = self._board.run(_SLICE_S)
            if data:
                return data
        return b""

    def write(self, data: bytes) -> None:
        """Send to the board."""
        if self._closed:
            raise LinkError(f"{self.name}: the port is closed")
        self._board.send(data)

    def close(self) -> None:
        """Give the port back; the board stays on."""
        self._closed = True
