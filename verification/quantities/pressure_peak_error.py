"""Peak error of the pressure, end to end."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._outcome import Measurement
from .._pressures import require_dynamics, runs, what_is_in
from .._quantity import Quantity, Shipped
from .._units import engineering
from .settling_error import rate_of


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    rate_of(dut, requirement)
    require_dynamics(dut)
    found = [(run.peak(), run) for run in runs(dut)]
    (error, (frame, row, column)), run = max(found, key=lambda item: item[0][0])
    return Measurement(
        100 * error,
        "% FS",
        where=f"cell ({row}, {column}) at {engineering(float(run.time_s[frame]), 's')}, {run.board}",
        confidence=f"{len(found)} boards, {len(run.time_s)} frames each, in board time",
        text=[what_is_in(dut)],
    )


QUANTITY = Quantity(
    name="pressure_peak_error",
    title="Peak error of the pressure",
    unit="% FS",
    says="Largest error of the pressure of any cell at any time, % of full scale.",
    compute=_compute,
    shipped=(Shipped(14, "No estimate is far off.", max=lambda design: 4 * design.requirements.pressure_rmse_percent),),
)
