"""BOARD.toml: a board whose frames are lines of text, JSON documents or binary words, described in a file.

``docs/boards.md`` explains every key. :meth:`BoardFile.family` makes the :class:`~ohmskin.wire.Family` that speaks the
format; its two protocol objects are in :mod:`._lines` and :mod:`._words`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from ..common.config import Finite, Section, load, parse
from ..errors import InputError
from ._cells import CellOrder, Cells
from ._checksums import CHECKSUMS
from ._lines import LineFormat, LineLayout, TextBoard, TextHost
from ._protocol import Family, Layout
from ._words import WORDS, BinaryBoard, BinaryHost, CobsHost, WordFormat

MOST_CELLS = 256 * 256
MOST_LINES = 1024
"""rows or columns"""
MOST_BITS = 16
"""of a count in the driver"""

Byte = Annotated[int, Field(ge=0, le=255)]
Sent = str | Annotated[tuple[Byte, ...], Field(strict=False)]
"""bytes to send, as text or as a list of numbers"""
Side = Annotated[int, Field(ge=1, le=MOST_LINES)]


class BoardTable(Section):
    """``[board]``: the array and its numbers."""

    name: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[\w .+-]+$")]
    rows: Side
    columns: Side
    bits: Annotated[int, Field(ge=1, le=MOST_BITS)] = 12
    """of the counts: the numbers sent, or what ``frame.range`` is divided into"""
    baudrate: Annotated[int, Field(ge=50, le=50_000_000)] = 115_200
    design: str | None = None
    """DESIGN.toml of the circuit, relative to this file; None: not known, frames have counts only"""
    cell: str | None = None
    """CELL.toml of the material, likewise"""


class _AnyFrame(Section):
    """Keys of every format."""

    order: CellOrder = "row-major"
    flip_rows: bool = False
    flip_columns: bool = False
    invert: bool = False
    """counts fall with pressure: they are turned over before anything else sees them"""
    range: Annotated[tuple[Finite, Finite], Field(strict=False)] | None = None
    """numbers that stand for count 0 and for the largest count; None: the numbers are the counts"""
    invalid: Literal["mark", "drop"] = "mark"
    """what a number that is missing, NaN or outside the range costs: the cell, or the frame"""


class _LinesFrame(_AnyFrame):
    """Keys of formats that send lines."""

    layout: LineLayout = "frame-per-line"
    end: Annotated[str, Field(max_length=200)] | None = None
    """unless frame-per-line: line, or beginning of the line, that ends a frame; "": an empty line; None: none does"""
    skip: Annotated[int, Field(ge=0, le=64)] = 0
    """numbers ahead of the cells in each line"""
    numbered_rows: bool = False
    """row-per-line: the first of the skipped numbers is the row's, from 0 or from 1"""
    newline: Annotated[str, Field(pattern=r"^[ \t,;]*\r?\n$")] = "\r\n"
    """end of a line as the emulator sends it; a host takes every usual one"""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.layout == "frame-per-line" and self.end is not None:
            raise ValueError('end has no effect on layout = "frame-per-line"; expected "row-per-line"')
        if self.layout != "row-per-line" and self.numbered_rows:
            raise ValueError(f'numbered_rows has no effect on layout = "{self.layout}"; expected "row-per-line"')
        if self.numbered_rows and not self.skip:
            raise ValueError("numbered_rows needs skip = 1 or more: the first skipped number is that of the row")
        return self


class TextFrame(_LinesFrame):
    """``[frame]`` with ``format = "text"``: numbers in lines."""

    format: Literal["text"]
    separator: Annotated[str, Field(min_length=1, max_length=8, pattern=r"^[^0-9A-Za-z+\-.\r\n]+$")] | None = None
    """between two numbers; None: any run of spaces, tabs, and , ; : |"""
    labels: bool = False
    """each number has its name ahead, as in ``A0:512``; the names are not read"""
    prefix: Annotated[str, Field(max_length=200)] = ""
    """text at the head of every line with numbers; other lines are skipped"""
    suffix: Annotated[str, Field(max_length=200)] = ""
    """text at the end of every line with numbers, likewise"""


class JsonFrame(_LinesFrame):
    """``[frame]`` with ``format = "json"``: a JSON document in each line."""

    format: Literal["json"]
    key: Annotated[str, Field(max_length=200)] = ""
    """of the list of numbers, keys of inner objects after dots; "": the document is the list"""


class BinaryFrame(_AnyFrame):
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


class StartTable(Section):
    """``[start]``: what the host does to get frames."""

    send: Sent = ""
    """bytes to send after opening"""
    poll: Sent = ""
    """bytes that ask for one frame"""
    dtr: bool | None = None
    """level of the control line DTR; None: the operating system's, which resets most boards"""
    rts: bool | None = None


class BoardFile(Section):
    """A whole file. ``BoardFile.load("board.toml")``."""

    board: BoardTable
    frame: Annotated[TextFrame | JsonFrame | BinaryFrame, Field(discriminator="format")]
    start: StartTable = StartTable()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        board, frame = self.board, self.frame
        if board.rows * board.columns > MOST_CELLS:
            raise ValueError(f"board: {board.rows} x {board.columns} cells; expected at most {MOST_CELLS}")
        if frame.range is not None and not frame.range[0] < frame.range[1]:
            raise ValueError(f"frame.range: expected the smaller number first (got {list(frame.range)})")
        word = frame.word if isinstance(frame, BinaryFrame) else "float64le"
        if frame.range is not None and not WORDS[word].holds(*frame.range, steps=2**board.bits - 1):
            raise ValueError(
                f"frame.range: a {word} cannot tell 2^{board.bits} numbers in {list(frame.range)} apart; "
                "expected fewer board.bits, or another range"
            )
        if isinstance(frame, BinaryFrame) and frame.range is None and board.bits > WORDS[frame.word].bits:
            raise ValueError(
                f"board.bits: a {frame.word} has {WORDS[frame.word].bits} bits for counts; expected no more, "
                f"or a frame.range (got {board.bits})"
            )
        return self

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file. Raises InputError that names the file and the key."""
        return load(path, cls)

    @classmethod
    def parse(cls, tables: Mapping[str, Any], source: str) -> Self:
        """Check tables from elsewhere, such as a recording; ``source`` names them in messages. Raises InputError."""
        return parse(tables, cls, source=source)

    def tables(self) -> dict[str, Any]:
        """The keys as plain values for JSON, without the names of other files."""
        tables: dict[str, Any] = self.model_dump(mode="json", exclude_defaults=True)
        for name in ("design", "cell"):
            tables["board"].pop(name, None)
        return tables

    def family(self, folder: Path | None = None, *, design: Mapping[str, Any] | None = None) -> Family:
        """The family of boards that speaks this format.

        Args:
            folder: in which the files of circuit and cell are; None: they are left out.
            design: tables of DESIGN.toml for the usual circuit, for families that ohmskin ships.

        """
        board, frame, start = self.board, self.frame, self.start
        host, device = _ends(frame, sent(start.send), sent(start.poll))
        files = {"design": board.design, "cell": board.cell} if folder is not None else {}
        return Family(
            name=board.name,
            summary=f"{board.rows} x {board.columns}, {board.bits} bits, {frame.format}",
            host=host,
            board=device,
            layout=Layout(board.rows, board.columns, board.bits),
            baud_rate=board.baudrate,
            has_sequence=False,
            has_device_time=False,
            has_description=False,
            polled=bool(start.poll),
            dtr=start.dtr,
            rts=start.rts,
            design=design,
            tables=self.tables(),
            files={name: folder / path for name, path in files.items() if path is not None and folder is not None},
        )


def sent(text: Sent) -> bytes:
    """The bytes of a key of ``[start]``."""
    return text.encode() if isinstance(text, str) else bytes(text)


def _ends(frame: TextFrame | JsonFrame | BinaryFrame, send: bytes, poll: bytes) -> tuple[Any, Any]:
    """Makers of the host's and the board's end."""
    cells = partial(
        Cells.of,
        order=frame.order,
        flip_rows=frame.flip_rows,
        flip_columns=frame.flip_columns,
        invert=frame.invert,
        span=frame.range,
        drops=frame.invalid == "drop",
    )
    if isinstance(frame, BinaryFrame):
        words = WordFormat(
            WORDS[frame.word],
            bytes(frame.header),
            frame.before,
            frame.after,
            CHECKSUMS.get(frame.checksum),
            frame.checksum_of,
            bytes(frame.trailer),
            cobs=frame.framing == "cobs",
            ranged=frame.range is not None,
        )
        host = CobsHost if words.cobs else BinaryHost
        return partial(host, words, cells, send, poll), partial(BinaryBoard, words, cells, send, poll)
    text = isinstance(frame, TextFrame)
    lines = LineFormat(
        layout=frame.layout,
        end=frame.end,
        skip=frame.skip,
        numbered_rows=frame.numbered_rows,
        newline=frame.newline,
        separator=frame.separator if isinstance(frame, TextFrame) else None,
        prefix=frame.prefix if isinstance(frame, TextFrame) else "",
        suffix=frame.suffix if isinstance(frame, TextFrame) else "",
        labels=isinstance(frame, TextFrame) and frame.labels,
        json_key=None if text else frame.key,  # type: ignore[union-attr]  # text is the check
    )
    return partial(TextHost, lines, cells, send, poll), partial(TextBoard, lines, cells, send, poll)


def load_family(path: str | Path) -> Family:
    """The family that a BOARD.toml describes. Raises InputError."""
    file = BoardFile.load(path)
    try:
        return file.family(Path(path).parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
