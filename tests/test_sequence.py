"""Sequences of frames: interpolation between exact frames keeps its certified error, and falls back where it must."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import Design, scan_batch, scan_sequence
from ohmskin.circuits.solvers import exact_transfer, sequence_transfer
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


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    frames=st.integers(3, 9),
    change=st.sampled_from([1e-3, 0.1, 1.0, 10.0]),
    loss=st.sampled_from([1e-4, 1e-2, 0.05, 0.2]),
    straight=st.booleans(),
)
def test_the_certificate_holds_however_much_it_allows(
    seed: int, shape: tuple[int, int], frames: int, change: float, loss: float, straight: bool
) -> None:
    """With everything allowed there are two knots, and the error is as large as the certificate says or smaller."""
    random = np.random.default_rng(seed)
    total_ohm = loss * 1e4 / max(shape)  # of a line, so that about ``loss`` of the drive is lost along it
    lead, segment = random.uniform(0, total_ohm, 2) / (1.0, max(shape))
    board = Design.model_validate(
        {
            "array": {
                "rows": shape[0],
                "columns": shape[1],
                "row_lead": lead,
                "column_lead": total_ohm - lead,
                "row_segment": segment,
                "column_segment": segment,
            },
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1e3},
        }
    ).board
    assert board.linear is not None
    assert board.linear.wires is not None
    lines = board.linear.lines
    first = 1e-4 * random.uniform(0.1, 1.0, shape)
    last = first + change * 1e-4 * random.uniform(0, 1, shape) * (random.random(shape) < 0.5)
    way = np.linspace(0, 1, frames) if straight else random.uniform(0, 1, frames)
    conductance = first + way[:, None, None] * (last - first)
    conductance[[0, -1]] = first, last
    found = sequence_transfer(conductance, board.linear.wires, lambda some: exact_transfer(some, lines), np.inf)
    exact, _ = exact_transfer(conductance, lines)
    off = np.abs(found.transfer - exact).max(axis=(1, 2))
    assert (off <= found.error + 1e-15 * exact.max()).all()
    if change <= 0.1 and loss <= 0.05:
        assert np.isfinite(found.error).all()
