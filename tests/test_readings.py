"""What a reader hands to an estimator: conductances, and errors that are those of the readings."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from designs import digitised

from ohmskin.circuits import Design, Reason, adc_codes, scan
from ohmskin.driver import CountReader


def board(kind: str, bits: int = 12, **readout: Any) -> Design:
    return digitised(kind, 6, 5, bits, array={"row_lead": 5.0, "column_lead": 5.0}, readout=readout)


@pytest.mark.parametrize("name", ["grounded", "divider", "loaded", "feedback"])
def test_variances_and_what_a_column_shares_are_those_of_repeated_readings(name: str) -> None:
    design, draw = board(name, 16), np.random.default_rng(3)
    assert design.adc is not None
    cells = 6e3 * 10 ** draw.uniform(-0.3, 0.3, (6, 5))
    volts, read, found = scan(design, cells).volts, CountReader(design), []
    for _ in range(300):
        noisy = volts + draw.normal(scale=4.0 * design.adc.step, size=volts.shape)
        found.append(read(adc_codes(design, noisy)))
    seen = np.array([each.conductance for each in found[100:]])
    told = found[-1]
    expected = told.noise_variance + told.column_std**2
    assert 0.7 < np.mean(np.var(seen, axis=0) / expected) < 1.2
    assert (np.abs(seen.mean(axis=0) * cells - 1.0) < 0.01).all()
    deviation = seen - seen.mean(axis=0)
    together = np.mean(deviation[:, 0] * deviation[:, 3], axis=0) / (told.column_std[0] * told.column_std[3] + 1e-30)
    if name in ("divider", "loaded"):
        assert together.mean() == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("name", ["grounded", "floating", "divider", "loaded", "open divider", "feedback"])
def test_steps_without_noise_are_within_what_is_stated(name: str) -> None:
    design, draw = board(name, 10), np.random.default_rng(5)
    for _ in range(5):
        cells = 6e3 * 10 ** draw.uniform(-0.3, 0.3, (6, 5))
        read = CountReader(design)
        for _ in range(4):
            reading = read(adc_codes(design, scan(design, cells).volts))
        told, known = reading, reading.valid
        assert known.any()
        off = np.abs(told.conductance - 1.0 / cells)[known]
        assert (
            np.mean(
                off
                <= 1.01 * np.hypot(told.half_step, told.column_half_step)[known]
                + 4.0 * np.sqrt(told.noise_variance[known])
            )
            > 0.9
        )


@pytest.mark.parametrize("name", ["grounded", "feedback", "divider"])
@pytest.mark.parametrize("odd", [1e-2, np.inf])
def test_a_reading_at_a_limit_is_an_interval(name: str, odd: float) -> None:
    design = board(name, **({} if name == "divider" else {"supply": (-0.2, 3.3)}))
    cells = np.full((6, 5), 6e3)
    cells[2, 3] = odd
    read = CountReader(design)
    for _ in range(4):
        reading = read(adc_codes(design, scan(design, cells).volts))
    told = reading
    assert not reading.valid[2, 3]
    assert told.least[2, 3] <= 1.0 / odd <= told.greatest[2, 3]
    assert np.isnan(told.conductance[2, 3]) or told.conductance[2, 3] == pytest.approx(1.0 / odd, rel=1.0)
    known = reading.valid
    assert (np.abs(told.conductance[known] * cells[known] - 1.0) <= reading.uncertainty[known]).all()


def test_what_is_not_known_has_no_value() -> None:
    design = board("open divider")
    cells = np.full((6, 5), 6e3)
    cells[2, 3] = 1e-3
    told = CountReader(design)(adc_codes(design, scan(design, cells).volts))
    unknown = ~told.valid
    assert unknown[2, 3]
    assert np.isnan(told.conductance[unknown]).all()
    assert (told.noise_variance[unknown] == 0.0).all()
    assert np.isinf(told.greatest[unknown]).all()


DRIVEN_BELOW = {
    "amplifiers": (
        {"selected": ["V1 s ref -1", "R1 s line 20"], "idle": ["R1 line ref 20"]},
        ["X1 ref line out opamp open_loop_gain=2e4", "R1 line out 2.2k"],
        0.5,
    ),
    "two stages": (
        {"selected": ["V1 s 0 -1", "R1 s line 20"], "idle": ["R1 line 0 20"]},
        ["X1 0 line a opamp", "R1 line a 2.2k", "R2 a b 10k", "R3 b out 10k", "X2 0 b out opamp"],
        0.0,
    ),
    "pulled up": (
        {"selected": ["R1 line 0 25"], "idle": ["V1 vcc 0 3", "R1 vcc line 25"]},
        ["V1 vcc 0 3", "R1 vcc line 5k"],
        0.0,
    ),
}


@pytest.mark.parametrize("kind", DRIVEN_BELOW)
def test_a_short_of_a_described_board_stands_at_the_limit_of_most_current(kind: str) -> None:
    """Whichever way the drive and the ends turn it; what a short may take from its row's drive counts in the others."""
    row_end, parts, level = DRIVEN_BELOW[kind]
    tables = {
        "array": {"rows": 6, "columns": 5, "row_lead": 6.0, "column_lead": 9.0},
        "row_end": row_end,
        "column_end": {"parts": parts},
        "readout": {"reference_voltage": level},
    }
    cells = 9e3 * np.exp(np.random.default_rng(3).uniform(-0.1, 0.1, (6, 5)))
    usual = scan(Design.model_validate(tables), cells).volts
    cells[3, 2] = 0.05
    short = scan(Design.model_validate(tables), cells).volts[3, 2]
    near, far = usual[3, 2] + 0.6 * (short - usual[3, 2]), usual[3, 2] - 2.0 * (short - usual[3, 2])
    board = Design.model_validate(tables | {"adc": {"bits": 16, "range": sorted((near, far))}})
    read = CountReader(board)
    for _ in range(4):
        measured = read(adc_codes(board, scan(board, cells).volts))
    assert measured.reason[3, 2] == Reason.SATURATED
    valid = measured.valid
    error = np.abs(measured.resistance[valid] / cells[valid] - 1.0)
    assert (error <= measured.uncertainty[valid]).all()
