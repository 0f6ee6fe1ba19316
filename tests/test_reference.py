"""The reference must be right before it may judge: closed forms, and its own arithmetic in 50 digits."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from designs import amplifier, divider
from reference import Indeterminate, reference_volts
from variety import any_design


def test_ideal_amplifier() -> None:
    cells = np.array([[1e3, 2e3, inf], [5e2, 1e5, 3e4]])
    np.testing.assert_allclose(reference_volts(amplifier(2, 3), cells, 50), 1e3 / cells, rtol=1e-15)


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (3, 5)])
def test_uniform_floating_divider(shape: tuple[int, int]) -> None:
    n, m = shape
    equivalent = 5e3 * (n + m - 1) / (n * m)
    volts = reference_volts(divider(n, m), np.full(shape, 5e3), 50)
    np.testing.assert_allclose(volts, 1e3 / (1e3 + equivalent), rtol=1e-15)


def test_one_cell_with_every_part() -> None:
    """One column is one equation: v_out = A (Vref + Vos - v_minus), with (v_minus - v_out)/Rref = i - Ib."""
    design = amplifier(
        1, 1, lead=10.0, open_loop_gain=100.0, offset_voltage=2e-3, bias_current=1e-6, reference_voltage=1.5
    )
    (volts,) = reference_volts(design, [[980.0]], 50).ravel()
    minus = 1.502 - volts / 100.0
    current = (0.5 - minus) / 1000.0
    assert (minus - volts) / 1000.0 == pytest.approx(current - 1e-6, rel=1e-12)


def test_a_saturated_column_loses_its_virtual_ground() -> None:
    volts = reference_volts(amplifier(1, 1, supply=(0.0, 3.0)), [[100.0]], 50)
    assert volts == pytest.approx(3.0)


@pytest.mark.parametrize("seed", range(40))
def test_double_precision_agrees_with_fifty_digits(seed: int) -> None:
    design, cells = any_design(seed)
    np.testing.assert_allclose(
        reference_volts(design, cells), reference_volts(design, cells, 50), rtol=1e-7, atol=1e-12
    )


def test_an_ideal_amplifier_on_a_driver_has_no_answer() -> None:
    with pytest.raises(Indeterminate):
        reference_volts(amplifier(2, 1), [[0.0], [1e3]], 50)
