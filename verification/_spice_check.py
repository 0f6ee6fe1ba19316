"""SPICE as a judge: the report's readings, settling and noise against ngspice."""

from __future__ import annotations

from math import inf

import numpy as np

from ..circuits import Design, Requirement, Settling, noise, scan, spice
from ..errors import InputError, MissingExtra, SolverError
from ._outcome import Measurement, NotRun, Table
from ._subject import Subject
from ._units import engineering

LARGEST = 8
"""lines in each direction that ngspice is given"""
SHARE_OF_SETTLING = 0.25
"""of the time to settle to 1 %: late enough to be near, early enough to tell a wrong model"""


def spice_agreement(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest difference from ngspice of readings, of sampled readings on their way, and of noise, %."""
    design = _excerpt(subject.design)
    cells = np.full(design.array.shape, subject.rest)
    cells[::2] = subject.pressed
    row = min(1, design.array.rows - 1)
    try:
        rows = _static(design, cells, row)
        if design.readout.circuit == "inverting-amplifier" and np.isfinite(design.readout.gain_bandwidth):
            rows += _dynamic(design, cells, row)
    except MissingExtra as error:
        raise NotRun(str(error)) from error
    except (SolverError, InputError) as error:
        raise NotRun(f"ngspice: {error}") from error
    worst = max(rows, key=lambda item: item[1])
    table = [[name, ours, its, engineering(difference, "%")] for name, difference, ours, its in rows]
    return Measurement(
        worst[1],
        "%",
        where=worst[0],
        confidence="ngspice shares no code with the solvers",
        tables=[Table(["quantity, column 0", "ohmskin", "ngspice", "largest difference"], table, "Against ngspice.")],
    )


def _excerpt(design: Design) -> Design:
    """The first lines of a large array: ngspice takes minutes for the whole."""
    rows, columns = (min(count, LARGEST) for count in design.array.shape)
    if (rows, columns) == design.array.shape:
        return design
    cut: dict[str, dict[str, object]] = {"array": {"rows": rows, "columns": columns}, "readout": {}}
    for name in ("array", "readout"):
        section = getattr(design, name)
        for key in type(section).PARTS:
            value = getattr(section, key)
            if isinstance(value, tuple):
                cut[name][key] = value[: rows if key.startswith("row") else columns]
    faults = tuple(fault for fault in design.fault if fault.place[0] < rows - 1 and fault.place[1] < columns - 1)
    return design.replace(**cut, fault=faults)


Row = tuple[str, float, str, str]
"""Name, difference in %, and both values of column 0."""


def _static(design: Design, cells: np.ndarray, row: int) -> list[Row]:
    found = spice.run_control(spice.netlist(design, cells, row))
    its = np.array([found[f"volts_{j}"] for j in range(design.array.columns)])
    ours = scan(design, cells, method="exact").volts[row]
    return [_compared(f"settled reading of row {row}", ours, its, design)]


def _dynamic(design: Design, cells: np.ndarray, row: int) -> list[Row]:
    # The linear model is what is compared: before the selection there is no signal, which offsets would bring, and a
    # single-supply output would stand at its limit.
    alike = design.replace(readout={"offset_voltage": 0.0, "bias_current": 0.0, "supply": (-inf, inf)})
    settling = Settling(alike, cells)
    period = SHARE_OF_SETTLING * settling.shortest_period(0.01)
    if alike.adc is not None and alike.adc.acquisition_time:
        alike = alike.replace(adc={"acquisition_time": 0.0})
        settling = Settling(alike, cells)
        period = SHARE_OF_SETTLING * settling.shortest_period(0.01)
    found = spice.dynamic_reading(alike, cells, row, period=period)
    ours = settling.sampled_from_rest(period)[row]
    scatter = noise(alike, cells)
    rows = [
        _compared(f"reading {engineering(period, 's')} after the selection of row {row}", ours, found.sampled, alike)
    ]
    if alike.readout.voltage_noise or alike.readout.temperature:
        rms = float(scatter.before_adc[row, 0])
        difference = 100 * abs(found.noise / rms - 1) if alike.readout.temperature else 0.0
        rows.append(("noise before the converter", difference, engineering(rms, "V"), engineering(found.noise, "V")))
    return rows


def _compared(name: str, ours: np.ndarray, its: np.ndarray, design: Design) -> Row:
    signal = np.abs(ours - design.readout.reference_voltage).max()
    difference = float(100 * np.abs(ours - its).max() / signal)
    return name, difference, engineering(float(ours[0]), "V", 6), engineering(float(its[0]), "V", 6)
