"""SPICE as a judge: the report's readings, settling, phase margin and noise against ngspice.

Two questions are kept apart. :func:`spice_agreement` asks whether ohmskin's solvers are right: ngspice gets the same
one-pole amplifiers, and must find the same numbers. :func:`measured_in_spice` asks whether the board is right: a
requirement with the method "spice" is judged by what ngspice finds, with the maker's macro-model where the design
names one.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np

from ..circuits import Design, Requirement, Settling, noise, scan, spice, stability
from ..common.arrays import FloatArray
from ..errors import InputError, MissingExtra, SolverError
from ._dynamic import frames_of, rate_of
from ._outcome import DoesNotApply, Measurement, NotRun, Table
from ._subject import Subject
from ._units import engineering

LARGEST = 8
"""lines in each direction that ngspice is given for a comparison"""
MOST_DRIVEN, MOST_SENSED = 64, 4
"""lines that ngspice is given where its numbers are judged: an amplifier is loaded by all cells of its own line"""
SHARE_OF_SETTLING = 0.25
"""of the time to settle to 1 %: late enough to be near, early enough to tell a wrong model"""
DEGREES = 90.0
"""Differences of phase margins are given relative to this."""
SETTLED, TIMES_SETTLED = 1e-9, 4.0
"""A sample of a one-pole amplifier later than so many times its time to settle to this error is not waited for."""
SIMULATED = {"phase_margin": ("°", "loop gain"), "settling_error": ("%", "transient"), "noise": ("V", "noise")}
"""quantities that a requirement can have judged in ngspice: unit, and the analysis that finds them"""
_log = logging.getLogger(__name__)


def spice_agreement(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest difference from ngspice: settled readings, early samples, phase margin, noise, %."""
    design = _excerpt(subject.design, LARGEST, LARGEST)
    cells = np.full(design.array.shape, subject.rest)
    cells[::2] = subject.pressed
    tables = []
    try:
        rows = [_static(design, cells)]
        if design.board.virtual_grounds and isfinite(design.readout.gain_bandwidth):
            rows += _dynamic(design, cells)
            if design.readout.amplifier_model is not None:
                tables = [_beside_the_model(design, cells)]
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
        tables=[compared, *tables],
    )


def measured_in_spice(subject: Subject, requirement: Requirement) -> Measurement:
    """A quantity of :data:`SIMULATED` as ngspice finds it, over the same frames as the analysis, with nominal parts.

    Raises:
        NotRun: the quantity or the circuit has no netlist in time, ngspice is missing, or it found no result.
        DoesNotApply: there is no feedback loop.
    """
    design, quantity = subject.design, requirement.quantity
    if quantity not in SIMULATED:
        raise NotRun(f"'{quantity}' has no netlist; expected one of {', '.join(SIMULATED)}")
    if not design.board.circuit.has_amplifiers:
        if quantity == "phase_margin":
            raise DoesNotApply(f"'{design.readout.circuit}' has no feedback loop")
        raise NotRun(f"the netlist in time is for circuits with feedback, not for '{design.readout.circuit}'")
    if design.adc is not None and design.adc.acquisition_time and quantity == "settling_error":
        raise NotRun("adc.acquisition_time: the netlist has no multiplexer ahead of the converter")
    try:
        found = list(_simulated(subject, requirement))
    except MissingExtra as error:
        raise NotRun(str(error)) from error
    except (SolverError, InputError) as error:
        raise NotRun(f"ngspice: {error}") from error
    value, where = _worst_of(quantity, found)
    model = design.readout.amplifier_model
    amplifier = "amplifier of one pole" if model is None else f"macro-model {model.subcircuit} of {model.file.name}"
    dropped = dict.fromkeys(name for frame in found for name in frame.dropped)
    return Measurement(
        value,
        SIMULATED[quantity][0],
        where=where,
        confidence=f"ngspice, nominal parts, {amplifier}; {len(found)} frames",
        undecided=f"ngspice does not know {', '.join(dropped)} of the macro-model, and leaves it out"
        if dropped
        else "",
    )


class _Frame(NamedTuple):
    """What ngspice found for one of the hard frames."""

    name: str
    value: float
    """in SI units or degrees; for a settling error the deviation in V"""
    signal: float
    """V"""
    dropped: tuple[str, ...]


def _worst_of(quantity: str, frames: list[_Frame]) -> tuple[float, str]:
    """The deciding value in the unit of the quantity, and the frame it belongs to."""
    pick = min if quantity == "phase_margin" else max
    decisive = pick(frames, key=lambda frame: frame.value)
    if quantity == "settling_error":
        return 100 * decisive.value / max(frame.signal for frame in frames), decisive.name
    return decisive.value, decisive.name


def _simulated(subject: Subject, requirement: Requirement) -> Iterator[_Frame]:
    """The quantity for each hard frame."""
    whole, quantity = subject.design, requirement.quantity
    frames = list(frames_of(subject))
    for number, (state, frame) in enumerate(frames, 1):
        _log.info("%s: ngspice computes frame %d of %d", requirement.id, number, len(frames))
        design = _excerpt(whole, *((MOST_SENSED, MOST_DRIVEN) if whole.board.turned else (MOST_DRIVEN, MOST_SENSED)))
        rows, columns = design.array.shape
        cells = frame[:rows, :columns]
        period, signal = None, 0.0
        if quantity == "settling_error":
            period = 1.0 / (rate_of(subject, requirement) * whole.board.shape[0])
            if design.readout.amplifier_model is None:
                latest = TIMES_SETTLED * Settling(_linear(design), cells).shortest_period(SETTLED)
                period = min(period, latest)
        reading = spice.dynamic_reading(design, cells, 0, period=period, analyses=[SIMULATED[quantity][1]])
        if quantity == "settling_error":
            signal = float(np.abs(reading.settled - design.readout.reference_voltage).max())
            value = float(np.abs(reading.sampled - reading.settled).max())
        else:
            value = reading.phase_margin if quantity == "phase_margin" else reading.noise
        if not np.isfinite(value):
            raise NotRun(f"ngspice found no number for {state}: the loop gain has no crossover, or nothing settled")
        yield _Frame(state, value, signal, reading.dropped)


def _excerpt(design: Design, most_rows: int, most_columns: int) -> Design:
    """The first lines of a large array: ngspice takes minutes for the whole."""
    rows, columns = min(design.array.rows, most_rows), min(design.array.columns, most_columns)
    if (rows, columns) == design.array.shape:
        return design
    sensed = rows if design.board.turned else columns
    cut: dict[str, dict[str, object]] = {"array": {"rows": rows, "columns": columns}, "readout": {}}
    for name in ("array", "readout"):
        section = getattr(design, name)
        for key in type(section).PARTS:
            value = getattr(section, key)
            if isinstance(value, tuple):
                kept = sensed if name == "readout" else rows if key.startswith("row") else columns
                cut[name][key] = value[:kept]
    faults = tuple(fault for fault in design.fault if fault.place[0] < rows - 1 and fault.place[1] < columns - 1)
    return design.replace(**cut, fault=faults)


def _linear(design: Design) -> Design:
    """One-pole amplifiers without limits and offsets, each column with a sampling capacitor of its own.

    Before the selection there is no signal, which offsets would bring, and a single-supply output would stand at its
    limit.
    """
    ideal = {"offset_voltage": 0.0, "bias_current": 0.0, "supply": (-inf, inf), "amplifier_model": None}
    alike = design.replace(readout=ideal)
    return alike if alike.adc is None else alike.replace(adc={"acquisition_time": 0.0})


Row = tuple[str, float, str, str]
"""Name, difference in %, and both values of the first sensed line."""


def _static(design: Design, cells: FloatArray) -> Row:
    row = min(1, design.array.rows - 1)
    found = spice.run_control(spice.netlist(design, cells, row))
    its = np.array([found[f"volts_{j}"] for j in range(design.array.columns)])
    ours = scan(design, cells, method="exact").volts[row]
    return _compared(f"settled readings of row {row}", ours, its, design)


def _dynamic(design: Design, cells: FloatArray) -> list[Row]:
    alike = _linear(design)
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


def _beside_the_model(design: Design, cells: FloatArray) -> Table:
    """What the one-pole analysis of the report says, and what the maker's macro-model does in the same circuit."""
    model = design.readout.amplifier_model
    assert model is not None
    line = min(1, design.board.shape[0] - 1)
    alike = _linear(design)
    settling = Settling(alike, cells)
    period = settling.shortest_period(0.01)
    settled = _of_line(alike, settling.settled, line)
    signal = float(np.abs(settled - design.readout.reference_voltage).max())
    left = float(np.abs(_of_line(alike, settling.sampled_from_rest(period), line) - settled).max() / signal)
    margin = float(_of_line(alike, stability(alike, cells).phase_margin, line)[0])
    rows = []
    found, why = _its(design, cells, line, period, "transient")
    if found is None:
        rows.append(["transient analysis", "", f"not run: {why}", ""])
    else:
        its_left = float(np.abs(found.sampled - found.settled).max() / signal)
        rows.append(["settled reading", *_pair(float(settled[0]), float(found.settled[0]), "V")])
        rows.append([f"error after {engineering(period, 's')}", *_pair(100 * left, 100 * its_left, "%")])
    found, why = _its(design, cells, line, period, "loop gain")
    its_margin = _pair(margin, found.phase_margin, "°") if found else [engineering(margin, "°"), f"not run: {why}", ""]
    rows.append(["phase margin", *its_margin])
    if design.readout.temperature:
        rms = float(_of_line(alike, noise(alike, cells).before_adc, line)[0])
        found, why = _its(design, cells, line, period, "noise")
        its_noise = _pair(rms, found.noise, "V") if found else [engineering(rms, "V"), f"not run: {why}", ""]
        rows.append(["noise before the converter", *its_noise])
    dropped = "" if not found or not found.dropped else f" ngspice leaves out its {', '.join(found.dropped)}."
    return Table(
        ["quantity, first line", "one-pole analysis", "macro-model", "difference"],
        rows,
        f"The maker's model {model.subcircuit} in place of the one-pole amplifier. The amplifiers differ here, not the "
        f'solvers. A requirement with the method "spice" is judged by the model.{dropped}',
    )


def _its(
    design: Design, cells: FloatArray, line: int, period: float, analysis: str
) -> tuple[spice.DynamicReading | None, str]:
    """One analysis of the macro-model; or None, and ngspice's reason."""
    try:
        return spice.dynamic_reading(design, cells, line, period=period, analyses=[analysis]), ""
    except SolverError as error:
        return None, str(error)


def _pair(ours: float, its: float, unit: str) -> list[str]:
    return [engineering(ours, unit), engineering(its, unit), engineering(its - ours if isfinite(its) else nan, unit)]


def _of_line(design: Design, values: FloatArray, line: int) -> FloatArray:
    """Values (rows, columns) while one driven line is selected, (sensed lines,)."""
    return values[:, line] if design.board.turned else values[line]


def _compared(name: str, ours: FloatArray, its: FloatArray, design: Design) -> Row:
    signal = np.abs(ours - design.readout.reference_voltage).max()
    difference = float(100 * np.abs(ours - its).max() / signal)
    return name, difference, engineering(float(ours[0]), "V", 6), engineering(float(its[0]), "V", 6)
