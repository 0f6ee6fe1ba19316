"""The layout of a binary frame: fields in the order sent, in blocks that repeat.

``[frame]`` of BOARD.toml names a usual frame by single keys (header, before, word, after, checksum, trailer) or lists
its fields in ``[[frame.block]]``. Both become a :class:`Template`, which tells frames from other bytes and takes their
numbers.

==========================  ==========================================================================================
``const 0xAA 0x55``         these bytes
``index WORD [FIRST]``      number of the block within the frame, from FIRST (0) on: it places the block's cells
``start WORD``              number of the block's first cell within the frame, likewise
``cells WORD [COUNT]``      so many cells (1)
``number WORD``             number of the frame; where blocks repeat, of the block
``time_ms``, ``time_us``    the board's time, with a WORD
``skip COUNT``              bytes that are not read
``sum8``, ``crc16``, ...    a checksum (:mod:`._checksums`) of what stands ahead of it in its block: all, without the
                            leading constants, or the cells alone, whichever agrees. ``sum16`` and ``crc16`` are any of
                            their variants, in either byte order
==========================  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from ..common.config import Section
from ._cells import Numbers
from ._checksums import CHECKSUMS, Checksum

MOST_FRAME = 2**20
"""bytes of a frame"""
MOST_BLOCKS, MOST_FIELDS = 16, 32


@dataclass(frozen=True)
class Word:
    """A kind of number on the line."""

    name: str
    dtype: np.dtype[np.generic]
    bits: int
    """for counts; a float has those of its mantissa, less those that text of 15 digits lacks"""

    def holds(self, low: float, high: float, *, steps: int) -> bool:
        """Whether the word can hold so many even steps from ``low`` to ``high``."""
        step = (high - low) / steps
        if self.dtype.kind == "f":
            kind = np.finfo(self.dtype)  # type: ignore[type-var]  # its kind is f
            most, least, largest = float(kind.max), float(kind.smallest_normal), max(abs(low), abs(high))
            return largest <= most and step > max(2.0 ** (2 - self.bits) * largest, least)
        limits = np.iinfo(self.dtype)  # type: ignore[type-var]  # its kind is not f
        most = 2**self.bits - 1 if self.packed else limits.max
        return bool(limits.min <= low and high <= most and step >= 1.0)

    packed: bool = False
    """two numbers of 12 bits in three bytes"""

    def size_of(self, count: int) -> int:
        """Bytes of so many numbers; those of packed ones are rounded up."""
        return -(-3 * count // 2) if self.packed else count * self.dtype.itemsize

    def count_in(self, size: int) -> int | None:
        """Numbers in so many bytes; None: they do not end with a number."""
        count = 2 * size // 3 if self.packed else size // self.dtype.itemsize
        return count if self.size_of(count) == size else None

    def decode(self, data: bytes | NDArray[np.uint8], count: int) -> Numbers:
        """The numbers of some bytes."""
        given = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else np.ascontiguousarray(data)
        if not self.packed:
            return given.view(self.dtype).astype(np.float64)
        three = np.zeros((-(-given.shape[-1] // 3) * 3,), np.uint8)
        three[: given.shape[-1]] = given
        first, middle, last = three.reshape(-1, 3).T.astype(np.int64)
        if self.dtype.str[0] == ">":
            pairs = first << 4 | middle >> 4, (middle & 15) << 8 | last
        else:
            pairs = first | (middle & 15) << 8, middle >> 4 | last << 4
        numbers: Numbers = np.stack(pairs, axis=1).ravel()[:count].astype(np.float64)
        return numbers

    def encode(self, numbers: Numbers) -> bytes:
        """The bytes of some numbers."""
        rounded = numbers if self.dtype.kind == "f" else np.rint(numbers)
        if not self.packed:
            return rounded.astype(self.dtype).tobytes()
        pairs = np.zeros(-(-rounded.size // 2) * 2, dtype=np.int64)
        pairs[: rounded.size] = rounded.astype(np.int64) & 0xFFF
        one, two = pairs[::2], pairs[1::2]
        if self.dtype.str[0] == ">":
            three = one >> 4, (one & 15) << 4 | two >> 8, two & 255
        else:
            three = one & 255, one >> 8 | (two & 15) << 4, two >> 4
        return np.stack(three, axis=1).astype(np.uint8).tobytes()[: self.size_of(numbers.size)]

    def read(self, data: bytes) -> int | float:
        """The number of some bytes."""
        value: int | float = np.frombuffer(data, dtype=self.dtype)[0].item()
        return value

    def bytes_of(self, value: float) -> bytes:
        """The bytes of a number, whole numbers wrapped."""
        if self.dtype.kind == "f":
            return np.array(value, dtype=self.dtype).tobytes()
        whole = int(value) % 2 ** (8 * self.dtype.itemsize)
        return np.array(whole, dtype=self.dtype.str.replace("i", "u")).tobytes()


WORDS = {
    name: Word(name, np.dtype(code), bits, "12" in name)
    for name, code, bits in (
        ("uint8", "u1", 8),
        ("int8", "i1", 7),
        ("uint12le", "<u2", 12),
        ("uint12be", ">u2", 12),
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
"""by name; a uint12 is half of three bytes"""
_NUMBERED = ("index", "start", "number", "time_ms", "time_us")
_FAMILIES = {"sum16": ("sum16",), "crc16": ("crc16-modbus", "crc16-ccitt", "crc16-xmodem"), "crc32": ("crc32",)}


@dataclass(frozen=True)
class FieldText:
    """One field as BOARD.toml writes it."""

    kind: str
    """const, index, start, cells, number, time_ms, time_us, skip or check"""
    word: str = ""
    count: int = 1
    """cells, or bytes that are skipped; of an index the first one"""
    data: bytes = b""
    checks: tuple[Checksum, ...] = ()

    @property
    def size(self) -> int:
        """Bytes of the field."""
        match self.kind:
            case "const":
                return len(self.data)
            case "skip":
                return self.count
            case "check":
                return self.checks[0].size
            case "cells":
                return WORDS[self.word].size_of(self.count)
        return WORDS[self.word].dtype.itemsize

    @classmethod
    def parse(cls, text: str) -> FieldText:
        """A field from its words. Raises ValueError that says what was expected."""
        kind, *words = text.split()
        if kind == "const" and words:
            return cls("const", data=bytes(_whole(word, 255, text) for word in words))
        if kind == "skip" and len(words) == 1:
            return cls("skip", count=_whole(words[0], MOST_FRAME, text))
        if kind in _NUMBERED and words and words[0] in WORDS and WORDS[words[0]].packed:
            raise ValueError(f"'{text}': a {words[0]} is a word of cells only")
        if kind in ("cells", *_NUMBERED) and words and words[0] in WORDS and len(words) <= 2:
            if len(words) == 2 and kind not in ("cells", "index"):
                raise ValueError(f"'{text}': a field '{kind}' has a word only")
            count = _whole(words[1], MOST_FRAME, text) if len(words) == 2 else 1 if kind == "cells" else 0
            return cls(kind, words[0], count)
        names = _FAMILIES.get(kind, (kind,))
        checks = [
            CHECKSUMS[own]
            for name in names
            for own in (name, f"{name}le", f"{name}-be", f"{name}be")
            if own in CHECKSUMS
        ]
        if checks and not words:
            return cls("check", checks=tuple(checks))
        raise ValueError(
            f"'{text}' is no field; expected const BYTE ..., cells WORD [COUNT], index WORD, start WORD, number WORD, "
            f"time_ms WORD, time_us WORD, skip COUNT, or a checksum such as sum8 or crc16; words are {', '.join(WORDS)}"
        )


def _whole(word: str, most: int, text: str) -> int:
    try:
        value = int(word, 0)
    except ValueError:
        value = -1
    if not 0 <= value <= most:
        raise ValueError(f"'{text}': '{word}' is no whole number from 0 to {most}")
    return value


class Block(Section):
    """``[[frame.block]]``: fields in the order sent, and how many times they come."""

    fields: Annotated[
        tuple[Annotated[str, Field(min_length=1, max_length=400)], ...],
        Field(strict=False, min_length=1, max_length=MOST_FIELDS),
    ]
    repeat: Annotated[int, Field(ge=1, le=65536)] = 1

    @field_validator("fields")
    @classmethod
    def _known(cls, fields: tuple[str, ...]) -> tuple[str, ...]:
        for text in fields:
            FieldText.parse(text)
        return fields

    @property
    def parsed(self) -> list[FieldText]:
        """The fields."""
        return [FieldText.parse(text) for text in self.fields]


@dataclass(frozen=True)
class _Check:
    at: int
    size: int
    ways: tuple[tuple[Checksum, int, int], ...]
    """kind, and first and last byte that it is of"""


@dataclass(frozen=True)
class _Numbered:
    at: int
    word: Word
    first: float
    """of an index, the value at this place; else 0"""


@dataclass
class Template:
    """A frame of fixed length: what stands where."""

    mark: bytes = b""
    """bytes with which it begins, as far as they are the same in each"""
    end_mark: bytes = b""
    size: int = 0
    word: Word = WORDS["uint8"]
    """of the cells"""
    consts: list[tuple[int, bytes]] = field(default_factory=list)
    checks: list[_Check] = field(default_factory=list)
    places: list[_Numbered] = field(default_factory=list)
    """indices and starts of blocks"""
    in_cells: bool = False
    """whether these count cells"""
    offsets: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """place of each byte of the cells"""
    cells: int = 0
    per_block: int = 0
    """cells of a block that has an index"""
    counters: list[_Numbered] = field(default_factory=list)
    """number of the frame; where it repeats, of each block"""
    time: tuple[_Numbered, int] | None = None
    """and us of its unit"""

    @property
    def proves(self) -> bool:
        """Whether a checksum can hardly be right by chance: one of one byte agrees with one stretch in 256."""
        return any(check.size > 1 for check in self.checks)

    def fault(self, frame: bytes) -> str:
        """Why bytes of the right length, with the mark at their head, are no frame; empty if they are one."""
        if not frame.endswith(self.end_mark):
            return f"no {self.end_mark.hex(' ').upper()} at the end of a frame"
        for at, data in self.consts:
            if frame[at : at + len(data)] != data:
                return f"no {data.hex(' ').upper()} at byte {at} of a frame"
        if self.places and self._order(frame) is None:
            return "blocks that are not those of one frame"
        for check in self.checks:
            said = frame[check.at : check.at + check.size]
            if not any(kind.of(frame[begin:end]) == said for kind, begin, end in check.ways):
                return "the checksum does not match"
        return ""

    def numbers(self, frame: bytes) -> Numbers:
        """The numbers of the cells in a frame, in the order of their places."""
        data = np.frombuffer(frame, dtype=np.uint8)[self.offsets]
        numbers = self.word.decode(data, self.cells)
        order = self._order(frame) if self.places else None
        if order is None or order == list(range(len(order))):
            return numbers
        placed = np.empty_like(numbers)
        placed.reshape(len(order), -1)[order] = numbers.reshape(len(order), -1)
        return placed

    def _order(self, frame: bytes) -> list[int] | None:
        """Place of each block; None: they are not a permutation."""
        step = self.per_block if self.in_cells else 1
        found = []
        for one in self.places:
            value = one.word.read(frame[one.at : one.at + one.word.dtype.itemsize]) - one.first
            if value % step:
                return None
            found.append(int(value // step))
        return found if sorted(found) == list(range(len(found))) else None

    def sequence(self, frame: bytes) -> tuple[int, int] | None:
        """Number of the frame, and after how many it begins again; None: it has none."""
        if not self.counters:
            return None
        first, blocks = self.counters[0], len(self.counters)
        size = first.word.dtype.itemsize
        value = int(first.word.read(frame[first.at : first.at + size]))
        return value // blocks, max(2 ** (8 * size) // blocks, 1)

    def time_us(self, frame: bytes) -> tuple[int, int] | None:
        """The board's time in us, and after how long it begins again; None: it has none."""
        if self.time is None:
            return None
        one, unit_us = self.time
        size = one.word.dtype.itemsize
        return int(one.word.read(frame[one.at : one.at + size])) * unit_us, 2 ** (8 * size) * unit_us

    def write(self, numbers: Numbers, *, sequence: int = 0, time_us: int = 0) -> bytes:
        """The bytes of a frame with these numbers; those that are not read are zeros."""
        frame = bytearray(self.size)
        for at, data in [(0, self.mark), *self.consts, (self.size - len(self.end_mark), self.end_mark)]:
            frame[at : at + len(data)] = data
        np.frombuffer(frame, dtype=np.uint8)[self.offsets] = np.frombuffer(self.word.encode(numbers), np.uint8)
        for k, one in enumerate(self.places):
            data = one.word.bytes_of(one.first + k * (self.per_block if self.in_cells else 1))
            frame[one.at : one.at + len(data)] = data
        for k, one in enumerate(self.counters):
            data = one.word.bytes_of(sequence * len(self.counters) + k)
            frame[one.at : one.at + len(data)] = data
        if self.time is not None:
            data = self.time[0].word.bytes_of(time_us // self.time[1])
            frame[self.time[0].at : self.time[0].at + len(data)] = data
        for check in self.checks:
            kind, begin, end = check.ways[0]
            frame[check.at : check.at + check.size] = kind.of(bytes(frame[begin:end]))
        return bytes(frame)


def template(blocks: Sequence[tuple[Sequence[FieldText], int]]) -> Template:
    """The layout of a frame of these blocks, each given by its fields and how many times it comes.

    Raises:
        ValueError: no cells, cells of different words, or too long.

    """
    made, at = Template(), 0
    spans: list[tuple[int, int]] = []
    cells = [(one.count, repeat) for fields, repeat in blocks for one in fields if one.kind == "cells"]
    words: dict[str, None] = {}
    for fields, repeat in blocks:
        size = sum(one.size for one in fields)
        if at + size * repeat > MOST_FRAME:
            raise ValueError(f"a frame of more than {MOST_FRAME} bytes")
        for _ in range(repeat):
            _add(made, fields, at, spans, words)
            at += size
    if not spans:
        raise ValueError("no field has cells; expected cells WORD [COUNT]")
    if len(words) > 1:
        raise ValueError(f"cells are {' and '.join(words)}; expected one word for all")
    made.size, made.word = at, WORDS[next(iter(words))]
    made.cells = sum(count * repeat for count, repeat in cells)
    if made.word.packed and len(spans) > 1 and any(count % 2 for count, _ in cells):
        raise ValueError(f"an odd number of cells {made.word.name} in a block; expected pairs, which share three bytes")
    made.offsets = np.concatenate([np.arange(begin, end) for begin, end in spans]).astype(np.intp)
    if made.places:
        made.per_block = made.cells // len(made.places)
    _find_marks(made)
    return made


def _add(
    made: Template, fields: Sequence[FieldText], start: int, spans: list[tuple[int, int]], words: dict[str, None]
) -> None:
    """Add one block at a place."""
    at, leading, cells = start, start, (start, start)
    for one in fields:
        end = at + one.size
        word = WORDS.get(one.word, WORDS["uint8"])
        match one.kind:
            case "const":
                made.consts.append((at, one.data))
                leading = end if at == leading else leading
            case "cells":
                spans.append((at, end))
                words[one.word] = None
                cells = (cells[0] if cells[1] > cells[0] else at, end)
            case "index" | "start":
                made.in_cells = one.kind == "start"
                made.places.append(_Numbered(at, word, float(one.count)))
            case "number":
                made.counters.append(_Numbered(at, word, 0.0))
            case "time_ms" | "time_us" if made.time is None:
                made.time = _Numbered(at, word, 0.0), 1000 if one.kind == "time_ms" else 1
            case "check":
                covers = dict.fromkeys([(start, at), (leading, at), cells])
                made.checks.append(_Check(at, one.size, tuple((kind, *span) for span in covers for kind in one.checks)))
        at = end


def _find_marks(made: Template) -> None:
    """Leading constants with the first block's index, and trailing constants, out of the list of constants."""
    known: dict[int, bytes] = dict(made.consts)
    if made.places:
        first = made.places[0]
        known[first.at] = first.word.bytes_of(first.first)
    while (data := known.pop(len(made.mark), None)) is not None:
        made.mark += data
    for at, data in reversed(made.consts):
        if at + len(data) == made.size - len(made.end_mark) and at >= len(made.mark):
            made.end_mark = data + made.end_mark
    made.consts = [
        (at, data)
        for at, data in made.consts
        if len(made.mark) <= at and at + len(data) <= made.size - len(made.end_mark)
    ]


def usual(frame: Any, cells: int) -> Template:
    """The layout that the single keys of ``[frame]`` describe, for so many cells."""
    fields = [
        FieldText("const", data=bytes(frame.header)),
        FieldText("skip", count=frame.before),
        FieldText("cells", frame.word, cells),
        FieldText("skip", count=frame.after),
    ]
    made = template([([one for one in fields if one.size], 1)])
    size = made.size
    if frame.checksum != "none":
        kind = CHECKSUMS[frame.checksum]
        begin = {"frame": 0, "body": len(frame.header), "payload": len(frame.header) + frame.before}[frame.checksum_of]
        made.checks = [
            _Check(size, kind.size, ((kind, begin, size - (frame.after if frame.checksum_of == "payload" else 0)),))
        ]
        size += kind.size
    made.mark, made.end_mark, made.consts = bytes(frame.header), bytes(frame.trailer), []
    made.size = size + len(made.end_mark)
    return made
