"""The converter: ideal codes, and the errors a data sheet names."""

from __future__ import annotations

import numpy as np
import pytest
from designs import amplifier
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.circuits import (
    Adc,
    Design,
    adc_codes,
    adc_error,
    clipped,
    conversion_changes,
    conversion_limits,
    volts_of_codes,
)
from ohmskin.errors import InputError


def converter(**adc: float) -> Design:
    return amplifier(1, 1).replace(adc=Adc(bits=12, range=(-0.5, 3.5), **adc))


@given(st.floats(-0.5, 3.499))
def test_an_ideal_code_is_at_most_half_a_step_off(volts: float) -> None:
    design = converter()
    assert abs(volts_of_codes(design, adc_codes(design, np.array(volts))) - volts) <= 4 / 2**13 + 1e-15


@given(st.floats(-0.4, 3.4), st.floats(-0.02, 0.02), st.floats(-0.01, 0.01), st.floats(-8.0, 8.0))
def test_a_real_code_is_within_the_stated_error(volts: float, offset: float, gain: float, inl: float) -> None:
    design = converter(offset_voltage=offset, gain_error=gain, inl_steps=inl)
    codes = adc_codes(design, np.array(volts))
    if not clipped(design, codes):
        # The bow and the slope act on what the others have moved: second order.
        slack = abs(gain * offset) + abs(inl) * 4 / 2**12 * 4 * (abs(gain) + abs(offset) / 4)
        assert abs(volts_of_codes(design, codes) - volts) <= adc_error(design) + slack + 1e-12


def test_each_error_by_its_definition() -> None:
    volts = np.array([-0.5, 1.5, 3.5]) + 1e-9
    at = adc_codes(converter(), volts).astype(int)
    step = 4 / 2**12
    assert (adc_codes(converter(offset_voltage=10 * step), volts) - at).tolist() == [
        10,
        10,
        0,
    ]  # the last one is clipped
    assert (adc_codes(converter(gain_error=0.01), volts) - at).tolist() == [0, 20, 0]
    assert (adc_codes(converter(inl_steps=5.0), volts) - at).tolist() == [0, 5, 0]
    assert (adc_codes(converter(gain_error=-0.01), volts) - at).tolist()[2] == -41 + 1


def test_what_lies_beyond_the_range_is_clipped_and_known_to_be() -> None:
    design = converter()
    codes = adc_codes(design, np.array([-9.0, 0.0, 9.0]))
    assert codes[[0, 2]].tolist() == [0, 4095]
    assert clipped(design, codes).tolist() == [True, False, True]


def test_without_an_adc_there_are_no_codes() -> None:
    with pytest.raises(InputError, match=r"no \[adc\] section"):
        adc_codes(amplifier(1, 1), np.zeros((1, 1)))


def shifted(design: Design, *inputs: np.ndarray, places: int = 4001) -> list[np.ndarray]:
    """What a host makes of inputs if the thresholds lie elsewhere, and it knows that: (places, ...) each."""
    assert design.adc is not None
    shift = np.linspace(-0.5, 0.5, places)[:, None] * design.adc.step
    return [volts_of_codes(design, adc_codes(design, volts + shift)) - shift for volts in inputs]


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_conversion_limits_are_those_of_all_places_within_a_step(inputs: list[float], seed: int) -> None:
    design, volts = converter().replace(adc={"bits": 8}), np.array(inputs)
    (read,) = shifted(design, volts)
    low, high = conversion_limits(design, volts)
    assert design.adc is not None
    step = design.adc.step
    np.testing.assert_allclose(read.min(axis=0), low, atol=step / 1000)
    np.testing.assert_allclose(read.max(axis=0), high, atol=step / 1000)


@given(st.lists(st.tuples(st.floats(0.2, 3.0), st.integers(-50, 50)), min_size=1, max_size=5))
def test_conversion_changes_are_the_extremes_of_all_places_within_a_step(readings: list[tuple[float, float]]) -> None:
    """Any function that is monotonic in both readings is largest and smallest at these places."""
    design = converter().replace(adc={"bits": 8})
    assert design.adc is not None
    before = np.array([volts for volts, _ in readings])
    after = before + np.array([twentieths / 20.0 for _, twentieths in readings]) * design.adc.step
    pairs = conversion_changes(design, before, after)
    for quantity in (lambda one, other: other - one, lambda one, other: (other + 1.0) / (one + 1.0)):
        everywhere, extreme = quantity(*shifted(design, before, after)), quantity(*pairs)
        np.testing.assert_allclose(everywhere.max(axis=0), extreme.max(axis=0), atol=design.adc.step / 500)
        np.testing.assert_allclose(everywhere.min(axis=0), extreme.min(axis=0), atol=design.adc.step / 500)


def test_a_change_of_nothing_shows_nowhere_and_a_small_one_as_a_whole_step() -> None:
    design = converter()
    assert design.adc is not None
    before = np.ones(4)
    one, other = conversion_changes(design, before, before + np.array([0.0, 1e-14, 1e-5, -1e-5]) * design.adc.step)
    np.testing.assert_allclose(np.abs(other - one).max(axis=0) / design.adc.step, [0.0, 0.0, 1.0, 1.0], atol=1e-9)


def test_the_converters_own_errors_count_as_they_are() -> None:
    design = converter(offset_voltage=0.4 * 4 / 2**12)
    low, high = conversion_limits(design, np.array([1.0]))
    np.testing.assert_allclose([low, high], np.array([[1.0 - 0.1 * 4 / 2**12], [1.0 + 0.9 * 4 / 2**12]]), rtol=1e-12)
