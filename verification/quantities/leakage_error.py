"""Error by the leakage of the switches of all idle driven lines."""

from __future__ import annotations

from ...circuits import Design, Requirement
from .._dut import DesignUnderTest
from .._judging import measured, worst_of
from .._outcome import Measurement, NotRun
from .._quantity import DOWN, Quantity, Shipped
from .._whole_board import LeakageTarget


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    leakage = dut.design.drive.idle_leakage
    if not leakage:
        raise NotRun("missing: drive.idle_leakage")
    found = worst_of(dut, LeakageTarget(amperes=leakage))
    return measured(found, 100 * found.value, "%")


def _limit(design: Design) -> float:
    return design.requirements.reading_error_percent / 5


QUANTITY = Quantity(
    name="leakage_error",
    title="Error by leakage of idle switches",
    unit="%",
    says="Largest change of a reading by the leakage of the switches of all idle driven lines, % of that reading.",
    compute=_compute,
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
