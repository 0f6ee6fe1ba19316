"""0 ohm, open lines and infinite gain where nothing else sets a scale: limits by hand, and refusals by name."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
import pytest
from designs import amplifier, divider

from ohmskin.circuits import Design, scan
from ohmskin.errors import SolverError


def with_column_lead(design: Design, ohms: float) -> Design:
    return design.replace(array={"column_lead": ohms})


def read(design: Design, cells: Any) -> np.ndarray:
    return scan(design, cells).volts


@pytest.mark.parametrize("idle_rows", ["float", "ground"])
@pytest.mark.parametrize("idle_columns", ["float", "load"])
def test_nothing_but_shorts_and_opens_on_a_divider(idle_rows: str, idle_columns: str) -> None:
    design = divider(2, 2, idle_rows=idle_rows, idle_columns=idle_columns)
    np.testing.assert_allclose(read(design, [[0, inf], [inf, 0]]), np.eye(2), atol=1e-12)
    halved = with_column_lead(design, 1000.0)
    np.testing.assert_allclose(read(halved, [[0, inf], [inf, 0]]), np.eye(2) / 2, atol=1e-12)


@pytest.mark.parametrize("gain", [2.57, 68.0, 1e5, 1e9, 1e12])
@pytest.mark.parametrize("others", [1e4, 1e6, inf])
def test_a_short_on_a_finite_amplifier_gives_its_open_loop(gain: float, others: float) -> None:
    """The driver holds the inverting input: v = -A Vin, whatever Rref and the other cells."""
    volts = read(amplifier(2, 2, open_loop_gain=gain), [[0, others], [others, others]])
    assert volts[0, 0] == pytest.approx(gain, rel=1e-12)
    assert abs(volts[1, 0]) < 1e-12  # the grounded idle driver holds it then


@pytest.mark.parametrize("others", [1e4, 1e9, 1e15])
@pytest.mark.parametrize("lead", [1.0, 1e-3, 1e-6])
def test_a_short_has_no_resistance_of_its_own(others: float, lead: float) -> None:
    volts = read(with_column_lead(amplifier(2, 2), lead), [[0, others], [others, others]])
    assert volts[0, 0] == pytest.approx(1000.0 / lead, rel=1e-11)


def test_supply_limits_the_infinite() -> None:
    for others in (1e13, inf):
        result = scan(amplifier(2, 2, supply=(-3.0, 3.0)), [[0, others], [others, others]])
        assert result.volts[0, 0] == 3.0
        assert result.saturated.tolist() == [[True, False], [False, False]]


def test_nothing_leaks_over_an_ideal_line() -> None:
    design = amplifier(3, 3, segment=1.0).model_copy()
    array = design.array.replace(row_lead=0.0, column_lead=5.0, row_segment=0.0)
    result = scan(design.replace(array=array), [[1e3, inf, 1e4], [1e3, 1e4, 1e4], [inf, 1e4, 1e4]])
    open_cells = np.array([[False, True, False], [False, False, False], [True, False, False]])
    assert (result.volts[open_cells] == 0).all()
    assert np.isinf(result.resistance[open_cells]).all()
    assert (result.volts[~open_cells] > 1e-2).all()


@pytest.mark.parametrize("vref", [0.0, 1.65])
@pytest.mark.parametrize("lead", [1.0, 1e-3, 1e-6])
@pytest.mark.parametrize("parts", [{}, {"offset_voltage": 5e-3}, {"open_loop_gain": 1e9}])
def test_a_reference_voltage_costs_no_digits(vref: float, lead: float, parts: dict[str, float]) -> None:
    """Three shorts in a row tie the columns together, far more strongly than the signal drives them."""
    cells = np.full((3, 3), 1e4)
    cells[0] = 0.0
    design = with_column_lead(amplifier(3, 3, reference_resistance=1e4, **parts), lead)
    design = design.replace(array={"row_lead": 100.0})
    base = read(design, cells)
    lifted = design.replace(readout={"reference_voltage": vref})
    share = design.readout.open_loop_gain
    droop = 0.0 if np.isinf(share) else vref / share  # of the level itself, at a finite gain: tested elsewhere
    np.testing.assert_allclose(read(lifted, cells) - vref, base, atol=np.abs(base).max() * 1e-12 + 1e5 * droop)


@pytest.mark.parametrize(
    ("design", "cells", "who"),
    [
        (divider(2, 1, idle_rows="ground"), [[0], [0]], "row drivers 0 and 1"),
        (amplifier(2, 1, open_loop_gain=1e5), [[0], [0]], "row drivers 0 and 1"),
        (amplifier(1, 3), [[0, 1e4, 0]], "ideal amplifiers of columns 0 and 2"),
    ],
)
def test_contradictions_are_refused_by_name(design: Design, cells: Any, who: str) -> None:
    with pytest.raises(SolverError, match=f"the {who} are joined by parts of 0 ohm"):
        read(design, cells)
