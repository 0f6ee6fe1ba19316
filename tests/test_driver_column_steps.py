"""ADC steps that scale whole columns of coarse dividers do not become loads."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.bench._driver import design
from ohmskin.cell import Cell
from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader, Reading
from ohmskin.driver._column_steps import ColumnSteps
from ohmskin.driver._systematic import SystematicError

SIZE, NOISE_V = 16, 1e-3
ROW, COLUMN = np.indices((SIZE, SIZE))
FINGER = np.exp(-((ROW - 6) ** 2 + (COLUMN - 9) ** 2) / 1.3)
"""share of the largest change of a resistance"""


@pytest.fixture(scope="module")
def board() -> Design:
    """16 x 16 cells, 8 bits, rows driven: a column lies 29 steps below the drive."""
    return design(SIZE, "voltage-divider", "ground", 8)


def read(board: Design, *cells: FloatArray, noise_v: float = NOISE_V) -> list[Reading]:
    """The last reading of each of several states of the cells (16, 16), in ohm, in their order."""
    draw, reader, found = np.random.default_rng(1), CountReader(board), []
    for ohms in cells:
        volts = scan(board, ohms).volts
        for _ in range(6):
            reading = reader(adc_codes(board, volts + draw.normal(scale=noise_v, size=volts.shape)))
        found.append(reading)
    return found


def equal(factor: float = 1.0) -> FloatArray:
    """Equal cells at rest."""
    return np.full((SIZE, SIZE), factor * Cell.example().rest_resistance_ohm)


@pytest.mark.parametrize("factor", [0.95, 1.0, 1.03])
def test_a_finger_does_not_press_its_column(board: Design, factor: float) -> None:
    rises = 0.3, 0.8, 1.2
    rest, *pressed = read(board, equal(factor), *(equal(factor) * (1.0 + rise * FINGER) for rise in rises))
    steps = ColumnSteps(rest.resistance, 1.0, rest_known=True)
    far = (COLUMN == 9) & (FINGER < 0.01)
    raw, left = [], []
    for rise, reading in zip(rises, pressed, strict=True):
        ohms, doubt = steps.without(reading)
        change = ohms / rest.resistance
        raw.append(np.abs(reading.resistance / rest.resistance - 1.0)[far].max())
        left.append(np.abs(change - 1.0)[far].max())
        own = (2.0 + rise) / 14.0  # half a step at rest, where a code has 14, and half a step under the finger
        assert abs(change[6, 9] / (1.0 + rise) - 1.0) < own
        assert doubt is not None
        assert doubt[9] > 0.0
    assert max(raw) > 0.2, "the whole column reads as pressed"
    assert max(left) < 1.0 / 13.0, "a step of a reading's own"


@pytest.mark.parametrize("size", [16, 32])
@pytest.mark.parametrize("rest_ohm", [14e3, 30e3])
def test_what_half_a_step_of_all_other_readings_makes_of_a_column_is_their_sum(size: int, rest_ohm: float) -> None:
    board = design(size, "voltage-divider", "ground", 8)
    reader, codes = CountReader(board), adc_codes(board, scan(board, np.full((size, size), rest_ohm)).volts)
    for _ in range(30):
        steps = reader(codes).column_steps
    left = 1.0 - (codes + 0.5).sum(axis=0) / 256.0  # of the drive, in which that sum is missing
    assert steps is not None
    np.testing.assert_allclose(steps, 0.5 * (size - 1) / 256.0 / left, rtol=0.15)


def test_what_a_load_on_whole_columns_loses_counts_as_deviation(board: Design) -> None:
    cell = Cell.example()
    rest, pressed = read(board, equal(), equal() * 1.5)
    ohms, doubt = ColumnSteps(rest.resistance, 1.0, rest_known=True).without(pressed)
    change = ohms / rest.resistance - 1.0
    assert (change < pressed.resistance / rest.resistance - 1.0).all()
    kpa = np.zeros((SIZE, SIZE))
    systematic = SystematicError(cell)
    plain = systematic.take(pressed, rest_known=True)(kpa, np.zeros((SIZE, SIZE)))
    wide = systematic.take(pressed, doubt, rest_known=True)(kpa, np.zeros((SIZE, SIZE)))
    assert (wide > plain).all()


def test_cells_that_differ_keep_their_readings(board: Design) -> None:
    # Each has an error of its own, and a load on a whole column is seen.
    unlike = equal() * np.exp(0.05 * np.random.default_rng(4).standard_normal((SIZE, SIZE)))
    rest, pressed = read(board, unlike, unlike * 1.5)
    found = ColumnSteps(rest.resistance, 1.0, rest_known=True).without(pressed)[0]
    assert np.array_equal(found, pressed.for_estimation, equal_nan=True)
    same, again = read(board, equal(), equal() * (1.0 + FINGER))
    untared = ColumnSteps(same.resistance, 1.0, rest_known=False).without(again)[0]
    assert np.array_equal(untared, again.for_estimation, equal_nan=True)


def test_noise_of_a_step_leaves_nothing_to_take_out(board: Design) -> None:
    assert board.adc is not None
    rest, pressed = read(board, equal(), equal() * (1.0 + FINGER), noise_v=board.adc.step)
    assert ColumnSteps(equal(), 1.0, rest_known=True).without(pressed)[1] is None
    assert rest.column_steps is None
