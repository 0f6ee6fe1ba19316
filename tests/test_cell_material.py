"""The percolation law: its power, its pole, and the known cell on it; temperature and age; held loads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.cell import Cell, ContactModel, Percolation, drifted_rest_resistance
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


def test_the_equilibrium_of_a_cell_is_what_its_forward_model_settles_to() -> None:
    cell = Cell.example()
    contact = cell.replace(model=ContactModel(exponent=0.9, full_scale_resistance_ohm=500))
    for kind in (cell, contact, cell.replace(log_span=2.0)):
        forward = kind.forward(())
        forward.step(1.0, 0.7 * kind.full_scale_kpa)
        settled = float(forward.step(1e6, 0.7 * kind.full_scale_kpa))
        assert float(kind.equilibrium_ohm(0.7)) == pytest.approx(settled, rel=1e-9)
        assert kind.falls == (settled < kind.rest_resistance_ohm)


def test_temperature_and_age_move_the_rest_resistance() -> None:
    assert drifted_rest_resistance(1e4, temperature_change_c=1.0) == pytest.approx(1.07e4)
    warm = drifted_rest_resistance(1e4, temperature_change_c=3.0)
    assert drifted_rest_resistance(warm, temperature_change_c=-3.0) == pytest.approx(1e4)
    assert drifted_rest_resistance(1e4, age_s=9 * 3600, per_decade=0.05) == pytest.approx(1.05e4)
