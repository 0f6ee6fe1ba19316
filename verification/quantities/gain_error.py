"""Gain error: how far the change that is read of a press is from the true one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...common.arrays import FloatArray, IntArray
from .._box import Box
from .._quantity import READING_PARTS, SEARCHED, SHARE_UNITS, Quantity, Shipped
from .._reading_errors import error_of
from .._readings import ReadingErrorTarget


@dataclass(frozen=True)
class GainError(ReadingErrorTarget):
    """Error of the change that the host sees when the cell alone is pressed from rest to full scale."""

    name: str = "gain error"
    frames: int = 2

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        before, after = pattern.copy(), pattern.copy()
        each = np.arange(len(pattern))
        before[each, row, column], after[each, row, column] = 0.0, 1.0
        return [before, after]

    def uniform(self, state: float) -> list[float]:
        return [0.0, 1.0]

    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return box.scale.gain_error(read[1] - read[0], true[1] - true[0])


QUANTITY = Quantity(
    name="gain_error",
    title="Gain error",
    unit="%",
    says="Largest error of the change that is read when a cell alone goes from rest to full scale.",
    compute=error_of(GainError()),
    methods=SEARCHED,
    units=SHARE_UNITS,
    shipped=(
        Shipped(3, "A press is read at its true size.", max=lambda design: design.requirements.reading_error_percent),
    ),
    mended_by=READING_PARTS,
    rewired=True,
)
