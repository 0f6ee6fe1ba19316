"""Search for wrong live readings: quantised streams of random boards of every circuit, against the cells behind them.

``python -m ohmskin.bench.hunt --live``. Each stream is made from a family's name and a number: a board, fingers that
move over its skin, and eight equal frames at the end. The driver's :class:`.CountReader` takes the counts. Findings:

* a *wrong cell*: valid, and off by more than its uncertainty (with noise: by five standard deviations, since an
  uncertainty covers three and a search sees millions of readings);
* a *factor of two*: valid, and off by more than that;
* an *unsolved* frame: right readings for which no cells are found;
* an *unsettled* stream: cells are still called unsettled in the last of eight equal frames.

How much work a frame may take is a limit in the code (tests/test_live.py); ``slowest`` is measured.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from time import monotonic, process_time
from typing import Any

import click
import numpy as np

from ..arrays import FloatArray
from ..circuits import Design, Reason, adc_codes, scan
from ..driver import CountReader
from ..errors import SolverError

MOVING, HELD = 12, 8
"""frames"""
FAMILIES: dict[str, tuple[str, str, str]] = {
    "inverting": ("inverting-amplifier", "ground", "float"),
    "row": ("row-amplifier", "ground", "float"),
    "floating": ("inverting-amplifier", "float", "float"),
    "divider": ("voltage-divider", "ground", "float"),
    "loaded": ("voltage-divider", "ground", "load"),
    "open divider": ("voltage-divider", "float", "float"),
    "feedback": ("voltage-feedback", "ground", "float"),
}
"""circuit, idle rows and idle columns"""

Draw = np.random.Generator


@dataclass(frozen=True)
class Stream:
    """Readings of one board."""

    design: Design
    cells: FloatArray
    """(frames, rows, columns) ohm"""
    noise_steps: float
    """standard deviation before the converter, in ADC steps"""
    counts: list[np.ndarray[Any, Any]]
    """for each frame"""


def stream(family: str, number: int) -> Stream | None:
    """The stream of one number of a family; None where the board cannot be read at all."""
    draw = np.random.default_rng([number, *family.encode()])
    design = _design(draw, *FAMILIES[family])
    cells = _pressed(draw, design)
    assert design.adc is not None
    noise_steps = float(draw.choice([0.0, 0.0, 0.3, 0.5, 2.0]))
    counts = []
    for frame in cells:
        try:
            volts = scan(design, frame).volts
        except SolverError:
            return None
        noisy = volts + draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
        counts.append(adc_codes(design, noisy))
    return Stream(design, cells, noise_steps, counts)


def _design(draw: Draw, circuit: str, idle_rows: str, idle_columns: str) -> Design:
    rows, columns = draw.integers(2, 9, 2).tolist()
    amplified = circuit.endswith("amplifier")
    sensed = rows if circuit == "row-amplifier" else columns
    lead, segment = (float(draw.choice(values)) for values in ([0.0, 1.0, 5.0, 25.0, 100.0], [0.0, 0.0, 0.2, 2.0]))
    array: dict[str, Any] = {"rows": rows, "columns": columns, "row_segment": segment, "column_segment": segment}
    array |= {"row_lead": lead, "column_lead": float(draw.choice([0.0, lead, lead]))}
    if draw.random() < 0.2:
        array["row_lead"] = (lead * draw.uniform(0.5, 1.5, rows)).tolist()
    readout: dict[str, Any] = {"circuit": circuit, "idle_columns": idle_columns}
    readout["reference_resistance"] = float(draw.choice([1e3, 4.7e3, 10e3, 47e3]))
    adc_range, voltage = [0.0, 3.3], 3.3
    if amplified:
        voltage, adc_range[0] = -1.0, float(draw.choice([0.0, -0.1]))
    if circuit != "voltage-divider":
        readout["open_loop_gain"] = float(draw.choice([np.inf, 1e5, 1e3]))
        readout["supply"] = [-0.2, 3.3] if draw.random() < 0.7 else [-np.inf, np.inf]
        if draw.random() < 0.5:
            readout["offset_voltage"] = draw.uniform(-3e-3, 3e-3, sensed).tolist()
    faults = []
    for kind, resistance in (("shorted-cell", 3e3), ("open-cell", 1e4), ("open-cell", np.inf)):
        if draw.random() < 0.05:
            place = [int(draw.integers(rows)), int(draw.integers(columns))]
            faults.append({"kind": kind, "place": place, "resistance": resistance})
    return Design.model_validate(
        {
            "array": array,
            "drive": {"voltage": voltage, "idle_rows": idle_rows},
            "readout": readout,
            "adc": {"bits": int(draw.choice([8, 10, 12, 16])), "range": adc_range},
            "fault": faults,
        }
    )


def _pressed(draw: Draw, design: Design) -> FloatArray:
    """(frames, rows, columns) ohm: two fingers that move, cells that are open or shorted, then all at rest."""
    shape = design.array.shape
    # At rest a reading is a tenth to a third of full scale.
    rest = _typical_ohm(design) * 10 ** draw.uniform(0.3, 1.0) * 10 ** draw.uniform(-0.1, 0.1, shape)
    hard = float(draw.choice([0.3, 0.1, 0.02]))  # resistance under a finger, over that at rest
    place, row, column = draw.uniform(0, 1, (2, 2)) * shape, *np.indices(shape)
    frames = []
    for number in range(MOVING):
        place = (place + draw.normal(0.0, 0.15, (2, 2))) % shape
        load = sum(
            np.exp(-((row - at[0]) ** 2 + (column - at[1]) ** 2)) * (0.5 + 0.5 * np.sin(number / 4 + k))
            for k, at in enumerate(place)
        )
        frames.append(rest / (1.0 + np.minimum(load, 1.0) ** 2 * (1.0 / hard - 1.0)))
    cells = np.array(frames)
    if draw.random() < 0.3:
        for _ in range(draw.integers(1, 4)):
            odd = float(draw.choice([np.inf, 1e-2, 1.0, 30.0, 1e8]))
            cells[:, draw.integers(shape[0]), draw.integers(shape[1])] = odd
    return np.concatenate([cells, np.repeat(cells[-1:], HELD, axis=0)])


def _typical_ohm(design: Design) -> float:
    reference = design.readout.reference_resistance
    assert isinstance(reference, float)
    return reference * (0.3 if design.readout.circuit.endswith("amplifier") else 1.0)


@dataclass
class LiveTally:
    """What was found in one family."""

    boards: int = 0
    unreadable: int = 0
    """boards that cannot be read, so that no stream was made"""
    frames: int = 0
    valid: int = 0
    """cells"""
    cells: int = 0
    used: float = 0.0
    """largest error over its uncertainty, streams without noise"""
    slowest: float = 0.0
    """largest ratio of a frame's processor time to the stream's median, of frames after the first with valid cells; the
    machine's load counts"""
    findings: list[str] = field(default_factory=list)

    def count(self, what: str) -> int:
        """Findings of one kind."""
        return sum(finding.startswith(what) for finding in self.findings)


KINDS = ("wrong cell", "factor of two", "unsolved", "unsettled")


def check(family: str, number: int, tally: LiveTally) -> None:
    """Read one stream and compare. ``work`` returns evaluations and derivatives since it was called last."""
    tally.boards += 1
    read_from = stream(family, number)
    if read_from is None:
        tally.unreadable += 1
        return
    found: dict[str, str] = {}
    reader = CountReader(read_from.design)
    times: list[float] = []
    unsettled = False
    for frame, (counts, cells) in enumerate(zip(read_from.counts, read_from.cells, strict=True)):
        start = process_time()
        reading = reader(counts.astype(np.uint16))
        elapsed = process_time() - start
        if 0 < frame < MOVING and reading.valid.any():  # others take next to no time
            times.append(elapsed)
        valid = reading.valid
        tally.frames += 1
        tally.valid, tally.cells = tally.valid + int(valid.sum()), tally.cells + cells.size
        if not reading.solved:
            found["unsolved"] = f"frame {frame}"
        if valid.any():
            with np.errstate(divide="ignore"):
                off = np.abs(reading.resistance[valid] / cells[valid] - 1.0)
            used = float((off / reading.uncertainty[valid]).max())
            if not read_from.noise_steps:
                tally.used = max(tally.used, used)
            surprised = frame == 0 and read_from.noise_steps > 0.5  # than the reader assumes before it can measure
            if not surprised and used > (5.0 / 3.0 if read_from.noise_steps else 1.0 + 1e-9):
                found["wrong cell"] = f"frame {frame}, error {used:.2f} uncertainties"
            if not surprised and np.abs(np.log2(reading.resistance[valid] / cells[valid])).max() > 1.0:
                found["factor of two"] = f"frame {frame}"
        unsettled = bool((reading.reason == Reason.UNSETTLED).any())
    if unsettled and not read_from.noise_steps:
        found["unsettled"] = "in the last frame"
    if times:
        tally.slowest = max(tally.slowest, max(times) / float(np.median(times)))
    tally.findings += [f"{what}: {family}:{number}, {where}" for what, where in found.items()]


def run(seed: int, seconds: float) -> int:
    """Check stream after stream, one of each family in turn, until the time is up. Returns the number of findings."""
    tallies = {family: LiveTally() for family in FAMILIES}
    start, number = monotonic(), seed * 10_000_000
    with contextlib.suppress(KeyboardInterrupt):  # the search may be ended at any time
        while monotonic() - start < seconds:
            for family, tally in tallies.items():
                known = len(tally.findings)
                check(family, number, tally)
                for finding in tally.findings[known:]:
                    click.echo(finding)
            number += 1
    click.echo(table(tallies))
    return sum(len(tally.findings) for tally in tallies.values())


def table(tallies: dict[str, LiveTally]) -> str:
    """The tallies as text."""
    lines = [
        f"{'family':13} {'boards':>7} {'unread':>7} {'frames':>7} {'valid':>7} {'used':>6} {'slowest':>8}  findings: "
        + ", ".join(KINDS)
    ]
    for family, tally in tallies.items():
        kinds = ", ".join(str(tally.count(kind)) for kind in KINDS)
        valid = 100.0 * tally.valid / max(tally.cells, 1)
        lines.append(
            f"{family:13} {tally.boards:7} {tally.unreadable:7} {tally.frames:7} {valid:6.1f}% {tally.used:6.2f}"
            f" {tally.slowest:8.1f}  {len(tally.findings)}: {kinds}"
        )
    return "\n".join(lines)
