"""What errors of settled readings have in common: the place where a reading is lost, both units, maps, the budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..circuits import Requirement
from ._dut import DesignUnderTest
from ._judging import Searched, contributions, in_both_units, maps, percent
from ._outcome import Measurement
from ._readings import ReadingErrorTarget
from ._search import WorstCase

_LOST = "a reading at or beyond an end of the circuit's law or of the converter, or an output at its limit"


def error_of(target: ReadingErrorTarget) -> Searched:
    """One error, of resistance in % or as a share of full scale."""
    return Searched(target=lambda dut, requirement: target, show=percent, detail=_detail)


def _detail(dut: DesignUnderTest, requirement: Requirement, found: WorstCase, measurement: Measurement) -> Measurement:
    if not np.isfinite(found.value):
        return replace(measurement, where=f"{measurement.where}: {_LOST}")
    return replace(
        measurement,
        text=[in_both_units(dut, found)],
        contributions=contributions(found, 100.0),
        figures=maps(found, measurement.unit, requirement.max),
    )
