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
    return np.clip(np.floor(_steps(adc, volts)), 0, 2.0**adc.bits - 1).astype(np.uint32)


def _steps(adc: Adc, volts: FloatArray) -> FloatArray:
    """Inputs in steps above the lower end of the range, shifted by the converter's offset, gain error and nonlinearity.

    The code is the integer part, clipped to the range.
    """
    steps = (np.asarray(volts, dtype=np.float64) - adc.range[0]) / adc.step
    if adc.gain_error or adc.offset_voltage:
        steps = steps * (1.0 + adc.gain_error) + adc.offset_voltage / adc.step
    if adc.inl_steps:
        share = np.clip(steps / 2.0**adc.bits, 0.0, 1.0)
        steps = steps + adc.inl_steps * 4.0 * share * (1.0 - share)
    return steps


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


def conversion_limits(design: Converts, volts: FloatArray) -> FloatArray:
    """Lowest and highest volts that a host can compute for outputs, over all positions within a quantisation step.

    The position of an output between two thresholds of the converter is random: a millivolt of drift moves it by a
    step. The converter's offset, gain error and nonlinearity are those of the design.

    Args:
        design: with an [adc] section.
        volts: (...) V at the converter's input.

    Returns:
        (2, ...) V.

    Raises:
        InputError: the design has no ADC.

    """
    adc = _adc(design)
    return _host_volts(adc, _steps(adc, volts) + _HALF_A_STEP.reshape(2, *[1] * np.ndim(volts)))


def conversion_changes(design: Converts, before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Extreme volts that a host can compute for two readings of the same outputs, over positions within an ADC step.

    Both readings have the same thresholds, so that the position of the first determines that of the second. A change
    of d steps changes the code by floor(d) at some positions and by floor(d) + 1 at the others: a change much smaller
    than a step can appear as a whole step. Changes below a millionth of a step count as rounding, hence as no change.
    Each of the two kinds of positions is an interval. The results belong to the ends of both intervals.

    Args:
        design: with an [adc] section.
        before: (...) V at the converter's input.
        after: (...) V, later.

    Returns:
        The host's volts before and after, each (4, ...).

    Raises:
        InputError: the design has no ADC.

    """
    adc = _adc(design)
    first, second = _steps(adc, before), _steps(adc, after)
    moved, sign = np.abs(second - first), np.sign(second - first)
    moved = np.where(moved < _NO_CHANGE, 0.0, moved)
    whole = np.floor(moved)
    rest = moved - whole
    # The position e is the host's reading minus the input, in steps: from -1/2 to 1/2. If the output rises, the second
    # reading passes one threshold more where e is below rest - 1/2. If the output falls, all signs are reversed.
    start, turn, end = np.full(rest.shape, -0.5), rest - 0.5, np.full(rest.shape, 0.5)
    places = np.stack([turn, end, start, turn])
    codes = np.stack([whole, whole, whole + (rest > 0), whole + (rest > 0)])
    direction = np.where(sign < 0, -1.0, 1.0)
    read = first + direction * places
    return _host_volts(adc, read), _host_volts(adc, read + direction * codes)


_NO_CHANGE = 1e-6  # steps; certified rounding errors of readings are smaller, and no position is known so precisely
_HALF_A_STEP = np.array([-0.5, 0.5])


def _host_volts(adc: Adc, steps: FloatArray) -> FloatArray:
    """V of readings in steps, limited to those of the first and the last code."""
    return adc.range[0] + np.clip(steps, 0.5, 2.0**adc.bits - 0.5) * adc.step


def clipped(design: Converts, codes: NDArray[np.integer]) -> BoolArray:
    """True where a code is the first or the last one, which only shows that the volts lie at or beyond that code."""
    return np.isin(codes, (0, 2 ** _adc(design).bits - 1))


def _adc(design: Converts) -> Adc:
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    return design.adc
