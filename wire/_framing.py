"""Framing shared by formats without delimiters: fixed-length packets found again by checking them, and text lines."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Annotated, Self

from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..common.config import Section
from ..errors import InputError
from ._cells import Byte, Cells
from ._packets import BadCommand, Command, Corrupt, Event, FramePacket, Order
from ._protocol import BoardProtocol, Family, HostProtocol, Layout

Sent = str | Annotated[tuple[Byte, ...], Field(strict=False)]
"""bytes to send, as text or as a list of numbers"""


class FixedLengthHost(HostProtocol):
    """Host end for packets of one length. A packet is what passes :meth:`fault` at its place.

    After a fault the host tries every later place that :meth:`candidate` names, until a packet passes again.
    """

    size: int
    """bytes of a packet"""

    def __init__(self, family: Family, layout: Layout) -> None:
        super().__init__(family, layout)
        self._buffer = bytearray()

    @abstractmethod
    def fault(self, buffer: bytearray, at: int) -> str:
        """Why the ``size`` bytes from ``at`` on are no packet; empty when they are one."""

    @abstractmethod
    def take(self, packet: bytes, received_at: float) -> list[Event]:
        """The events of one good packet."""

    def candidate(self, buffer: bytearray, at: int) -> int:
        """The first place from ``at`` on where a packet may begin."""
        return at

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        events: list[Event] = []
        self._buffer += data
        at = skipped = 0
        reason = ""
        while len(self._buffer) - at >= self.size:
            fault = self.fault(self._buffer, at)
            if fault:
                reason = reason or fault
                hop = self.candidate(self._buffer, at + 1) - at
                skipped += hop
                at += hop
                continue
            if skipped:
                events.append(Corrupt(skipped, reason))
                skipped, reason = 0, ""
            events += self.take(bytes(self._buffer[at : at + self.size]), received_at)
            at += self.size
        if skipped:
            events.append(Corrupt(skipped, reason))
        del self._buffer[:at]
        return events


class LineHost(HostProtocol):
    """Host end for text: lines that end in a line feed."""

    longest: int
    """bytes of a line; a longer one is corrupt"""

    def __init__(self, family: Family, layout: Layout) -> None:
        super().__init__(family, layout)
        self._line = bytearray()
        self._too_long = False

    @abstractmethod
    def take(self, line: bytes, received_at: float) -> list[Event]:
        """The events of one line, without its line feed."""

    def broken(self) -> None:
        """A line was too long and has been reported."""
        return

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        events: list[Event] = []
        *lines, rest = data.split(b"\n")
        for line in lines:
            self._extend(line, events)
            whole, too_long = bytes(self._line), self._too_long
            self._line.clear()
            self._too_long = False
            if too_long:
                events.append(Corrupt(len(whole) + 1, "the end of a line that is too long"))
                self.broken()
            else:
                events += self.take(whole, received_at)
        self._extend(rest, events)
        return events

    def _extend(self, piece: bytes, events: list[Event]) -> None:
        self._line += piece
        if len(self._line) > self.longest:
            events.append(Corrupt(len(self._line), f"a line longer than {self.longest} bytes"))
            self._line.clear()
            self._too_long = True


class FreeRunningBoard(BoardProtocol):
    """Board end of a family that streams from power-up and takes no commands."""

    def feed(self, data: bytes) -> list[Command | BadCommand]:
        return []


class PolledBoard(BoardProtocol):
    """Board end of a family that sends one frame for each request."""

    def asks(self, byte: int) -> bool:
        """Whether this byte of the host asks for a frame."""
        return True

    def feed(self, data: bytes) -> list[Command | BadCommand]:
        return [Command(Order.ONE_FRAME) for byte in data if self.asks(byte)]


def one_frame(counts: ArrayLike, *, sequence: int | None = None, time_us: int | None = None) -> list[Event]:
    """The event of one frame."""
    return [FramePacket.of(counts, sequence=sequence, time_us=time_us)]


def require(family: Family, layout: Layout, shapes: list[tuple[int, int]], adc_bits: Sequence[int]) -> None:
    """Refuse a board that the family's format cannot carry. Raises InputError."""
    if shapes and (layout.rows, layout.columns) not in shapes:
        known = ", ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise InputError(f"a board '{family.name}' of {layout.rows} x {layout.columns} cells; the family has {known}")
    if layout.adc_bits not in adc_bits:
        known = f"at most {adc_bits[-1]}" if isinstance(adc_bits, range) else " or ".join(map(str, adc_bits))
        raise InputError(f"a board '{family.name}' with an ADC of {layout.adc_bits} bits; its format carries {known}")


class StartTable(Section):
    """``[start]`` of BOARD.toml: what the host does to get frames."""

    send: Sent = ""
    """bytes to send after opening"""
    poll: Sent = ""
    """bytes that ask for one frame"""
    every: Annotated[float, Field(ge=0.05, le=3600.0)] | None = None
    """s after which ``send`` is sent again, to a board that stops when it hears nothing; None: once is enough"""
    dtr: bool | None = None
    """level of the control line DTR; None: the operating system's, which resets most boards"""
    rts: bool | None = None

    @model_validator(mode="after")
    def _repeats_something(self) -> Self:
        if self.every is not None and not self.send:
            raise ValueError("every has no effect without send")
        return self

    def order(self, order: Order) -> bytes:
        """The bytes that give an order; empty where there is no such."""
        text = self.poll if order is Order.ONE_FRAME else self.send if order is Order.START else ""
        return text.encode() if isinstance(text, str) else bytes(text)


class DescribedBoard(BoardProtocol):
    """Board end of a format that BOARD.toml describes: waits for the bytes that start it, or ask for each frame."""

    def __init__(
        self, write: Callable[..., bytes], cells: Cells, start: StartTable, family: Family, layout: Layout
    ) -> None:
        super().__init__(family, layout)
        self._write, self._cells = write, cells
        self._send, self._poll = start.order(Order.START), start.order(Order.ONE_FRAME)
        self._started = not self._send
        self._heard = b""

    def feed(self, data: bytes) -> list[Command | BadCommand]:
        commands: list[Command | BadCommand] = []
        for byte in data:
            self._heard = (self._heard + bytes([byte]))[-max(len(self._send), len(self._poll), 1) :]
            if self._send and self._heard.endswith(self._send):
                self._started = True
                if not self._poll:  # a polled board does not stream when it is started
                    commands.append(Command(Order.START))
            elif self._poll and self._heard.endswith(self._poll):
                commands.append(Command(Order.ONE_FRAME))
        return commands

    def frame(self, frame: FramePacket) -> bytes:
        if not self._started:
            return b""
        numbers = self._cells.numbers(frame)
        return self._write(numbers, self.layout, sequence=frame.sequence or 0, time_us=frame.time_us or 0)
