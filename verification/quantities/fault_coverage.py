"""Fault coverage: which broken lines and cells a self-test of the untouched skin detects.

The self-test reads the skin at rest and compares every reading with the interval that a sound board can give. That
interval follows to first order from all tolerances, the spread of the cells and the step of the converter. A fault is
detected if at least one reading leaves its interval.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from ...circuits import Design, Fault, Requirement, scan
from ...common.arrays import FloatArray
from ...errors import InputError, SolverError
from .._dut import DesignUnderTest
from .._judging import box_of
from .._outcome import DoesNotApply, Measurement, NotRun, Table
from .._quantity import Quantity, Shipped
from .._readings import AT_REST, Excursion, first_order

MOST_FAULTS = 400
"""faults that are solved; of larger arrays every n-th cell is taken"""


def faults_of(design: Design) -> list[Fault]:
    """Open and shorted cells, lines broken at their electronics, in the middle and at the end, bridged neighbours."""
    rows, columns = design.array.shape
    places = [(i, j) for i in range(rows) for j in range(columns)]
    every = -(-2 * len(places) // MOST_FAULTS)
    kept = places[::every]
    found = [Fault(kind=kind, place=place) for kind in ("open-cell", "shorted-cell") for place in kept]
    for row in range(rows):
        for column in sorted({0, columns // 2, columns - 1}):
            found.append(Fault(kind="broken-row", place=(row, column)))
    for column in range(columns):
        for row in sorted({0, rows // 2, rows - 1}):
            found.append(Fault(kind="broken-column", place=(row, column)))
    found += [Fault(kind="bridged-rows", place=(row, columns // 2), resistance=1.0) for row in range(rows - 1)]
    found += [Fault(kind="bridged-columns", place=(rows // 2, column), resistance=1.0) for column in range(columns - 1)]
    return found


def sound_interval(dut: DesignUnderTest) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest voltage (N, M) that a converter's code stands for, of sound boards whose cells are at rest."""
    box = box_of(dut)
    at_rest = Excursion("voltage at rest", (0.0, 0.0), at_converter=True, frames=AT_REST)
    high, low = first_order(at_rest, box)
    return -low - 2 * box.half_step, high + 2 * box.half_step


def _compute(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    design = dut.design
    if design.fault:
        raise NotRun("the design has faults of its own; a self-test is judged on a sound one")
    if dut.scale.open_is_rest and dut.cell.open_at_rest:
        raise DoesNotApply("cells that are open at rest carry no current that a self-test could miss")
    try:
        lowest_sound, highest_sound = sound_interval(dut)
    except InputError as error:
        raise NotRun(f"no interval of a sound board: {error}") from error
    lowest, highest = _limited(design, lowest_sound), _limited(design, highest_sound)
    counts: dict[str, Counter[bool]] = {}
    missed: list[str] = []
    cells = np.full(design.array.shape, dut.rest)
    for fault in faults_of(design):
        try:
            volts = _limited(design, scan(design.replace(fault=(fault,)), cells, method="exact").volts)
            detected = bool((~((volts >= lowest) & (volts <= highest))).any())
        except SolverError:  # ideal parts contradict each other: no sound reading comes of it
            detected = True
        counts.setdefault(fault.kind, Counter())[detected] += 1
        if not detected:
            missed.append(f"{fault.kind} at {fault.place}")
    detected_of_all = sum(count[True] for count in counts.values())
    total = sum(sum(count.values()) for count in counts.values())
    rows = [
        [kind, str(sum(count.values())), str(count[True]), f"{100 * count[True] / sum(count.values()):.1f} %"]
        for kind, count in counts.items()
    ]
    return Measurement(
        100 * detected_of_all / total,
        "%",
        where=f"not detected: {', '.join(missed[:5])}{', ...' if len(missed) > 5 else ''}"
        if missed
        else "all are detected",
        confidence=f"{total} single faults solved exactly; interval of a sound board to first order",
        tables=[Table(["fault", "tried", "detected", "coverage"], rows, "Faults that a self-test at rest detects.")],
    )


def _limited(design: Design, volts: FloatArray) -> FloatArray:
    """What supply and converter let through: of readings beyond, a self-test sees the limit only."""
    within = np.clip(volts, *design.board.supply)
    limited: FloatArray = within if design.adc is None else np.clip(within, *design.adc.range)
    return limited


QUANTITIES = (
    Quantity(
        name="fault_coverage",
        title="Fault coverage of a self-test",
        unit="%",
        says="Share of single faults that a self-test of the untouched skin detects, %.",
        compute=_compute,
        shipped=(Shipped(12, "A self-test detects broken lines and cells.", min=60.0),),
    ),
)
