"""``Converted``: the values of one frame, of one board (:mod:`._convert`) or of several (:mod:`._joined`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import BoolArray, FloatArray
from ..common.geometry import Geometry
from ._contacts import Contact


class Converted(NamedTuple):
    """What a frame is converted to. Arrays are (rows, columns) and read-only."""

    valid: BoolArray
    reason: NDArray[np.int8]
    """why a cell is not valid: a :class:`ohmskin.circuits.Reason` each"""
    resistance: FloatArray
    """ohm"""
    pressure: FloatArray
    """kPa"""
    pressure_std: FloatArray
    """kPa"""
    rest_counts: FloatArray
    """where the circuit is not known; else 0"""
    geometry: Geometry
    contacts: Callable[[], tuple[Contact, ...]]
    estimator_starts: int
    """number of times that the estimator has started without memory, up to this frame"""
