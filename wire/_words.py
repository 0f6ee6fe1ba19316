"""Frames of binary words behind a header, or between the zeros of COBS, as ``[frame]`` of BOARD.toml describes them.

What shows that bytes are a frame, and where the next one begins:

* a checksum: header, length and checksum together. A checksum of one byte alone may agree by chance; a host that is not
  in step then asks for the next header, too.
* without a checksum: header, length, trailer, and the next header. Cells may look like a header: the host keeps the
  phase that it has. Where several phases are possible it takes the one whose frame is nearest to the last good frame,
  and reports an ambiguous header while there is none.
* COBS: the zeros between the packets, and the length.
* without a header: the pauses between the frames (:class:`._cells.Pauses`), or the requests of a host that polls.

Text between two frames is skipped and counted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from cobs import cobs
from pydantic import Field, model_validator

from ._cells import AnyFrame, Byte, Cells, Numbers, Pauses
from ._checksums import CHECKSUMS, Checksum
from ._framing import StartTable, require
from ._packets import Corrupt, Event, Order
from ._protocol import Family, HostProtocol, Layout

MOST_TEXT = 4096
"""bytes of text between two frames"""
_TEXT = re.compile(rb"[\t\r\n\x20-\x7e]*")
AMBIGUOUS_HEADER = "ambiguous header: cells look like one, and no frame is known"
AMBIGUOUS_PHASE = "ambiguous: no header and no pause shows where a frame begins; counted from the first byte"


@dataclass(frozen=True)
class Word:
    """A kind of number on the line."""

    dtype: np.dtype[np.generic]
    bits: int
    """for counts; a float has those of its mantissa, less those that text of 15 digits lacks"""

    def holds(self, low: float, high: float, *, steps: int) -> bool:
        """Whether the word can hold so many even steps from ``low`` to ``high``."""
        step = (high - low) / steps
        if self.dtype.kind == "f":
            return step > 2.0 ** (2 - self.bits) * max(abs(low), abs(high))
        limits = np.iinfo(self.dtype)  # type: ignore[type-var]  # its kind is not f
        return bool(limits.min <= low and high <= limits.max and step >= 1.0)


WORDS = {
    name: Word(np.dtype(code), bits)
    for name, code, bits in (
        ("uint8", "u1", 8),
        ("int8", "i1", 7),
        ("uint16le", "<u2", 16),
        ("uint16be", ">u2", 16),
        ("int16le", "<i2", 15),
        ("int16be", ">i2", 15),
        ("uint32le", "<u4", 32),
        ("uint32be", ">u4", 32),
        ("int32le", "<i4", 31),
        ("int32be", ">i4", 31),
        ("float32le", "<f4", 24),
        ("float32be", ">f4", 24),
        ("float64le", "<f8", 49),
        ("float64be", ">f8", 49),
    )
}
"""by name"""


class BinaryFrame(AnyFrame):
    """``[frame]`` with ``format = "binary"``: header, bytes before, words, bytes after, checksum, trailer."""

    format: Literal["binary"]
    word: Literal[tuple(WORDS)]  # type: ignore[valid-type]  # a list of names that is in one place only
    header: Annotated[tuple[Byte, ...], Field(strict=False, max_length=64)] = ()
    trailer: Annotated[tuple[Byte, ...], Field(strict=False, max_length=64)] = ()
    framing: Literal["none", "cobs"] = "none"
    before: Annotated[int, Field(ge=0, le=1024)] = 0
    """bytes between header and words that are not read: a length, a counter, a type"""
    after: Annotated[int, Field(ge=0, le=1024)] = 0
    """bytes between words and checksum that are not read"""
    checksum: Literal["none", *CHECKSUMS] = "none"  # type: ignore[valid-type]  # likewise
    checksum_of: Literal["payload", "body", "frame"] = "payload"
    """the words; all between header and checksum; the header, too"""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.framing == "cobs" and (self.header or self.trailer):
            raise ValueError('framing = "cobs" stands in place of header and trailer; expected none of them')
        if self.checksum == "none" and self.checksum_of != "payload":
            raise ValueError('checksum_of has no effect without a checksum; expected checksum = "..."')
        if self.checksum != "none" and self.framing == "none" and not self.header:
            raise ValueError("a checksum alone does not show where a frame begins; expected a header or framing")
        return self

    @cached_property
    def _word(self) -> Word:
        return WORDS[self.word]

    @cached_property
    def _check(self) -> Checksum | None:
        return CHECKSUMS.get(self.checksum)

    @cached_property
    def mark(self) -> bytes:
        """The header."""
        return bytes(self.header)

    @cached_property
    def end_mark(self) -> bytes:
        """The trailer."""
        return bytes(self.trailer)

    @property
    def proves(self) -> bool:
        """Whether the checksum can hardly be right by chance: one of one byte agrees with one stretch in 256."""
        return self._check is not None and self._check.size > 1

    def require(self, family: Family, layout: Layout) -> None:
        """Refuse counts that do not fit into the words. Raises InputError."""
        require(family, layout, [], range(1, 17 if self.range is not None else min(self._word.bits, 16) + 1))

    def size(self, cells: int) -> int:
        """Bytes of a frame of so many cells."""
        return self._begin + cells * self._word.dtype.itemsize + self._tail

    @cached_property
    def _begin(self) -> int:
        """Place of the first word."""
        return len(self.header) + self.before

    @cached_property
    def _tail(self) -> int:
        """Bytes behind the words."""
        return self.after + (0 if self._check is None else self._check.size) + len(self.trailer)

    def numbers(self, frame: bytes) -> Numbers:
        """The numbers in the bytes of a frame."""
        words = np.frombuffer(frame[self._begin : len(frame) - self._tail], dtype=self._word.dtype)
        return words.astype(np.float64)

    def fault(self, frame: bytes) -> str:
        """Why bytes of the right length, with the header at their head, are no frame; empty if they are one."""
        if not frame.endswith(self.end_mark):
            return f"no {self.end_mark.hex(' ').upper()} at the end of a frame"
        if self._check is not None:
            end = len(frame) - len(self.trailer)
            at = end - self._check.size
            if self._check.of(self._covered(frame[:at])) != frame[at:end]:
                return "the checksum does not match"
        return ""

    def _covered(self, head: bytes) -> bytes:
        """The bytes that the checksum is of, in those ahead of it."""
        match self.checksum_of:
            case "frame":
                return head
            case "body":
                return head[len(self.header) :]
            case _:
                return head[self._begin : len(head) - self.after]

    def write(self, numbers: Numbers, layout: Layout) -> bytes:
        """The bytes of a frame with these numbers; those that are not read are zeros."""
        rounded = numbers if self._word.dtype.kind == "f" else np.rint(numbers)
        head = self.mark + bytes(self.before) + rounded.astype(self._word.dtype).tobytes() + bytes(self.after)
        check = b"" if self._check is None else self._check.of(self._covered(head))
        frame = head + check + self.end_mark
        return bytes(cobs.encode(frame)) + b"\0" if self.framing == "cobs" else frame


class _WordHost(HostProtocol):
    """What the hosts of all binary formats share."""

    def __init__(self, form: BinaryFrame, cells: Cells, start: StartTable, family: Family, layout: Layout) -> None:
        super().__init__(family, layout)
        self._form, self._cells, self._start = form, cells, start
        self._size = form.size(cells.count)
        self._buffer = bytearray()

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return self._start.order(order)


class CobsHost(_WordHost):
    """Host end of frames that COBS stuffs, each ended by a zero."""

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        events: list[Event] = []
        *pieces, rest = data.split(b"\0")
        for piece in pieces:
            stretch = bytes(self._buffer) + piece
            self._buffer.clear()
            if stretch:
                events.append(self._take(stretch))
        self._buffer += rest
        longest = self._size + self._size // 254 + 1
        if len(self._buffer) > max(2 * longest, MOST_TEXT):
            events.append(Corrupt(len(self._buffer), "no zero within the longest frame"))
            self._buffer.clear()
        return events

    def _take(self, stretch: bytes) -> Event:
        try:
            frame = bytes(cobs.decode(stretch))
        except cobs.DecodeError as error:
            return Corrupt(len(stretch), f"not COBS: {error}")
        if len(frame) != self._size:
            return Corrupt(len(stretch), f"{len(frame)} bytes between two zeros; expected {self._size}")
        fault = self._form.fault(frame)
        if fault:
            return Corrupt(len(stretch), fault)
        return self._cells.event(self._form.numbers(frame), len(stretch) + 1)


class BinaryHost(_WordHost):
    """Host end of frames with a header, or with nothing but a length."""

    def __init__(self, form: BinaryFrame, cells: Cells, start: StartTable, family: Family, layout: Layout) -> None:
        super().__init__(form, cells, start, family, layout)
        self._in_step = False
        """the bytes at the head of the buffer follow a good frame"""
        self._last: Numbers | None = None
        """numbers of the last good frame"""
        self._pauses = None if form.header or form.trailer or family.polled else Pauses(self._size)
        self._placed = False

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        if order is Order.ONE_FRAME and not self._form.header:
            self._buffer.clear()  # the rest of an earlier reply; the next begins with its first word
        return super().request(order, period_us=period_us)

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        if self._pauses is not None:
            return list(self._by_pauses(data, received_at))
        self._buffer += data
        events: list[Event] = []
        while True:
            event = self._next()
            if event is None:
                return events
            events.append(event)

    def _by_pauses(self, data: bytes, received_at: float) -> Iterator[Event]:
        """The events of bytes whose place in a frame follows from pauses alone."""
        assert self._pauses is not None
        place = self._pauses.arrive(received_at, len(data))
        head = (place - len(self._buffer)) % self._size
        self._buffer += data
        if not self._pauses.decided:
            return
        ahead = (self._pauses.start - head) % self._size
        if (ahead and len(self._buffer) >= ahead) or not self._placed:
            shown = self._pauses.by_pause is not None
            if not self._placed or ahead:
                yield Corrupt(ahead, "bytes ahead of the first pause" if shown else AMBIGUOUS_PHASE)
            del self._buffer[:ahead]
            self._placed = True
        elif ahead:
            return
        while len(self._buffer) >= self._size:
            yield self._take()

    def _next(self) -> Event | None:
        """The next event in the buffer, or None when more bytes are needed."""
        header = self._form.mark
        if self._in_step and header and not self._buffer.startswith(header):
            at = self._header_behind_text(0)
            if at is None:
                return None
            if at > 0:
                return self._skip(at, "text between two frames", in_step=True)
        if len(self._buffer) < self._size:
            return None
        if self._is_next():
            return self._take()
        return self._find_checked() if self._form.proves else self._find_by_headers()

    def _is_next(self) -> bool:
        """Whether the head of the buffer is a frame without doubt."""
        if self._fault(0):
            return False
        if self._form.proves or self.family.polled:
            return True
        return self._in_step and not self._another_header()

    def _header_behind_text(self, place: int) -> int | None:
        """Where a header stands at ``place`` or behind nothing but text; -1: nowhere, None: not known yet."""
        header, buffer = self._form.mark, self._buffer
        at = buffer.find(header, place, place + MOST_TEXT + len(header))
        text = _TEXT.match(buffer, place, place + MOST_TEXT)
        end = place if text is None else text.end()
        if place <= at <= end:
            return at
        is_open = end == len(buffer) or header.startswith(bytes(buffer[end:]))
        return None if is_open and end < place + MOST_TEXT else -1

    def _fault(self, at: int) -> str:
        """Why no frame begins at a place; empty if one may."""
        frame = bytes(self._buffer[at : at + self._size])
        if not frame.startswith(self._form.mark):
            return f"no header {self._form.mark.hex(' ').upper()}"
        fault = self._form.fault(frame)
        if not fault and self._cells.drops and not self._cells.are_counts(self._form.numbers(frame)):
            fault = "a number that is no count"
        return fault

    def _another_header(self) -> bool:
        """Whether a header may begin within the frame at the head, its last byte included."""
        header = self._form.mark
        return bool(header) and self._buffer.find(header, 1, self._size + len(header) - 1) >= 0

    def _find_checked(self) -> Event:
        """Skip to the next header whose frame has a right checksum."""
        reason, at = self._fault(0), 0
        while True:
            at = self._buffer.find(self._form.mark, at + 1)
            if at < 0:
                return self._skip(max(len(self._buffer) - len(self._form.header) + 1, 1), reason)
            if at + self._size > len(self._buffer) or not self._fault(at):
                return self._skip(at, reason)

    def _find_by_headers(self) -> Event | None:
        """Find the phase in two lengths of a frame: places with a header, a frame, and another header behind it."""
        header, buffer, size = self._form.mark, self._buffer, self._size
        enough = 2 * size + len(header) - 1
        if len(buffer) < enough:
            return None
        places, waits = [], False
        for at in self._candidates():
            if self._fault(at):
                continue
            behind = self._header_behind_text(at + size) if header else self._trailer_behind(at)
            waits = waits or behind is None
            if behind is not None and behind >= 0:
                places.append(at)
        if not places and waits and len(buffer) < enough + MOST_TEXT:
            return None
        if not places:
            return self._skip(size, "no two headers at the distance of a frame")
        if len(places) == 1:
            best = places[0]
        elif self._last is None:
            return self._skip(size, AMBIGUOUS_HEADER)
        else:
            best = min(places, key=self._distance)
        if best > 0:
            return self._skip(best, "bytes ahead of a header", in_step=True)
        return self._take()

    def _candidates(self) -> Iterator[int]:
        """Places within the first frame's length at which a frame may begin."""
        mark, shift = self._form.mark, 0
        if not mark:
            mark, shift = self._form.end_mark, self._size - len(self._form.trailer)
        at = self._buffer.find(mark, shift)
        while 0 <= at - shift < self._size:
            yield at - shift
            at = self._buffer.find(mark, at + 1)

    def _trailer_behind(self, at: int) -> int:
        """Where the frame after the one at ``at`` has its trailer; -1: it has none."""
        end = at + 2 * self._size
        trailer = self._form.end_mark
        return end if self._buffer[end - len(trailer) : end] == trailer else -1

    def _distance(self, at: int) -> float:
        """Sum of the differences to the last good frame, if a frame begins at ``at``."""
        assert self._last is not None
        with np.errstate(over="ignore", invalid="ignore"):
            apart = np.abs(self._form.numbers(bytes(self._buffer[at : at + self._size])) - self._last)
        return float(np.nansum(apart))

    def _take(self) -> Event:
        self._last = self._form.numbers(bytes(self._buffer[: self._size]))
        self._in_step = True
        del self._buffer[: self._size]
        return self._cells.event(self._last, self._size)

    def _skip(self, size: int, reason: str, *, in_step: bool = False) -> Corrupt:
        self._in_step = in_step
        del self._buffer[:size]
        return Corrupt(size, reason)
