"""Streams of boards from the product of all options, read by ``CountReader`` beside the independent :mod:`nodal` judge.

``python tests/option_product.py --streams 200 --seed 1`` prints one line per kind of board: wrong cells (valid, and off
by more than stated), valid cells, and the share that the readings' own derivatives allow.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np
from nodal import nodal_volts

from ohmskin.circuits import Design, adc_codes
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader

CIRCUITS = "inverting-amplifier", "row-amplifier", "voltage-divider", "voltage-feedback"
LINES = "parallel", "float", "ground", "load"
"""all columns read at once, or one by one with idle columns that end so"""
IDLE_ROWS = "ground", "float", "pull"
SIZES = "small", "row", "column", "usual", "large"
FAULTS = (
    "none",
    "none",
    "none",
    "shorted-cell",
    "open-cell",
    "broken-row",
    "broken-column",
    "bridged-rows",
    "bridged-columns",
)
EVENTS = "none", "short", "open", "saturated", "line", "press", "several"
FRAMES = 7


@dataclass
class Tally:
    """Counts of one kind of board."""

    streams: int = 0
    cells: int = 0
    valid: int = 0
    allowed: list[float] = field(default_factory=list)
    reached: list[float] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    slow: float = 0.0


def drawn(seed: int) -> tuple[str, Design, list[FloatArray], str]:
    """The kind of board, the board, its cells in each frame, and what happens to them."""
    draw = np.random.default_rng([seed, 20260])
    pick = lambda options: options[int(draw.integers(len(options)))]  # noqa: E731
    circuit, lines, idle_rows = pick(CIRCUITS), pick(LINES), pick(IDLE_ROWS)
    size = {
        "small": tuple(int(n) for n in draw.integers(1, 5, 2)),
        "row": (1, int(draw.integers(2, 10))),
        "column": (int(draw.integers(2, 10)), 1),
        "usual": tuple(int(n) for n in draw.integers(4, 9, 2)),
        "large": (11, 10) if draw.random() < 0.7 else (13, 9),
    }[pick(SIZES) if draw.random() < 0.9 else "usual"]
    amplifier = circuit.endswith("amplifier")
    if circuit == "voltage-divider" and lines == "parallel":
        lines = "load"
    if circuit == "voltage-feedback":
        lines, idle_rows = "parallel", "ground"
    lead = float(pick([0.0, 0.3, 1.0, 5.0, 25.0, 100.0]))
    segment = float(pick([0.0, 0.0, 0.0, 0.5, 5.0]))
    array: dict[str, Any] = {"rows": size[0], "columns": size[1], "row_segment": segment, "column_segment": segment}
    array |= {"row_lead": lead, "column_lead": float(pick([0.0, lead, lead]))}
    voltage = -1.0 if amplifier else 3.3
    drive: dict[str, Any] = {"voltage": voltage, "idle_rows": idle_rows}
    if idle_rows == "pull":
        drive["idle_row_resistance"] = float(10 ** draw.uniform(2.0, 5.0))
    reference = float(pick([1e3, 2e3, 1e4, 4.7e4]))
    readout: dict[str, Any] = {"circuit": circuit, "reference_resistance": reference}
    if amplifier and lines != "parallel":
        readout |= {"columns": "multiplexed", "idle_columns": lines}
    if circuit == "voltage-divider":
        readout["idle_columns"] = lines
        if lines == "ground":
            readout["columns"] = "multiplexed"
    if circuit != "voltage-divider":
        readout["open_loop_gain"] = float(pick([np.inf, np.inf, 1e5, 1e3]))
        readout["offset_voltage"] = float(pick([0.0, 0.0, 3e-3, -3e-3, 3e-4]))
        readout["supply"] = pick([[-0.2, 3.6], [0.0, 3.0], [-np.inf, np.inf]])
    adc = {"bits": int(pick([8, 10, 12, 12, 16])), "range": [-0.1 if amplifier and draw.random() < 0.5 else 0.0, 3.3]}
    faults = []
    kind = pick(FAULTS)
    i, j = int(draw.integers(size[0])), int(draw.integers(size[1]))
    if kind == "bridged-rows" and size[0] > 1:
        faults.append({"kind": kind, "place": [min(i, size[0] - 2), j], "resistance": float(pick([100.0, 2e3]))})
    elif kind == "bridged-columns" and size[1] > 1:
        faults.append({"kind": kind, "place": [i, min(j, size[1] - 2)], "resistance": float(pick([100.0, 2e3]))})
    elif kind not in ("none", "bridged-rows", "bridged-columns"):
        most = {"shorted-cell": 300.0}.get(kind, np.inf)
        faults.append({"kind": kind, "place": [i, j], "resistance": float(pick([1e3, most]))})
    design = Design.model_validate({"array": array, "drive": drive, "readout": readout, "adc": adc, "fault": faults})
    typical = reference * (1.0 if not amplifier else 3.0)
    rest = typical * draw.uniform(0.7, 1.5, size) * 10 ** draw.uniform(0.0, 0.6)
    event, frames = pick(EVENTS), []
    place = int(draw.integers(size[0])), int(draw.integers(size[1]))
    line, share = int(draw.integers(2)), float(pick([1e-3, 0.01, 0.1]))
    odd = [(int(draw.integers(size[0])), int(draw.integers(size[1])), float(pick([0.01, 1.0, 30.0, 1e8, np.inf])))
           for _ in range(4)]  # fmt: skip
    short = float(pick([0.01, 0.5, 5.0]))
    for number in range(FRAMES):
        cells = rest * draw.uniform(0.98, 1.02, size)
        if number >= 2:
            if event == "short":
                cells[place] = short
            elif event == "open":
                cells[place] = np.inf
            elif event == "saturated":
                cells[place] = reference * 0.15
            elif event == "line":
                cells[(place[0], slice(None)) if line else (slice(None), place[1])] *= share
            elif event == "press":
                cells *= share * draw.uniform(0.8, 1.2, size)
            elif event == "several":
                for row, column, ohm in odd:
                    cells[row, column] = ohm
        frames.append(np.maximum(cells, 1e-2))
    within = event not in ("line", "press") or share == 0.1  # else whole lines are below the range; single cells may be
    if draw.random() < 0.5 and within:
        design = design.replace(cells={"rest_resistance": 3.0 * typical, "full_scale_resistance": 0.5 * typical})
    kind = f"{circuit} {lines} {'follower' if circuit == 'voltage-feedback' else idle_rows}"
    return kind, design, frames, event


def allowed_share(design: Design, cells: FloatArray, free: np.ndarray[Any, Any]) -> float:
    """Share of cells whose conductance half an ADC step of each ``free`` reading leaves known to a half."""
    assert design.adc is not None
    half, step = design.adc.step / 2, 1e-4
    jacobian = np.empty((cells.size, cells.size))
    for k in range(cells.size):
        ends = []
        for sign in (1.0, -1.0):
            moved = cells.copy().ravel()
            moved[k] *= np.exp(sign * step)
            ends.append(nodal_volts(design, moved.reshape(cells.shape)).ravel())
        jacobian[:, k] = (ends[0] - ends[1]) / (2 * step)
    jacobian = jacobian[free.ravel()][:, free.ravel()]
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    inverse = np.linalg.pinv(jacobian / size, rcond=1e-13) / size[:, None]
    worst, random = np.abs(inverse).sum(axis=1) * half, np.sqrt((inverse**2).sum(axis=1)) * half * np.sqrt(3.0)
    return float(np.count_nonzero(np.maximum(np.minimum(worst, random), 0.0) < 0.5) / cells.size)


def check(seed: int, tallies: dict[str, Tally], *, derivatives: bool = True) -> None:
    """Read one stream."""
    kind, design, frames, event = drawn(seed)
    tally = tallies[kind]
    try:
        codes = [adc_codes(design, nodal_volts(design, cells)) for cells in frames]
    except (ArithmeticError, np.linalg.LinAlgError):
        return
    tally.streams += 1
    reader, times = None, []
    for number, (cells, counts) in enumerate(zip(frames, codes, strict=True)):
        start = process_time()
        try:
            reader = reader or CountReader(design)
            reading = reader(counts)
        except Exception as error:
            tally.failed.append(f"{seed}: {type(error).__name__} {error}"[:90])
            return
        times.append(process_time() - start)
        valid = reading.valid
        tally.cells += cells.size
        tally.valid += int(valid.sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            used = np.abs(reading.resistance / cells - 1.0)[valid] / reading.uncertainty[valid]
        if used.size and not used.max() <= 1.0 + 1e-9:
            most = float(used.max())
            tally.wrong.append(f"{seed} frame {number} {event}: {most:.1f} times the stated error")
            break
    if len(times) > 3:
        tally.slow = max(tally.slow, max(times[1:]) / np.median(times[1:]))
    ordinary = event in ("none", "short", "open") and not design.fault and cells.size <= 20 and np.isfinite(cells).all()
    if derivatives and ordinary and number == FRAMES - 1:
        level, top = design.readout.supply[1], design.adc.range[1] if design.adc else np.inf
        volts = nodal_volts(design, cells)
        free = (volts < min(level, top)) & (volts > design.adc.range[0])
        tally.allowed.append(allowed_share(design, cells, free))
        tally.reached.append(float(valid.mean()))


def main() -> int:
    """Print the table; exit code 1 if a cell was wrong or a reader failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streams", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    tallies: dict[str, Tally] = defaultdict(Tally)
    for seed in range(arguments.seed, arguments.seed + arguments.streams):
        check(seed, tallies)
    print(
        f"{'board':44} {'streams':>7} {'valid':>6} {'wrong':>5} {'failed':>6} {'allowed':>7} {'reached':>7} {'slow':>5}"
    )
    for kind, tally in sorted(tallies.items()):
        allowed, reached = (f"{100 * np.mean(each):.0f}" if each else "" for each in (tally.allowed, tally.reached))
        share = f"{100 * tally.valid / max(tally.cells, 1):.0f}"
        print(
            f"{kind:44} {tally.streams:7} {share:>6} {len(tally.wrong):5} {len(tally.failed):6} "
            f"{allowed:>7} {reached:>7} {tally.slow:5.0f}"
        )
        for finding in tally.wrong + tally.failed:
            print("   ", finding)
    streams, wrong, failed = (
        sum(f(t) for t in tallies.values())
        for f in (lambda t: t.streams, lambda t: len(t.wrong), lambda t: len(t.failed))
    )
    print(f"{streams} streams, {wrong} with a wrong cell, {failed} failed")
    return int(bool(wrong or failed))


if __name__ == "__main__":
    sys.exit(main())
