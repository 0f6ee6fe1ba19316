"""Shorts on boards whose cells share their current: no other cells are read in their place, and none beside them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from designs import digitised
from live import follow

from ohmskin.circuits import Design
from ohmskin.common.arrays import FloatArray

RESISTANCES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 30.0, 100.0)
"""ohm of a short"""


def board(kind: str, shape: tuple[int, int], bits: int = 10, **sections: Any) -> Design:
    usual = {"reference_resistance": 4.7e3} | ({"open_loop_gain": 1e3} if kind == "feedback" else {})
    return digitised(kind, *shape, bits, readout=usual | sections.pop("readout", {}), **sections)


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
        lines = {"column_lead": float(draw.choice([0.0, lead]))}
        segment, reference = float(draw.choice([0.0, 0.0, 0.5])), float(draw.choice([1e3, 4.7e3, 10e3, 47e3]))
        parts, bits = {"reference_resistance": reference}, int(draw.choice([8, 10, 12, 16]))
        rest = reference * 4.0 * 10 ** draw.uniform(-0.2, 0.2, shape)
        shorted = rest.copy()
        for place in places(draw, shape, form):
            shorted[place] = draw.choice(RESISTANCES)
        design = board(kind, shape, bits, lead=lead, segment=segment, array=lines, readout=parts)
        follow(design, [rest] * 2 + [shorted] * 4 + [rest] * 2)


@pytest.mark.parametrize("ohm", [0.05, 5.0, 30.0, 90.0])
def test_hard_cells_of_a_row_beyond_the_declared_range_hide_nothing(ohm: float) -> None:
    """Two answers differ by all cells, and the wrong one has none beyond the range."""
    draw = np.random.default_rng(1)
    for lead, column_lead, reference in ((20.0, 1.0, 1e3), (20.0, 20.0, 1e3), (1.0, 1.0, 4.7e3), (1.0, 1.0, 1e3)):
        rest = 9e3 * np.exp(draw.uniform(-0.12, 0.12, (8, 8)))
        design = board(
            "divider",
            (8, 8),
            12,
            array={"row_lead": lead, "column_lead": column_lead},
            drive={"voltage": 3.3, "idle_rows": "ground"},
            readout={"reference_resistance": reference, "columns": "multiplexed", "idle_columns": "ground"},
            cells={"rest_resistance": 9e3, "full_scale_resistance": 1.8e3},
        )
        for pressed in (np.s_[2:3, 6:8], np.s_[2:4, 6:8]):
            hard = rest.copy()
            hard[pressed] = ohm
            follow(design, [rest] * 3 + [hard] * 3)


@pytest.mark.parametrize("gain", [1e4, 1e5])
def test_a_finger_on_a_board_with_a_follower_and_no_column_leads_is_read(gain: float) -> None:
    """Its cells are within their range, although cells of an ohm could read like them."""
    design = board("feedback", (8, 8), 12, array={"row_lead": 25.0}, readout={"open_loop_gain": gain})
    design = design.replace(cells={"rest_resistance": 2e4, "full_scale_resistance": 1e3})
    (row, column), rest = np.indices((8, 8)), 2e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (8, 8))
    loads = (np.exp(-((row - 3.0) ** 2 + (column - 3.0 - 0.1 * number) ** 2) / 2.0) for number in range(12))
    assert follow(design, [rest / (1.0 + 20.0 * load) for load in loads])[-1].valid.all()


@pytest.mark.parametrize("shape", [(16, 16), (16, 32)])
def test_large_dividers_of_8_bits_with_fingers_and_shorts(shape: tuple[int, int]) -> None:
    rest, (row, column) = 3e4 * 10 ** np.random.default_rng(shape[1]).uniform(-0.1, 0.1, shape), np.indices(shape)

    def frames() -> Iterator[FloatArray]:
        for number in range(8):
            cells = rest / (1.0 + 20.0 * np.exp(-((row - 6.0) ** 2 + (column - 3.0 - number) ** 2) / 3.0))
            if 3 <= number < 6:
                cells[4, 9] = cells[11, 9] = cells[4, 12] = 0.1
            yield cells

    follow(board("divider", shape, 8, lead=25.0), frames())


@pytest.mark.parametrize(
    ("shape", "short", "lead"), [((16, 16), 0.5, 5.0), ((14, 10), 30.0, 25.0), ((9, 12), 5.0, 0.3)]
)
def test_a_short_on_a_larger_divider_with_floating_rows_leaves_the_others_known(
    shape: tuple[int, int], short: float, lead: float
) -> None:
    """The structure of the lines does not hold there, but the derivatives of all readings determine nearly all."""
    draw = np.random.default_rng(shape)
    rest = 5e3 * draw.uniform(0.7, 3.0, shape)
    frames = [rest * draw.uniform(0.98, 1.02, shape) for _ in range(8)]
    for cells in frames[2:]:
        cells[shape[0] // 3, shape[1] // 3] = short
    assert follow(board("open divider", shape, 12, lead=lead), frames)[-1].valid.mean() > 0.85


@pytest.mark.parametrize("seed", [0, 1])
def test_two_shorts_cost_dividers_their_columns(seed: int) -> None:
    """Each ties a row to a column, by a conductance that no reading tells: the others follow, wherever it is."""
    rest = 1e4 * 10 ** np.random.default_rng(seed).uniform(-0.1, 0.1, (8, 8))
    shorted = rest.copy()
    shorted[3, 5] = shorted[4, 0] = 5.0
    readings = follow(board("divider", (8, 8), lead=5.0), [rest] * 2 + [shorted] * 6 + [rest] * 3)
    assert readings[7].valid[:, 1:5].mean() > 0.9
    assert readings[7].valid[:, 6:].mean() > 0.9
    assert readings[-1].valid.all()


@pytest.mark.parametrize("hard", [8.0])
@pytest.mark.parametrize("places", [((1, 2),), ((1, 2), (6, 5))])
@pytest.mark.parametrize("kind", ["divider", "loaded"])
def test_cells_of_a_few_ohm_cost_their_columns_and_rows_that_they_join(kind: str, places: Any, hard: float) -> None:
    """What a cell near a short is, nobody can tell, nor what is beside it in its column. Others stay known."""
    rest = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.05, 0.05, (9, 10))
    at, free = tuple(np.transpose(places)), np.ones((9, 10), dtype=np.bool_)
    free[at[0]], free[:, at[1]] = False, False
    short = rest.copy()
    short[at] = hard
    touched = short.copy()
    touched[6:8, 3:6] = np.minimum(short[6:8, 3:6], 3e3)  # a finger, in part on lost columns
    readings = follow(board(kind, (9, 10), 12, lead=5.0), [rest] * 4 + [short] * 5 + [touched] * 7)
    for reading in (readings[8], *readings[12:]):  # four frames after the events
        assert reading.valid[free].all()


@pytest.mark.parametrize("idle_columns", ["float", "load"])
@pytest.mark.parametrize("lead", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("short", [0.01, 5.0])
def test_a_shorted_cell_of_an_open_divider_costs_its_column_at_most(
    lead: float, short: float, idle_columns: str
) -> None:
    cells = np.random.default_rng(0).uniform(5e3, 9e3, (8, 8))
    cells[2, 5] = short
    parts = {"reference_resistance": 2e3, "idle_columns": idle_columns}
    reading = follow(board("divider", (8, 8), 12, lead=lead, readout=parts), [cells] * 6)[-1]
    assert np.delete(reading.valid, 5, axis=1).all()


# A column of good conductors, and a row behind a lead: two sets of cells give the same readings


@pytest.mark.parametrize("seed", [2, 3, 5, 10, 14, 17, 23, 28])
def test_a_column_of_shorts_beside_a_row_with_a_lead_leaves_no_wrong_cell(seed: int) -> None:
    """Boards at random, each of which once had valid cells that were wrong, most of them by a factor of two."""
    random = np.random.default_rng(seed)
    rows, columns = (int(count) for count in random.integers((3, 3), (7, 9)))
    lead = np.full(rows, float(random.choice([0.0, 5.0])))
    lead[random.integers(rows)] = 10 ** random.uniform(1.0, 3.0)
    bits, column_lead = int(random.choice([12, 16, 20])), float(random.choice([0.0, 20.0]))
    rest = 1e4 * 10 ** random.uniform(-0.5, 0.5, (rows, columns))
    pressed = rest.copy()
    pressed[:, random.integers(columns)] = random.choice([0.3, 1.0, 5.0]) * 10 ** random.uniform(-0.5, 0.5, rows)
    lines = {"row_lead": lead.tolist(), "column_lead": column_lead}
    readings = follow(board("loaded", (rows, columns), bits, array=lines), [rest] * 3 + [pressed] * 8)
    assert readings[0].valid.all()


def test_a_hard_press_on_light_leads_has_one_scale() -> None:
    rest = 1e4 * 10 ** np.random.default_rng(3).uniform(-0.2, 0.2, (6, 6))
    pressed = rest.copy()
    pressed[1:4, 2] = 300.0
    design = board("loaded", (6, 6), 16, array={"row_lead": 5.0})
    assert follow(design, [rest] * 3 + [pressed] * 8)[-1].valid.all()


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("lead", [15.0, 120.0])
def test_a_divider_that_grounds_idle_columns_behind_leads_states_all_of_its_answers(lead: float, bits: int) -> None:
    """Other cells, far away, give the same readings: no cell is valid, and each lies within its bounds."""
    parts = {"idle_columns": "ground", "columns": "multiplexed", "reference_resistance": 1.5e3}
    design = board("divider", (3, 11), bits, lead=lead, array={"column_lead": lead / 2.0}, readout=parts)
    rest = 10 ** np.random.default_rng(77).uniform(3.9, 4.15, (3, 11))
    pressed = rest.copy()
    pressed[1, 4] = 0.5
    frames = [rest] * 3 + [pressed] * 8
    for reading, cells in zip(follow(design, frames), frames, strict=True):
        assert not reading.valid.any()
        assert (reading.least <= 1.0 / cells).all()
        assert (1.0 / cells <= reading.greatest).all()
