"""Longest calls of the live recovery: what sudden changes cost on every kind of board, in usual frames.

The driver promises that a frame never costs more than ten usual ones. Five fingers that wander over the skin give the
usual frame (median), and each of :data:`EVENTS` changes much at once. The recovery is deterministic. Each stream is
therefore read twice, and of each frame the shorter processor time counts, so that a loaded machine does not.

A skin that has rested costs less than one with fingers. What it costs to wake it, all cells at once, is stated in usual
frames of the resting skin, packets to kPa with standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np

from ..cell import Cell
from ..circuits import Design, adc_codes, scan
from ..common.arrays import FloatArray
from ..driver import CountReader
from ._driver import APART_S, every_frame, packets_of, port_of
from .harness import column

LIMIT = 10.0
"""usual frames that a frame may cost"""
HARD_OHM = 5.0
"""of cells that are held at a short, so that their readings stand at a limit"""
PRESS_SHARE = 0.12
"""of its resistance at rest that a hard press leaves of a cell"""
NOISE_STEPS = 0.5
"""standard deviation of the outputs' noise in ADC steps"""
BEFORE, DURING, AFTER = 8, 12, 12
"""frames of an event"""
ASLEEP, SETTLING = 50, 34
"""frames at rest before a sleeping skin is pressed, and those in which its cells go to sleep"""
WAKES = 1.5
"""times their resistance at rest, of the example cells when they are pressed"""
HOLD, TAP = "held", "tapped"
LASTS = {HOLD: 30, TAP: 12}
"""frames for which a sleeping skin is pressed: what is back within 0.1 s may have been a bad contact"""
USUAL = 40
"""frames with wandering fingers"""

CASES: tuple[tuple[str, str, str, float, int, int], ...] = (
    ("inverting-amplifier", "ground", "float", 0.0, 12, 1),
    ("inverting-amplifier", "float", "float", 0.0, 12, 1),
    ("row-amplifier", "float", "float", 0.0, 12, 1),
    ("voltage-feedback", "ground", "float", 0.0, 12, 1),
    ("voltage-feedback", "ground", "float", 0.5, 12, 1),
    ("voltage-divider", "ground", "float", 0.0, 8, 2),
    ("voltage-divider", "ground", "float", 0.0, 12, 1),
    ("voltage-divider", "ground", "float", 0.0, 16, 1),
    ("voltage-divider", "ground", "float", 0.5, 12, 1),
    ("voltage-divider", "ground", "load", 0.0, 12, 1),
    ("voltage-divider", "float", "float", 0.0, 12, 1),
    ("voltage-divider", "float", "float", 0.5, 12, 1),
    ("voltage-divider", "float", "load", 0.0, 8, 1),
    ("voltage-divider", "float", "load", 0.0, 16, 1),
)
"""circuit, idle rows, idle columns, ohm of a line's segment, ADC bits, columns over rows"""
_LARGEST_FLOATING = 32  # rows beyond which boards with floating rows are left out: minutes
_FRAME_S = 0.005
_LEAD_OHM = 5.0
_REST_OHM = 10e3

Change = Callable[[FloatArray, np.random.Generator], FloatArray]


def _hard_press(rest: FloatArray, draw: np.random.Generator) -> FloatArray:
    return rest * PRESS_SHARE * 10 ** draw.uniform(-0.1, 0.1, rest.shape)


def _saturated(rest: FloatArray, draw: np.random.Generator) -> FloatArray:
    cells = rest.copy()
    cells.flat[draw.choice(rest.size, min(7, rest.size // 2), replace=False)] = HARD_OHM
    return cells


def _half_pressed(rest: FloatArray, draw: np.random.Generator) -> FloatArray:
    cells = rest.copy()
    cells[:, : max(1, rest.shape[1] // 2)] *= PRESS_SHARE
    return cells


def _open_cell(rest: FloatArray, draw: np.random.Generator) -> FloatArray:
    cells = rest.copy()
    cells.flat[int(draw.integers(rest.size))] = np.inf
    return cells


def _dead_row(rest: FloatArray, draw: np.random.Generator) -> FloatArray:
    cells = rest.copy()
    cells[int(draw.integers(len(rest)))] = np.inf
    return cells


EVENTS: dict[str, Change] = {
    "press": _hard_press,
    "half": _half_pressed,
    "saturated": _saturated,
    "open": _open_cell,
    "dead row": _dead_row,
}
"""hard press of all cells at once, and of half of them; seven cells at a limit; a cell without a contact; a row without
a driver. Each begins from rest and ends at once."""


HEAD = (
    f"longest call, counts to kPa, in usual frames of the same board, at most {LIMIT:g}; the first frame of all apart; "
    f"pressed as a whole from rest ({HOLD}, {TAP}) in usual frames of a reader of the skin at rest. Valid cells in "
    "percent with fingers, and at the end of each event (back); frames without any after it (without)"
)


@dataclass(frozen=True)
class WorstFrames:
    """One board."""

    board: str = field(metadata=column("board", "{}", width=46))
    rows: int = field(metadata=column("rows", "{}"))
    columns: int = field(metadata=column("columns", "{}"))
    first_ms: float = field(metadata=column("first ms", "{:.1f}"))
    """processor time of the first frame of all"""
    usual_us: float = field(metadata=column("usual us", "{:.0f}"))
    """median processor time of a frame with wandering fingers, counts to kPa by the default estimator"""
    wandering: float = field(metadata=column("fingers", "{:.1f}"))
    """longest of these frames, in usual ones"""
    events: dict[str, float] = field(metadata=column("{}", "{:.1f}"))
    """longest frame of each event, in usual frames; frames after the first"""
    asleep: dict[str, float] = field(metadata=column("{}", "{:.1f}"))
    """longest frame after a sleeping skin is pressed as a whole or released, in usual frames of the skin at rest"""
    back: dict[str, float] = field(metadata=column("back: {}", "{:.0f}"))
    """percent of the cells valid in the last frame of the event, and in the last frame after it, the less of both"""
    wait: dict[str, int] = field(metadata=column("without: {}", "{}"))
    """frames without any valid cell after an event begins, or after it ends, the more of both"""
    valid_percent: float = field(metadata=column("valid, %", "{:.1f}"))
    """of the cells, while fingers wander"""

    @property
    def worst(self) -> float:
        """Longest frame of all after the first, in usual frames."""
        return max(self.wandering, *self.events.values(), *self.asleep.values())


def worst_frames(sizes: Iterable[int]) -> Iterator[WorstFrames]:
    """Measure the boards of :data:`CASES` with so many rows."""
    for size in sizes:
        for circuit, idle_rows, idle_columns, segment, bits, wider in CASES:
            if idle_rows == "float" and size > _LARGEST_FLOATING:
                continue
            name = f"{circuit}, {idle_rows}"
            if circuit == "voltage-divider":
                name += f"/{idle_columns}"
            name += f", {bits} bits" + (f", {segment:g} ohm" if segment else "")
            array = {"rows": size, "columns": wider * size, "row_lead": _LEAD_OHM, "column_lead": _LEAD_OHM}
            array |= {"row_segment": segment, "column_segment": segment}
            amplified = circuit.endswith("amplifier")
            readout: dict[str, Any] = {"circuit": circuit, "idle_columns": idle_columns}
            readout["reference_resistance"] = 2e3 if amplified else 5e3
            if circuit != "voltage-divider":
                readout |= {"open_loop_gain": 1e5, "supply": [-0.1, 3.3]}
            design = {
                "array": array,
                "drive": {"voltage": -1.0 if amplified else 3.3, "idle_rows": idle_rows},
                "readout": readout,
                "adc": {"bits": bits, "range": [0.0, 3.3]},
            }
            yield worst_frames_of(name, Design.model_validate(design))


def worst_frames_of(name: str, board: Design) -> WorstFrames:
    """Measure one board with a converter."""
    draw = np.random.default_rng(0)
    shape = board.array.shape
    rest = _REST_OHM * 10 ** draw.uniform(-0.05, 0.05, shape)
    wandering = list(_wandering(rest, draw))
    times, valid = _read(board, wandering)
    usual = float(np.median(times[5:]))
    events, back, wait = {}, {}, {}
    for event, change in EVENTS.items():
        pressed = change(rest, draw)
        frames = [rest] * BEFORE + [pressed] * DURING + [rest] * AFTER
        spent, share = _read(board, frames)
        events[event] = float(spent[1:].max()) / usual
        back[event] = 100.0 * min(share[BEFORE + DURING - 1], share[-1])
        during, after = share[BEFORE : BEFORE + DURING], share[BEFORE + DURING :]
        wait[event] = max(_without_valid(during), _without_valid(after))
    return WorstFrames(
        board=name,
        rows=shape[0],
        columns=shape[1],
        first_ms=1e3 * float(times[0]),
        usual_us=1e6 * usual,
        wandering=float(times[5:].max()) / usual,
        events=events,
        asleep={name: _woken(board, lasts) for name, lasts in LASTS.items()},
        back=back,
        wait=wait,
        valid_percent=100.0 * float(valid[5:].mean()),
    )


def _without_valid(share: FloatArray) -> int:
    """Frames before the first one with a valid cell; all, if there is none."""
    return int(np.argmax(share > 0)) if (share > 0).any() else len(share)


def _wandering(rest: FloatArray, draw: np.random.Generator) -> Iterator[FloatArray]:
    row, column = np.indices(rest.shape)
    place, way = draw.uniform(0.0, 1.0, (5, 2)) * rest.shape, draw.uniform(-0.02, 0.02, (5, 2))
    for number in range(USUAL):
        load = np.zeros(rest.shape)
        for finger, at in enumerate(place + number * way):
            strength = 0.5 + 0.5 * np.sin(number / 8.0 + finger)
            load += strength * np.exp(-((row - at[0]) ** 2 + (column - at[1]) ** 2) / 2.0)
        yield rest / (1.0 + 2.0 * load)


def _woken(board: Design, lasts: int) -> float:
    """Longest frame after a sleeping skin is pressed as a whole for so many frames, in usual frames of it at rest."""
    rest = np.full(board.array.shape, _REST_OHM)
    packets = packets_of(board, np.array([rest] * ASLEEP + [WAKES * rest] * lasts + [rest] * AFTER))
    times = np.full(len(packets), np.inf)
    for _ in range(2):
        port = port_of(packets, board)
        with every_frame(port, board, Cell.example(), None) as skin:
            for number in range(len(packets)):
                port.work(APART_S)
                start = process_time()
                _ = skin.read(0.0).pressure_std
                times[number] = min(times[number], process_time() - start)
    return float(times[ASLEEP:].max() / np.median(times[SETTLING:ASLEEP]))


def _read(board: Design, frames: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Processor time in s and share of valid cells of each frame."""
    assert board.adc is not None
    noise = np.random.default_rng(1)
    volts: dict[int, FloatArray] = {}
    counts = []
    for cells in frames:
        if id(cells) not in volts:
            volts[id(cells)] = scan(board, cells).volts
        noisy = volts[id(cells)] + noise.normal(scale=NOISE_STEPS * board.adc.step, size=cells.shape)
        counts.append(adc_codes(board, noisy).astype(np.uint16))
    times, valid = np.full(len(frames), np.inf), np.empty(len(frames))
    for _ in range(2):
        read, estimator = CountReader(board), Cell.example().estimator(board.array.shape)
        for number, codes in enumerate(counts):
            start = process_time()
            reading = read(codes)
            estimator.step(_FRAME_S, reading.resistance)
            times[number] = min(times[number], process_time() - start)
            valid[number] = reading.valid.mean()
    return times, valid
