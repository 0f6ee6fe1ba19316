"""Largest power in the switch and lead of a driven line, W."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._judging import Searched
from .._outcome import NotRun
from .._quantity import DOWN, SEARCHED, Quantity
from .._whole_board import OperatingTarget, driven_line


def _target(dut: DesignUnderTest, requirement: Requirement) -> OperatingTarget:
    lead = f"{dut.design.board.line_kinds[0]}_lead"
    if not np.any(getattr(dut.design.array, lead)):
        raise NotRun(f"missing: array.{lead}")
    return OperatingTarget("driver_power", "switch power")


QUANTITY = Quantity(
    name="switch_power",
    title="Power in a row switch",
    unit="W",
    says="Largest power in the switch and lead of a driven line, W.",
    compute=Searched(_target, "W", line=driven_line),
    methods=SEARCHED,
    mended_by=(("drive.voltage", DOWN), ("array.row_lead", DOWN)),
    rates=("driver", "power"),
)
