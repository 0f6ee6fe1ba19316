"""Columns that shorted cells on one row join: the currents of one column that reach another column's amplifier."""

from __future__ import annotations

from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ._amplified_board import AmplifiedBoard


def shared_currents(board: AmplifiedBoard, shorts: BoolArray, conductance: FloatArray) -> FloatArray:
    """S (N, M) that each reading may gain from other columns that shorts (N, M) join to its column, row by row.

    A current into one column divides between its own amplifier, the row's driver and the other column's amplifier, as
    between three resistors. If a third column is joined, less of the current arrives in each.
    """
    rows, columns, joined = _joined(shorts)
    gained = np.zeros_like(conductance)
    if not len(rows):
        return gained
    into, _, there = _wires(board, rows, columns)
    # In ohm squared, from a column (the second index) to another one (the third).
    across = there * into[:, :, None]
    both = into[:, :, None] * into[:, None, :]
    whole = across + both + there * into[:, None, :]
    share = np.divide(across, whole, out=np.zeros_like(whole), where=joined & (whole > 0))
    by_row = conductance[:, columns] @ share
    by_row[np.arange(len(rows)), rows] = 0.0  # in its own step the row is driven
    gained[:, columns] = by_row.sum(axis=0)
    return gained


def currents_between_sources(board: AmplifiedBoard, shorts: BoolArray) -> FloatArray:
    """S (M,) that each reading of a column may gain from the sources of other columns that shorts (N, M) join to it."""
    gained = np.zeros(shorts.shape[1])
    if not board.sources_differ:
        return gained
    rows, columns, joined = _joined(shorts)
    if not len(rows):
        return gained
    into, driver, _ = _wires(board, rows, columns)
    wire = into[:, :, None] + into[:, None, :] + np.abs(driver[:, :, None] - driver[:, None, :])
    source = board.source_per_volt[columns]
    apart = np.abs(np.subtract.outer(source, source))
    joined &= apart > 0
    current = np.divide(apart[None], wire, out=np.full(wire.shape, inf), where=wire > 0)
    gained[columns] = np.where(joined, current, 0.0).sum(axis=(0, 2))
    return gained


def _joined(shorts: BoolArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Find the columns that shorts (N, M) join.

    Returns:
        The rows with at least two shorts; the columns of these shorts; and (rows, columns, columns) where such a row
        joins a column to another one.

    """
    rows = np.flatnonzero(shorts.sum(axis=1) > 1)
    there = shorts[rows]
    columns = np.flatnonzero(there.any(axis=0))
    there = there[:, columns]
    joined: BoolArray = there[:, :, None] & there[:, None, :]
    joined[:, np.arange(len(columns)), np.arange(len(columns))] = False
    return rows, columns, joined


def _wires(board: AmplifiedBoard, rows: IntArray, columns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Wire resistances at the crosspoints of some rows and columns.

    Returns:
        Ohm (rows, columns) to the amplifiers; to the drivers; and (rows, columns, columns) of the row's wire that two
        columns share.

    """
    places = np.ix_(rows, columns)
    into, driver = board.to_amplifier[places], board.to_driver[places]
    return into, driver, np.minimum(driver[:, :, None], driver[:, None, :])
