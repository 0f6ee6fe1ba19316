"""The median of a small array."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from ohmskin.common.arrays import FloatArray, median


@given(arrays(np.float64, array_shapes(max_dims=2, max_side=20), elements=st.floats(-1e150, 1e150)))
def test_the_median_is_numpy_s_and_leaves_the_values_alone(values: FloatArray) -> None:
    before = values.copy()
    assert median(values) == float(np.median(values))
    assert median(values[::-1]) == median(values)
    np.testing.assert_array_equal(values, before)
