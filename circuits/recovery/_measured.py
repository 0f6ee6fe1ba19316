"""A recovered frame as a :class:`Measurement`: conductances in siemens, and what of their errors is whose."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import FloatArray
from ...common.compiled import Blocks, Reasons, Record, Records, Rows, loop, zeros
from ...common.measurement import (
    COLUMN_HALF_STEP,
    COLUMN_STD,
    CONDUCTANCE,
    GREATEST,
    HALF_STEP,
    LEAST,
    NOISE_VARIANCE,
    UNCERTAINTY,
    Measurement,
)
from ...common.noise import constant_part
from ._live_reading import UNCERTAIN, LiveReading

MOST_NOISE = 0.95
"""relative uncertainty of a noisy reading that an average can use"""
MOST_STEPS = 0.1
"""relative uncertainty by ADC steps, likewise; averaging does not reduce it"""


class Constants(Record):
    """Of one board."""

    step: float
    """V, of the converter"""
    half: float
    """V, largest error of a reading by the converter"""
    random: float
    """V, the part that differs from reading to reading"""
    shared: float
    """V, the part that all readings share"""
    alike: float
    """by how much rounding of equal readings exceeds independent errors in the sum of a column"""
    accuracy: float
    """uncertainty up to which a cell is valid"""
    averages: float
    """1 where noisy readings serve for estimation, valid or not; else 0. So too the next ones"""
    scales_columns: float
    mixes: float
    has_leads: float
    one_by_one: float
    floating: float
    factors: float
    """1 where the laws are corrected by factors"""
    fits: float
    """1 where derivatives of all readings may know more of cells beside unknown ones"""
    turned: float
    """1 where the lines that are driven are the array's columns"""


@loop
def state_one(
    block: Blocks,
    reason: Reasons,
    row: int,
    column: int,
    conductance: float,
    uncertainty: float,
    own: float,
    by_column: float,
    every: float,
    noise: float,
    usual: float,
    half_step: float,
    sensed: int,
    board: Constants,
) -> None:
    """Write what is known of a cell; ``reason`` is that of the recovery.

    Args:
        block: (8, rows, columns) fields of a :class:`Measurement`; ``row`` and ``column`` are the cell's.
        reason: (rows, columns) why cells are not valid.
        conductance: S.
        uncertainty: relative.
        own: 1/V, relative change of the conductance by its own reading; ``by_column`` by the sum of its column, signed;
            ``every`` by independent errors of all readings.
        noise: V, of the cell's reading; ``usual`` of the others.
        half_step: V, half a step of the converter as far as noise does not randomise it.
        sensed: readings of a column.
        board: the constants.
    """
    block[UNCERTAINTY, row, column] = uncertainty
    block[CONDUCTANCE, row, column] = math.nan
    for place in range(NOISE_VARIANCE, LEAST):
        block[place, row, column] = 0.0
    if not math.isfinite(every) or not math.isfinite(conductance):
        return
    squares = every * every
    others = board.alike * board.alike * max(squares - own * own, 0.0)
    steps, shared_steps = half_step * math.sqrt(own * own + others), 0.0
    shared = 0.0
    if board.scales_columns > 0.0:
        steps, shared_steps = half_step * own, half_step * board.alike * by_column
        # A cell's own error is also one of those that scale its column.
        size = abs(by_column)
        shared = math.copysign(math.sqrt(size * size + 2.0 * own * size / math.sqrt(sensed)), by_column)
    why = reason[row, column]
    if why != 0:
        noisy = why == UNCERTAIN and board.averages > 0.0 and uncertainty <= MOST_NOISE
        if not noisy or math.sqrt(steps * steps + shared_steps * shared_steps) > MOST_STEPS:
            return
    left = max(squares - shared * shared, 0.0)
    alone = min(own * own, left)
    block[CONDUCTANCE, row, column] = conductance
    block[NOISE_VARIANCE, row, column] = (
        conductance * conductance * (alone * noise * noise + (left - alone) * usual * usual)
    )
    block[COLUMN_STD, row, column] = conductance * shared * usual
    block[HALF_STEP, row, column] = conductance * steps
    block[COLUMN_HALF_STEP, row, column] = conductance * shared_steps
    block[LEAST, row, column] = 0.0
    block[GREATEST, row, column] = math.inf


@loop
def state_each(
    conductance: Rows,
    uncertainty: Rows,
    own: Rows,
    by_column: Rows,
    every: Rows,
    noise: Rows,
    usual: float,
    sensed: int,
    boards: Records[Constants],
    block: Blocks,
    reason: Reasons,
) -> None:
    """Write what is known of all cells (rows, columns), in the array's coordinates; as :func:`state_one`."""
    board = boards[0]
    half_step = 0.5 * board.step * constant_part(usual / board.step)
    for i in range(conductance.shape[0]):
        for j in range(conductance.shape[1]):
            values = conductance[i, j], uncertainty[i, j], own[i, j], by_column[i, j], every[i, j], noise[i, j]
            state_one(block, reason, i, j, *values, usual, half_step, sensed, board)


class Measured:
    """Makes measurements of the recovered frames of one board."""

    def __init__(self, step: float, sensed: int, *, scales_columns: bool, averages: bool) -> None:
        """Begin.

        Args:
            step: V, of the converter.
            sensed: readings of a column.
            scales_columns: whether errors of readings scale all conductances of their column by one factor.
            averages: whether noisy readings serve for estimation, valid or not.

        """
        self._sensed, self._constants = sensed, zeros(Constants, 1)
        for name, value in (("step", step), ("scales_columns", scales_columns), ("averages", averages)):
            self._constants[name] = value

    def __call__(self, found: LiveReading, reason: NDArray[np.int8], noise: FloatArray, usual: float) -> Measurement:
        """The measurement of a frame.

        Args:
            found: as recovered.
            reason: (rows, columns) why cells are not valid.
            noise: (rows, columns) V, standard deviation of each reading, best guess; ``usual`` of the others.
            usual: V.

        """
        made = Measurement.unknown(reason.shape)
        made.reason[...] = reason
        if found.bounds is not None:
            made.least[...], made.greatest[...] = found.bounds
        own, column, every, self._constants["alike"] = found.errors
        with np.errstate(divide="ignore"):
            conductance = 1.0 / found.resistance
        whole = np.ascontiguousarray
        state_each.unchecked(
            *(whole(conductance), whole(found.uncertainty), whole(own), whole(column), whole(every), whole(noise)),
            *(usual, self._sensed, self._constants, made.block, made.reason),
        )
        return made
