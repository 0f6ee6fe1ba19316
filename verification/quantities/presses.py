"""Errors of the pressure and lost readings while presses come and go, end to end."""

from __future__ import annotations

from functools import partial

import numpy as np

from ...circuits import Requirement, adc_codes, clipped, scan
from .._dut import DesignUnderTest
from .._hardware import Readings, true_cells
from .._outcome import Measurement
from .._pressures import require_dynamics, runs, traces, what_is_in
from .._quantity import Quantity, Shipped
from .._units import engineering
from .settling import rate_of


def _error(peak: bool, dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    rate_of(dut, requirement)
    require_dynamics(dut)
    found = [(run.peak() if peak else run.rmse(), run) for run in runs(dut)]
    (error, place), run = max(found, key=lambda item: item[0][0])
    frame, cell, lost = place[0], place[-2:], float(run.lost.mean())
    where = f"cell {cell} at {engineering(float(run.time_s[frame]), 's')}, {run.board}"
    if not peak:
        where = f"cell {cell} of {run.board}" + (f"; {100 * lost:.3g} % of all readings are lost" if lost else "")
    return Measurement(
        100 * error,
        "% FS",
        where=where,
        confidence=f"{len(found)} boards, {len(run.time_s)} frames each, in board time",
        text=[what_is_in(dut)],
        figures=[] if peak else traces(run),
    )


def _lost(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    run = max(runs(dut), key=lambda run: float(run.lost.mean()))
    cells = np.argwhere(run.lost.any(axis=0))
    places = ", ".join(f"({i}, {j})" for i, j in cells[:6].tolist())
    where = f"{len(cells)} cells of {run.board}: {places}" if len(cells) else "none"
    return Measurement(100 * float(run.lost.mean()), "%", where=where)


def _lost_on_board(dut: DesignUnderTest, readings: Readings) -> Measurement:
    nominal = clipped(dut.design, adc_codes(dut.design, scan(dut.design, true_cells(dut)).volts))
    return Measurement(
        100 * float(readings.clipped.mean()),
        "%",
        where=f"{int(readings.clipped.any(axis=0).sum())} cells",
        text=[f"Simulated with nominal parts: {engineering(100 * float(nominal.mean()), '%')}."],
    )


QUANTITIES = (
    Quantity(
        name="pressure_rmse",
        title="RMS error of the pressure",
        unit="% FS",
        says="RMS error of the pressure of the worst cell while it is touched, % of full scale.",
        compute=partial(_error, False),
        shipped=(
            Shipped(13, "The pressure follows the load.", max=lambda design: design.requirements.pressure_rmse_percent),
        ),
    ),
    Quantity(
        name="pressure_peak_error",
        title="Peak error of the pressure",
        unit="% FS",
        says="Largest error of the pressure of any cell at any time, % of full scale.",
        compute=partial(_error, True),
        shipped=(
            Shipped(14, "No estimate is far off.", max=lambda design: 4 * design.requirements.pressure_rmse_percent),
        ),
    ),
    Quantity(
        name="lost_readings",
        title="Readings lost to a limit",
        unit="%",
        says="Share of readings beyond the converter's range or of outputs at a limit during the presses, %.",
        compute=_lost,
        shipped=(Shipped(15, "No press drives a reading beyond a limit.", max=0.0),),
        measured=_lost_on_board,
    ),
)
