"""Self-test of the virtual board: continuity of the lines, and reference resistors read through the real circuit."""

from __future__ import annotations

import numpy as np

from ..circuits import Design, adc_codes, apparent_resistance, clipped, ideal_volts, scan, volts_of_codes
from ..common.arrays import BoolArray, FloatArray
from ..wire import LineState
from ._tuning import SHORT_OHM, SILENT_STEPS

TestedLines = tuple[LineState, ...]


def self_test(
    design: Design, resistance: FloatArray, references_ohm: tuple[float, ...] = ()
) -> tuple[TestedLines, TestedLines, tuple[tuple[float, float], ...]]:
    """Test the board as its own firmware would.

    A line is open when none of its readings differs from that of an open cell. A line is shorted when it is joined to
    another one, or when all of its readings are at the end of the converter where large currents read.

    Args:
        design: of the readout, with its faults; it has an ADC.
        resistance: (rows, columns) ohm of the cells now.
        references_ohm: nominal resistances that the board can switch in place of a cell.

    Returns:
        States of the rows, states of the columns, and (nominal, measured) ohm of each reference resistor.

    """
    counts = adc_codes(design, scan(design, resistance).volts)
    open_count = adc_codes(design, ideal_volts(design, np.full(design.array.shape, np.inf))).astype(np.int64)
    silent = np.abs(counts.astype(np.int64) - open_count) < SILENT_STEPS
    railed = clipped(design, counts) & ~silent
    joined = {"bridged-rows": set[int](), "bridged-columns": set[int]()}
    for fault in design.fault:
        if fault.bridge and fault.ohms < SHORT_OHM:
            axis = 0 if fault.kind == "bridged-rows" else 1
            joined[fault.kind] |= {end[axis] for end in fault.ends}
    rows = _states(silent.all(axis=1), railed.all(axis=1), joined["bridged-rows"])
    columns = _states(silent.all(axis=0), railed.all(axis=0), joined["bridged-columns"])
    return rows, columns, tuple((nominal, _measure(design, nominal)) for nominal in references_ohm)


def _states(silent: BoolArray, railed: BoolArray, joined: set[int]) -> TestedLines:
    states = []
    for line, (is_silent, is_railed) in enumerate(zip(silent.tolist(), railed.tolist(), strict=True)):
        if line in joined or is_railed:
            states.append(LineState.SHORTED)
        else:
            states.append(LineState.OPEN if is_silent else LineState.GOOD)
    return tuple(states)


def _measure(design: Design, nominal_ohm: float) -> float:
    """Ohm that the board's own readout makes of one reference resistor, through drive, amplifier and converter."""
    alone = design.replace(array={"rows": 1, "columns": 1}, fault=())
    counts = adc_codes(alone, scan(alone, np.array([[nominal_ohm]])).volts)
    return float(apparent_resistance(alone, volts_of_codes(alone, counts))[0, 0])
