"""Upper bounds: the stress of cells, row switches and amplifier outputs, and the leakage of idle switches."""

from __future__ import annotations

import numpy as np

from ..circuits import Requirement
from ._outcome import DoesNotApply, Measurement, NotRun
from ._parameters import SECTION
from ._static import excursion_of, worst_of
from ._subject import Subject
from ._units import engineering


def _drive(subject: Subject) -> float:
    """V: the largest drive voltage of any board."""
    return float(subject.factors.largest("drive.voltage")[0])


def _offset(subject: Subject) -> float:
    """V: the largest offset of any amplifier."""
    return float(subject.factors.largest("readout.offset_voltage").max())


def _swing(subject: Subject) -> float:
    """V: the largest voltage that can stand across a cell, a column pulled away from the reference included."""
    readout = subject.design.readout
    limits = [abs(limit - readout.reference_voltage) for limit in readout.supply if np.isfinite(limit)]
    return _drive(subject) + (max(limits) if limits and _saturates(subject) else _offset(subject))


def _saturates(subject: Subject) -> bool:
    limited = excursion_of(subject.design, "output_headroom") is not None
    return limited and worst_of(subject, "output_headroom").value > 0


def cell_voltage(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest voltage across a cell, V."""
    return Measurement(
        _swing(subject),
        "V",
        where="a selected row against a column at the end of its range",
        confidence="upper bound: leads and segments take nothing",
    )


def cell_power(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest power in a cell while its row is selected, W."""
    volts, (least, _) = _swing(subject), subject.extremes
    return Measurement(
        volts**2 / least,
        "W",
        where=f"a cell of {engineering(least, 'ohm')} at {engineering(volts, 'V')}",
        confidence="upper bound: leads and segments take nothing",
        text=["While its row is selected; averaged over a frame it is smaller by the number of lines."],
    )


def switch_current(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest current through the switch of a selected row, A."""
    amperes, where = _switch_current(subject)
    return Measurement(amperes, "A", where=where, confidence="upper bound: leads and segments take nothing")


def _switch_current(subject: Subject) -> tuple[float, str]:
    volts, (least, _) = _swing(subject), subject.extremes
    board = subject.design.board
    count = board.shape[1]
    return count * volts / least, f"a {board.line_kinds[0]} of {count} cells at {engineering(least, 'ohm')}"


def switch_power(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest power in the switch and lead of a selected row, W."""
    driven = subject.design.board.line_kinds[0]
    name = f"{driven}_lead"
    lead = subject.factors.largest(f"{SECTION[name]}.{name}")
    if not lead.any():
        raise NotRun(f"missing: array.{name}")
    volts, (least, _) = _swing(subject), subject.extremes
    load = least / subject.design.board.shape[1]  # ohm: the cells of the line side by side
    power = np.max(volts**2 * lead / (lead + load) ** 2)
    matched = volts**2 / (4 * load)  # no resistance in series can take more
    row = int(np.argmax(lead))
    _, where = _switch_current(subject)
    return Measurement(
        float(min(power, matched)),
        "W",
        where=f"{driven} {row} of {engineering(float(lead[row]), 'ohm')}; {where}",
        confidence="upper bound: the columns stand at one end of their range",
    )


def output_current(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest current that an amplifier's output delivers into the array, A."""
    board, (least, _) = subject.design.board, subject.extremes
    if not board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{subject.design.readout.circuit}' has no amplifier that drives the array")
    driven, sensed = board.shape
    selected, others = _swing(subject) / least, 2.0 * _offset(subject) / least
    if board.circuit.virtual_ground:
        bias = float(subject.factors.largest("readout.bias_current").max())
        # Open columns and rows pass on to one amplifier what all cells of the selected row, or of its column, take.
        passed_on = board.multiplexed and board.floating and board.idle_columns != "ground"
        count = min(driven, sensed) if passed_on else 1
        amperes = count * selected + (driven - 1) * others + bias
        where = f"{'all cells' if passed_on else 'one cell'} of {engineering(least, 'ohm')} selected"
    else:
        amperes = (sensed - 1) * selected + (driven - 1) * others
        where = f"{sensed - 1} idle {board.line_kinds[1]}s, driven against the selected {board.line_kinds[0]}"
    return Measurement(amperes, "A", where=where, confidence="upper bound: leads and segments take nothing")


def leakage_error(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Largest change of a reading by the leakage of the switches of all idle driven lines, % of that reading."""
    design = subject.design
    leakage, (least, largest) = design.drive.idle_leakage, subject.extremes
    if not leakage:
        raise NotRun("missing: drive.idle_leakage")
    board = design.board
    idle, kind = board.shape[0] - 1, board.line_kinds[0]
    drive = subject.factors.centre["drive.voltage"][0]
    signal = (2 * abs(drive) - _drive(subject)) / largest  # A of the selected cell at its largest resistance
    if board.floating:
        stray, where = idle * leakage, f"all idle {kind}s leak into the column that is read"
    else:
        name = f"{kind}_lead"
        lead = float(subject.factors.largest(f"{SECTION[name]}.{name}").max())
        volts = leakage * lead
        stray, where = idle * volts / least, f"idle {kind}s are lifted by {engineering(volts, 'V')} at their switches"
    return Measurement(
        100 * stray / signal if signal > 0 else np.inf,
        "%",
        where=f"a cell of {engineering(largest, 'ohm')}; {where}",
        confidence="upper bound: all leakages of one sign, the other cells at their least resistance",
    )
