"""Error by the leakage of the switches of all idle driven lines."""

from __future__ import annotations

from ...circuits import Design, Requirement
from .._dut import DesignUnderTest
from .._judging import Searched, percent
from .._outcome import NotRun
from .._quantity import DOWN, SEARCHED, Quantity, Shipped
from .._whole_board import LeakageTarget


def _target(dut: DesignUnderTest, requirement: Requirement) -> LeakageTarget:
    if not dut.design.drive.idle_leakage:
        raise NotRun("missing: drive.idle_leakage")
    return LeakageTarget(amperes=dut.design.drive.idle_leakage)


def _limit(design: Design) -> float:
    return design.requirements.reading_error_percent / 5


QUANTITY = Quantity(
    name="leakage_error",
    title="Error by leakage of idle switches",
    unit="%",
    says="Largest change of a reading by the leakage of the switches of all idle driven lines, % of that reading.",
    compute=Searched(_target, "%", percent),
    methods=SEARCHED,
    shipped=(
        Shipped(
            25,
            "Idle switches do not shift readings.",
            max=_limit,
            applies=lambda design: bool(design.drive.idle_leakage),
        ),
    ),
    mended_by=(("drive.idle_leakage", DOWN), ("array.row_lead", DOWN)),
)
