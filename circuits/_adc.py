"""ADC model: volts to codes and back, with offset, gain error, integral nonlinearity and quantisation."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import BoolArray, CodeArray, FloatArray
from ..errors import InputError
from ._sections import Adc


class Converts(Protocol):
    """An object with an [adc] section: a design, or its board."""

    @property
    def adc(self) -> Adc | None: ...


def adc_codes(design: Converts, volts: FloatArray) -> CodeArray:
    """Codes of the converter: code k covers [k, k + 1) steps above the lower end; clipped at both ends.

    Offset and gain error shift the input. The integral nonlinearity is modelled as a parabola over the range, since a
    data sheet gives only its largest value.
    """
    adc = _adc(design)
    errors = np.array([adc.offset_voltage, adc.gain_error, adc.inl_steps])
    return np.clip(np.floor(_steps(adc, volts, errors)), 0, 2.0**adc.bits - 1).astype(np.uint32)


def _steps(adc: Adc, volts: FloatArray, errors: FloatArray) -> FloatArray:
    """Inputs in steps above the lower end of the range, shifted by the errors: the code is the integer part."""
    offset, slope, bow = np.moveaxis(errors, -1, 0)
    steps = (np.asarray(volts, dtype=np.float64) - adc.range[0]) / adc.step
    if errors.any():
        steps = steps * (1.0 + slope) + offset / adc.step
        share = np.clip(steps / 2.0**adc.bits, 0.0, 1.0)
        steps = steps + bow * 4.0 * share * (1.0 - share)
    return steps


def at_ideal_converter(design: Converts, volts: FloatArray, errors: FloatArray) -> FloatArray:
    """Volts of which an ideal converter makes the codes that one with these errors makes of ``volts``.

    Args:
        design: one without a converter has no errors.
        volts: of any shape.
        errors: (..., 3) offset in V, relative error of the slope, and integral nonlinearity in steps; broadcast.
    """
    if design.adc is None:
        return volts
    return design.adc.range[0] + design.adc.step * _steps(design.adc, volts, errors)


def volts_of_codes(design: Converts, codes: NDArray[np.integer]) -> FloatArray:
    """Volts that a host computes from codes: the middle of each code's interval in an ideal converter.

    With an ideal converter the error of an unclipped code is at most half a step. A host does not know the converter's
    offset, gain and INL errors; :func:`adc_error` bounds the total error with them.
    """
    adc = _adc(design)
    return adc.range[0] + (np.asarray(codes, dtype=np.float64) + 0.5) * adc.step


def adc_error(design: Converts) -> float:
    """Largest difference in V between an input within range and the volts that a host computes from its code."""
    adc = _adc(design)
    span = adc.range[1] - adc.range[0]
    return (0.5 + abs(adc.inl_steps)) * adc.step + abs(adc.offset_voltage) + abs(adc.gain_error) * span


def clipped(design: Converts, codes: NDArray[np.integer]) -> BoolArray:
    """True where a code is the first or the last one, which only shows that the volts lie at or beyond that code."""
    return np.isin(codes, (0, 2 ** _adc(design).bits - 1))


def _adc(design: Converts) -> Adc:
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    return design.adc
