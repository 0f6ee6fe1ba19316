"""P11 to P13: what each readout says of cells that nobody touched."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..circuits import Design, adc_codes, apparent_resistance, ideal_volts, scan, spice, volts_of_codes
from ..emulator import spread
from ..errors import MissingExtra
from . import plots
from .bench import Bench
from .outcome import Check, Figure, Finding, Table

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

OPEN_DIVIDER = "divider, idle lines open"


def grid_resistance(bench: Bench) -> Finding:
    """P11: with a plain divider the equivalent resistance of the whole grid is read."""
    array = bench.design.array
    shapes = [(2, 2), (4, 4), (8, 8), array.shape]
    worst, rows = 0.0, []
    for n, m in dict.fromkeys(shapes):
        design = _divider(_replaced(bench.design, "array", rows=n, columns=m))
        cells = np.full((n, m), bench.rest)
        read = scan(_ideal(design), cells).resistance
        exact = bench.rest * (n + m - 1) / (n * m)
        worst = max(worst, float(np.abs(read / exact - 1).max()))
        share = 100 * exact / bench.rest
        rows.append([f"{n} × {m}", f"{bench.rest:.0f}", f"{read[0, 0]:.3f}", f"{exact:.3f}", f"{share:.1f} %"])
    return Finding(
        checks=[Check("uniform grid reads R (N+M-1)/(N M): worst relative deviation", worst, 1e-12)],
        text=[
            "All cells have the same resistance R and all idle lines are left open. The divider then measures every "
            "path from the driven row to the sensed column at once: R (N+M-1)/(N M) instead of R, so a larger skin "
            "reads lower, and any cell changes every reading."
        ],
        tables=[Table(["array", "true R / ohm", "divider reads / ohm", "R (N+M-1)/(N M)", "of the true value"], rows)],
    )


def equation_10(bench: Bench) -> Finding:
    """P12: Vout = -Vin Rref / Rij, and how far real parts depart from it."""
    ideal = _ideal(bench.design)
    rng = np.random.default_rng(12)
    worst = 0.0
    for _ in range(20):
        cells = bench.rest * 10 ** rng.uniform(-1, 3, bench.design.array.shape)
        worst = max(worst, float(np.abs(scan(ideal, cells).volts / ideal_volts(ideal, cells) - 1).max()))
    factors = np.geomspace(0.5, 20, 60)
    index = (0, bench.design.array.columns - 1)
    exact, real, code = [], [], []
    for factor in factors:
        cells = np.full(bench.design.array.shape, bench.rest)
        cells[index] *= factor
        exact.append(ideal_volts(bench.design, cells)[index])
        volts = scan(bench.design, cells).volts
        real.append(volts[index])
        code.append(converted(bench.design, volts)[index])
    with plots.drawing(1, 2) as (figure, (panels,)):
        ohms = factors * bench.rest / 1e3
        panels[0].semilogx(ohms, exact, color=plots.INK, lw=3, alpha=0.25, label="equation (10)")
        panels[0].semilogx(ohms, real, label="as designed")
        panels[0].set(title="Output of one column", xlabel="cell resistance / kΩ", ylabel="output / V")
        panels[0].legend()
        panels[1].axhline(0, color=plots.INK, lw=0.8)
        for values, label in ((real, "at the amplifier"), (code, "after the ADC")):
            panels[1].semilogx(ohms, 100 * (np.array(values) / np.array(exact) - 1), label=label)
        panels[1].set(title="Departure from equation (10)", xlabel="cell resistance / kΩ", ylabel="% of the reading")
        panels[1].legend()
        picture = plots.svg(figure)
    return Finding(
        checks=[
            Check("ideal parts give -Vin Rref/Rij whatever the neighbours: worst relative deviation", worst, 1e-12)
        ],
        text=["Twenty random arrays over four decades of resistance, read with ideal parts, against equation (10)."],
        figures=[
            Figure(
                picture, f"Cell {index} swept, all others at {bench.rest:.0f} ohm. Left: output. Right: what is left."
            )
        ],
    )


def crosstalk(bench: Bench) -> Finding:
    """P13: grounded idle rows and an amplifier on each column leave no crosstalk but that of real parts."""
    design, limits = bench.design, bench.design.requirements
    patterns = _patterns(design.array.shape)
    readouts = _readouts(design)
    worst: dict[str, float] = {}
    rows, figures = [], []
    for title, pressed in patterns.items():
        seen = {name: _change(readout, bench, pressed) for name, readout in readouts.items()}
        true = np.where(pressed, 100 * (bench.pressed / bench.rest - 1), 0.0)
        figures.append(
            Figure(
                plots.heat_maps(
                    {"truth": true} | seen, label="change of resistance / %", limit=true.max(), marked=pressed
                ),
                f"{title}: change of each cell's apparent resistance against rest. Outlined cells are pressed; every "
                "other cell should read 0.",
            )
        )
        for name, change in seen.items():
            untouched = np.abs(np.where(pressed, 0.0, change))
            place = np.unravel_index(np.argmax(untouched), untouched.shape)
            worst[name] = max(worst.get(name, 0.0), float(untouched[place]))
            rows.append(
                [
                    title,
                    name,
                    f"{untouched[place]:.3g} %" if untouched[place] > 1e-9 else "none",
                    f"({place[0]}, {place[1]})" if untouched[place] > 1e-9 else "",
                    f"{100 * np.min(change[pressed] / true[pressed]):.1f} %",
                ]
            )
    at_rest = np.full(design.array.shape, bench.rest)
    frames = [at_rest] + [np.where(pressed, bench.pressed, bench.rest) for pressed in patterns.values()]
    scans = [scan(design, cells) for cells in frames]
    errors = [
        np.abs(apparent_resistance(design, converted(design, result.volts)) / cells - 1)
        for result, cells in zip(scans, frames, strict=True)
    ]
    checks = [
        Check("crosstalk as designed, worst untouched cell", worst["as designed"], limits.crosstalk_percent, "%"),
        Check("crosstalk with ideal parts, worst untouched cell", worst["amplifier, ideal parts"], 1e-10, "%"),
        Check(
            "reading error as designed, worst cell, uncalibrated",
            100 * float(np.max(errors)),
            limits.reading_error_percent,
            "%",
        ),
        Check("outputs at a supply limit", float(sum(int(result.saturated.sum()) for result in scans)), 0.0),
        _against_ngspice(design, frames, [result.volts for result in scans]),
    ]
    if min(design.array.shape) > 1:
        checks.append(Check("the plain divider does show crosstalk", worst[OPEN_DIVIDER], 1.0, "%", at_least=True))
    return Finding(
        checks=checks,
        text=[
            f"Cells rest at {bench.rest:.0f} ohm and are pressed with {bench.full_scale_kpa:g} kPa, which raises them "
            f"to {bench.pressed:.0f} ohm at equilibrium. Crosstalk is the change of an untouched cell's apparent "
            "resistance, in % of its own reading. 'As designed' includes leads, segments, the amplifier's gain, "
            "offset, bias current and swing, and the ADC."
        ],
        figures=figures,
        tables=[
            Table(
                ["pressed", "readout", "worst crosstalk", "at cell", "pressed cells show, of their true change"],
                rows,
                "Crosstalk of each readout.",
            ),
            _budget(bench, patterns),
        ],
    )


def slicing(bench: Bench) -> Finding:
    """P10: a sliced sheet isolates the cells; a continuous one still works, but they couple."""
    array = bench.design.array
    sliced = _replaced(_ideal(bench.design).with_circuit("inverting-amplifier"), "drive", idle_rows="ground")
    uncut = _replaced(sliced, "array", sheet="continuous")
    pressed = next(iter(_patterns(array.shape).values()))
    sheet = bench.design.sheet
    felt = 100 * spread(pressed.astype(np.float64), sheet.thickness / 2 / sheet.pitch)
    forward = bench.cell.forward(array.shape)
    load = felt / 100 * bench.full_scale_kpa
    forward.step(1.0, load)
    cells = forward.step(1e6, load)
    at_rest = np.full(array.shape, bench.rest)
    truth = 100 * (bench.pressed / bench.rest - 1)
    maps = {
        "sliced": _change(sliced, bench, pressed),
        "uncut, electrically": _change(uncut, bench, pressed),
        "uncut, mechanically": 100 * (cells / at_rest - 1),
        "uncut, both": 100 * (_apparent(uncut, cells) / _apparent(uncut, at_rest) - 1),
    }
    untouched = {name: float(np.abs(np.where(pressed, 0.0, change)).max()) for name, change in maps.items()}
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
        figures=[
            Figure(
                plots.heat_maps(
                    maps, label="change of resistance / %", limit=truth, marked=pressed, values="{:.2f}", size=2.0
                ),
                "One cell pressed (outlined): change of each cell's apparent resistance.",
            )
        ],
        tables=[
            Table(
                ["sheet", "worst untouched cell", "pressed cell, of its true change"],
                [
                    [name, f"{untouched[name]:.3g} %", f"{100 * float(change[pressed].min()) / truth:.1f} %"]
                    for name, change in maps.items()
                ],
            )
        ],
    )


def _against_ngspice(design: Design, frames: list[FloatArray], volts: list[FloatArray]) -> Check:
    name = "against ngspice, worst relative difference of a reading"
    try:
        judged = [spice.spice_scan(design, cells) for cells in frames]
    except MissingExtra as error:
        return Check(name, None, 1e-6, reason=str(error))
    zero = design.readout.reference_voltage
    differences = [np.abs((ours - its) / (its - zero)).max() for ours, its in zip(volts, judged, strict=True)]
    return Check(name, float(max(differences)), 1e-6)


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


def _readouts(design: Design) -> dict[str, Design]:
    grounded = _replaced(_divider(design), "drive", idle_rows="ground")
    amplifier = _replaced(_ideal(design).with_circuit("inverting-amplifier"), "drive", idle_rows="ground")
    return {
        OPEN_DIVIDER: _divider(design),
        "divider, idle rows grounded": grounded,
        "amplifier, ideal parts": amplifier,
        "as designed": design,
    }


def _replaced(design: Design, section: str, **values: Any) -> Design:
    return design.model_copy(update={section: getattr(design, section).model_copy(update=values)})


def _divider(design: Design) -> Design:
    return _replaced(_ideal(design).with_circuit("voltage-divider"), "drive", idle_rows="float")


def _ideal(design: Design) -> Design:
    """The same circuit with perfect wires, amplifiers and converter."""
    array, readout = design.array, design.readout
    return Design.model_validate(
        {
            "array": {"rows": array.rows, "columns": array.columns},
            "drive": design.drive.model_dump(),
            "readout": {
                "circuit": readout.circuit,
                "reference_resistance": readout.reference_resistance,
                "reference_voltage": readout.reference_voltage,
                "idle_columns": readout.idle_columns,
            },
        }
    )


def converted(design: Design, volts: FloatArray) -> FloatArray:
    """The volts that the ADC's codes stand for; without an ADC, the volts themselves."""
    return volts if design.adc is None else volts_of_codes(design, adc_codes(design, volts))


def _apparent(design: Design, cells: FloatArray) -> FloatArray:
    return apparent_resistance(design, converted(design, scan(design, cells).volts))


def _change(design: Design, bench: Bench, pressed: BoolArray) -> FloatArray:
    """Change of the apparent resistance against rest, in % of the reading at rest."""
    rest = _apparent(design, np.full(pressed.shape, bench.rest))
    return 100 * (_apparent(design, np.where(pressed, bench.pressed, bench.rest)) / rest - 1)


def _budget(bench: Bench, patterns: dict[str, BoolArray]) -> Table:
    """Each real part alone: what it costs, over all patterns."""
    design, ideal = bench.design, _ideal(bench.design)
    array, readout = design.array, design.readout
    lines = ("row_segment", "column_segment")
    alone: dict[str, Design] = {
        "row leads and switches": _replaced(ideal, "array", row_lead=array.row_lead),
        "column leads": _replaced(ideal, "array", column_lead=array.column_lead),
        "fabric segments": _replaced(ideal, "array", **{key: getattr(array, key) for key in lines}),
        "open-loop gain": _replaced(ideal, "readout", open_loop_gain=readout.open_loop_gain),
        "offset voltage": _replaced(ideal, "readout", offset_voltage=readout.offset_voltage),
        "bias current": _replaced(ideal, "readout", bias_current=readout.bias_current),
        "output swing": _replaced(ideal, "readout", supply=readout.supply),
        "ADC": ideal.model_copy(update={"adc": design.adc}),
        "all together": design,
    }
    rows = []
    for name, variant in alone.items():
        errors, changes = [], []
        for pressed in patterns.values():
            cells = np.where(pressed, bench.pressed, bench.rest)
            errors.append(np.abs(_apparent(variant, cells) / cells - 1).max() * 100)
            changes.append(np.abs(np.where(pressed, 0.0, _change(variant, bench, pressed))).max())
        rows.append([name, *(f"{max(x):.3g} %" if max(x) > 1e-9 else "none" for x in (errors, changes))])
    return Table(
        ["real part, alone", "worst reading error", "worst crosstalk"],
        rows,
        "Error budget of the design, over all patterns.",
    )
