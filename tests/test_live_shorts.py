"""Shorts on boards whose cells share their current: no other cells are read in their place, and none beside them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from designs import digitised

from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader

RESISTANCES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 30.0, 100.0)
"""ohm of a short"""


def board(kind: str, shape: tuple[int, int], bits: int = 10, *, array: Any = None, readout: Any = None) -> Design:
    parts = {"reference_resistance": 4.7e3} | ({"open_loop_gain": 1e3} if kind == "feedback" else {})
    return digitised(kind, *shape, bits, array=array or {}, readout=parts | (readout or {}))


def counts_of(design: Design, cells: FloatArray) -> Any:
    return adc_codes(design, scan(design, cells).volts).astype(np.uint16)


def check(reading: Any, cells: FloatArray) -> None:
    """All valid cells are within their uncertainties, and none is off by a factor of two."""
    valid = reading.valid
    share = reading.resistance[valid] / cells[valid]
    assert (np.abs(share - 1.0) <= reading.uncertainty[valid]).all()
    assert ((share > 0.5) & (share < 2.0)).all()


def places(draw: np.random.Generator, shape: tuple[int, int], form: str) -> list[tuple[int, int]]:
    """Shorts in one row, in one column, or at the corners of a rectangle."""
    count = int(draw.integers(2, 5))
    rows, columns = draw.permutation(shape[0]), draw.permutation(shape[1])
    if form == "row":
        return [(int(rows[0]), int(j)) for j in columns[:count]]
    if form == "column":
        return [(int(i), int(columns[0])) for i in rows[:count]]
    return [(int(i), int(j)) for i in rows[:2] for j in columns[:2]]


@pytest.mark.parametrize("form", ["row", "column", "rectangle"])
@pytest.mark.parametrize("kind", ["divider", "loaded", "open divider", "feedback"])
def test_shorts_of_a_line_are_never_read_as_other_cells(kind: str, form: str) -> None:
    """They come and go in mid-stream; lines, converters and references are drawn."""
    draw = np.random.default_rng([*kind.encode(), *form.encode()])
    for _ in range(12):
        shape = int(draw.integers(2, 9)), int(draw.integers(2, 9))
        lead = float(draw.choice([0.0, 1.0, 5.0, 25.0, 100.0]))
        array = {"row_lead": lead, "column_lead": float(draw.choice([0.0, lead]))}
        array["row_segment"] = array["column_segment"] = float(draw.choice([0.0, 0.0, 0.5]))
        reference = float(draw.choice([1e3, 4.7e3, 10e3, 47e3]))
        bits = int(draw.choice([8, 10, 12, 16]))
        design = board(kind, shape, bits, array=array, readout={"reference_resistance": reference})
        read, rest = CountReader(design), reference * 4.0 * 10 ** draw.uniform(-0.2, 0.2, shape)
        shorted = rest.copy()
        for place in places(draw, shape, form):
            shorted[place] = draw.choice(RESISTANCES)
        for cells in (rest, rest, shorted, shorted, shorted, shorted, rest, rest):
            check(read(counts_of(design, cells)), cells)


@pytest.mark.parametrize("gain", [1e4, 1e5])
def test_a_finger_on_a_board_with_a_follower_and_no_column_leads_is_read(gain: float) -> None:
    """Its cells are within their range, although cells of an ohm could read like them."""
    design = board("feedback", (8, 8), 12, array={"row_lead": 25.0}, readout={"open_loop_gain": gain})
    design = design.replace(cells={"rest_resistance": 2e4, "full_scale_resistance": 1e3})
    read, (row, column) = CountReader(design), np.indices((8, 8))
    rest = 2e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (8, 8))
    for number in range(12):
        load = np.exp(-((row - 3.0) ** 2 + (column - 3.0 - 0.1 * number) ** 2) / 2.0)
        cells = rest / (1.0 + 20.0 * load)
        reading = read(counts_of(design, cells))
        check(reading, cells)
    assert reading.valid.all()


@pytest.mark.parametrize("shape", [(16, 16), (16, 32)])
def test_large_dividers_of_8_bits_with_fingers_and_shorts(shape: tuple[int, int]) -> None:
    draw = np.random.default_rng(shape[1])
    design = board("divider", shape, 8, array={"row_lead": 25.0, "column_lead": 25.0})
    read, rest = CountReader(design), 3e4 * 10 ** draw.uniform(-0.1, 0.1, shape)
    row, column = np.indices(shape)
    for number in range(8):
        load = np.exp(-((row - 6.0) ** 2 + (column - 3.0 - number) ** 2) / 3.0)
        cells = rest / (1.0 + 20.0 * load)
        if 3 <= number < 6:
            cells[4, 9] = cells[11, 9] = cells[4, 12] = 0.1
        check(read(counts_of(design, cells)), cells)


@pytest.mark.parametrize(
    ("shape", "short", "lead"), [((16, 16), 0.5, 5.0), ((14, 10), 30.0, 25.0), ((9, 12), 5.0, 0.3)]
)
def test_a_short_on_a_larger_divider_with_floating_rows_leaves_the_others_known(
    shape: tuple[int, int], short: float, lead: float
) -> None:
    """The structure of the lines does not hold there, but the derivatives of all readings determine nearly all."""
    draw, place = np.random.default_rng(shape), (shape[0] // 3, shape[1] // 3)
    design = board("open divider", shape, 12, array={"row_lead": lead, "column_lead": lead})
    read, rest = CountReader(design), 5e3 * draw.uniform(0.7, 3.0, shape)
    for number in range(8):
        cells = rest * draw.uniform(0.98, 1.02, shape)
        if number >= 2:
            cells[place] = short
        reading = read(counts_of(design, cells))
        check(reading, cells)
    assert reading.valid.mean() > 0.85


@pytest.mark.parametrize("seed", [0, 1])
def test_two_shorts_cost_dividers_their_columns(seed: int) -> None:
    """Each ties a row to a column, by a conductance that no reading tells: the others follow, wherever it is."""
    design = board("divider", (8, 8), array={"row_lead": 5.0, "column_lead": 5.0})
    read, rest = CountReader(design), 1e4 * 10 ** np.random.default_rng(seed).uniform(-0.1, 0.1, (8, 8))
    shorted = rest.copy()
    shorted[3, 5] = shorted[4, 0] = 5.0
    for cells in (rest, rest, *[shorted] * 6, rest, rest, rest):
        reading = read(counts_of(design, cells))
        check(reading, cells)
        if cells is shorted:
            shares = reading.valid[:, 1:5].mean(), reading.valid[:, 6:].mean()
    assert min(shares) > 0.9
    assert reading.valid.all()
