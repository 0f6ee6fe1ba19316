"""Compiled loops for the steps on coupled boards, for :mod:`ohmskin.common.compiled`.

The loops compute the same as :class:`._linearised.Base` and :class:`._column_blocks.Step` do by array operations. Their
sums may have another order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import FixedFlags, FixedRow, FixedRows, Row, loop
from ._column_blocks import Step

OWN, BY_SUM, DRIVEN, SECOND, FREE, THROUGH_LEAD, SHARE, PARTS = range(8)
"""positions of a step's matrices in the argument of :func:`change_by_columns`, and their number"""


class ColumnSteps(NamedTuple):
    """Steps column by column, with what bounds them."""

    parts: FloatArray
    """(PARTS N, M) the matrices of a :class:`._column_blocks.Step`, one below the other"""
    mixed: FloatArray
    """(3, M)"""
    noise: float
    """V, standard deviation of a reading"""
    linear: BoolArray
    """(n,) cells that count linearly"""
    stride: float
    """most change of a logarithm"""
    linear_stride: float
    """most change upwards of a cell that counts linearly"""

    @classmethod
    def of(cls, step: Step, linear: BoolArray, stride: float, linear_stride: float) -> ColumnSteps:
        """Of a step in closed form."""
        parts = step.own, step.by_sum, step.driven, step.second_vector, step.free, step.through_lead, step.share
        whole = np.concatenate([np.broadcast_to(part, step.driven.shape) for part in parts])
        return cls(whole, np.array(step.mixed), step.noise, linear, stride, linear_stride)

    def change(self, volts: FloatArray, steeper: FloatArray) -> FloatArray:
        """As :meth:`._linearised.Base.change`."""
        change = np.empty(volts.size)
        change_by_columns.code(volts, steeper, *self, change)
        return change


@loop
def change_by_columns(
    volts: FixedRow,
    steeper: FixedRow,
    parts: FixedRows,
    mixed: FixedRows,
    noise: float,
    linear: FixedFlags,
    stride: float,
    linear_stride: float,
    change: Row,
) -> None:
    """The regularised step for readings ``volts`` (n,) beside the model, into ``change`` (n,)."""
    rows, columns = parts.shape[0] // PARTS, parts.shape[1]
    summed, first, second = np.zeros(columns), np.zeros(columns), np.zeros(columns)
    for i in range(rows):
        for j in range(columns):
            k = i * columns + j
            change[k] = volts[k] * steeper[k] / noise
            summed[j] += parts[BY_SUM * rows + i, j] * change[k]
    for i in range(rows):
        for j in range(columns):
            k = i * columns + j
            driven = parts[DRIVEN * rows + i, j]
            normal = parts[OWN * rows + i, j] * change[k] + driven * summed[j]
            change[k] = parts[FREE * rows + i, j] * normal
            first[j] += driven * change[k]
            second[j] += parts[SECOND * rows + i, j] * change[k]
    for i in range(rows):
        along = 0.0
        for j in range(columns):
            k = i * columns + j
            shared = parts[DRIVEN * rows + i, j] * (mixed[0, j] * first[j] + mixed[1, j] * second[j])
            shared += parts[SECOND * rows + i, j] * (mixed[1, j] * first[j] + mixed[2, j] * second[j])
            change[k] -= parts[FREE * rows + i, j] * shared
            along += parts[THROUGH_LEAD * rows + i, j] * change[k]
        for j in range(columns):
            k = i * columns + j
            found = change[k] + parts[SHARE * rows + i, j] * along
            most = linear_stride if linear[k] else stride
            if found < -stride:
                found = -stride
            elif found > most:
                found = most
            change[k] = found


@loop
def moved(log: FixedRow, floor: FixedRow, told: FixedRow, std: FixedRow, by_noise: float) -> tuple[float, float]:
    """As :meth:`._linearised.Base.moved`; ``by_noise`` times the standard deviation is a change by noise."""
    counted = largest = total = 0.0
    for i in range(log.size):
        change = abs(max(log[i], floor[i]) - told[i])
        total += change
        largest = max(largest, change)
        counted = max(counted, change / max(by_noise * std[i], 1.0))
    if math.isnan(total):
        return math.nan, math.nan
    return counted, largest


@loop
def steeper_each(slope: FixedRow, base: FixedRow, most: float, steeper: Row) -> None:
    """As :meth:`._linearised.Base.steeper`, up to a factor of ``most``."""
    for i in range(slope.size):
        ratio = 1.0
        if base[i] > 0.0 and slope[i] > 0.0:
            ratio = slope[i] / base[i]
        steeper[i] = max(min(ratio, most), 1.0 / most)


ALL = change_by_columns, moved, steeper_each
