"""What a held load settles to, temperature and age."""

import pytest

from ohmskin.cell import Cell, ContactModel
from ohmskin.cell.materials import _material as material


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
    assert material.drifted_rest_resistance(1e4, temperature_change_c=1.0) == pytest.approx(1.07e4)
    warm = material.drifted_rest_resistance(1e4, temperature_change_c=3.0)
    assert material.drifted_rest_resistance(warm, temperature_change_c=-3.0) == pytest.approx(1e4)
    assert material.drifted_rest_resistance(1e4, age_s=9 * 3600, per_decade=0.05) == pytest.approx(1.05e4)
