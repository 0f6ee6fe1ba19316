"""BOARD.toml: a board whose frames are lines of text, JSON documents or binary words, described in a file.

``docs/boards.md`` explains every key. :meth:`BoardFile.family` makes the :class:`~ohmskin.wire.Family` that speaks the
format; its two protocol objects are in :mod:`._lines` and :mod:`._words`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from ..common.config import MOST_CELLS, LocalFile, Section, load, parse
from ..errors import InputError
from ._blocks import WORDS
from ._framing import DescribedBoard, StartTable
from ._lines import JsonFrame, TextFrame, TextHost
from ._protocol import Family, HostProtocol, Layout
from ._words import BinaryFrame, BinaryHost, DelimitedHost

MOST_LINES = 1024
"""rows or columns"""
MOST_BITS = 16
"""of a count in the driver"""

Side = Annotated[int, Field(ge=1, le=MOST_LINES)]


class BoardTable(Section):
    """``[board]``: the array and its numbers."""

    name: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[\w .+-]+$")]
    rows: Side
    columns: Side
    bits: Annotated[int, Field(ge=1, le=MOST_BITS)] = 12
    """of the counts: the numbers sent, or what ``frame.range`` is divided into"""
    baudrate: Annotated[int, Field(ge=50, le=50_000_000)] = 115_200
    design: LocalFile | None = None
    """DESIGN.toml of the circuit, relative to this file; None: not known, frames have counts only"""
    cell: LocalFile | None = None
    """CELL.toml of the material, likewise"""


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
        cells = board.rows * board.columns
        if frame.map is not None:
            reordered = frame.order != "row-major" or frame.flip_rows or frame.flip_columns
            if reordered or sorted(frame.map) != list(range(cells)):
                raise ValueError(f"frame.map: expected each place from 0 to {cells - 1} once, and no order or flips")
        sent = frame.cells_sent if isinstance(frame, BinaryFrame) else None
        if sent is not None and sent != cells:
            raise ValueError(f"frame.block: {sent} cells in a frame; expected {cells}, {board.rows} x {board.columns}")
        word = frame.cell_word if isinstance(frame, BinaryFrame) else WORDS["float64le"]
        if frame.range is not None and not word.holds(*frame.range, steps=2**board.bits - 1):
            raise ValueError(
                f"frame.range: a {word.name} cannot tell 2^{board.bits} numbers in {list(frame.range)} apart; "
                "expected fewer board.bits, or another range"
            )
        if isinstance(frame, BinaryFrame) and frame.range is None and board.bits > word.bits:
            raise ValueError(
                f"board.bits: a {word.name} has {word.bits} bits for counts; expected no more, "
                f"or a frame.range (got {board.bits})"
            )
        return self

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file. Raises InputError that names the file and the key."""
        return load(path, cls)

    @classmethod
    def parse(cls, tables: Mapping[str, Any], source: str) -> Self:
        """Check tables of a recording or a program; ``source`` names them in messages. Raises InputError."""
        return parse(tables, cls, source=source)

    def tables(self) -> dict[str, Any]:
        """The keys as plain values for JSON, without the names of other files."""
        tables: dict[str, Any] = self.model_dump(mode="json", exclude_defaults=True)
        for name in ("design", "cell"):
            tables["board"].pop(name, None)
        return tables

    def family(self, *, design: Mapping[str, Any] | None = None) -> Family:
        """The family of boards that speaks this format.

        Args:
            design: tables of DESIGN.toml for the usual circuit, for families that ohmskin ships.

        """
        board, frame, start = self.board, self.frame, self.start
        files = {"design": board.design, "cell": board.cell}
        return Family(
            name=board.name,
            summary=f"{board.rows} x {board.columns}, {board.bits} bits, {frame.format}",
            host=self._host,
            board=self._device,
            layout=Layout(board.rows, board.columns, board.bits),
            baud_rate=board.baudrate,
            has_sequence=frame.has_number,
            has_device_time=frame.has_time,
            has_description=False,
            polled=bool(start.poll),
            repeat_start_s=start.every,
            dtr=start.dtr,
            rts=start.rts,
            design=design,
            tables=self.tables(),
            files={name: path for name, path in files.items() if path is not None},
        )

    def _host(self, family: Family, layout: Layout) -> HostProtocol:
        frame = self.frame
        if isinstance(frame, BinaryFrame):
            frame.require(family, layout)
            make = BinaryHost if frame.framing == "none" else DelimitedHost
            return make(frame, frame.cells(layout), self.start, family, layout)
        return TextHost(frame, frame.cells(layout), self.start, family, layout)

    def _device(self, family: Family, layout: Layout) -> DescribedBoard:
        if isinstance(self.frame, BinaryFrame):
            self.frame.require(family, layout)
        return DescribedBoard(self.frame.write, self.frame.cells(layout), self.start, family, layout)


def load_family(path: str | Path) -> Family:
    """The family that a BOARD.toml describes. Raises InputError."""
    file = BoardFile.load(path)
    try:
        return file.family()
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
