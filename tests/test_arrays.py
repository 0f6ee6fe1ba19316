"""The median of a small array, and rows that are spaced for the cache."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from ohmskin.common.arrays import FloatArray, columns, median, spaced, spaced_columns, whole


@given(arrays(np.float64, array_shapes(max_dims=2, max_side=20), elements=st.floats(-1e150, 1e150)))
def test_the_median_is_numpy_s_and_leaves_the_values_alone(values: FloatArray) -> None:
    before = values.copy()
    assert median(values) == float(np.median(values))
    assert median(values[::-1]) == median(values)
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("columns_of", [1, 7, 8, 256, 300])
def test_spaced_rows_hold_the_same_and_begin_an_odd_number_of_lines_apart(columns_of: int) -> None:
    rows = np.random.default_rng(0).normal(size=(5, columns_of))
    apart = spaced(rows)
    np.testing.assert_array_equal(apart, rows)
    assert_odd_number_of_lines_apart(apart)
    places = np.array([columns_of - 1, 0, columns_of // 2])
    for some in (rows, apart, apart[:], apart[1:3], apart[:, : columns_of // 2 + 1], apart[:, 1:]):
        inside = places[places < some.shape[1]]
        np.testing.assert_array_equal(columns(some, inside), some[:, inside])
        found = spaced_columns(some, inside)
        np.testing.assert_array_equal(found, some[:, inside])
        assert_odd_number_of_lines_apart(found)
        assert whole(found) is found.base
        assert whole(some).shape[1] >= some.shape[1]
        np.testing.assert_array_equal(whole(some)[:, : some.shape[1]], some)


def assert_odd_number_of_lines_apart(rows: FloatArray) -> None:
    lines, rest = divmod(rows.strides[0], 64)
    assert (lines % 2, rest) == (1, 0)
