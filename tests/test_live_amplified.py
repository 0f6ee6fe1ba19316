"""Boards with amplifiers at their limits: leads as large as the cells, shorts beside offsets, pressed followers."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import Any

import numpy as np
import pytest
from designs import digitised
from live import assert_bounded, counts_of, follow

from ohmskin.circuits import Design, Reason
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader

LOW = {"range": [0.2, 3.1]}
"""a converter that begins above 0 V"""


def board(rows: int, columns: int, lead: float, *, bits: int = 12, kind: str = "grounded", **sections: Any) -> Design:
    readout = {"reference_resistance": 1e3} | sections.pop("readout", {})
    return digitised(kind, rows, columns, bits, lead=lead, readout=readout, **sections)


def test_rows_that_shorts_join_are_not_told_apart() -> None:
    """A column of shorts: every row has the potential of that column, and other cells would give the same readings."""
    cells = np.full((4, 3), 700.0)
    cells[:, 1] = 0.01
    reading = follow(board(4, 3, 100.0, array={"row_lead": 0.5}), [cells] * 6)[-1]
    assert not reading.valid[:, 1].any()


@pytest.mark.parametrize("lead", [0.5, 8.0, 25.0])
@pytest.mark.parametrize("segment", [0.0, 0.5])
def test_a_hard_press_costs_its_own_rows_and_columns(lead: float, segment: float) -> None:
    """Saturated cells may be shorts that tie their rows together; what a row feeds to others stays bounded."""
    parts = {"reference_resistance": 4700.0, "supply": [-0.2, 3.6], "open_loop_gain": 3e3}
    rest = np.full((8, 7), 9e3) * np.exp(np.random.default_rng(1).uniform(-0.1, 0.1, (8, 7)))
    pressed, beside = rest.copy(), np.zeros((8, 7), dtype=bool)
    pressed[3:5, 2:4], beside[3:5], beside[:, 2:4] = 900.0, True, True
    reading = follow(board(8, 7, lead, segment=segment, readout=parts), [rest] * 3 + [pressed] * 3)[-1]
    assert reading.valid[~beside].all()


@pytest.mark.parametrize("segment", [0.0, 0.5])
@pytest.mark.parametrize("noise_steps", [0.0, 1.0])
def test_cells_like_their_leads_are_read_in_every_frame(segment: float, noise_steps: float) -> None:
    """A multiplexer's 100 ohm on both ends, and a hand that presses all cells of 3 kohm to a few hundred ohm."""
    rng = np.random.default_rng(7)
    rest = 3e3 * np.exp(rng.normal(0, 0.1, (6, 6)))
    shares = np.r_[np.linspace(0, 1, 20), np.ones(10)]
    frames = (rest / (1.0 + 9.0 * share * rng.uniform(0.9, 1.0, (6, 6))) for share in shares)
    readings = follow(board(6, 6, 100.0, segment=segment), frames, noise_steps, rng)[2:]
    assert min(reading.valid.mean() for reading in readings) > 0.9
    assert sum((reading.reason == Reason.UNSETTLED).any() for reading in readings) <= 2


def test_two_shorts_on_a_row_join_columns_of_unequal_offsets() -> None:
    """The difference of 4 mV drives a current like a cell's through both shorts, in every step."""
    parts, rng = {"offset_voltage": [2e-3, -2e-3, 0.0], "supply": [-0.2, 3.3]}, np.random.default_rng(3)

    def frames() -> Iterator[FloatArray]:
        for _ in range(20):
            cells = 10 ** rng.uniform(3.0, 3.3, (4, 3))
            cells[2, :2] = rng.uniform(0.01, 3.0, 2)
            yield cells

    readings = follow(board(4, 3, 10.0, readout=parts, adc={"range": [-0.1, 3.3]}), frames())
    assert sum(int(reading.valid.sum()) for reading in readings) > 10


def test_two_shorts_on_a_row_share_the_currents_of_their_columns() -> None:
    """The amplifiers' inputs are like the shorts, so a current of the one column returns half through the other."""
    design = board(4, 4, 0.0, array={"row_lead": 100.0}, readout={"open_loop_gain": 1e3, "supply": [-0.2, 3.3]})
    cells = 10 ** np.random.default_rng(5).uniform(3.0, 4.0, (4, 4))
    assert follow(design, [cells])[0].valid.all()
    cells[2, :2] = 0.01
    assert follow(design, [cells])[0].valid[[0, 1, 3], 2:].all()


def test_a_cell_below_the_range_draws_its_columns_source() -> None:
    """The offset drives a current through all cells of a column in every step, also through those that are not read."""
    parts = {"offset_voltage": [4e-3, -4e-3, 0.0], "supply": [-0.1, 2.9], "reference_resistance": 5e4}
    cells = np.full((5, 3), 6e4)
    cells[:3, 0] = cells[1:, 1] = 3e5
    assert follow(board(5, 3, 1.0, bits=16, readout=parts, adc=LOW), [cells])[0].valid.sum() == 8


@pytest.mark.parametrize("least", [1e6, inf])
def test_what_an_offset_pushes_below_the_range_may_conduct_up_to_the_range(least: float) -> None:
    """Outputs below 0 V read as hardly a current, but their cells load a column with a heavy lead."""
    parts = {"open_loop_gain": 300.0, "offset_voltage": -9e-5}
    cells = np.array([[least], [44.0], [150.0], [least], [110.0], [7.8e3]])
    reading = follow(board(6, 1, 0.4, bits=20, array={"column_lead": 1e3}, readout=parts), [cells])[0]
    assert reading.valid.ravel().tolist() == [False, True, True, False, True, True]
    assert (reading.reason[~reading.valid] == Reason.NO_CURRENT).all()


@pytest.mark.parametrize("bits", [12, 16, 18, 24])
@pytest.mark.parametrize("offset_steps", [0.0, -2.5, 2.5])
def test_an_output_at_a_limit_is_never_a_measurement(bits: int, offset_steps: float) -> None:
    """The swing ends within the converter's range, whose lower end is above 0 V; the converter has an offset, too."""
    adc = LOW | {"offset_voltage": offset_steps * 2.9 / 2**bits}
    cells = np.full((3, 4), 1e3)
    cells[0, 1], cells[2, 3] = 100.0, 1e5  # beyond the swing, and below the range
    for reading in follow(board(3, 4, 5.0, bits=bits, readout={"supply": [-0.1, 2.9]}, adc=adc), [cells] * 2):
        assert not reading.valid[[0, 2], [1, 3]].any()
        assert reading.reason[0, 1] == Reason.SATURATED
        assert reading.valid[1, 0]


@pytest.mark.parametrize("noise_steps", [0.0, 0.5, 2.0])
@pytest.mark.parametrize(
    ("kind", "supply", "level", "voltage"),
    [
        ("grounded", [0.0, 3.4], 0.0, -1.0),
        ("rows", [0.0, 3.4], 0.0, -1.0),
        ("rows", [0.1, 3.4], 0.1, -0.8),
        ("grounded", [-0.1, 3.0], 3.0, 1.0),
        ("feedback", [0.0, 3.4], 0.0, 1.0),
    ],
)
def test_an_open_cell_whose_output_an_offset_holds_at_its_limit_is_never_a_measurement(
    kind: str, supply: list[float], level: float, voltage: float, noise_steps: float
) -> None:
    """As of amplifiers on a single supply: noise moves the reading away from the limit as a current would."""
    parts = {"supply": supply, "reference_voltage": level, "open_loop_gain": 1e5}
    parts["offset_voltage"] = -5e-3 if level < 1.0 else 5e-3
    design, draw = (
        board(6, 5, 5.0, bits=14, kind=kind, readout=parts, drive={"voltage": voltage}),
        np.random.default_rng(3),
    )
    cells = 1e4 * 10 ** draw.uniform(-0.1, 0.1, (6, 5))
    cells[2, 3] = cells[4, 0] = inf
    for number, reading in enumerate(follow(design, [cells] * 40, noise_steps, draw)):
        assert not reading.valid[np.isinf(cells)].any()
        if number > 4:
            assert reading.valid[np.isfinite(cells)].all()


@pytest.mark.parametrize("bits", [18, 20, 24])
@pytest.mark.parametrize("noise_volts", [1e-6, 8e-6, 2e-5])
def test_noise_of_fine_converters_brings_no_saturated_output_back_to_life(bits: int, noise_volts: float) -> None:
    """From the first frame on, in which nobody knows that the noise is many steps: up to 100 of 24 bits."""
    design = board(4, 3, 40.0, bits=bits, readout={"supply": [-0.1, 2.9]})
    cells, draw = np.full((4, 3), 2e3), np.random.default_rng(bits)
    cells[1, 1] = cells[3, 1] = 60.0  # beyond the swing: each would be read as one that just reaches the limit
    for _ in range(30):
        read = CountReader(design)
        for _ in range(4):
            reading = read(counts_of(design, cells, noise_volts * 2**bits / 3.3, draw))
            assert not reading.valid[[1, 3], 1].any()
    assert reading.valid[0, 0]


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
@pytest.mark.parametrize("seed", range(12))
def test_a_row_stands_no_lower_than_it_would_without_its_cells_below_the_range(idle_rows: str, seed: int) -> None:
    """Cells whose readings say at most what they conduct may conduct nothing: then their row loses less drive."""
    draw = np.random.default_rng(seed)
    lines = {"row_lead": float(draw.choice([1.0, 100.0, 1000.0]))}
    sections = {"drive": {"idle_rows": idle_rows}, "readout": {"supply": (-0.1, 3.2)}, "adc": {"range": (0.2, 3.3)}}
    design = board(4, 5, 0.0, bits=int(draw.choice([12, 24])), array=lines, **sections)
    follow(design, [10 ** draw.uniform(2.7, 4.5, (4, 5))] * 3)  # above 5 kohm below the range


# Followers: two sets of cells may give the same readings


def follower(rows: int, columns: int, lead: float, *, bits: int = 16, **sections: Any) -> Design:
    readout = {"reference_resistance": 300e3, "offset_voltage": -2e-3} | sections.pop("readout", {})
    return digitised("feedback", rows, columns, bits, lead=lead, readout=readout, **sections)


def cells_between(rest_ohm: float, full_scale_ohm: float) -> dict[str, float]:
    return {"rest_resistance": rest_ohm, "full_scale_resistance": full_scale_ohm}


def test_cells_of_an_ohm_read_like_kiloohms_and_are_called_so_by_their_range_only() -> None:
    """Without leads of the columns two skins have the same readings, to an ADC step."""
    parts = {"reference_resistance": 3e3, "open_loop_gain": 300.0, "offset_voltage": 0.0}
    design, cells = follower(6, 8, 25.0, array={"column_lead": 0.0}, readout=parts), np.full((6, 8), 1.0)
    counts = counts_of(design, cells)
    reading = CountReader(design)(counts)
    assert not reading.valid.any()
    assert ((reading.least <= 1.0 / cells) & (1.0 / cells <= reading.greatest)).all()
    known = CountReader(design.replace(cells=cells_between(10e3, 1e3)))(counts)
    assert known.valid.all()
    assert (known.resistance > 1e3).all()
    assert (np.abs(counts_of(design, known.resistance) - counts) <= 1).all()


def test_a_press_to_a_few_ohm_beside_segments_leaves_no_wrong_cell() -> None:
    """Valid cells of 2 ohm were read as some hundred: the wire lessened what the column's other cells take."""
    parts, random = (
        {"reference_resistance": 3e3, "open_loop_gain": 1e3, "offset_voltage": 0.0},
        np.random.default_rng(1),
    )
    rest, pressed = 10 ** random.uniform(4.6, 5.0, (5, 6)), random.uniform(2.0, 2.5, (5, 6))
    design = follower(5, 6, 50.0, segment=0.5, array={"column_lead": 0.0}, readout=parts)
    design = design.replace(cells=cells_between(50e3, 20.0))
    assert any(reading.valid.any() for reading in follow(design, [rest] * 2 + [pressed] * 6 + [rest] * 2))


@pytest.mark.parametrize("seed", range(6))
def test_a_skin_that_is_pressed_at_once_leaves_no_wrong_cell(seed: int) -> None:
    random = np.random.default_rng(seed)
    rest, pressed = (10 ** random.uniform(*decades, (5, 5)) for decades in ((5.0, 5.5), (1.0, 4.0)))
    readings = follow(follower(5, 5, 50.0), [rest] * 3 + [pressed] * 5 + [rest] * 3)
    assert any(reading.valid.any() for reading in readings)


@pytest.mark.parametrize("lead", [20.0, 200.0])
@pytest.mark.parametrize("offset", [0.0, 1e-3])
@pytest.mark.parametrize("reference", [3e3, 29.4e3])
@pytest.mark.parametrize("shape", [(7, 3), (16, 16)])
def test_equal_cells_far_above_their_leads_are_valid(
    shape: tuple[int, int], reference: float, offset: float, lead: float
) -> None:
    """An offset that drives currents from the idle lines into a column cannot hide a pressed skin."""
    parts = {"reference_resistance": reference, "offset_voltage": offset, "open_loop_gain": 1e5}
    design = follower(*shape, lead, bits=12, array={"column_lead": 0.0}, readout=parts)
    design = design.replace(cells=cells_between(120e3, 10e3))
    for resistance in (10e3, 120e3):
        assert follow(design, [np.full(shape, resistance)] * 3)[-1].valid.all()


def test_current_from_idle_lines_above_a_poor_conductor_is_enclosed_with_the_others() -> None:
    """By the follower's offset. Cells of 170 to 190 kohm beside hard presses were read as 44 to 62 kohm, and valid."""
    parts = {"reference_resistance": 29.4e3, "offset_voltage": 5e-3, "open_loop_gain": 300.0}
    rest = np.full((7, 3), 120e3)
    pressed = np.array([118e3, 111e3, 82.0, 181e3, 192e3, 173e3, 148.0, 5.3, 63.0, 93.0, 6.0, 43.0, 81e3, 300.0, 191e3,
                        173e3, 8.0, 48.5, 109e3, 11.7, 188e3]).reshape(7, 3)  # fmt: skip
    design = follower(7, 3, 200.0, bits=12, array={"column_lead": 0.0}, readout=parts)
    readings = follow(design, [rest] * 2 + [pressed] * 6 + [rest] * 3)
    assert sum(int(reading.valid.sum()) for reading in readings) >= 4 * rest.size


def test_readings_below_the_range_do_not_bound_what_their_columns_conduct() -> None:
    """Shorts beside which an offset drives outputs below zero: their row's other cells read 40 times too high."""
    parts = {"reference_resistance": 20e3, "offset_voltage": -2e-3, "open_loop_gain": 300.0}
    design = follower(5, 7, 0.5, bits=24, array={"column_lead": 0.0}, readout=parts, cells=cells_between(150e3, 15e3))
    rest = 150e3 * np.exp(np.random.default_rng(58).uniform(-0.3, 0.3, (5, 7)))
    shorted = rest.copy()
    shorted[2, 0], shorted[3, 0], shorted[3, 3] = 0.8, 0.04, 0.02
    assert follow(design, [rest] * 2 + [shorted] * 3)[0].valid.all()


@pytest.mark.parametrize("bits", [8, 16])
def test_an_open_cell_behind_heavy_leads_is_not_valid(bits: int) -> None:
    """What passes beside the cell was taken for its own current, of which the cell's own share is far less."""
    lines = {"column_lead": 60.0, "row_segment": 2.0, "column_segment": 2.0}
    parts = {"reference_resistance": 4.7e3, "offset_voltage": 5e-4, "open_loop_gain": 1e6, "bias_current": 1e-9}
    rest = 10 ** np.random.default_rng(77).uniform(3.9, 4.15, (20, 20))
    opened = rest.copy()
    opened[2, 1] = 1e12
    design = follower(20, 20, 120.0, bits=bits, array=lines, readout=parts)
    assert follow(design, [rest] * 2 + [opened] * 4)[-1].valid.sum() == rest.size - 1


def test_current_by_detours_over_pressed_cells_is_enclosed_with_them() -> None:
    """By way of a row and a column of good conductors. A cell of 9 kohm was read as 3.7 kohm within 22 %, and valid."""
    parts = {"reference_resistance": 10.8e3, "offset_voltage": 2e-3, "open_loop_gain": 1e3}
    rest = np.array([6043.0, 4607, 4910, 4538, 6337, 5930, 7393, 9021, 4308, 5943, 5827, 6447, 4584, 10210, 8159, 6465,
                     5794, 8097, 8343, 9735, 7610, 5109, 8662, 4450, 5011, 6436, 5332, 8942, 6494, 6095, 6242, 6365,
                     6369, 9211, 4914]).reshape(7, 5)  # fmt: skip
    pressed = rest.copy()
    pressed[:, 1] = 115.3, 355.7, 34.49, 25.84, 4.365, 38.64, 619.7
    pressed[4] = 42.55, 4.365, 17.39, 5.744, 20.90
    design = follower(7, 5, 100.0, array={"column_lead": 5.0}, readout=parts)
    assert follow(design, [rest] * 2 + [pressed] * 7 + [rest] * 2)[-1].valid.all()


def test_both_sides_of_a_bound_are_judged() -> None:
    """The judge of these tests notices cells that are off."""
    design, cells = board(3, 3, 5.0), np.full((3, 3), 4e3)
    reading = follow(design, [cells] * 3)[-1]
    for wrong in (0.9, 1.1):
        with pytest.raises(AssertionError):
            assert_bounded(reading, wrong * cells)
