"""Sequences of frames: interpolation between exact frames keeps its certified error, and falls back where it must."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import Design, scan_batch, scan_sequence
from ohmskin.errors import InputError

TABLES = {
    "array": {
        "rows": 6,
        "columns": 7,
        "row_lead": 60.0,
        "column_lead": 20.0,
        "row_segment": 1.0,
        "column_segment": 2.0,
    },
    "drive": {"voltage": -1.0},
    "readout": {"circuit": "inverting-amplifier", "reference_resistance": 20e3},
    "adc": {"bits": 12, "range": [0.0, 3.3]},
}
DESIGN = Design.model_validate(TABLES)


def press(seed: int, frames: int, shape: tuple[int, int], *, speed: float = 0.02, rest: float = 10e3) -> np.ndarray:
    """Cells (frames, rows, columns) in ohm under two fingers that slide, and one cell that is tapped."""
    random = np.random.default_rng(seed)
    row, column = np.mgrid[: shape[0], : shape[1]]
    time = np.arange(frames)[:, None, None]
    pressed = np.zeros((frames, *shape))
    for _ in range(2):
        start, way = random.uniform(0, shape), random.normal(size=2) * speed
        away = (row - start[0] - way[0] * time) ** 2 + (column - start[1] - way[1] * time) ** 2
        pressed += random.uniform(0.2, 1.5) * np.exp(-away)
    pressed[frames // 3 : frames // 2, random.integers(shape[0]), random.integers(shape[1])] += 2.0
    return rest * (1.0 + pressed)


def step_errors(design: Design, cells: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Largest true error of each frame in ADC steps, checked against the bound; and the methods."""
    assert design.adc is not None
    read = scan_sequence(design, cells)
    exact = scan_batch(design, cells, method="exact")
    off = np.abs(read.volts - exact.volts).max(axis=(1, 2))
    largest = np.abs(read.volts).max(axis=(1, 2))
    assert (off <= read.error_bound * largest + 1e-12).all()
    np.testing.assert_array_equal(read.saturated, exact.saturated)
    return off / design.adc.step, read.method


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    frames=st.integers(3, 40),
    speed=st.sampled_from([0.0, 0.003, 0.05, 1.0]),
    rest=st.sampled_from([1e3, 1e4, 1e6]),
    segment=st.sampled_from([0.0, 0.2, 5.0, 100.0]),
    bits=st.sampled_from([8, 12, 16]),
)
def test_no_output_is_off_by_more_than_a_quarter_step(
    seed: int, frames: int, speed: float, rest: float, segment: float, bits: int
) -> None:
    design = DESIGN.replace(
        array={"row_segment": segment, "column_segment": segment},
        readout={"reference_resistance": 2.0 * rest, "open_loop_gain": 1e4},
        adc={"bits": bits},
    )
    errors, _ = step_errors(design, press(seed, frames, (6, 7), speed=speed, rest=rest))
    assert errors.max() <= 0.25


def test_slow_sequences_are_mostly_interpolated_and_jumps_are_solved() -> None:
    cells = press(1, 65, (6, 7), speed=0.01)
    _, methods = step_errors(DESIGN, cells)
    assert methods.count("interpolation") > 40
    jump = 65 // 3
    assert {methods[jump - 1], methods[jump]} == {"exact"}


def test_resting_frames_are_solved_once() -> None:
    cells = np.full((20, 6, 7), 5e3)
    errors, methods = step_errors(DESIGN, cells)
    assert methods.count("exact") == 1
    assert errors.max() < 1e-9


@pytest.mark.parametrize(
    "changes",
    [
        {"readout": {"offset_voltage": 2e-3, "open_loop_gain": 1e5, "supply": [0.0, 3.3]}},
        {"readout": {"reference_voltage": 1.0, "supply": [0.0, 3.3]}},
        {"array": {"row_lead": [10.0, 20.0, 30.0, 40.0, 50.0, 60.0]}},
        {"fault": [{"kind": "open-cell", "place": [1, 1]}], "readout": {"supply": [0.0, 3.3]}},
        {"array": {"row_lead": 0.0, "column_lead": 0.0, "row_segment": 0.0, "column_segment": 0.0}},
    ],
)
def test_boards_of_many_kinds_keep_the_bound(changes: dict[str, object]) -> None:
    errors, methods = step_errors(DESIGN.replace(**changes), press(4, 33, (6, 7), speed=0.02))
    assert errors.max() <= 0.25
    assert "interpolation" in methods


def test_outputs_that_saturate_are_read_exactly() -> None:
    design = DESIGN.replace(readout={"supply": [0.0, 1.5]})
    cells = press(4, 33, (6, 7))
    errors, methods = step_errors(design, cells)
    assert errors.max() <= 0.25
    assert scan_batch(design, cells).saturated.any()
    assert set(methods) == {"exact"}


@pytest.mark.parametrize(
    "changes",
    [
        {"readout": {"circuit": "voltage-divider"}},
        {"drive": {"idle_rows": "float"}},
        {"fault": [{"kind": "broken-row", "place": [2, 3]}]},
        {"fault": [{"kind": "shorted-cell", "place": [2, 3]}]},
        {"fault": [{"kind": "bridged-rows", "place": [2, 3], "resistance": 100.0}]},
    ],
)
def test_what_attenuation_cannot_express_is_read_as_a_batch(changes: dict[str, object]) -> None:
    design = DESIGN.replace(**changes)
    cells = press(2, 5, (6, 7))
    np.testing.assert_array_equal(scan_sequence(design, cells).volts, scan_batch(design, cells).volts)


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(InputError, match=r"expected \(frames, 6, 7\)"):
        scan_sequence(DESIGN, np.ones((3, 2, 2)))
    with pytest.raises(InputError, match="expected more than 0"):
        scan_sequence(DESIGN, np.ones((3, 6, 7)), error_volts=0.0)
    with pytest.raises(InputError, match=r"no \[adc\] section"):
        scan_sequence(DESIGN.replace(adc=None), np.ones((3, 6, 7)))
