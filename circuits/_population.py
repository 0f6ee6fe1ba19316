"""Many boards of one design, each with part values of its own: Monte Carlo and worst-case corners in one call.

:func:`.scan_batch` reads many frames through *one* board. Here every sample has its own lines, amplifiers and cells, so
that no factorisation can be shared. The solution is a block elimination along the columns (block Gauss, Golub and Van
Loan, Matrix Computations, 4.5), vectorised over the boards:

1. Each row line is a ladder of wires and cells. Its two continued fractions give the Schur complement ``Y`` (M, M) of
   the row on the M column nodes, and the Norton currents ``s`` (M,) that 1 V on the driver sends into them.
2. The column nodes of the rows follow each other through the column segments ``R``. With ``A`` the admittance of all
   rows above, ``A <- Y + (1 + A R)^-1 A`` and ``s <- (1 + A R)^-1 s``. Wires appear as resistances, so that a wire of
   0 ohm needs no special case.
3. What the columns end in is attached at the last row.

The cost is N solves of M x M equations per board: 16 x 16 takes about 0.2 ms of one core. With floating rows each
driven line takes as many; the readings of one line alone (``driven``) cost no more than those of grounded rows. A board
that drives columns is read in line coordinates (:mod:`._parts`). A loop over :func:`.scan` is the reference of the
tests, and the fallback for the designs that the elimination does not cover.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import NamedTuple, Self

import numpy as np

from ..common.arrays import IN_CACHE, BoolArray, FloatArray, IntArray
from ..errors import InputError
from ._design import Design
from ._scan import scan
from ._sections import PerLine
from .readouts import EndParts, Ends, Terminated

MOST_BUILT = 64
"""boards that are kept while others are read one by one"""
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
        values = {
            each.name: _each(
                getattr(getattr(design, each.metadata["section"]), each.name), counts[each.metadata["lines"]]
            )
            for each in fields(cls)
            if each.name != "ends"
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

    @property
    def at_ends(self) -> EndParts:
        """What is at the columns' ends, of boards in line coordinates."""
        slack = 1.0 / self.open_loop_gain
        return EndParts(
            self.reference_resistance, slack, self.offset_voltage, self.bias_current, self.reference_voltage
        )

    def read_ends(self, design: Design) -> Ends:
        """The same as Thevenin equivalents, of columns that are read."""
        circuit = design.board.circuit
        assert isinstance(circuit, Terminated)
        return circuit.ends_of(design.board, self.at_ends)

    def part(self, some: slice) -> Boards:
        """Some of the boards."""

        def of(values: FloatArray) -> FloatArray:
            return values if len(values) == 1 else values[some]

        ends = {key: of(values) for key, values in self.ends.items()}
        return Boards(**{name: of(getattr(self, name)) for name in self.names()}, ends=ends)

    @property
    def transposed(self) -> Boards:
        """The same boards in line coordinates, of a circuit that drives columns."""
        other = {"row_lead": "column_lead", "row_segment": "column_segment"}
        other |= {theirs: ours for ours, theirs in other.items()}
        return Boards(**{name: getattr(self, other.get(name, name))[:, ::-1] for name in self.names()})

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
        resolve_saturation: solve boards with a saturated output exactly, one by one. If False their volts are limited
            to the supply, and the other outputs of such a frame are those of amplifiers without limits.

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
        lines = np.indices((rows, columns))[1 if board.transposed else 0]
        wanted = lines == np.reshape(driven, (-1, 1, 1))
    if read_together(design):
        low, high = design.readout.supply
        ours = boards.transposed if board.transposed else boards
        places = None if driven is None else board.shape[0] - 1 - driven if board.transposed else driven
        for some in _chunks(count, max(1, IN_CACHE // 8 // board.shape[1] ** 2)):
            line = None if places is None else places[some]
            frames = board.transpose(cells if len(cells) == 1 else cells[some])
            with np.errstate(all="ignore"):  # boards with a NaN are solved again below
                volts[some] = board.transpose(_read(design, ours.part(some), frames, line))
        if board.circuit.has_amplifiers:
            saturated = (volts < low) | (volts > high)
        again = (wanted & ~np.isfinite(volts)).any(axis=(1, 2))
        if resolve_saturation:
            again |= saturated.any(axis=(1, 2))
        else:
            np.clip(volts, low, high, out=volts)
    else:
        again = np.ones(count, dtype=np.bool_)
    built: dict[bytes, Design] = {}
    for number in np.flatnonzero(again).tolist():
        alike = boards.values(number)
        if alike not in built:  # what follows from a board's parts alone is worked out once
            built = built if len(built) < MOST_BUILT else {}
            built[alike] = boards.design(design, number)
        result = scan(built[alike], cells[0 if len(cells) == 1 else number], method="exact")
        volts[number] = np.where(wanted[number], result.volts, np.nan)
        saturated[number] = wanted[number] & result.saturated
    return PopulationReading(volts, saturated)


def read_together(design: Design) -> bool:
    """Whether the elimination covers this kind of design; if not, each board takes a scan, tens of times longer."""
    board = design.board
    special = board.virtual_grounds != board.circuit.virtual_ground and board.idle_columns == "load"
    return not special and board.circuit.in_populations and design.array.sheet == "sliced" and not design.fault


def _chunks(count: int, size: int) -> Iterator[slice]:
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))


class Rows(NamedTuple):
    """The row lines of S boards, seen from the column nodes."""

    admittance: FloatArray
    """(S, N, M, M) S"""
    current: FloatArray
    """(S, N, M) S: short-circuit current for 1 V on the driver; 0 for idle rows"""


class _Columns(NamedTuple):
    """The grid seen from the ends of the columns, for one selected row or for all of them."""

    admittance: FloatArray
    """(S, M, M) S, all drivers at 0 V"""
    current: FloatArray
    """(S, M, R) S: short-circuit currents for 1 V on each of R drivers"""


def _read(design: Design, boards: Boards, cells: FloatArray, driven: IntArray | None) -> FloatArray:
    """Output volts (S, N, M) without supply limits, in line coordinates; NaN for lines that are not wanted."""
    conductance = 1.0 / cells
    count = max(boards.count, len(cells))
    conductance = np.broadcast_to(conductance, (count, *cells.shape[1:]))
    grounded, floating = row_ladders(design, boards, conductance)
    volts = np.full(conductance.shape, np.nan)
    if driven is not None:
        each = np.arange(count)
        one = _only_driven(grounded, floating, np.broadcast_to(driven, count))
        seen = _down_the_columns(one, boards.column_segment, together=True)
        volts[each, driven] = _outputs(design, boards, seen)[..., 0]
    elif design.board.floating:
        for row, seen in enumerate(_one_driven(grounded, floating, boards.column_segment)):
            volts[:, row] = _outputs(design, boards, seen)[..., 0]
    else:
        seen = _down_the_columns(grounded, boards.column_segment)
        volts[:] = _outputs(design, boards, seen).swapaxes(1, 2)
    return volts


def column_ends(design: Design, boards: Boards, cells: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """The grids (conductances (S, G, M, M) in S, with G = N where idle rows float and else 1) and the Norton currents
    (S, N, M) in A of the drivers as the ends of the columns see them, behind the column leads.

    Args:
        design: which parts there are.
        boards: in line coordinates.
        cells: (S, N, M) ohm, in line coordinates.

    Returns:
        None for designs that the elimination does not cover; not finite where parts of 0 ohm join.
    """
    if design.array.sheet != "sliced" or design.fault:
        return None
    lead = boards.column_lead
    with np.errstate(all="ignore"):
        grounded, floating = row_ladders(design, boards, 1.0 / cells)
        if design.board.floating:
            steps = list(_one_driven(grounded, floating, boards.column_segment))
        else:
            steps = [_down_the_columns(grounded, boards.column_segment)]
        found = []
        for seen in steps:
            both = np.concatenate([seen.admittance, seen.current], axis=-1)
            found.append(through_segment(seen.admittance, lead, both) if lead.any() else both)
    columns = cells.shape[-1]
    conductance = np.stack([both[..., :columns] for both in found], axis=1)
    current = np.concatenate([both[..., columns:] for both in found], axis=-1).swapaxes(1, 2)
    return conductance, boards.voltage[..., None] * current


def row_ladders(design: Design, boards: Boards, conductance: FloatArray) -> tuple[Rows, Rows]:
    """The row lines (S, N, ...) of selected rows, and of idle ones."""
    board = design.board
    passed = 1.0 / (1.0 + boards.row_lead / board.pull)  # by the divider of lead and pull-down; 1 without
    grounded = _row_ladders(conductance, boards.row_lead * passed, boards.row_segment)
    grounded = grounded._replace(current=grounded.current * passed[..., None])
    idle_lead = np.full_like(boards.row_lead, board.pull)
    return grounded, _row_ladders(conductance, idle_lead, boards.row_segment) if board.floating else grounded


def _row_ladders(conductance: FloatArray, lead: FloatArray, segment: FloatArray) -> Rows:
    """Schur complements of the row lines on the column nodes.

    The line is a ladder. At place j its admittance is ``y_j`` away from the driver and ``w_j`` towards the driver.
    Place j receives the fraction ``t_j`` of the voltage at place j - 1. The line's impedance matrix is then
    ``Z_jk = prod(t_j+1 ... t_k) / (w_j + y_j)`` for k >= j.
    """
    count, rows, columns = conductance.shape
    places = np.moveaxis(conductance, -1, 0)
    beyond = np.empty((columns, count, rows))
    passed = np.ones((columns, count, rows))
    back = np.empty((columns, count, rows))
    beyond[-1] = places[-1]
    for place in range(columns - 2, -1, -1):
        passed[place + 1] = 1.0 / (1.0 + segment * beyond[place + 1])
        beyond[place] = places[place] + beyond[place + 1] * passed[place + 1]
    back[0] = 1.0 / lead
    for place in range(1, columns):
        back[place] = 1.0 / (segment + 1.0 / (back[place - 1] + places[place - 1]))
    reach = np.cumprod(passed, axis=0)
    total = beyond + back
    own = np.where(total > 0, 1.0 / total, 0.0)
    near = np.moveaxis(places * own / reach, 0, -1)
    far = np.moveaxis(places * reach, 0, -1)
    admittance = near[..., :, None] * far[..., None, :]
    upper = np.triu_indices(columns, 1)
    admittance[..., upper[1], upper[0]] = admittance[..., upper[0], upper[1]]
    np.negative(admittance, out=admittance)
    diagonal = np.arange(columns)
    admittance[..., diagonal, diagonal] += conductance
    driven = 1.0 / (1.0 + lead * beyond[0])
    return Rows(admittance, far * np.where(np.isinf(lead), 0.0, driven)[..., None])


def _only_driven(driven: Rows, floating: Rows, line: IntArray) -> Rows:
    """One row (S,) of each board at its driver, and all others idle."""
    chosen = np.arange(driven.current.shape[1]) == line[:, None]
    admittance = driven.admittance
    if floating is not driven:
        admittance = np.where(chosen[..., None, None], driven.admittance, floating.admittance)
    return Rows(admittance, np.where(chosen[..., None], driven.current, 0.0))


def _down_the_columns(rows: Rows, segment: FloatArray, *, together: bool = False) -> _Columns:
    """Eliminate the column nodes from the first row to the last.

    The currents of the drivers are those of 1 V on each of them in turn, or with ``together`` on all of them at once.
    """
    count, size, columns = rows.current.shape
    if not segment.any():
        current = rows.current.sum(axis=1)[..., None] if together else rows.current.swapaxes(1, 2)
        return _Columns(rows.admittance.sum(axis=1), current)
    both = np.zeros((count, columns, columns + (1 if together else size)))
    admittance, current = both[..., :columns], both[..., columns:]
    for row in range(size):
        if row:
            known = columns + (1 if together else row)
            both[..., :known] = through_segment(admittance, segment, both[..., :known])
        admittance += rows.admittance[:, row]
        current[..., 0 if together else row] += rows.current[:, row]
    return _Columns(admittance, current)


def _one_driven(driven: Rows, floating: Rows, segment: FloatArray) -> Iterator[_Columns]:
    """Each row driven in turn while the others float."""
    size = driven.current.shape[1]
    above = np.zeros_like(driven.admittance[:, 0])
    for row in range(size):
        admittance = above + driven.admittance[:, row]
        current = driven.current[:, row, :, None]
        for below in range(row + 1, size):
            both = np.concatenate([admittance, current], axis=-1)
            if segment.any():
                both = through_segment(admittance, segment, both)
            admittance = both[..., :-1] + floating.admittance[:, below]
            current = both[..., -1:]
        yield _Columns(admittance, current)
        above = above + floating.admittance[:, row]
        if segment.any():
            above = through_segment(above, segment, above)


def through_segment(admittance: FloatArray, segment: FloatArray, values: FloatArray) -> FloatArray:
    """``(1 + A R)^-1 values``: admittances or currents beyond one segment of each column."""
    passing = admittance * segment[:, None, :]
    diagonal = np.arange(admittance.shape[-1])
    passing[..., diagonal, diagonal] += 1.0
    return _solve(passing, values)


def _outputs(design: Design, boards: Boards, seen: _Columns) -> FloatArray:
    """Output volts (S, M, R) of the circuit at the columns' ends."""
    lead, drive = boards.column_lead[..., None], boards.voltage[..., None]
    board = design.board
    if board.circuit.drives_idle_lines:
        return _followed(boards, seen)
    resistance, source, output, slope = (part[..., None] for part in boards.read_ends(design))
    if board.idle_columns == "load" or board.virtual_grounds:
        return output + slope * _end_currents(seen, lead + resistance, drive, source)
    alone = _one_by_one(boards, seen, board.idle_columns)
    current = (drive * alone.current - source * alone.admittance) / (1.0 + resistance * alone.admittance)
    volts: FloatArray = output + slope * current
    return volts


def _one_by_one(boards: Boards, seen: _Columns, idle: str) -> _Columns:
    """Each column's end, alone: its admittance (S, M, 1), and its short-circuit currents (S, M, R).

    The other columns end at the reference behind their leads (``idle`` "ground"), or are open ("float").
    """
    lead = boards.column_lead[..., None]
    if idle == "float":
        columns = seen.admittance.shape[-1]
        inner = _solve(seen.admittance, np.broadcast_to(np.eye(columns), seen.admittance.shape))
        behind = np.einsum("...jj->...j", inner)[..., None] + lead
        return _Columns(1.0 / behind, inner @ seen.current / behind)
    from_rows, all_lines = seen.current, seen.admittance
    if lead.any():
        columns = from_rows.shape[1]
        ended = through_segment(all_lines, boards.column_lead, np.concatenate([all_lines, from_rows], axis=-1))
        all_lines, from_rows = ended[..., :columns], ended[..., columns:]
    return _Columns(np.einsum("...jj->...j", all_lines)[..., None], from_rows)


def _followed(boards: Boards, seen: _Columns) -> FloatArray:
    """Output volts (S, M, R) of followers that drive all idle lines: :class:`.readouts.VoltageFeedback`."""
    reference, slack, offset, bias, level = (part[..., None] for part in boards.at_ends)
    drive, share = boards.voltage[..., None], 1.0 / (1.0 + slack)
    inverse = slack * share
    ended = _one_by_one(boards, seen, "ground")
    from_row, idle = ended.current, ended.admittance - ended.current
    current = from_row * drive - bias + idle * (share * offset - inverse * level)
    column = current / (from_row + idle * inverse + 1.0 / reference)
    volts: FloatArray = share * (level + column + offset)
    return volts


def _end_currents(seen: _Columns, resistance: FloatArray, drive: FloatArray, source: FloatArray) -> FloatArray:
    """A (S, M, R) into the columns' ends: ``resistance`` in series with ``source``, both (S or 1, M, 1)."""
    count, columns, _ = seen.current.shape
    applied = drive * seen.current - seen.admittance @ np.broadcast_to(source, (count, columns, 1))
    if not resistance.any():
        return applied
    ended = seen.admittance * resistance.swapaxes(-1, -2)
    diagonal = np.arange(columns)
    ended[..., diagonal, diagonal] += 1.0
    return _solve(ended, applied)


def _solve(matrix: FloatArray, values: FloatArray) -> FloatArray:
    """As numpy's; NaN for all boards of a chunk with a singular matrix, which are then read one by one."""
    try:
        return np.asarray(np.linalg.solve(matrix, values), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full(np.broadcast_shapes(matrix.shape[:-1], values.shape[:-1]) + values.shape[-1:], np.nan)


def _each(value: PerLine, count: int) -> FloatArray:
    return np.full((1, count), value, dtype=np.float64)
