"""The converter: ideal codes, and the errors a data sheet names."""

from __future__ import annotations

import numpy as np
import pytest
from designs import amplifier
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.circuits import Adc, Design, adc_codes, adc_error, clipped, volts_of_codes
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
