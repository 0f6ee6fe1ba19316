"""The percolation law: its power, its pole, and the known cell on it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.cell.materials._percolation import Percolation
from ohmskin.errors import InputError

LAW = Percolation(fraction=0.015, rest_resistance_ohm=10e3, sensitivity=0.775)


def test_the_known_cell_is_on_the_curve() -> None:
    assert LAW.rest_resistance(0.015) == pytest.approx(10e3, rel=1e-14)
    assert LAW.sensitivities(0.015) == pytest.approx(0.775, rel=1e-12)
    assert LAW.resistance(0.015, 0.0) == pytest.approx(10e3, rel=1e-14)


def test_conduction_is_a_power_of_the_distance_to_the_threshold() -> None:
    fractions = np.geomspace(0.008, 0.3, 30)
    slope = np.polyfit(np.log(fractions - 0.006), np.log(LAW.rest_resistance(fractions)), 1)[0]
    assert slope == pytest.approx(-2.0, rel=1e-12)


@given(st.floats(0.0111, 0.2), st.floats(1.001, 1.5))
def test_resistance_and_sensitivity_rise_as_the_fraction_falls(fraction: float, ratio: float) -> None:
    assert LAW.rest_resistance(fraction) > LAW.rest_resistance(fraction * ratio)
    assert LAW.sensitivities(fraction) > LAW.sensitivities(fraction * ratio) > 0


def test_at_the_threshold_nothing_conducts() -> None:
    assert np.isinf(LAW.rest_resistance([0.006, 0.001])).all()
    assert np.isinf(LAW.sensitivities([0.006, 0.0065])).all()


@pytest.mark.parametrize("wrong", [{"fraction": 0.005}, {"sensitivity": 0.0}, {"exponent": -1.0}])
def test_bad_families_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        Percolation(**{"fraction": 0.015, "rest_resistance_ohm": 10e3, "sensitivity": 0.775} | wrong)
