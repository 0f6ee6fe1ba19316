"""P1 and P2 as laws: percolation, sensitivity, contact, temperature."""

import numpy as np
import pytest

from ohmskin.cell import Cell, ContactModel, material
from ohmskin.errors import InputError


def test_percolation_is_a_power_of_the_distance_to_the_threshold() -> None:
    above = np.array([0.001, 0.002, 0.004, 0.04])
    resistance = material.percolation_resistance(0.008 + above, exponent=1.95)
    assert np.diff(np.log(resistance)) / np.diff(np.log(above)) == pytest.approx(-1.95)
    assert material.percolation_resistance(0.015) == pytest.approx(10000)
    assert np.isinf(material.percolation_resistance([0.008, 0.001])).all()
    with pytest.raises(InputError, match="must lie above the threshold"):
        material.percolation_resistance(0.015, reference_fraction=0.005)


def test_sensitivity_rises_as_the_fraction_falls() -> None:
    """P1, Fig. 3: eight fractions down to 1.5 %; below that R0 explodes, at the threshold there is none."""
    fractions = np.linspace(0.015, 0.1, 8)
    sensitivity = material.percolation_sensitivity(fractions)
    assert (np.diff(sensitivity) < 0).all()
    assert (sensitivity > 0).all()
    assert np.isinf(material.percolation_sensitivity(0.009))
    assert np.isnan(material.percolation_sensitivity(0.008))


def test_sensitivity_of_a_cell_is_what_its_forward_model_settles_to() -> None:
    cell = Cell.example()
    contact = cell.model_copy(update={"model": ContactModel(exponent=0.9, full_scale_resistance_ohm=500)})
    for kind in (cell, contact):
        forward = kind.forward(())
        forward.step(1.0, kind.full_scale_kpa)
        settled = float(forward.step(1e6, kind.full_scale_kpa)) / kind.rest_resistance_ohm - 1
        found = material.sensitivity(kind.model, kind.full_scale_kpa, kind.rest_resistance_ohm)
        assert found == pytest.approx(settled, rel=1e-9)


def test_contact_resistance_is_a_power_of_the_force() -> None:
    force = np.array([1.0, 2.0, 4.0])
    resistance = material.contact_resistance(force, coefficient=1000, exponent=0.7)
    assert resistance == pytest.approx(1000 * force**-0.7)
    assert np.isinf(material.contact_resistance(0.0, coefficient=1000))
    assert material.contact_resistance(0.0, coefficient=1000, rest_resistance_ohm=5e4) == pytest.approx(5e4)


def test_temperature_and_age_move_the_rest_resistance() -> None:
    assert material.drifted_rest_resistance(1e4, temperature_change_c=1.0) == pytest.approx(1.07e4)
    warm = material.drifted_rest_resistance(1e4, temperature_change_c=3.0)
    assert material.drifted_rest_resistance(warm, temperature_change_c=-3.0) == pytest.approx(1e4)
    assert material.drifted_rest_resistance(1e4, age_s=9 * 3600, per_decade=0.05) == pytest.approx(1.05e4)
