"""Frames of binary words behind a header, or between delimiters (COBS, SLIP), as ``[frame]`` of BOARD.toml has them.

What shows that bytes are a frame, and where the next one begins:

* a checksum: header, length and checksum together. A checksum of one byte alone may agree by chance; a host that is not
  in step then asks for the next header, too.
* without a checksum: header, length, trailer, and the next header. Cells may look like a header: the host keeps the
  phase that it has. Where several phases are possible it takes the one whose frame is nearest to the last good frame,
  and reports an ambiguous header while there is none.
* a framing (:data:`FRAMINGS`): the bytes that stand between packets only, and the length.
* without a header: the pauses between the frames (:class:`._cells.Pauses`), or the requests of a host that polls.

Text between two frames is skipped and counted.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ._blocks import MOST_BLOCKS, WORDS, Block, Template, Word, template, usual
from ._cells import AnyFrame, Byte, Cells, Copies, Numbers, Pauses, Unwrapped
from ._checksums import CHECKSUMS
from ._delimited import FRAMINGS
from ._framing import StartTable, require
from ._packets import Corrupt, Event, Order
from ._protocol import Family, HostProtocol, Layout

MOST_TEXT = 4096
"""bytes of text between two frames"""
_TEXT = re.compile(rb"[\t\r\n\x20-\x7e]*")
AMBIGUOUS_HEADER = "ambiguous header: cells look like one, and no frame is known"
AMBIGUOUS_PHASE = "ambiguous: no header and no pause shows where a frame begins; counted from the first byte"


class BinaryFrame(AnyFrame):
    """``[frame]`` with ``format = "binary"``: header, bytes before, words, bytes after, checksum, trailer."""

    format: Literal["binary"]
    word: Literal["", *WORDS] = ""  # type: ignore[valid-type]  # a list of names that is in one place only
    block: Annotated[tuple[Block, ...], Field(strict=False, max_length=MOST_BLOCKS)] = ()
    """the fields of a frame in the order sent, in place of word, header, before, after, checksum and trailer"""
    header: Annotated[tuple[Byte, ...], Field(strict=False, max_length=64)] = ()
    trailer: Annotated[tuple[Byte, ...], Field(strict=False, max_length=64)] = ()
    framing: Literal["none", *FRAMINGS] = "none"  # type: ignore[valid-type]  # likewise
    before: Annotated[int, Field(ge=0, le=1024)] = 0
    """bytes between header and words that are not read: a length, a counter, a type"""
    after: Annotated[int, Field(ge=0, le=1024)] = 0
    """bytes between words and checksum that are not read"""
    checksum: Literal["none", *CHECKSUMS] = "none"  # type: ignore[valid-type]  # likewise
    checksum_of: Literal["payload", "body", "frame"] = "payload"
    """the words; all between header and checksum; the header, too"""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.block:
            others = ("word", "header", "trailer", "before", "after", "checksum", "checksum_of")
            given = next((key for key in others if key in self.model_fields_set), None)
            if given is not None:
                raise ValueError(f"{given} stands in place of [[frame.block]]; expected one of them")
            self.template(0)  # which says what does not fit
        elif not self.word:
            raise ValueError("word is missing; expected the kind of number of each cell, or [[frame.block]]")
        if self.framing != "none" and (self.header or self.trailer):
            raise ValueError(f'framing = "{self.framing}" stands in place of header and trailer; expected none of them')
        if self.checksum == "none" and self.checksum_of != "payload":
            raise ValueError('checksum_of has no effect without a checksum; expected checksum = "..."')
        if self.checksum != "none" and self.framing == "none" and not self.header:
            raise ValueError("a checksum alone does not show where a frame begins; expected a header or framing")
        return self

    @property
    def has_number(self) -> bool:
        return bool(self.template(1).counters)

    @property
    def has_time(self) -> bool:
        return self.template(1).time is not None

    def template(self, cells: int) -> Template:
        """The layout of a frame; ``cells`` is their number where no block says it."""
        if self.block:
            return template([(block.parsed, block.repeat) for block in self.block])
        return usual(self, cells)

    @property
    def cell_word(self) -> Word:
        """The kind of number of the cells."""
        return self.template(1).word

    @property
    def cells_sent(self) -> int | None:
        """Cells in a frame; None: as many as the array has."""
        if not self.block:
            return None
        return self.template(0).cells

    def require(self, family: Family, layout: Layout) -> None:
        """Refuse counts that do not fit into the words. Raises InputError."""
        most = 16 if self.range is not None else min(self.cell_word.bits, 16)
        require(family, layout, [], range(1, most + 1))

    def write(self, numbers: Numbers, layout: Layout, *, sequence: int = 0, time_us: int = 0) -> bytes:
        """The bytes of a frame with these numbers; those that are not read are zeros."""
        frame = self.template(numbers.size).write(numbers, sequence=sequence, time_us=time_us)
        return frame if self.framing == "none" else FRAMINGS[self.framing].write(frame)


class _WordHost(HostProtocol):
    """What the hosts of all binary formats share."""

    def __init__(self, form: BinaryFrame, cells: Cells, start: StartTable, family: Family, layout: Layout) -> None:
        super().__init__(family, layout)
        self._form, self._cells, self._start = form.template(cells.count), cells, start
        self._size = self._form.size
        self._buffer = bytearray()
        self._count, self._clock = Unwrapped(), Unwrapped()
        """number of the frame and the board's time, which fields of few bytes begin again and again"""

        self._copies = Copies(form.copies)

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        return self._start.order(order)

    def feed(self, data: bytes, received_at: float) -> list[Event]:
        return self._copies.without(self.events(data, received_at))

    @abstractmethod
    def events(self, data: bytes, received_at: float) -> list[Event]:
        """As :meth:`feed`, with copies of frames."""

    def _event(self, frame: bytes, numbers: Numbers, size: int) -> Event:
        """The event of a good frame of ``size`` bytes on the line."""
        sequence, time_us = self._count.of(self._form.sequence(frame)), self._clock.of(self._form.time_us(frame))
        return self._cells.event(numbers, size, sequence=sequence, time_us=time_us)


class DelimitedHost(_WordHost):
    """Host end of frames between bytes that stand nowhere else."""

    def __init__(self, form: BinaryFrame, cells: Cells, start: StartTable, family: Family, layout: Layout) -> None:
        super().__init__(form, cells, start, family, layout)
        self._framing = FRAMINGS[form.framing]

    def events(self, data: bytes, received_at: float) -> list[Event]:
        self._buffer += data
        *stretches, rest = bytes(self._buffer).split(bytes([self._framing.delimiter]))
        self._buffer[:] = rest
        events: list[Event] = [self._take(stretch) for stretch in stretches if stretch]
        if len(self._buffer) > max(2 * self._size, MOST_TEXT):
            events.append(Corrupt(len(self._buffer), f"no byte {self._framing.delimiter} within the longest frame"))
            self._buffer.clear()
        return events

    def _take(self, stretch: bytes) -> Event:
        try:
            frame = self._framing.decode(stretch, self._size)
        except ValueError as error:
            return Corrupt(len(stretch), str(error))
        if len(frame) != self._size:
            return Corrupt(len(stretch), f"{len(frame)} bytes in a packet; expected {self._size}")
        fault = self._form.fault(frame)
        if fault:
            return Corrupt(len(stretch), fault)
        return self._event(frame, self._form.numbers(frame), len(stretch) + 1)


class BinaryHost(_WordHost):
    """Host end of frames with a header, or with nothing but a length."""

    def __init__(self, form: BinaryFrame, cells: Cells, start: StartTable, family: Family, layout: Layout) -> None:
        super().__init__(form, cells, start, family, layout)
        self._in_step = False
        """the bytes at the head of the buffer follow a good frame"""
        self._last: Numbers | None = None
        """numbers of the last good frame"""
        marked = self._form.mark or self._form.end_mark
        self._pauses = None if marked or family.polled else Pauses(self._size)
        self._placed = False

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        if order is Order.ONE_FRAME and not self._form.mark:
            self._buffer.clear()  # the rest of an earlier reply; the next begins with its first word
        return super().request(order, period_us=period_us)

    def events(self, data: bytes, received_at: float) -> list[Event]:
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
                return self._skip(max(len(self._buffer) - len(self._form.mark) + 1, 1), reason)
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
            mark, shift = self._form.end_mark, self._size - len(self._form.end_mark)
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
        frame = bytes(self._buffer[: self._size])
        self._last = self._form.numbers(frame)
        self._in_step = True
        del self._buffer[: self._size]
        return self._event(frame, self._last, self._size)

    def _skip(self, size: int, reason: str, *, in_step: bool = False) -> Corrupt:
        self._in_step = in_step
        del self._buffer[:size]
        return Corrupt(size, reason)
