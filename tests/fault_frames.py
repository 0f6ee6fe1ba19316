"""What a faulty cell costs the others, on every kind of board: valid cells, processor time, and what is attainable.

``python tests/fault_frames.py --size 8`` prints one line per board and fault: the share of valid cells, the share that
half an ADC step of each unlimited reading leaves known to a half (by differences of scans), and the longest and the
median of the frames with the fault, in usual frames of the same board. Differences say 0 where others depend on a
short whose logarithm they leave open, as on dividers that ground idle columns: readings bound the short itself, one of
0.5 ohm to 7, for which the others move by 15 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from time import process_time
from typing import Any

import numpy as np
from live import counts_of

from ohmskin.circuits import Design, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader

BOARDS: dict[str, tuple[str, str, str]] = {
    "amplifiers": ("inverting-amplifier", "ground", "parallel"),
    "amplifiers, floating rows": ("inverting-amplifier", "float", "parallel"),
    "amplifier, multiplexed, open": ("inverting-amplifier", "ground", "float"),
    "amplifier, multiplexed, floating rows": ("inverting-amplifier", "float", "float"),
    "amplifier, multiplexed, grounded": ("inverting-amplifier", "ground", "ground"),
    "followers": ("voltage-feedback", "ground", "parallel"),
    "divider, open columns": ("voltage-divider", "ground", "float"),
    "divider, loaded columns": ("voltage-divider", "ground", "load"),
    "divider, grounded columns": ("voltage-divider", "ground", "ground"),
    "divider, floating rows": ("voltage-divider", "float", "load"),
    "divider, floating, open columns": ("voltage-divider", "float", "float"),
    "divider, floating, grounded columns": ("voltage-divider", "float", "ground"),
    "divider, pulled rows": ("voltage-divider", "pull", "load"),
    "divider, pulled, grounded columns": ("voltage-divider", "pull", "ground"),
}
"""circuit, idle rows, and how columns are read, or how idle ones end"""
FAULTS = "short", "open", "limit", "two shorts", "two limits", "seven shorts", "pressed"
BEFORE, DURING = 40, 12
"""frames before a fault and with it"""


def boards(size: int, lead: float, bits: int) -> Iterator[tuple[str, Design]]:
    """The boards, whose cells of 5 to 15 kohm lie in the middle of the converter's range."""
    for name, (circuit, idle_rows, columns) in BOARDS.items():
        amplifier = circuit.endswith("amplifier")
        drive: dict[str, Any] = {"voltage": -1.0 if amplifier else 3.3, "idle_rows": idle_rows}
        if idle_rows == "pull":
            drive["idle_row_resistance"] = 1e4
        readout: dict[str, Any] = {"circuit": circuit, "reference_resistance": 4.7e3}
        if amplifier:
            readout |= {"supply": [-0.2, 3.6]}
        if columns != "parallel":
            readout |= {"idle_columns": columns}
            if amplifier or columns == "ground":
                readout["columns"] = "multiplexed"
        yield (
            name,
            Design.model_validate(
                {
                    "array": {"rows": size, "columns": size, "row_lead": lead, "column_lead": lead},
                    "drive": drive,
                    "readout": readout,
                    "adc": {"bits": bits, "range": [0.0, 3.3]},
                    "cells": {"rest_resistance": 15e3, "full_scale_resistance": 3e3},
                }
            ),
        )


def faulty(cells: FloatArray, fault: str) -> FloatArray:
    """The same cells with a fault."""
    rows, columns = cells.shape
    cells, places = cells.copy(), [(rows // 3, columns // 2), (rows // 2 + 1, columns // 4)]
    some = [(int(i), int(j)) for i, j in zip(range(7), np.arange(7) * 3 % columns, strict=True) if i < rows]
    match fault:
        case "short":
            cells[places[0]] = 0.5
        case "open":
            cells[places[0]] = np.inf
        case "limit":
            cells[places[0]] = 700.0
        case "two shorts":
            for place in places:
                cells[place] = 0.5
        case "two limits":
            for place in places:
                cells[place] = 700.0
        case "seven shorts":
            for place in some:
                cells[place] = 0.5
        case "pressed":
            cells[: rows // 2, : columns // 2] /= 4.0
    return cells


def allowed_share(design: Design, cells: FloatArray, free: np.ndarray[Any, Any]) -> float:
    """Share of cells whose conductance half an ADC step of each ``free`` reading leaves known to a half."""
    assert design.adc is not None
    half, step = design.adc.step / 2, 1e-4
    jacobian = np.empty((cells.size, cells.size))
    for k in range(cells.size):
        ends = []
        for sign in (1.0, -1.0):
            moved = cells.copy()
            moved.flat[k] *= np.exp(sign * step)
            ends.append(scan(design, moved, tolerance=1e-9).volts.ravel())
        jacobian[:, k] = (ends[0] - ends[1]) / (2 * step)
    jacobian = jacobian[free.ravel()][:, free.ravel()]
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    inverse = np.linalg.pinv(jacobian / size, rcond=1e-13) / size[:, None]
    worst, random = np.abs(inverse).sum(axis=1) * half, np.sqrt((inverse**2).sum(axis=1)) * half * np.sqrt(3.0)
    return float(np.count_nonzero(np.minimum(worst, random) < 0.5) / cells.size)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=8)
    parser.add_argument("--lead", type=float, default=1.0)
    parser.add_argument("--bits", type=int, default=12)
    parser.add_argument("--only", default="", help="boards whose names contain this")
    arguments = parser.parse_args()
    shape = arguments.size, arguments.size
    rest = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.2, 0.2, shape)
    print(f"{'board':40} {'fault':13} {'valid':>5} {'of':>4} {'wrong':>5} {'worst':>6} {'later':>6}   usual us")
    for name, design in boards(arguments.size, arguments.lead, arguments.bits):
        if arguments.only not in name:
            continue
        # One pattern that comes and goes: changes of each cell by itself would be noise.
        pattern = np.random.default_rng(1).uniform(-0.02, 0.02, shape)
        moving = [rest * (1.0 + pattern * np.sin(number)) for number in range(BEFORE + DURING)]
        codes = {fault: [counts_of(design, faulty(c, fault)) for c in moving[BEFORE:]] for fault in FAULTS}
        before = [counts_of(design, cells) for cells in moving[:BEFORE]]
        for fault in FAULTS:
            times, wrong = np.full(BEFORE + DURING, np.inf), 0
            for _ in range(2):  # the shorter time of each frame counts
                read = CountReader(design)
                for number, counts in enumerate(before + codes[fault]):
                    start = process_time()
                    found = read(counts)
                    times[number] = min(times[number], process_time() - start)
                    if number >= BEFORE:
                        with np.errstate(divide="ignore", invalid="ignore"):
                            off = np.abs(found.resistance / faulty(moving[number], fault) - 1.0) / found.uncertainty
                        wrong += int((off[found.valid] > 1.0).any())
            usual, last = float(np.median(times[BEFORE // 2 : BEFORE])), faulty(moving[-1], fault)
            volts = scan(design, last).volts
            free = (volts < min(design.readout.supply[1], 3.3)) & (volts > 0.0)
            of = allowed_share(design, np.minimum(last, 1e9), free)
            with_fault = times[BEFORE:] / usual
            print(
                f"{name:40} {fault:13} {100 * found.valid.mean():5.0f} {100 * of:4.0f} {wrong:5} "
                f"{with_fault.max():6.1f} {float(np.median(with_fault[2:])):6.1f}   {1e6 * usual:8.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
