"""RMS error of the pressure, end to end."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._outcome import Measurement, drawn
from .._pressures import require_dynamics, runs, traces, what_is_in
from .._quantity import Quantity, Shipped
from .settling_error import rate_of


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    rate_of(dut, requirement)
    require_dynamics(dut)
    found = [(run.rmse(), run) for run in runs(dut)]
    (error, place), run = max(found, key=lambda item: item[0][0])
    lost = float(run.lost.mean())
    where = f"cell {place} of {run.board}" + (f"; {100 * lost:.3g} % of all readings are lost" if lost else "")
    return Measurement(
        100 * error,
        "% FS",
        where=where,
        confidence=f"{len(found)} boards, {len(run.time_s)} frames each, in board time",
        text=[what_is_in(dut)],
        figures=drawn(lambda: traces(run)),
    )


QUANTITY = Quantity(
    name="pressure_rmse",
    title="RMS error of the pressure",
    unit="% FS",
    says="RMS error of the pressure of the worst cell while it is touched, % of full scale.",
    compute=_compute,
    shipped=(
        Shipped(13, "The pressure follows the load.", max=lambda design: design.requirements.pressure_rmse_percent),
    ),
)
