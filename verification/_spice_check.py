"""SPICE as a judge: settling, phase margin and noise by ngspice.

Two questions are kept apart. :mod:`.quantities.spice_agreement` asks whether ohmskin's solvers are right: ngspice gets
the same one-pole amplifiers, and must find the same numbers. Here the question is whether the board is right: a
requirement with the method "spice" is judged by what ngspice finds, with the maker's macro-model where the design names
one.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from math import inf
from typing import NamedTuple

import numpy as np

from ..circuits import Design, Requirement, Settling, spice
from ..common.arrays import FloatArray
from ..errors import InputError, MissingExtra, SolverError
from ._dut import DesignUnderTest
from ._judging import worst_of
from ._outcome import DoesNotApply, Measurement, NotRun
from ._units import engineering
from ._whole_board import SETTLED, PhaseMarginTarget
from .quantities.settling import nominal_settling, rate_of

MOST_DRIVEN, MOST_SENSED = 64, 4
"""lines that ngspice is given where its numbers are judged: an amplifier is loaded by all cells of its own line"""
_log = logging.getLogger(__name__)


def measured_in_spice(dut: DesignUnderTest, requirement: Requirement, analysis: str, unit: str) -> Measurement:
    """A quantity as ngspice finds it with nominal parts, on the frames that the analysis finds worst.

    Args:
        dut: the design under test.
        requirement: names the quantity, and may name a frame rate.
        analysis: of ngspice, that finds the quantity; empty: none does.
        unit: of the quantity.

    Raises:
        NotRun: the quantity or the circuit has no netlist in time, ngspice is missing, or it found no result.
        DoesNotApply: there is no feedback loop.
    """
    design = dut.design
    if not analysis:
        raise NotRun(f"'{requirement.quantity}' has no netlist")
    if not design.board.circuit.has_amplifiers:
        if analysis == "loop gain":
            raise DoesNotApply(f"'{design.readout.circuit}' has no feedback loop")
        raise NotRun(f"the netlist in time is for circuits with feedback, not for '{design.readout.circuit}'")
    try:
        found = list(_simulated(dut, requirement, analysis))
    except MissingExtra as error:
        raise NotRun(str(error)) from error
    except (SolverError, InputError) as error:
        raise NotRun(f"ngspice: {error}") from error
    pick = min if analysis == "loop gain" else max
    decisive = pick(found, key=lambda frame: frame.value)
    value = decisive.value
    if analysis == "transient":
        value *= 100 / max(frame.signal for frame in found)
    model = design.readout.amplifier_model
    amplifier = "amplifier of one pole" if model is None else f"macro-model {model.subcircuit} of {model.file.name}"
    dropped = dict.fromkeys(name for frame in found for name in frame.dropped)
    return Measurement(
        value,
        unit,
        where=decisive.name,
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


def _frames(dut: DesignUnderTest, requirement: Requirement, analysis: str) -> Iterator[tuple[str, FloatArray]]:
    """The frame on which the one-pole analysis is worst with nominal parts, and all cells at each end."""
    low, high = dut.extremes
    for ohms in (low, high):
        yield f"all cells at {engineering(ohms, 'ohm')}", np.full(dut.design.array.shape, ohms)
    try:
        if analysis == "transient":
            found = nominal_settling(dut, rate_of(dut, requirement))
        elif analysis == "loop gain":
            found = worst_of(dut, PhaseMarginTarget(), "nominal")
        else:
            return
    except NotRun:  # nothing is searched without the one-pole amplifier
        return
    yield found.where, found.frames[0]


def _simulated(dut: DesignUnderTest, requirement: Requirement, analysis: str) -> Iterator[_Frame]:
    """The quantity for each frame."""
    whole = dut.design
    design = excerpt(whole, *((MOST_SENSED, MOST_DRIVEN) if whole.board.transposed else (MOST_DRIVEN, MOST_SENSED)))
    frames = list(_frames(dut.with_design(design), requirement, analysis))
    for number, (state, cells) in enumerate(frames, 1):
        _log.info("%s: ngspice computes frame %d of %d", requirement.id, number, len(frames))
        period, signal = None, 0.0
        if analysis == "transient":
            period = 1.0 / (rate_of(dut, requirement) * whole.board.shape[0])
            if design.readout.amplifier_model is None:
                period = min(period, Settling(linear(design), cells).shortest_period(SETTLED))
        for line in range(design.board.shape[0]) if analysis == "transient" and number > 2 else (0,):
            reading = spice.dynamic_reading(design, cells, line, period=period, analyses=[analysis])
            if analysis == "transient":
                signal = float(np.abs(reading.settled - design.readout.reference_voltage).max())
                value = float(np.abs(reading.sampled - reading.settled).max())
            else:
                value = reading.phase_margin if analysis == "loop gain" else reading.noise
            if not np.isfinite(value):
                raise NotRun(f"ngspice found no number for {state}: there is no crossover, or nothing settled")
            yield _Frame(state, value, signal, reading.dropped)


def excerpt(design: Design, most_rows: int, most_columns: int) -> Design:
    """The first lines of a large array: ngspice takes minutes for the whole."""
    rows, columns = min(design.array.rows, most_rows), min(design.array.columns, most_columns)
    if (rows, columns) == design.array.shape:
        return design
    sensed = rows if design.board.transposed else columns
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


def linear(design: Design) -> Design:
    """One-pole amplifiers without limits and offsets, each column with a sampling capacitor of its own.

    Before the selection there is no signal, which offsets would bring, and a single-supply output would stand at its
    limit.
    """
    ideal = {"offset_voltage": 0.0, "bias_current": 0.0, "supply": (-inf, inf), "amplifier_model": None}
    alike = design.replace(readout=ideal)
    return alike if alike.adc is None else alike.replace(adc={"acquisition_time": 0.0})
