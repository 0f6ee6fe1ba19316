"""A recovered frame as a :class:`Measurement`: conductances in siemens, and what of their errors is whose."""

from __future__ import annotations

import math

from ...common.compiled import Blocks, Reasons, Record, Records, loop, zeros
from ...common.measurement import (
    COLUMN_HALF_STEP,
    COLUMN_STD,
    CONDUCTANCE,
    GREATEST,
    HALF_STEP,
    LEAST,
    NOISE_VARIANCE,
    UNCERTAINTY,
)
from .._adc import adc_error
from .._board import Board
from ._live_reading import UNCERTAIN, ValidityRule
from ._tuning import OF_STEPS


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
    """uncertainty up to which noisy readings serve for estimation, valid or not"""
    scales_columns: float
    """1 where errors of readings scale their column; else 0. So too the next ones"""
    mixes: float
    has_leads: float
    one_by_one: float
    floating: float
    factors: float
    """1 where the laws are corrected by factors"""
    faulty: float
    """1 where parts are known to be in series with cells or in parallel"""
    encloses: float
    """1 where the bounds beside unknown cells count all ways of currents"""
    several: float
    """1 where readings may have several answers"""
    fits: float
    """1 where derivatives of all readings may know more of cells beside unknown ones"""
    transposed: float
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
        noisy = why == UNCERTAIN and uncertainty <= board.averages
        if not noisy or math.sqrt(steps * steps + shared_steps * shared_steps) > OF_STEPS * board.averages:
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


def constants_of(board: Board, rule: ValidityRule, **others: float) -> Records[Constants]:
    """The constants of a board with a converter; those that are not given are zero."""
    constants = zeros(Constants, 1)
    assert board.adc is not None
    given = {
        "step": board.adc.step,
        "half": adc_error(board),
        "accuracy": rule.limit,
        "averages": rule.averages,
        "one_by_one": board.circuit.columns_one_by_one(board),
        "floating": board.floating,
        "transposed": board.transposed,
    }
    for name, value in (given | others).items():
        constants[name] = value
    return constants
