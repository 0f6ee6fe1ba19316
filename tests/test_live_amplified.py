"""Amplifier boards at their limits: leads as large as the cells, shorts beside offsets."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
import pytest

from ohmskin.circuits import Design, Reason, adc_codes, scan
from ohmskin.driver import CountReader


def board(rows: int, columns: int, lead: float, *, bits: int = 12, segment: float = 0.0, **readout: Any) -> Design:
    lines = {"row_lead": lead, "column_lead": lead, "row_segment": segment, "column_segment": segment}
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns} | lines,
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1e3} | readout,
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


def test_rows_that_shorts_join_are_not_told_apart() -> None:
    """A column of shorts: every row has the potential of that column, and other cells would give the same readings."""
    design = board(4, 3, 100.0).replace(array={"row_lead": 0.5})
    cells = np.full((4, 3), 700.0)
    cells[:, 1] = 0.01
    read = CountReader(design)
    for _ in range(6):
        reading = read(adc_codes(design, scan(design, cells).volts))
        off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
        assert (off <= reading.uncertainty[reading.valid]).all()
    assert not reading.valid[:, 1].any()


@pytest.mark.parametrize("lead", [0.5, 8.0, 25.0])
@pytest.mark.parametrize("segment", [0.0, 0.5])
def test_a_hard_press_costs_its_own_rows_and_columns(lead: float, segment: float) -> None:
    """Saturated cells may be shorts that tie their rows together; what a row feeds to others stays bounded."""
    design = board(8, 7, lead, segment=segment, reference_resistance=4700.0, supply=[-0.2, 3.6], open_loop_gain=3e3)
    rest = np.full((8, 7), 9e3) * np.exp(np.random.default_rng(1).uniform(-0.1, 0.1, (8, 7)))
    pressed, beside = rest.copy(), np.zeros((8, 7), dtype=bool)
    pressed[3:5, 2:4], beside[3:5], beside[:, 2:4] = 900.0, True, True
    read = CountReader(design)
    for cells in [rest] * 3 + [pressed] * 3:
        reading = read(adc_codes(design, scan(design, cells).volts))
    assert reading.valid[~beside].all()
    off = np.abs(reading.resistance / pressed - 1.0)[reading.valid]
    assert (off <= reading.uncertainty[reading.valid]).all()


@pytest.mark.parametrize("segment", [0.0, 0.5])
@pytest.mark.parametrize("noise_steps", [0.0, 1.0])
def test_cells_like_their_leads_are_read_in_every_frame(segment: float, noise_steps: float) -> None:
    """A multiplexer's 100 ohm on both ends, and a hand that presses all cells of 3 kohm to a few hundred ohm."""
    design, rng = board(6, 6, 100.0, segment=segment), np.random.default_rng(7)
    read, rest = CountReader(design), 3e3 * np.exp(rng.normal(0, 0.1, (6, 6)))
    assert design.adc is not None
    unsettled = 0
    for number, share in enumerate(np.r_[np.linspace(0, 1, 20), np.ones(10)]):
        cells = rest / (1.0 + 9.0 * share * rng.uniform(0.9, 1.0, (6, 6)))
        volts = scan(design, cells).volts + rng.normal(scale=noise_steps * design.adc.step, size=(6, 6))
        reading = read(adc_codes(design, volts))
        found = reading.valid
        off = np.abs(reading.resistance / cells - 1.0)[found] / reading.uncertainty[found]
        assert off.max(initial=0.0) <= (1.0 + 1e-9 if not noise_steps else 5.0 / 3.0)
        if number > 1:
            unsettled += int((reading.reason == Reason.UNSETTLED).any())
            assert found.mean() > 0.9
    assert unsettled <= 2


def test_two_shorts_on_a_row_join_columns_of_unequal_offsets() -> None:
    """The difference of 4 mV drives a current like a cell's through both shorts, in every step."""
    design = board(4, 3, 10.0, offset_voltage=[2e-3, -2e-3, 0.0], supply=[-0.2, 3.3]).replace(
        adc={"range": [-0.1, 3.3]}
    )
    rng, read = np.random.default_rng(3), CountReader(design)
    seen = 0
    for _ in range(20):
        cells = 10 ** rng.uniform(3.0, 3.3, (4, 3))
        cells[2, :2] = rng.uniform(0.01, 3.0, 2)
        reading = read(adc_codes(design, scan(design, cells).volts))
        found = reading.valid
        off = np.abs(reading.resistance / cells - 1.0)[found]
        assert (off <= reading.uncertainty[found] + 1e-9).all()
        seen += int(found.sum())
    assert seen > 10


def test_two_shorts_on_a_row_share_the_currents_of_their_columns() -> None:
    """The amplifiers' inputs are like the shorts, so a current of the one column returns half through the other."""
    design = board(4, 4, 0.0, open_loop_gain=1e3, supply=[-0.2, 3.3]).replace(array={"row_lead": 100.0})
    cells = 10 ** np.random.default_rng(5).uniform(3.0, 4.0, (4, 4))
    untouched = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    cells[2, :2] = 0.01
    reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    assert (off <= reading.uncertainty[reading.valid] + 1e-9).all()
    assert untouched.valid.all()
    assert reading.valid[[0, 1, 3], 2:].all()


def test_a_cell_below_the_range_draws_its_columns_source() -> None:
    """The offset drives a current through all cells of a column in every step, also through those that are not read."""
    design = board(5, 3, 1.0, bits=16, offset_voltage=[4e-3, -4e-3, 0.0], supply=[-0.1, 2.9])
    design = design.replace(adc={"range": [0.2, 3.1]}, readout={"reference_resistance": 5e4})
    cells = np.full((5, 3), 6e4)
    cells[:3, 0] = cells[1:, 1] = 3e5
    reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
    assert reading.valid.sum() == 8
    assert (off <= reading.uncertainty[reading.valid]).all()


def test_what_an_offset_pushes_below_the_range_may_conduct_up_to_the_range() -> None:
    """Outputs below 0 V read as hardly a current, but their cells load a column with a heavy lead."""
    design = board(6, 1, 0.4, bits=20, open_loop_gain=300.0, offset_voltage=-9e-5).replace(array={"column_lead": 1e3})
    pressed = np.array([[1e6], [44.0], [150.0], [2.5e5], [110.0], [7.8e3]])
    for least in (1e6, np.inf):
        cells = np.where(pressed < 1e5, pressed, least)
        reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
        off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
        assert reading.valid.ravel().tolist() == [False, True, True, False, True, True]
        assert (reading.reason[~reading.valid] == Reason.NO_CURRENT).all()
        assert (off <= reading.uncertainty[reading.valid]).all()


@pytest.mark.parametrize("bits", [12, 16, 18, 24])
@pytest.mark.parametrize("offset_steps", [0.0, -2.5, 2.5])
def test_an_output_at_a_limit_is_never_a_measurement(bits: int, offset_steps: float) -> None:
    """The swing ends within the converter's range, whose lower end is above 0 V; the converter has an offset, too."""
    design = board(3, 4, 5.0, bits=bits, supply=[-0.1, 2.9]).replace(adc={"range": [0.2, 3.1]})
    assert design.adc is not None
    design = design.replace(adc={"offset_voltage": offset_steps * design.adc.step})
    cells = np.full((3, 4), 1e3)
    cells[0, 1], cells[2, 3] = 100.0, 1e5  # beyond the swing, and below the range
    for _ in range(2):
        reading = CountReader(design)(adc_codes(design, scan(design, cells).volts))
        assert not reading.valid[0, 1]
        assert not reading.valid[2, 3]
        assert reading.reason[0, 1] == Reason.SATURATED
        assert reading.valid[1, 0]


@pytest.mark.parametrize("noise_steps", [0.0, 0.5, 2.0])
@pytest.mark.parametrize(
    ("circuit", "supply", "level", "voltage"),
    [
        ("inverting-amplifier", [0.0, 3.4], 0.0, -1.0),
        ("row-amplifier", [0.0, 3.4], 0.0, -1.0),
        ("row-amplifier", [0.1, 3.4], 0.1, -0.8),
        ("inverting-amplifier", [-0.1, 3.0], 3.0, 1.0),
        ("voltage-feedback", [0.0, 3.4], 0.0, 1.0),
    ],
)
def test_an_open_cell_whose_output_an_offset_holds_at_its_limit_is_never_a_measurement(
    circuit: str, supply: list[float], level: float, voltage: float, noise_steps: float
) -> None:
    """As of amplifiers on a single supply: noise moves the reading away from the limit as a current would."""
    design = board(6, 5, 5.0, bits=14, circuit=circuit, supply=supply, reference_voltage=level, open_loop_gain=1e5)
    away = -5e-3 if level < 1.0 else 5e-3
    design, draw = (
        design.replace(drive={"voltage": voltage}, readout={"offset_voltage": away}),
        np.random.default_rng(3),
    )
    assert design.adc is not None
    cells = 1e4 * 10 ** draw.uniform(-0.1, 0.1, (6, 5))
    cells[2, 3] = cells[4, 0] = inf
    read, volts = CountReader(design), scan(design, cells).volts
    for number in range(40):
        noise = draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
        reading = read(adc_codes(design, volts + noise))
        assert not reading.valid[np.isinf(cells)].any()
        if number > 4:
            assert reading.valid[np.isfinite(cells)].all()


@pytest.mark.parametrize("bits", [18, 20, 24])
@pytest.mark.parametrize("noise_volts", [1e-6, 8e-6, 2e-5])
def test_noise_of_fine_converters_brings_no_saturated_output_back_to_life(bits: int, noise_volts: float) -> None:
    """From the first frame on, in which nobody knows that the noise is many steps: up to 100 of 24 bits."""
    design = board(4, 3, 50.0, bits=bits, supply=[-0.1, 2.9])
    cells, draw = np.full((4, 3), 2e3), np.random.default_rng(bits)
    cells[1, 1] = cells[3, 1] = 60.0  # beyond the swing: each would be read as one that just reaches the limit
    volts = scan(design, cells).volts
    assert (volts[[1, 3], 1] == 2.9).all()
    for _ in range(30):
        read = CountReader(design)
        for _ in range(4):
            reading = read(adc_codes(design, volts + draw.normal(scale=noise_volts, size=volts.shape)))
            assert not reading.valid[[1, 3], 1].any()
    assert reading.valid[0, 0]


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
@pytest.mark.parametrize("seed", range(12))
def test_a_row_stands_no_lower_than_it_would_without_its_cells_below_the_range(idle_rows: str, seed: int) -> None:
    """Cells whose readings say at most what they conduct may conduct nothing: then their row loses less drive."""
    draw = np.random.default_rng(seed)
    lead = float(draw.choice([1.0, 100.0, 1000.0]))
    design = board(4, 5, lead, bits=int(draw.choice([12, 24])), supply=(-0.1, 3.2)).replace(
        array={"column_lead": 0.0}, drive={"idle_rows": idle_rows}, adc={"range": (0.2, 3.3)}
    )
    cells = 10 ** draw.uniform(2.7, 4.5, (4, 5))  # above 5 kohm below the range
    read = CountReader(design)
    for _ in range(3):
        reading = read(adc_codes(design, scan(design, cells).volts))
        off = np.abs(reading.resistance / cells - 1.0)[reading.valid]
        assert (off <= reading.uncertainty[reading.valid] * (1.0 + 1e-9)).all()
