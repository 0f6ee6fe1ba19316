"""P10 to P13: what each readout says of cells that nobody touched."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..circuits import Array, Design, adc_codes, apparent_resistance, ideal_volts, scan, volts_of_codes
from ..common.arrays import BoolArray, FloatArray
from ..emulator import spread
from ._claim import statement
from ._dut import DesignUnderTest
from ._judging import worst_of
from ._outcome import Check, DoesNotApply, Figure, Finding, Table, drawn
from ._pictures import heat_maps
from .quantities.reading_errors import Crosstalk, ReadingError

OPEN_DIVIDER, IDEAL_PARTS = "divider, idle lines open", "amplifier, ideal parts"


@statement(
    *("P11", "A divider reads the whole grid", "VII, Fig. 13"),
    "With a plain voltage divider the resistance found is the equivalent resistance of the grid.",
)
def grid_resistance(dut: DesignUnderTest) -> Finding:
    array = dut.design.array
    shapes = [(2, 2), (4, 4), (8, 8), array.shape]
    worst, rows = 0.0, []
    for n, m in dict.fromkeys(shapes):
        design = _ideal(dut.design, "voltage-divider", "float")
        design = design.replace(array=Array(rows=n, columns=m), readout={"reference_resistance": dut.rest})
        cells = np.full((n, m), dut.rest)
        read = scan(design, cells, method="exact").resistance
        exact = dut.rest * (n + m - 1) / (n * m)
        worst = max(worst, float(np.abs(read / exact - 1).max()))
        share = 100 * exact / dut.rest
        rows.append([f"{n} × {m}", f"{dut.rest:.0f}", f"{read[0, 0]:.3f}", f"{exact:.3f}", f"{share:.1f} %"])
    return Finding(
        checks=[Check("uniform grid reads R (N+M-1)/(N M): worst relative deviation", worst, 1e-12)],
        text=[
            "All cells have the same resistance R and all idle lines are left open. The divider then measures every "
            "path from the driven row to the sensed column at once: R (N+M-1)/(N M) instead of R, so a larger skin "
            "reads lower, and any cell changes every reading."
        ],
        tables=[Table(["array", "true R / ohm", "divider reads / ohm", "R (N+M-1)/(N M)", "of the true value"], rows)],
    )


@statement(
    *("P12", "The inverting amplifier", "(10), Fig. 14"),
    "With the column held at ground by an inverting amplifier, Vout = -Vin Rref / Rij.",
)
def equation_10(dut: DesignUnderTest) -> Finding:
    if not dut.design.board.virtual_grounds:
        raise DoesNotApply(
            "equation (10) is that of an amplifier on each line, not of "
            f"{dut.design.readout.circuit} with {dut.design.readout.columns} columns"
        )
    circuit = _amplifiers(dut.design)
    rng = np.random.default_rng(12)
    worst = 0.0
    for _ in range(20):
        cells = dut.rest * 10 ** rng.uniform(-1, 3, dut.design.array.shape)
        signal = scan(circuit, cells, method="exact").volts - circuit.readout.reference_voltage
        alone = ideal_volts(circuit, cells) - circuit.readout.reference_voltage
        worst = max(worst, float(np.abs(signal / alone - 1).max()))
    return Finding(
        checks=[
            Check("ideal parts give -Vin Rref/Rij whatever the neighbours: worst relative deviation", worst, 1e-12)
        ],
        text=["Twenty random arrays over four decades of resistance, read with ideal parts, against equation (10)."],
    )


@statement(
    *("P13", "No crosstalk", "VII, Fig. 15"),
    "An amplifier on each column and all idle rows grounded: each cell is read without any crosstalk.",
)
def crosstalk(dut: DesignUnderTest) -> Finding:
    design, limits = dut.design, dut.design.requirements
    readouts = {
        OPEN_DIVIDER: _ideal(design, "voltage-divider", "float"),
        "divider, idle rows grounded": _ideal(design, "voltage-divider", "ground"),
        IDEAL_PARTS: _amplifiers(design),
        "as designed": design,
    }
    patterns = _patterns(design.array.shape)
    at_rest, largest = dut.uniform["at rest"], 100 * (dut.pressed / dut.rest - 1)
    seen = {
        title: {
            name: _change(readout, at_rest, np.where(pressed, dut.pressed, dut.rest))
            for name, readout in readouts.items()
        }
        for title, pressed in patterns.items()
    }

    def untouched(readout: str) -> float:
        """Largest change of an untouched cell over all patterns, %."""
        return max(float(np.abs(maps[readout][~patterns[title]]).max(initial=0.0)) for title, maps in seen.items())

    worst, error = (worst_of(dut, target) for target in (Crosstalk(), ReadingError()))
    checks = [
        Check("crosstalk as designed, worst untouched cell", 100 * worst.value, limits.crosstalk_percent, "%"),
        Check("crosstalk with ideal parts, worst untouched cell", untouched(IDEAL_PARTS), 1e-10, "%"),
        Check(
            "reading error as designed, worst cell, uncalibrated", 100 * error.value, limits.reading_error_percent, "%"
        ),
    ]
    if min(design.array.shape) > 1:
        divided = untouched(OPEN_DIVIDER)
        checks.append(Check("the plain divider does show crosstalk", divided, 1.0, "%", at_least=True))

    def draw(title: str, pressed: BoolArray) -> Figure:
        maps = {"truth": np.where(pressed, largest, 0.0)} | seen[title]
        return Figure(
            heat_maps(maps, label="change of resistance / %", limit=abs(largest), marked=pressed),
            f"{title.capitalize()}: change of each cell's apparent resistance against rest. Outlined cells are "
            "pressed; every other cell should read 0.",
        )

    return Finding(
        checks=checks,
        text=[
            f"Cells rest at {dut.rest:.0f} ohm and are pressed with {dut.full_scale_kpa:g} kPa, which raises "
            f"them to {dut.pressed:.0f} ohm at equilibrium. Crosstalk is the change of an untouched cell's "
            "apparent resistance, in % of its own reading. 'As designed' includes leads, segments, the amplifier's "
            "gain, offset, bias current and swing, and the ADC; the checks take the worst pattern, the worst corner of "
            "all tolerances, and the worst place within an ADC step.",
            f"Crosstalk: {worst.search}.",
        ],
        figures=drawn(*(partial(draw, *item) for item in patterns.items())),
    )


@statement(
    *("P10", "Slicing isolates the cells", "VI, Fig. 12"),
    "Slicing the sheet isolates the cells; unsliced it still works, but the cells couple.",
)
def slicing(dut: DesignUnderTest) -> Finding:
    array = dut.design.array
    sliced = _amplifiers(dut.design)
    uncut = sliced.replace(array={"sheet": "continuous"})
    pressed = next(iter(_patterns(array.shape).values()))
    sheet = dut.design.sheet
    felt = 100 * spread(pressed.astype(np.float64), sheet.thickness / 2 / sheet.pitch)
    forward = dut.cell.forward(array.shape)
    load = felt / 100 * dut.full_scale_kpa
    forward.step(1.0, load)
    cells = forward.step(1e6, load)
    at_rest = dut.uniform["at rest"]
    truth = 100 * (dut.pressed / dut.rest - 1)
    maps = {
        "sliced": _change(sliced, at_rest, np.where(pressed, dut.pressed, dut.rest)),
        "uncut, electrically": _change(uncut, at_rest, np.where(pressed, dut.pressed, dut.rest)),
        "uncut, mechanically": 100 * (cells / at_rest - 1),
        "uncut, both": _change(uncut, at_rest, cells),
    }
    untouched = {name: float(np.abs(np.where(pressed, 0.0, changed)).max()) for name, changed in maps.items()}
    checks = [
        Check("sliced: crosstalk, worst untouched cell", untouched["sliced"], 1e-10, "%"),
        Check(
            "uncut: pressed cell shows, of its true change",
            100 * float(maps["uncut, both"][pressed].min() / truth),
            80.0,
            "%",
            at_least=True,
        ),
    ]
    if array.rows * array.columns > 1:
        checks.append(
            Check("uncut: crosstalk, worst untouched cell", untouched["uncut, both"], 0.01, "%", at_least=True)
        )
    return Finding(
        checks=checks,
        text=[
            "Ideal amplifiers and wires, so that only the sheet can couple the cells. Electrically: the uncut sheet is "
            f"a three-dimensional network of {sheet.divisions} x {sheet.divisions} x {sheet.layers} boxes per cell "
            f"({1e3 * sheet.pitch:.3g} mm pitch, {1e3 * sheet.thickness:.3g} mm thick, strips of "
            f"{1e3 * sheet.electrode_width:.3g} mm). Mechanically: cells feel the stress of an elastic half-space at "
            "half the sheet's thickness. The geometry of the strips is the project's own. With virtual grounds on all "
            "idle lines little current goes sideways; what couples the cells of an uncut sheet is mostly the load."
        ],
        figures=drawn(
            lambda: Figure(
                heat_maps(
                    maps, label="change of resistance / %", limit=truth, marked=pressed, values="{:.2f}", size=2.0
                ),
                "One cell pressed (outlined): change of each cell's apparent resistance.",
            )
        ),
    )


def _patterns(shape: tuple[int, int]) -> dict[str, BoolArray]:
    """Which cells are pressed: one, three corners of a rectangle (the fourth is the ghost), all but one."""
    rows, columns = shape
    middle = (rows // 2 - (rows > 1), columns // 2)
    one = np.zeros(shape, dtype=np.bool_)
    one[middle] = True
    patterns = {"one cell": one}
    if rows > 1 and columns > 1:
        corners = np.zeros(shape, dtype=np.bool_)
        corners[0, 0] = corners[0, columns // 2] = corners[rows // 2, 0] = True
        patterns["three corners of a rectangle"] = corners
    if rows * columns > 1:
        patterns["all but one"] = ~one
    return patterns


def _ideal(design: Design, circuit: str, idle_rows: str) -> Design:
    """The same array, drive voltage and reference resistors with perfect wires, parts and converter.

    A circuit that senses the other lines takes the mean of the reference resistors.
    """
    readout = design.readout
    reference = readout.reference_resistance
    if circuit != readout.circuit:
        reference = float(np.mean(reference))
    return Design.model_validate(
        {
            "array": {"rows": design.array.rows, "columns": design.array.columns},
            "sheet": design.sheet,
            "drive": {"voltage": design.drive.voltage, "idle_rows": idle_rows},
            "readout": {
                "circuit": circuit,
                "reference_resistance": reference,
                "reference_voltage": readout.reference_voltage,
            },
        }
    )


def _amplifiers(design: Design) -> Design:
    """The paper's circuit with ideal parts: grounded idle lines, an inverting amplifier on each sensed line."""
    own = design.board.circuit
    return _ideal(design, own.name if own.virtual_ground else "inverting-amplifier", "ground")


def _apparent(design: Design, cells: FloatArray) -> FloatArray:
    """What equation (10) makes of the design's readings, ADC included."""
    volts = scan(design, cells, method="exact").volts
    return apparent_resistance(
        design, volts if design.adc is None else volts_of_codes(design, adc_codes(design, volts))
    )


def _change(design: Design, before: FloatArray, after: FloatArray) -> FloatArray:
    """Change of the apparent resistances in % of those before."""
    return 100 * (_apparent(design, after) / _apparent(design, before) - 1)
