"""Many boards of one design, each with part values of its own: Monte Carlo and worst-case corners in one call.

:func:`.scan_batch` reads many frames through *one* board. Here every frame has a board of its own: a stack
(:mod:`._parts`), which the exact solver reads like a batch. A loop over :func:`.scan` is the reference of the tests,
and the way of boards whose lines end in networks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from math import inf
from typing import NamedTuple, Self

import numpy as np

from ..common.arrays import IN_CACHE, BoolArray, FloatArray, IntArray
from ..errors import InputError
from ._board import Board
from ._design import Design
from ._exact import read_exactly
from ._scan import scan
from ._tuning import MOST_BUILT

_OF_ROW, _OF_COLUMN = {"section": "array", "lines": "rows"}, {"section": "array", "lines": "columns"}
_OF_READOUT, _SHARED = {"section": "readout", "lines": "sensed"}, {"section": "readout", "lines": "board"}
"""the section of DESIGN.toml that a part is in, and the lines that have one each"""


@dataclass(frozen=True)
class Boards:
    """Part values of S boards: (S, N) per row, (S, M) per column, (S, 1) per board; S = 1 if all boards share them."""

    row_lead: FloatArray = field(metadata=_OF_ROW)
    """ohm"""
    row_segment: FloatArray = field(metadata=_OF_ROW)
    column_lead: FloatArray = field(metadata=_OF_COLUMN)
    column_segment: FloatArray = field(metadata=_OF_COLUMN)
    reference_resistance: FloatArray = field(metadata=_OF_READOUT)
    open_loop_gain: FloatArray = field(metadata=_OF_READOUT)
    offset_voltage: FloatArray = field(metadata=_OF_READOUT)
    """V"""
    bias_current: FloatArray = field(metadata=_OF_READOUT)
    """A"""
    voltage: FloatArray = field(metadata={"section": "drive", "lines": "board"})
    """V of the selected row against the reference"""
    reference_voltage: FloatArray = field(metadata=_SHARED)
    """V"""
    gain_bandwidth: FloatArray = field(metadata=_SHARED)
    """Hz"""
    column_capacitance: FloatArray = field(metadata=_SHARED)
    """F"""
    feedback_capacitance: FloatArray = field(metadata=_SHARED)
    """F"""
    ends: Mapping[str, FloatArray] = field(default_factory=dict)
    """(S, L) values of the parts of networks, by the names of :attr:`.Design.end_parts`"""

    @classmethod
    def names(cls) -> dict[str, str]:
        """The parts that every design has, with the section of DESIGN.toml that each is in."""
        return {each.name: each.metadata["section"] for each in fields(cls) if each.name != "ends"}

    @classmethod
    def of(cls, design: Design) -> Self:
        """One board with the nominal values of the design."""
        rows, columns = design.array.shape
        counts = {"rows": rows, "columns": columns, "sensed": design.board.shape[1], "board": 1}
        lines = {each.name: counts[each.metadata["lines"]] for each in fields(cls) if each.name != "ends"}
        values = {
            name: np.full((1, lines[name]), getattr(getattr(design, section), name), dtype=np.float64)
            for name, section in cls.names().items()
        }
        return cls(**values, ends={key: values[None] for key, values in design.end_parts.items()})

    @property
    def count(self) -> int:
        """S, or 1 if all boards are alike."""
        return max(map(len, (*(getattr(self, name) for name in self.names()), *self.ends.values())))

    def values(self, board: int) -> bytes:
        """All values of one board: equal if, and only if, two boards are alike."""
        parts = (*(getattr(self, name) for name in self.names()), *self.ends.values())
        return np.concatenate([part[0 if len(part) == 1 else board] for part in parts]).tobytes()

    def board(self, design: Design) -> Board:
        """The boards as a stack (:mod:`._parts`), of a design without networks at its lines."""
        count = self.count
        values = {name: getattr(self, name) for name in self.names()}
        return Board.of(design, values={name: np.repeat(v, count // len(v), axis=0) for name, v in values.items()})

    def part(self, some: IntArray | slice) -> Boards:
        """Some of the boards."""

        def of(values: FloatArray) -> FloatArray:
            return values if len(values) == 1 else values[some]

        ends = {key: of(values) for key, values in self.ends.items()}
        return Boards(**{name: of(getattr(self, name)) for name in self.names()}, ends=ends)

    def design(self, nominal: Design, board: int) -> Design:
        """The design of one board."""

        def pick(name: str) -> float | tuple[float, ...]:
            values = getattr(self, name)
            line = values[0 if len(values) == 1 else board]
            return float(line[0]) if (line == line[0]).all() else tuple(line.tolist())

        changed: dict[str, dict[str, float | tuple[float, ...]]] = {}
        for name, section in self.names().items():
            changed.setdefault(section, {})[name] = pick(name)
        built = nominal.replace(**changed)
        ends = {key: values[0 if len(values) == 1 else board] for key, values in self.ends.items()}
        return built.with_end_parts(ends) if ends else built


class PopulationReading(NamedTuple):
    """Outputs of S boards."""

    volts: FloatArray
    """(S, N, M) V"""
    saturated: BoolArray
    """(S, N, M) outputs at a supply limit"""


def scan_population(
    design: Design,
    boards: Boards,
    cells: FloatArray,
    *,
    driven: IntArray | None = None,
    resolve_saturation: bool = True,
) -> PopulationReading:
    """Read one frame of cells through each board.

    Args:
        design: circuit, supply and faults, which all boards share.
        boards: the part values of S boards, or of one.
        cells: (S, N, M) ohm, or (1, N, M) for all boards.
        driven: (S,) the one line (row, or column where columns are driven) whose readings are wanted of each board; the
            volts of all others are NaN. None: all lines.
        resolve_saturation: find which outputs are at their limits, and what the others then are. If False volts are
            limited to the supply, and the other outputs of such a frame are those of amplifiers without limits.

    Raises:
        InputError: shapes that do not fit.

    """
    rows, columns = design.array.shape
    if cells.ndim != 3 or cells.shape[1:] != (rows, columns):
        raise InputError(f"cell resistances have shape {cells.shape}, expected (boards, {rows}, {columns})")
    count = max(boards.count, len(cells))
    if len(cells) not in (1, count) or boards.count not in (1, count):
        raise InputError(f"{boards.count} boards and {len(cells)} frames of cells; expected equally many, or one")
    volts = np.empty((count, rows, columns))
    saturated = np.zeros(volts.shape, dtype=np.bool_)
    board = design.board
    wanted = np.ones(volts.shape, dtype=np.bool_)
    if driven is not None:
        wanted = np.indices((rows, columns))[int(board.transposed)] == np.reshape(driven, (-1, 1, 1))
    if not read_together(design):
        built: dict[bytes, Design] = {}
        for number in range(count):
            alike = boards.values(number)
            if alike not in built:  # what follows from a board's parts alone is worked out once
                built = built if len(built) < MOST_BUILT else {}
                built[alike] = boards.design(design, number)
            result = scan(built[alike], cells[0 if len(cells) == 1 else number], method="exact")
            volts[number], saturated[number] = result.volts, result.saturated
        return PopulationReading(np.where(wanted, volts, np.nan), saturated & wanted)
    lines = board.transpose(np.broadcast_to(cells, volts.shape))
    for some, line in _groups(count, max(1, IN_CACHE // 8 // (rows * columns)), driven if board.floating else None):
        stack = boards.part(some).board(design)
        if line is not None:
            stack = replace(stack, steps=np.array([board.driven_line(line)]))
        if not resolve_saturation:
            stack = replace(stack, supply=(-inf, inf))
        outputs, _ = read_exactly(stack, lines[some])
        volts[some] = board.transpose(board.circuit.in_the_limit(stack, lines[some], outputs.volts))
        saturated[some] = board.transpose(outputs.saturated)
    if not resolve_saturation:
        low, high = board.supply
        saturated = (volts < low) | (volts > high)
        np.clip(volts, low, high, out=volts)
    return PopulationReading(np.where(wanted, volts, np.nan), saturated & wanted)


def read_together(design: Design) -> bool:
    """Whether boards of this kind make a stack; if not, each board takes a scan, tens of times longer."""
    return not design.is_described


def _groups(count: int, size: int, lines: IntArray | None) -> Iterator[tuple[IntArray, int | None]]:
    """Numbers of boards that are read together, at most so many, and their one driven line where each has one."""
    for line in [None] if lines is None else np.unique(lines).tolist():
        numbers = np.arange(count) if line is None else np.flatnonzero(np.broadcast_to(lines == line, count))
        for first in range(0, len(numbers), size):
            yield numbers[first : first + size], line
