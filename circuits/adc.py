"""The converter behind the outputs: volts to codes and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .design import Adc, Design

FloatArray = NDArray[np.float64]
CodeArray = NDArray[np.uint32]


def adc_codes(design: Design, volts: FloatArray) -> CodeArray:
    """Codes of an ideal converter: code k covers [k, k + 1) steps above the lower end; clipped at both ends."""
    adc = _adc(design)
    steps = np.floor((np.asarray(volts, dtype=np.float64) - adc.range[0]) / adc.step)
    return np.clip(steps, 0, 2.0**adc.bits - 1).astype(np.uint32)


def volts_of_codes(design: Design, codes: NDArray[np.integer]) -> FloatArray:
    """The middle of each code's interval, in V: the error of an unclipped code is at most half a step."""
    adc = _adc(design)
    return adc.range[0] + (np.asarray(codes, dtype=np.float64) + 0.5) * adc.step


def clipped(design: Design, codes: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Where a code is the first or the last one, so that the volts are only known to lie at or beyond it."""
    return np.isin(codes, (0, 2 ** _adc(design).bits - 1))


def _adc(design: Design) -> Adc:
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    return design.adc
