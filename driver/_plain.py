"""Frames of a board whose circuit is not known: counts alone, without resistances and pressures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.measurement import Measurement
from ..errors import InputError, ProtocolError
from ._frame import Frame
from ._tare import DRIFT_STDS, Tare

DRIFT_COUNTS = 2.0
"""change of a count during a tare that a resting cell may show beside its noise"""


class PlainReader:
    """Stands in for a :class:`._reading.CountReader`: every count is valid, and no resistance is known."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape

    def __call__(self, counts: NDArray[np.uint16]) -> Measurement:
        """The reading of one frame (rows, columns). Raises ProtocolError if the frame has another shape."""
        if counts.shape != self._shape:
            raise ProtocolError("a frame of {} x {} cells; this board has {} x {}".format(*counts.shape, *self._shape))
        return Measurement.unknown(counts.shape)


def tare_of_counts(taken: Sequence[Frame], *, lost: int | None, serial_number: str) -> Tare:
    """The mean counts of some frames, as counts at rest.

    Counts at rest may be 0, and what the cells have in common is not known. The only sign of a load is therefore that
    counts change while the frames come.

    Raises:
        InputError: no cell has a count.

    """
    valid = np.array([frame.valid for frame in taken])
    counts = np.array([frame.counts for frame in taken], dtype=np.float64)
    readings = valid.sum(axis=0)
    measured = readings > 0
    if not measured.any():
        raise InputError("no cell has a count to tare with")
    mean = np.where(valid, counts, 0.0).sum(axis=0) / np.maximum(readings, 1)
    apart = np.where(valid, counts - mean, 0.0)
    half = max(len(taken) // 2, 1)
    change = np.abs(apart[-half:].mean(axis=0) - apart[:half].mean(axis=0))
    noise = np.sqrt((np.diff(apart, axis=0) ** 2).sum(axis=0) / (2 * max(len(taken) - 1, 1)))
    moving = change > DRIFT_COUNTS + DRIFT_STDS * noise * np.sqrt(2 / half)
    remarks = (f"the counts of {int(moving.sum())} cells are changing",) if len(taken) > 3 and moving.any() else ()
    unknown = np.full(mean.shape, np.nan)
    return Tare(
        rest_resistance_ohm=unknown,
        measured=measured,
        std_ohm=unknown,
        frames=len(taken),
        lost=lost,
        serial_number=serial_number,
        wall_time=taken[-1].host_time,
        remarks=remarks,
        rest_counts=mean,
    )
