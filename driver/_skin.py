"""``Skin``: a board's bytes to frames of counts, ohms and kPa."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, FloatArray
from ..cell import Cell, Estimator
from ..circuits import Design
from ..config import parse
from ..errors import InputError, LinkTimeout, ProtocolError
from ..wire import Command, Corrupt, Decoder, DescriptionPacket, Event, FramePacket, Framer, Order, encode
from ._port import BAUDRATE, BytePort, SerialPort
from ._reading import CountReader

T = TypeVar("T", bound=np.generic)
P = TypeVar("P", FramePacket, DescriptionPacket)
S = TypeVar("S", Design, Cell)

ASK_AGAIN_S = 0.5
"""how long to wait for an answer before asking again"""
# The zero ends what an earlier host may have left unfinished.
_WAKE = b"\0" + encode(Command(Order.DESCRIBE)) + encode(Command(Order.START))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One scan of the skin. Arrays are (rows, columns) and read-only."""

    sequence: int
    """the board's number of this frame, modulo 2**32"""
    device_time: float
    """s since the board started, when the scan began"""
    host_time: float
    """s since the epoch, when its last byte was here"""
    lost_before: int
    """frames lost between the previous frame and this one, on the line or by the board"""
    counts: NDArray[np.uint16]
    valid: BoolArray
    """where ``resistance`` is a measurement: not clipped, and known to 1 % or an ADC step whatever clipped ones are"""
    resistance: FloatArray
    """of the cells, in ohm, what the circuit adds taken out; NaN where not valid"""
    pressure: FloatArray
    """kPa, estimated from this and all earlier frames; where not valid the last estimate, NaN before the first"""


class Skin:
    """An open skin: iterate over it for its frames. Make one with :meth:`open`."""

    def __init__(
        self,
        port: BytePort,
        *,
        design: Design | None = None,
        cell: Cell | None = None,
        estimator: str | None = None,
        timeout: float = 3.0,
        framer: Framer | None = None,
        wake: bytes = _WAKE,
    ) -> None:
        """Introduce the board behind an open port.

        Args:
            port: closed by :meth:`close`, and when this fails.
            design: how the board reads its array; None: as the board describes itself.
            cell: what the skin is made of; None: as the board describes itself.
            estimator: name for :meth:`ohmskin.cell.Cell.estimator`.
            timeout: s to wait for the description here, and for each frame later.
            framer: how the board's bytes become events; None: as ``docs/wire.md`` says.
            wake: what to send when the board says nothing.

        Raises:
            LinkTimeout: the board is silent.
            ProtocolError: it sends something else than packets, or a description that is not valid.
            LinkError: the port is gone.
            InputError: there is no such estimator for this cell.

        """
        self._port = port
        self._timeout = timeout
        self._framer = Decoder() if framer is None else framer
        self._wake = wake
        self._events: deque[tuple[float, Event]] = deque()
        self._expected: int | None = None
        self._latest_us = -1
        self.description: DescriptionPacket | None = None
        """the board's data sheet; None when design and cell were given and it was not needed"""
        self.corrupt = 0
        """stretches of bytes so far that were no packets"""
        self.unsolved = 0
        """frames so far whose readings no cell resistances can give: none of their cells is valid"""
        try:
            port.write(wake)
            if design is None or cell is None:
                self.description = self._introduce()
            self.design = self._described("design", Design) if design is None else design
            self.cell = self._described("cell", Cell) if cell is None else cell
            self._read = CountReader(self.design)
            self._estimator_name = estimator
            self._rest: FloatArray | None = None
            self._estimator = self._new_estimator()
        except BaseException:
            port.close()
            raise

    @classmethod
    def open(
        cls,
        port: str,
        *,
        design: Design | None = None,
        cell: Cell | None = None,
        estimator: str | None = None,
        timeout: float = 3.0,
        baudrate: int = BAUDRATE,
    ) -> Skin:
        """Open a serial device, a pty or ``socket://HOST:PORT``; see :meth:`__init__` for the rest.

        Raises:
            LinkError: the port is not there, may not be used, or is in use; and what :meth:`__init__` raises.

        """
        return cls(SerialPort(port, baudrate), design=design, cell=cell, estimator=estimator, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Give the port back. The board goes on by itself."""
        self._port.close()

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        """The next frame.

        Raises:
            LinkTimeout: none came in time.
            LinkError: the board has gone away.
            ProtocolError: what came breaks the format, or does not fit the design.

        """
        host_time, packet = self._await(FramePacket, "frame")
        reading = self._read(packet.counts)
        self.unsolved += not reading.solved
        lost = self._count_lost(packet)
        estimate = self._estimator.update(packet.time_us / 1e6, reading.resistance)
        return Frame(
            sequence=packet.sequence,
            device_time=packet.time_us / 1e6,
            host_time=host_time,
            lost_before=lost,
            counts=packet.counts,
            valid=_read_only(reading.valid),
            resistance=_read_only(reading.resistance),
            pressure=_read_only(estimate.pressure_kpa),
        )

    def tare(self, frames: int = 20) -> FloatArray:
        """Take the skin for unloaded now: the mean of the next ``frames`` becomes each cell's rest resistance.

        This removes what differs from cell to cell, and the steady part of what the lines and switches add. A cell
        without a valid reading keeps the rest resistance of the data sheet. Frames taken are not iterated over.

        Returns:
            (rows, columns) rest resistances in ohm.

        Raises:
            InputError: ``frames`` is not positive; and what iterating raises.

        """
        if frames < 1:
            raise InputError(f"tare over {frames} frames; expected at least 1")
        taken = np.array([next(self).resistance for _ in range(frames)])
        readings = np.isfinite(taken).sum(axis=0)
        mean = np.nansum(taken, axis=0) / np.maximum(readings, 1)
        self._rest = np.where(readings > 0, mean, self.cell.rest_resistance_ohm)
        self._estimator = self._new_estimator()
        return self._rest.copy()

    def _new_estimator(self) -> Estimator:
        return self.cell.estimator(self.design.array.shape, self._estimator_name, rest_resistance_ohm=self._rest)

    def _introduce(self) -> DescriptionPacket:
        _, description = self._await(DescriptionPacket, "description")
        self._expected, self._latest_us = description.sequence, description.time_us - 1
        return description

    def _described(self, key: str, kind: type[S]) -> S:
        assert self.description is not None
        try:
            return parse(getattr(self.description, key), kind, source=key)
        except InputError as error:
            raise ProtocolError(f"{self._port.name}: the board describes itself wrongly: {error}") from error

    def _count_lost(self, packet: FramePacket) -> int:
        """Frames missing before ``packet``, by the rule of docs/wire.md; a new start of the board is noticed here."""
        if packet.time_us < self._latest_us:
            self._expected = 0
            self._estimator = self._new_estimator()
        elif packet.time_us == self._latest_us:
            raise ProtocolError(f"{self._port.name}: two frames of the same time, {packet.time_us} us")
        lost = 0 if self._expected is None else (packet.sequence - self._expected) % 2**32
        if lost >= 2**31:
            raise ProtocolError(
                f"{self._port.name}: frame {packet.sequence} came where {self._expected} was next, "
                "yet the board has not started anew"
            )
        self._expected, self._latest_us = (packet.sequence + 1) % 2**32, packet.time_us
        return lost

    def _await(self, kind: type[P], what: str) -> tuple[float, P]:
        """The next packet of this kind and when it came; packets of other kinds are passed over."""
        start = time.monotonic()
        ask_at, deadline = start + ASK_AGAIN_S, start + self._timeout
        received, reason = 0, "no end of a packet"
        while True:
            while self._events:
                host_time, event = self._events.popleft()
                if isinstance(event, kind):
                    return host_time, event
                if isinstance(event, Corrupt):
                    self.corrupt += 1
                    reason = event.reason
                else:
                    reason = ""
            now = time.monotonic()
            if now >= deadline:
                raise self._nothing_came(what, received, reason)
            if now >= ask_at:
                self._port.write(self._wake)
                ask_at = now + ASK_AGAIN_S
            data = self._port.read(min(ask_at, deadline) - now)
            received += len(data)
            host_time = time.time()
            self._events.extend((host_time, event) for event in self._framer.feed(data))

    def _nothing_came(self, what: str, received: int, reason: str) -> LinkTimeout | ProtocolError:
        """The error for a wait that brought no packet of the kind wanted; ``reason`` is that of the latest event."""
        where = f"{self._port.name}: no {what} within {self._timeout:g} s"
        if not received:
            return LinkTimeout(f"{where}: the port is silent")
        if reason:
            return ProtocolError(
                f"{where}: {received} bytes came, the last of them no packet ({reason}); "
                "expected an ohmskin board, at this baud rate"
            )
        return LinkTimeout(f"{where}: the board is there, but sends none")


def _read_only(array: NDArray[T]) -> NDArray[T]:
    array.flags.writeable = False
    return array
