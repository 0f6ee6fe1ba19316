"""Columns that shorted cells on one row join: what of a column's currents reaches another column's amplifier."""

from __future__ import annotations

from math import inf

import numpy as np

from ...arrays import BoolArray, FloatArray, IntArray
from ._amplified_board import AmplifiedBoard


def shared_currents(board: AmplifiedBoard, shorts: BoolArray, conductance: FloatArray) -> FloatArray:
    """S (N, M) that each reading may gain from the columns that shorts (N, M) join its column to, row by row.

    A current into one column divides between its own amplifier, the row's driver and the other column's amplifier,
    as between three resistors. With a third column joined, less of it arrives in each.
    """
    gained_in_all = np.zeros_like(conductance)
    for row in _rows_that_join(shorts):
        joined = np.flatnonzero(shorts[row])
        into, driver = board.to_amplifier[row, joined], board.to_driver[row, joined]
        there = np.minimum.outer(driver, driver)  # ohm of the row's wire that both share
        across = there * into[:, None]  # from a column ...
        with np.errstate(divide="ignore", invalid="ignore"):  # ... to another one
            share = np.nan_to_num(across / (across + np.outer(into, into) + there * into), nan=0.0)
        np.fill_diagonal(share, 0.0)
        gained = conductance[:, joined] @ share
        gained[row] = 0.0  # in its own step, the row is driven
        gained_in_all[:, joined] += gained
    return gained_in_all


def currents_between_sources(board: AmplifiedBoard, shorts: BoolArray) -> FloatArray:
    """S (M,) that each reading of a column may gain from the sources of columns that shorts (N, M) join it to."""
    gained = np.zeros(shorts.shape[1])
    if not board.sources_differ:
        return gained
    for row in _rows_that_join(shorts):
        joined = np.flatnonzero(shorts[row])
        into, driver = board.to_amplifier[row, joined], board.to_driver[row, joined]
        wire = np.add.outer(into, into) + np.abs(np.subtract.outer(driver, driver))
        source = board.source_per_volt[joined]
        apart = np.abs(np.subtract.outer(source, source))
        current = np.divide(apart, wire, out=np.full(wire.shape, inf), where=wire > 0)
        gained[joined] += np.where(apart > 0, current, 0.0).sum(axis=1)
    return gained


def _rows_that_join(shorts: BoolArray) -> IntArray:
    """The rows with at least two shorts."""
    return np.flatnonzero(shorts.sum(axis=1) > 1)
