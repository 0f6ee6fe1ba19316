"""URL handler for pyserial: ``serial.serial_for_url("ohmskin://scene.toml")`` opens a virtual board in this process.

The board lives in a thread from ``open`` to ``close``. Options follow the path like those of ``ohmskin emulate``:
``ohmskin://scene.toml?clock=fast&seed=3&board=flexitac&duration=10&truth=truth.npz``; ``part=2`` is the second board of
a scene with several. An absolute path has three slashes: ``ohmskin:///home/me/scene.toml``. ``ohmskin://demo`` is the
scene that ohmskin ships. pyserial finds this module, by its name, once :mod:`ohmskin.emulator` has been imported.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
from math import inf
from pathlib import Path
from typing import Any, cast
from urllib.parse import parse_qsl, unquote, urlsplit

from serial import PortNotOpenError, SerialException, SerialTimeoutException
from serial.serialutil import Timeout
from serial.urlhandler import protocol_socket

from ..errors import InputError, OhmskinError
from ._ports import PairPort
from ._run import running
from ._scene import DEMO, load_scenes
from ._service import ClockName

OPTIONS = ("board", "clock", "duration", "part", "seed", "truth")
MOST_WAITING = 2**18
"""bytes that :attr:`Serial.in_waiting` counts up to; a socket's buffer holds fewer"""


class Serial(protocol_socket.Serial):
    """A serial port with a virtual board at its other end."""

    def open(self) -> None:
        """Start the board.

        Raises:
            SerialException: the URL or the scene is wrong, or the port is open already.

        """
        self.logger = None
        if self.port is None:
            raise SerialException("the port has no name; expected ohmskin://SCENE.toml")
        if self.is_open:
            raise SerialException("the port is open already")
        self._life = contextlib.ExitStack()
        try:
            self._socket = self._start(self.port)
        except OhmskinError as error:
            raise SerialException(str(error)) from error
        self._socket.setblocking(False)
        self.is_open = True

    def _start(self, url: str):  # type: ignore[no-untyped-def]  # a socket, whose type pyserial does not name
        parts = urlsplit(url)
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        unknown = sorted(options.keys() - set(OPTIONS))
        if unknown:
            raise InputError(f"{url}: unknown option '{unknown[0]}'; expected one of {', '.join(OPTIONS)}")
        clock = options.get("clock", "real")
        if clock not in ("real", "fast"):
            raise InputError(f"{url}: clock is '{clock}'; expected 'real' or 'fast'")
        try:
            duration_s, seed = float(options.get("duration", inf)), int(options.get("seed", 0))
            part = int(options.get("part", 1))
        except ValueError as error:
            raise InputError(f"{url}: expected numbers for duration, part and seed: {error}") from error
        path = unquote(parts.netloc + parts.path)
        port = PairPort(url)
        try:
            scenes = load_scenes(DEMO if path == "demo" else path)
            if not 1 <= part <= len(scenes) or ("part" not in options and len(scenes) > 1):
                raise InputError(f"{url}: the scene has {len(scenes)} boards; expected part=1 to {len(scenes)}")
            board = running(
                scenes[part - 1],
                port,
                clock=cast("ClockName", clock),
                duration_s=duration_s,
                seed=seed,
                truth=Path(options["truth"]) if "truth" in options else None,
                family=options.get("board", "ohmskin"),
            )
            self._life.enter_context(board)
        except BaseException:
            port.close()
            port.host_end.close()
            raise
        return port.host_end

    def read(self, size: int = 1) -> bytes:
        """Up to ``size`` bytes, fewer after the timeout; SerialException when the board's time is over."""
        self._check_open()
        got, patience = bytearray(), _patience(self.timeout)
        while len(got) < size and self._ready(selectors.EVENT_READ, patience):
            data = self._socket.recv(size - len(got))
            if data:
                got += data
            elif got:
                break
            else:
                raise SerialException(f"{self.port}: the board has gone")
        return bytes(got)

    def write(self, data: Any, /) -> int:
        """Send all of ``data``; SerialTimeoutException where that takes longer than the write timeout."""
        self._check_open()
        left, patience = memoryview(bytes(data)), _patience(self.write_timeout)
        while left:
            if not self._ready(selectors.EVENT_WRITE, patience):
                raise SerialTimeoutException(f"{self.port}: the board takes no bytes")
            try:
                left = left[self._socket.send(left) :]
            except OSError as error:
                raise SerialException(f"{self.port}: the board has gone") from error
        return len(bytes(data))

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        self._check_open()
        try:
            return len(self._socket.recv(MOST_WAITING, socket.MSG_PEEK))
        except BlockingIOError:
            return 0

    def _check_open(self) -> None:
        if not self.is_open:
            raise PortNotOpenError

    def _ready(self, event: int, patience: Timeout) -> bool:
        """Wait for the socket; whether it is ready. pyserial's own way, select(), fails beyond descriptor 1023."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, event)
            return bool(selector.select(patience.time_left()))

    def close(self) -> None:
        """Stop the board, and raise what it failed with."""
        if not self.is_open:
            return
        self.is_open = False
        self._socket.close()
        self._life.close()


def _patience(timeout_s: float | None) -> Timeout:
    return Timeout(timeout_s)  # type: ignore[arg-type]  # None is for ever, which the type stubs do not know
