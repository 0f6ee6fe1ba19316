"""The reference must be right before it may judge: closed forms."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from designs import amplifier, divider

from ohmskin.bench._reference import Indeterminate, reference_volts


def test_ideal_amplifier() -> None:
    cells = np.array([[1e3, 2e3, inf], [5e2, 1e5, 3e4]])
    np.testing.assert_allclose(reference_volts(amplifier(2, 3), cells), 1e3 / cells, rtol=1e-15)


@pytest.mark.parametrize("shape", [(1, 1), (4, 4), (3, 5)])
def test_uniform_floating_divider(shape: tuple[int, int]) -> None:
    n, m = shape
    equivalent = 5e3 * (n + m - 1) / (n * m)
    volts = reference_volts(divider(n, m), np.full(shape, 5e3))
    np.testing.assert_allclose(volts, 1e3 / (1e3 + equivalent), rtol=1e-15)


def test_one_cell_with_every_part() -> None:
    """One column is one equation: v_out = A (Vref + Vos - v_minus), with (v_minus - v_out)/Rref = i - Ib."""
    design = amplifier(
        1, 1, lead=10.0, open_loop_gain=100.0, offset_voltage=2e-3, bias_current=1e-6, reference_voltage=1.5
    )
    (volts,) = reference_volts(design, [[980.0]]).ravel()
    minus = 1.502 - volts / 100.0
    current = (0.5 - minus) / 1000.0
    assert (minus - volts) / 1000.0 == pytest.approx(current - 1e-6, rel=1e-12)


def test_a_saturated_column_loses_its_virtual_ground() -> None:
    volts = reference_volts(amplifier(1, 1, supply=(0.0, 3.0)), [[100.0]])
    assert volts == pytest.approx(3.0)


def test_a_row_of_two_columns_that_float_is_parts_in_series() -> None:
    array = {"row_lead": 3.0, "row_segment": 5.0, "column_segment": 11.0, "column_lead": [7.0, 13.0]}
    volts = reference_volts(divider(1, 2, **array), [[80.0, 90.0]])
    np.testing.assert_allclose(volts, [[1e3 / (1e3 + 3 + 80 + 7), 1e3 / (1e3 + 3 + 5 + 90 + 13)]], rtol=1e-15)


def test_a_follower_of_gain_one_halves_what_it_follows() -> None:
    design = amplifier(1, 1, circuit="voltage-feedback", open_loop_gain=1.0, offset_voltage=1e-3)
    (volts,) = reference_volts(design, [[1000.0]]).ravel()
    assert volts == pytest.approx((-0.5 + 1e-3) / 2.0, rel=1e-15)


def test_a_row_amplifier_reads_the_transpose() -> None:
    cells = np.array([[1e3, 2e3, inf], [5e2, 1e5, 3e4]])
    parts = {"lead": 20.0, "segment": 3.0, "open_loop_gain": 1e3}
    volts = reference_volts(amplifier(2, 3, circuit="row-amplifier", **parts), cells)
    turned = reference_volts(amplifier(3, 2, **parts), cells.T[::-1, ::-1])[::-1, ::-1].T
    np.testing.assert_array_equal(volts, turned)


def test_nearly_singular_circuits_are_told_from_singular_ones() -> None:
    design = amplifier(2, 1, lead=1e-30)
    np.testing.assert_allclose(reference_volts(design, [[0.0], [1e3]]), [[5e32], [0.5]], rtol=1e-12)


def test_an_ideal_amplifier_on_a_driver_has_no_answer() -> None:
    with pytest.raises(Indeterminate):
        reference_volts(amplifier(2, 1), [[0.0], [1e3]])
