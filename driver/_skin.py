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
from ..wire import (
    Corrupt,
    Description,
    Event,
    FramePacket,
    HostProtocol,
    Order,
    board_family,
    host_protocol,
)
from ._port import BytePort, SerialPort
from ._reading import CountReader

T = TypeVar("T", bound=np.generic)
P = TypeVar("P", FramePacket, Description)
S = TypeVar("S", Design, Cell)

ASK_AGAIN_S = 0.5
"""how long to wait for an answer before asking again"""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One scan of the skin. Arrays are (rows, columns) and read-only."""

    sequence: int | None
    """the board's number of this frame, modulo 2**32; None: the board does not number its frames"""
    device_time: float
    """s since the board started, when the scan began; for a board without a clock, the host's time of arrival"""
    host_time: float
    """s since the epoch, when its last byte was here"""
    lost_before: int | None
    """frames lost between the previous frame and this one, on the line or by the board; None: the board does not
    number its frames, so that losses are unknown"""
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
        protocol: HostProtocol | None = None,
    ) -> None:
        """Introduce the board behind an open port.

        Args:
            port: closed by :meth:`close`, and when this fails.
            design: how the board reads its array; None: as the board describes itself.
            cell: what the skin is made of; None: as the board describes itself.
            estimator: name for :meth:`ohmskin.cell.Cell.estimator`.
            timeout: s to wait for the description here, and for each frame later.
            protocol: the host's end of the line to this family of boards; None: the native one.

        Raises:
            LinkTimeout: the board is silent.
            ProtocolError: it sends something else than packets, or a description that is not valid.
            LinkError: the port is gone.
            InputError: there is no such estimator for this cell.

        """
        self._port = port
        self._timeout = timeout
        self._protocol = host_protocol("ohmskin") if protocol is None else protocol
        self._events: deque[tuple[float, Event]] = deque()
        self._expected: int | None = None
        self._latest_us = -1
        self._latest_s = 0.0
        self._boot_id: int | None = None
        self.description: Description | None = None
        """the board's data sheet; None when design and cell were given and it was not needed"""
        self.corrupt = 0
        """stretches of bytes so far that were no packets"""
        self.unsolved = 0
        """frames so far whose readings no cell resistances can give: none of their cells is valid"""
        try:
            self._wake()
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
        board: str = "ohmskin",
        baudrate: int | None = None,
    ) -> Skin:
        """Open a serial device, a pty or ``socket://HOST:PORT``; see :meth:`__init__` for the rest.

        Args:
            port: name of the device, or URL.
            design: as in :meth:`__init__`; None for a board that does not describe itself: its family's usual circuit.
            cell: as in :meth:`__init__`; None for a board that does not describe itself: the shipped example.
            estimator: as in :meth:`__init__`.
            timeout: as in :meth:`__init__`.
            board: family of the board, a key of :data:`ohmskin.wire.BOARDS`.
            baudrate: of a real UART; None: the family's.

        Raises:
            LinkError: the port is not there, may not be used, or is in use; and what :meth:`__init__` raises.
            InputError: there is no such family of boards.

        """
        family = board_family(board)
        if design is None and family.design is not None:
            design = parse(family.design, Design, source=f"board '{board}'")
        if cell is None and not family.has_description:
            cell = Cell.example()
        known = {} if design is None or design.adc is None else {"adc_bits": design.adc.bits}
        protocol = host_protocol(board, shape=None if design is None else design.array.shape, **known)
        opened = SerialPort(port, family.baud_rate if baudrate is None else baudrate)
        return cls(opened, design=design, cell=cell, estimator=estimator, timeout=timeout, protocol=protocol)

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
        self._poll()
        reading = self._read(packet.counts)
        self.unsolved += not reading.solved
        lost = self._count_lost(packet)
        # Frames without time stamps that came in one piece are a moment apart, in their order.
        arrival = max(host_time, np.nextafter(self._latest_s, np.inf))
        device_time = float(arrival) if packet.time_us is None else packet.time_us / 1e6
        self._latest_s = device_time
        estimate = self._estimator.update(device_time, reading.resistance)
        return Frame(
            sequence=packet.sequence,
            device_time=device_time,
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

    def _introduce(self) -> Description:
        _, description = self._await(Description, "description")
        self._expected, self._boot_id = description.sequence, description.boot_id
        if description.time_us is not None:
            self._latest_us = description.time_us - 1
        return description

    def _wake(self) -> None:
        """Ask the board for what is missing; empty requests are orders that the family does not have."""
        for order in (Order.IDENTIFY, Order.DESCRIBE, Order.START):
            request = self._protocol.request(order)
            if request:
                self._port.write(request)

    def _poll(self) -> None:
        """Ask a board that sends frames only on request for the next one."""
        if self._protocol.family.polled:
            self._port.write(self._protocol.request(Order.ONE_FRAME))

    def _described(self, key: str, kind: type[S]) -> S:
        assert self.description is not None
        tables = getattr(self.description, key)
        if tables is None:
            raise ProtocolError(f"{self._port.name}: the board does not describe its {key}; pass {key}=")
        try:
            return parse(tables, kind, source=key)
        except InputError as error:
            raise ProtocolError(f"{self._port.name}: the board describes itself wrongly: {error}") from error

    def _count_lost(self, packet: FramePacket) -> int | None:
        """Frames missing before ``packet``, by the rule of docs/wire.md; a new start of the board is noticed here."""
        if packet.sequence is None or packet.time_us is None:
            return None
        rebooted = self._boot_id is not None and packet.boot_id != self._boot_id
        self._boot_id = packet.boot_id
        if rebooted or packet.time_us < self._latest_us:
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
                self._wake()
                ask_at = now + ASK_AGAIN_S
            data = self._port.read(min(ask_at, deadline) - now)
            received += len(data)
            host_time = time.time()
            self._events.extend((host_time, event) for event in self._protocol.feed(data, host_time))

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
