"""The converter behind the outputs: volts to codes and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, CodeArray, FloatArray
from ..errors import InputError
from ._design import Adc, Design


def adc_codes(design: Design, volts: FloatArray) -> CodeArray:
    """Codes of the converter: code k covers [k, k + 1) steps above the lower end; clipped at both ends.

    Offset and gain error move the input; the integral nonlinearity is a parabola over the range, since a data sheet
    gives its largest value only.
    """
    adc = _adc(design)
    steps = (np.asarray(volts, dtype=np.float64) - adc.range[0]) / adc.step
    if adc.gain_error or adc.offset_voltage:
        steps = steps * (1.0 + adc.gain_error) + adc.offset_voltage / adc.step
    if adc.inl_steps:
        share = np.clip(steps / 2.0**adc.bits, 0.0, 1.0)
        steps = steps + adc.inl_steps * 4.0 * share * (1.0 - share)
    return np.clip(np.floor(steps), 0, 2.0**adc.bits - 1).astype(np.uint32)


def volts_of_codes(design: Design, codes: NDArray[np.integer]) -> FloatArray:
    """What a host makes of codes, in V: the middle of each code's interval in an ideal converter.

    For that one the error of an unclipped code is at most half a step; the design's offset, gain and INL errors are
    what a host does not know, and :func:`adc_error` is what they can add.
    """
    adc = _adc(design)
    return adc.range[0] + (np.asarray(codes, dtype=np.float64) + 0.5) * adc.step


def adc_error(design: Design) -> float:
    """Largest difference in V between an input within range and what a host makes of its code."""
    adc = _adc(design)
    span = adc.range[1] - adc.range[0]
    return (0.5 + abs(adc.inl_steps)) * adc.step + abs(adc.offset_voltage) + abs(adc.gain_error) * span


def clipped(design: Design, codes: NDArray[np.integer]) -> BoolArray:
    """Where a code is the first or the last one, so that the volts are only known to lie at or beyond it."""
    return np.isin(codes, (0, 2 ** _adc(design).bits - 1))


def _adc(design: Design) -> Adc:
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    return design.adc
