"""Frames of a board whose circuit is not known: counts alone, without resistances and pressures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..common.measurement import Measurement
from ..errors import ProtocolError


class PlainReader:
    """Stands in for a :class:`._reading.CountReader`: every count is valid, and no resistance is known."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape

    def __call__(self, counts: NDArray[np.uint16]) -> Measurement:
        """The reading of one frame (rows, columns). Raises ProtocolError if the frame has another shape."""
        if counts.shape != self._shape:
            raise ProtocolError("a frame of {} x {} cells; this board has {} x {}".format(*counts.shape, *self._shape))
        return Measurement.unknown(counts.shape)
