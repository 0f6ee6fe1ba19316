"""Electrical stress: voltage and power in the cells, current and power in the row switches. All are upper bounds."""

from __future__ import annotations

import numpy as np

from ..circuits import Requirement
from ._outcome import Measurement, NotRun
from ._parameters import SECTION
from ._static import excursion_of, worst_of
from ._subject import Subject
from ._units import engineering


def _drive(subject: Subject) -> float:
    """V: the largest drive voltage of any board."""
    voltage = subject.factors.centre["drive.voltage"][0]
    return float(abs(voltage) + np.abs(subject.factors.matrix["drive.voltage"]).sum())


def _swing(subject: Subject) -> float:
    """V: the largest voltage that can stand across a cell, a column pulled away from the reference included."""
    readout = subject.design.readout
    limits = [abs(limit - readout.reference_voltage) for limit in readout.supply if np.isfinite(limit)]
    offset = subject.factors.centre["readout.offset_voltage"]
    offset = np.abs(offset) + np.abs(subject.factors.matrix["readout.offset_voltage"]).sum(axis=1)
    column = (
        max(limits) if limits and subject.design.board.circuit.has_amplifiers and _saturates(subject) else offset.max()
    )
    return _drive(subject) + float(column)


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
    key = f"{SECTION[name]}.{name}"
    lead = subject.factors.centre[key] + np.abs(subject.factors.matrix[key]).sum(axis=1)
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
