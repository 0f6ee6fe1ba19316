"""Crosstalk: the change of an untouched cell's reading when other cells are pressed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...circuits import Requirement
from ...common.arrays import FloatArray, IntArray
from .._box import Box
from .._dut import DesignUnderTest
from .._outcome import DoesNotApply
from .._quantity import READING_PARTS, SEARCHED, SHARE_UNITS, Quantity, Shipped
from .._reading_errors import error_of
from .._readings import ReadingErrorTarget


@dataclass(frozen=True)
class Crosstalk(ReadingErrorTarget):
    """Change of an untouched cell's reading when other cells are pressed."""

    name: str = "crosstalk"
    frames: int = 2

    def pressed(self, pattern: FloatArray, row: IntArray, column: IntArray) -> list[FloatArray]:
        after = pattern.copy()
        after[np.arange(len(pattern)), row, column] = 0.0
        return [np.zeros_like(pattern), after]

    def uniform(self, state: float) -> list[float]:
        return [0.0, state]

    def error(self, box: Box, read: Sequence[FloatArray], true: Sequence[FloatArray]) -> FloatArray:
        return box.scale.difference(read[1], read[0])


def _target(dut: DesignUnderTest, requirement: Requirement) -> Crosstalk:
    if dut.design.array.rows * dut.design.array.columns == 1:
        raise DoesNotApply("a single cell has no neighbours")
    return Crosstalk()


QUANTITY = Quantity(
    name="crosstalk",
    title="Crosstalk",
    unit="%",
    says="Largest change of an untouched cell's reading, of that reading or of full scale, whatever else is pressed.",
    compute=replace(error_of(Crosstalk()), target=_target),
    methods=SEARCHED,
    units=SHARE_UNITS,
    shipped=(
        Shipped(
            1, "A press does not show on untouched cells.", max=lambda design: design.requirements.crosstalk_percent
        ),
    ),
    mended_by=READING_PARTS,
    rewired=True,
)
