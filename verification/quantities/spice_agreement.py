"""Agreement with ngspice on settled readings, early samples, phase margin and noise of the same circuit."""

from __future__ import annotations

from math import isfinite

import numpy as np

from ...circuits import Design, Requirement, Settling, noise, scan, spice, stability
from ...common.arrays import FloatArray
from ...errors import InputError, MissingExtra, SolverError
from .._dut import DesignUnderTest
from .._outcome import Measurement, NotRun, Table
from .._quantity import NOMINAL, Quantity, Shipped
from .._spice_check import excerpt, linear
from .._units import engineering

MOST_LINES = 8
"""lines in each direction that ngspice is given for a comparison"""
SHARE_OF_SETTLING = 0.25
"""of the time to settle to 1 %: late enough to be near, early enough to tell a wrong model"""
DEGREES = 90.0
"""Differences of phase margins are given relative to this."""


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    design = excerpt(dut.design, MOST_LINES, MOST_LINES)
    cells = np.full(design.array.shape, dut.rest)
    cells[::2] = dut.pressed
    try:
        rows = [_static(design, cells)]
        if design.board.virtual_grounds and isfinite(design.readout.gain_bandwidth):
            rows += _dynamic(design, cells)
    except MissingExtra as error:
        raise NotRun(str(error)) from error
    except (SolverError, InputError) as error:
        raise NotRun(f"ngspice: {error}") from error
    worst = max(rows, key=lambda item: item[1])
    shown = [[name, ours, its, engineering(difference, "%")] for name, difference, ours, its in rows]
    compared = Table(["quantity, first line", "ohmskin", "ngspice", "largest difference"], shown, "Against ngspice.")
    return Measurement(
        worst[1],
        "%",
        where=worst[0],
        confidence=f"ngspice shares no code with the solvers; compared on {design.array.rows} × {design.array.columns} "
        f"cells: {', '.join(name for name, *_ in rows)}",
        tables=[compared],
    )


Row = tuple[str, float, str, str]
"""Name, difference in %, and both values of the first sensed line."""


def _static(design: Design, cells: FloatArray) -> Row:
    row = min(1, design.array.rows - 1)
    found = spice.run_control(spice.netlist(design, cells, row))
    its = np.array([found[f"volts_{j}"] for j in range(design.array.columns)])
    ours = scan(design, cells, method="exact").volts[row]
    return _compared(f"settled readings of row {row}", ours, its, design)


def _dynamic(design: Design, cells: FloatArray) -> list[Row]:
    alike = linear(design)
    line = min(1, design.board.shape[0] - 1)  # one of those that are driven
    kind = design.board.line_kinds[0]
    settling = Settling(alike, cells)
    period = SHARE_OF_SETTLING * settling.shortest_period(0.01)
    found = spice.dynamic_reading(alike, cells, line, period=period)
    ours = _of_line(alike, settling.sampled_from_rest(period), line)
    rows = [
        _compared(
            f"readings {engineering(period, 's')} after the selection of {kind} {line}", ours, found.sampled, alike
        )
    ]
    margin = float(_of_line(alike, stability(alike, cells).phase_margin, line)[0])
    if isfinite(margin) or isfinite(found.phase_margin):
        difference = 100 * abs(margin - found.phase_margin) / DEGREES
        rows.append(
            ("phase margin, of 90 °", difference, engineering(margin, "°"), engineering(found.phase_margin, "°"))
        )
    if alike.readout.temperature:
        rms = float(_of_line(alike, noise(alike, cells).before_adc, line)[0])
        difference = 100 * abs(found.noise / rms - 1)
        rows.append(("noise before the converter", difference, engineering(rms, "V"), engineering(found.noise, "V")))
    return rows


def _of_line(design: Design, values: FloatArray, line: int) -> FloatArray:
    """Values (rows, columns) while one driven line is selected, (sensed lines,)."""
    return values[:, line] if design.board.transposed else values[line]


def _compared(name: str, ours: FloatArray, its: FloatArray, design: Design) -> Row:
    signal = np.abs(ours - design.readout.reference_voltage).max()
    difference = float(100 * np.abs(ours - its).max() / signal)
    return name, difference, engineering(float(ours[0]), "V", 6), engineering(float(its[0]), "V", 6)


QUANTITIES = (
    Quantity(
        name="spice_agreement",
        title="Agreement with ngspice",
        unit="%",
        says="Largest difference from ngspice: settled readings, early samples, phase margin, noise, %.",
        compute=_compute,
        methods=(NOMINAL,),
        shipped=(Shipped(19, "An independent simulator finds the same.", max=1.0),),
    ),
)
