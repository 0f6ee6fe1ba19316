"""Ambiguous rows behind a follower of finite gain: shorts in one row that give the readings of ordinary cells.

The follower of :mod:`._voltage_feedback` holds idle lines at the potential of the sensed column. Through cells of a few
ohm the follower also shifts the potential of a row behind the row's lead. The balance of currents can then have a
second solution, in which all cells of the row conduct many times better than their readings say. This module searches
for second solutions.

A second solution is plausible only if most other cells remain ordinary. The best conductors of the row join their
columns. The follower then divides all other readings of such a column by F = 1 + C Rref / (1 + A), where C is the
conductance from the column to others by way of the row. The follower's offset moves these readings by
(1 + A) Vos (F - 1) / F.

Shorts that join several rows have a coarser test of their own (:func:`_rows_together`).
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from .._parts import LEAST_SHORT_OHM, Parts

_CAPPED = 2.0  # times a short's conductance: largest conductance of a cell in the search, as readings are rounded
_FAR_ABOVE = 3.0  # times the median conductance; cells above are not ordinary
_WELL_ABOVE = 10.0  # times the conductance of Rref; cells above are not ordinary
_ROUGHLY = 0.7  # fraction of an offset's effect that a reading shows for certain
_UNNOTICED = 0.1  # fraction of a reading's error; smaller shifts by other cells are neglected
_LEAST_DROP = 1e-6  # fraction of the drive: least voltage between a driver and the column
_LEAST_LEFT = 0.01  # fraction of the drive that remains behind a row's lead, at least
_LEAST_PULLED = 0.1  # fraction of a cell's drop that the follower causes in a second solution, at least
_HARDLY_ANY = 2.0  # times the largest signal that counts as zero: what shorts may leave of an ordinary cell's signal
_LIFTED = 4.0  # times a follower's offset: largest reading of ordinary cells beside shorts
_NEAR = 0.02  # of the drive: largest excess of joined columns' readings over the effect of offsets, if that is larger
_LEAST_NONE = 0.1  # fraction of a board's readings that shorts in several rows reduce to nothing, at least
_HALVINGS = 6  # bisections of the interval that contains a second solution
_ROUNDS = 8  # rounds of leaving out columns in which a second solution is impossible
_MOST_MORE = 1e6  # largest factor by which all cells of a row conduct better than their readings say
_GROWTH = np.concatenate([[1.0], np.geomspace(1.5, _MOST_MORE, 24)])


def imitated(
    board: Parts,
    lead: FloatArray,
    signal: FloatArray,
    least: float,
    apparent: Callable[[], FloatArray],
    may_look: Callable[[], bool],
) -> BoolArray | None:
    """(N, M) cells whose readings shorts could give as well, and cells whose readings such shorts would shift.

    None if there are none.

    Args:
        board: parts of the readout.
        lead: (N,) ohm between each row's driver and its cells.
        signal: (N, M) V above the reference.
        least: V; smaller signals count as zero.
        apparent: (N, M) S of each cell, if it were alone, by the signals.
        may_look: as of :meth:`.ReadoutCircuit.imitated_by_shorts`.

    """
    lift = board.follower_lift
    if not _pulls_anywhere(board, float(lead.max()), signal, lift, least) or not may_look():
        return None
    rows = PulledRows.of(board, lead, signal, lift, least, apparent())
    if _rows_together(rows, board, signal, lift, least):
        return np.ones(signal.shape, dtype=np.bool_)  # cells that read nothing still load the rows
    return _imitated_in_rows(rows, board, signal, lift, least, may_look)


def _imitated_in_rows(
    rows: PulledRows,
    board: Parts,
    signal: FloatArray,
    lift: FloatArray,
    least: float,
    may_look: Callable[[], bool],
) -> BoolArray | None:
    """:func:`imitated` for shorts in a single row at a time; the readings of all other rows are taken as they are."""
    ordinary = np.maximum(_WELL_ABOVE / rows.reference, rows.apparent)
    for again in range(_ROUNDS):
        if again and not may_look():
            return None
        found = rows.second_solutions()
        if found is None:
            return None
        through = found.most
        suspect = rows.suspect(board, signal, lift, least, found)
        if not suspect.any():
            return None
        # Leave out the columns in which a second solution would make other cells extraordinary. Without these columns
        # there may be no second solution.
        extraordinary = (through > 0.0) & ~suspect & (rows.most > ordinary)
        if not extraordinary.any():
            break
        rows = rows._replace(
            most=np.where(extraordinary, ordinary, rows.most),
            largest=np.where(through.any(axis=1), rows.largest, 0.0),
        )
    # Cells of other rows in these columns then conduct more, or less, than their readings say, and load their rows
    # accordingly.
    joined = np.where(suspect, through - rows.ordinary_through, 0.0).max(axis=0, initial=0.0) * board.reference
    divided = 1.0 + joined * board.inverse_gain
    shift = joined / divided * np.abs(rows.column * board.inverse_gain - lift * np.sign(board.drive))
    unloaded = rows.lead * (rows.apparent * np.maximum(divided - 1.0, joined > 0.0)).sum(axis=1)
    unnoticed = _UNNOTICED * least
    loaded = unloaded[:, None] * np.abs(signal) > unnoticed
    disturbed: BoolArray = (shift > unnoticed) | loaded | suspect.any(axis=1, keepdims=True)
    return disturbed


class _Joined(NamedTuple):
    """Bounds in S (N, M) on C, from each column to others by way of a row with a second solution; 0 in other rows."""

    least: FloatArray
    most: FloatArray


class PulledRows(NamedTuple):
    """Rows whose potential the follower shifts through cells of a few ohm.

    Idle columns stand at the follower's output. This output is below the potential V of the sensed column by the
    fraction e = 1 / (1 + A) - Vos A / (1 + A) / V of V. Let r be the row's lead, G the sum of the row's conductances g,
    z = r G, and a = drive / V - 1. The balance of currents at the row's crosspoints is then

        a = (1 + z) / (Rref g) + (z - r g) e.

    Each z determines all g of the row, which must add up to z / r. Ordinary cells give one such z. A *second solution*
    is another z that satisfies this condition.
    """

    lead: FloatArray
    """(N,) ohm, r"""
    apparent: FloatArray
    """(N, M) S of each cell, if it were alone"""
    column: FloatArray
    """(N, M) V of the sensed column's end, positive towards the drive"""
    drop: FloatArray
    """(N, M) lower bound on a"""
    drop_most: FloatArray
    """(N, M) upper bound on a"""
    pulled: FloatArray
    """(N, M) upper bound on e"""
    pulled_least: FloatArray
    """(N, M) lower bound on e"""
    first: FloatArray
    """(N,) 1 + z of ordinary cells"""
    largest: FloatArray
    """(N,) largest 1 + z for which most other cells are still ordinary"""
    reference: FloatArray
    """(M,) ohm, Rref"""
    most: FloatArray
    """(N, M) S: largest conductance of a cell in series with its column's lead"""

    @classmethod
    def of(
        cls,
        board: Parts,
        lead: FloatArray,
        signal: FloatArray,
        lift: FloatArray,
        least: float,
        apparent: FloatArray,
    ) -> PulledRows:
        """Bounds for the rows of one frame of readings.

        Args:
            board: parts of the readout.
            lead: (N,) ohm between each row's driver and its cells.
            signal: (N, M) V above the reference.
            lift: (M,) V of the follower's output above its column, with the column at the reference.
            least: V; smaller signals count as zero.
            apparent: (N, M) S of each cell, if it were alone.

        """
        drive = abs(board.drive)
        column = _column_potential(board, signal)
        surely = np.maximum(column - least, 0.0)
        column = np.maximum(column, least)
        lifted = lift * np.sign(board.drive)
        lowest = np.maximum(surely, _LEAST_DROP * drive)
        above, below = lifted / (column + least), lifted / lowest
        most = np.broadcast_to(_CAPPED / (board.column_lead + LEAST_SHORT_OHM), signal.shape[1:])
        largest = np.full(len(signal), inf)
        if len(signal) > 1:
            # Upper bound on C for each column: if C were larger, the true conductance of the other rows' cells in this
            # column would exceed _WELL_ABOVE / Rref.
            with np.errstate(divide="ignore", invalid="ignore"):
                usual = np.maximum(_usual(surely) - np.abs(lift) / board.inverse_gain, 0.0)
                joined = _WELL_ABOVE * (drive / usual - 1.0) / board.reference / board.inverse_gain
                # The column of the row's best conductor is joined to the others at most as well as these to the row.
                largest = 1.0 + lead * (joined.sum() + most.max())
        first = 1.0 / np.maximum(1.0 - lead * apparent.sum(axis=1), _LEAST_LEFT)
        return cls(
            lead=lead,
            apparent=apparent,
            column=column,
            drop=np.maximum(drive / (column + least) - 1.0, _LEAST_DROP),
            drop_most=np.maximum(drive / lowest - 1.0, _LEAST_DROP),
            pulled=board.inverse_gain - np.minimum(above, below),
            pulled_least=board.inverse_gain - np.maximum(above, below),
            first=first,
            largest=np.minimum(np.fmin(largest, 1.0 + lead * most.sum()), _MOST_MORE),
            reference=np.broadcast_to(board.reference, signal.shape[1:]),
            most=np.broadcast_to(most, signal.shape),
        )

    def second_solutions(self) -> _Joined | None:
        """Conductances by which rows with a second solution join columns; None if no row has one."""
        # A follower that causes far less than this fraction of a cell's drop changes hardly anything.
        share = np.maximum(2.0 / self.first - 1.0, _LEAST_PULLED)
        rows = np.flatnonzero(((self.pulled / self.drop).max(axis=1) * self.largest > share) & (self.lead > 0.0))
        if not rows.size:
            return None
        more = np.minimum(self.first[rows] * _GROWTH[:, None], np.maximum(self.largest, self.first * _GROWTH[0])[rows])
        second = self._second(rows, more)
        second[0] = False  # ordinary cells
        doubtful = np.flatnonzero(second.any(axis=0))
        if not doubtful.size:
            return None
        rows, more, second = rows[doubtful], more[:, doubtful], second[:, doubtful]
        each, end = np.arange(len(rows)), len(more) - 1
        above = second.argmax(axis=0)
        lowest, highest = more[above - 1, each], more[above, each]
        for _ in range(_HALVINGS):
            middle = np.sqrt(lowest * highest)
            exceeds = self._second(rows, middle)
            lowest, highest = np.where(exceeds, lowest, middle), np.where(exceeds, middle, highest)
        last = more[np.minimum(end + 1 - second[::-1].argmax(axis=0), end), each]
        least = self._cells(rows, lowest, self.drop_most[rows], self.pulled_least[rows])
        most = self._cells(rows, last, self.drop[rows], self.pulled[rows])
        joined = []
        for cells in (least, most):
            through = np.zeros(self.drop.shape)
            through[rows] = self._through(cells, self.lead[rows, None])
            joined.append(through)
        return _Joined(*joined)

    @property
    def ordinary_through(self) -> FloatArray:
        """S (N, M) from each column to the others by way of a row, if all cells are ordinary."""
        return self._through(self.apparent * self.first[:, None], self.lead[:, None])

    @staticmethod
    def _through(cells: FloatArray, lead: FloatArray) -> FloatArray:
        """S (R, M) from each column to the others by way of a row of cells (R, M) in S, with leads (R, 1) in ohm."""
        with np.errstate(divide="ignore"):
            beside = cells.sum(axis=-1, keepdims=True) - cells + 1.0 / lead
        through: FloatArray = cells / (1.0 + cells / beside)
        return through

    def _second(self, rows: IntArray, more: FloatArray) -> BoolArray:
        """Whether the cells of rows (R,) can add up to z / r or more, for 1 + z = ``more`` (..., R)."""
        total: FloatArray = self._cells(rows, more, self.drop[rows], self.pulled[rows]).sum(axis=-1)
        second: BoolArray = total * self.lead[rows] >= more - 1.0
        return second

    def _cells(self, rows: IntArray, more: FloatArray, drop: FloatArray, pulled: FloatArray) -> FloatArray:
        """Conductances g in S (..., R, M) of the cells of rows, by the balance of currents.

        Args:
            rows: (R,) numbers of the rows.
            more: (..., R) 1 + z.
            drop: (R, M) a.
            pulled: (R, M) e.

        """
        falling = drop - (more - 1.0)[..., None] * pulled
        current = more[..., None] / self.reference
        root = np.sqrt(np.maximum(falling**2 + 4.0 * current * self.lead[rows, None] * pulled, 0.0))
        with np.errstate(divide="ignore"):
            cells: FloatArray = np.minimum(2.0 * current / np.maximum(falling + root, 0.0), self.most[rows])
        return cells

    def suspect(self, board: Parts, signal: FloatArray, lift: FloatArray, least: float, through: _Joined) -> BoolArray:
        """(N, M) cells that join columns, if the cells in the other rows of these columns would still be ordinary.

        Args:
            board: parts of the readout.
            signal: (N, M) V above the reference.
            lift: (M,) V of the follower's output above its column, with the column at the reference.
            least: V; smaller signals count as zero.
            through: conductances by which each row joins columns.

        """
        if len(signal) == 1:
            return through.most > 0.0
        rows = np.flatnonzero(through.most.any(axis=1))
        column = np.maximum(self.column - least, 0.0)
        # Current balance of each cell's column, which the other columns drive through the row. The cell's conductance
        # is linear in ``joined``, so that its least value belongs to one of the two bounds. Readings that may be zero
        # count as open cells.
        others = np.full((len(rows), *signal.shape), inf)
        for joined in (each[rows][:, None] for each in through):  # one row at a time
            taken = column * (1.0 / self.reference + joined * board.inverse_gain)
            given = joined * lift * np.sign(board.drive)
            cells = np.maximum(taken - given, 0.0) / np.maximum(abs(board.drive) - column, _LEAST_DROP)
            cells[_ROUGHLY * given > self.column * (1.0 / self.reference + joined * board.inverse_gain)] = inf
            np.minimum(others, cells, out=others)
        others[:, np.abs(signal) <= least] = 0.0
        usual = np.zeros(signal.shape)
        usual[rows] = _usual(others.transpose(1, 0, 2))
        suspect = _of_pairs((through.most > 0.0) & (usual <= _WELL_ABOVE / self.reference))
        elsewhere = self.apparent[~suspect.any(axis=1)][:, ~suspect.any(axis=0)]
        elsewhere = elsewhere[elsewhere > 0.0]
        if elsewhere.size:
            suspect = _of_pairs(suspect & (usual <= _FAR_ABOVE * np.median(elsewhere)))
        return suspect


def _pulls_anywhere(board: Parts, lead: float, signal: FloatArray, lift: FloatArray, least: float) -> bool:
    """Whether :meth:`PulledRows.second_solutions` can find a row at all, by upper bounds that cost a fraction.

    Args:
        board: parts of the readout.
        lead: ohm, largest resistance between a row's driver and its cells.
        signal: (N, M) V above the reference.
        lift: (M,) V of the follower's output above its column, with the column at the reference.
        least: V; smaller signals count as zero.

    """
    drive = abs(board.drive)
    column = _column_potential(board, signal)
    most = np.maximum(column, least) + least
    pulled = board.inverse_gain
    if lift.any():
        pulled = pulled + np.abs(lift) / np.minimum(np.maximum(column - least, _LEAST_DROP * drive), most)
    drop = np.maximum(drive / most - 1.0, _LEAST_DROP)
    return bool((pulled / drop).max() * _most_more(board, lead, signal.shape[1]) > _LEAST_PULLED)


def _column_potential(board: Parts, signal: FloatArray) -> FloatArray:
    """V (N, M) of the sensed columns' ends, positive towards the drive, for signals (N, M) in V above the reference."""
    above = (signal + board.level) / board.loop_share - board.level - board.offset
    towards_drive: FloatArray = above * np.sign(board.drive)
    return towards_drive


def _most_more(board: Parts, lead: FloatArray | float, columns: int) -> FloatArray | float:
    """1 + z (see :class:`PulledRows`) of rows behind ``lead`` in ohm if all cells are shorts; at most _MOST_MORE."""
    shorts = _CAPPED * columns / (float(np.min(board.column_lead)) + LEAST_SHORT_OHM)
    return np.minimum(1.0 + lead * shorts, _MOST_MORE)


def _rows_together(rows: PulledRows, board: Parts, signal: FloatArray, lift: FloatArray, least: float) -> bool:
    """Whether shorts may join several rows of a board.

    Shorts in one row join columns. The followers then divide the readings of the other rows, those of shorts included.
    No row can therefore be judged by the readings of other rows. But the leads of rows with shorts, and the followers,
    also divide the readings of ordinary cells beside the shorts, down to the effect of the followers' offsets. A board
    is therefore suspect if both conditions hold:

    * At least the fraction ``_LEAST_NONE`` of the readings shows nothing but the effect of offsets.
    * In some column, two or more rows have readings as large as followers may leave of a short.

    Args:
        rows: the rows.
        board: parts of the readout.
        signal: (N, M) V above the reference.
        lift: (M,) V of the follower's output above its column, with the column at the reference.
        least: V; smaller signals count as zero.

    """
    none = np.abs(signal) <= _HARDLY_ANY * least + _LIFTED * np.abs(lift)
    no_more = none
    if lift.any():
        # A column that shorts join to others reads ``alone``, the multiple of the follower's offset at which no current
        # flows, or a little more. The shorts in this column read the same. Such readings show nothing but the offset,
        # and may nevertheless be those of shorts (``heavy``).
        with np.errstate(divide="ignore", invalid="ignore"):
            alone = board.loop_share * (board.level + lift / board.inverse_gain + board.offset) - board.level
        near = np.where(np.abs(alone) > _NEAR * abs(board.drive), _NEAR * abs(board.drive), 0.0)
        no_more = none | (np.abs(signal - alone) <= _HARDLY_ANY * least + near)
    if np.count_nonzero(no_more) < _LEAST_NONE * none.size:
        return False
    more = np.asarray(_most_more(board, rows.lead, signal.shape[1]))[:, None]
    heavy = ~none & (rows.pulled / rows.drop * more > _LEAST_PULLED) & (rows.lead > 0.0)[:, None]
    return bool((np.count_nonzero(heavy, axis=0) > 1).any())


def _usual(cells: FloatArray) -> FloatArray:
    """Lower median of all but the largest value of each column, along the first axis."""
    usual: FloatArray = np.sort(cells, axis=0)[max(len(cells) - 2, 0) // 2]
    return usual


def _of_pairs(chosen: BoolArray) -> BoolArray:
    """The chosen cells (N, M) that have another chosen cell in their row."""
    pairs: BoolArray = chosen & (np.count_nonzero(chosen, axis=1, keepdims=True) > 1)
    return pairs
