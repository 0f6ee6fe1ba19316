"""Largest power in the switch and lead of a driven line, W."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import Measurement, NotRun
from .._quantity import DOWN, Quantity
from .._whole_board import OperatingTarget, driven_line


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    lead = f"{dut.design.board.line_kinds[0]}_lead"
    if not np.any(getattr(dut.design.array, lead)):
        raise NotRun(f"missing: array.{lead}")
    found = worst_of(dut, OperatingTarget("driver_power", "switch power"))
    return measured(found, found.value, "W", where=f"{driven_line(found.box, found.cell)}; {found.where}")


QUANTITY = Quantity(
    name="switch_power",
    title="Power in a row switch",
    unit="W",
    says="Largest power in the switch and lead of a driven line, W.",
    compute=_compute,
    mended_by=(
        ("drive.voltage", DOWN),
        ("array.row_lead", DOWN),
    ),
)
