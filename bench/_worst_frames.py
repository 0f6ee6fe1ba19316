"""Longest frames of the live path: what sudden changes cost on every kind of board, in usual frames.

The driver promises that a frame never costs more than ten usual ones. Fingers that wander over the skin give the usual
frame (median), and each of :func:`_events` changes much at once. The recovery is deterministic. Each stream is
therefore read twice, and of each frame the shorter processor time counts, so that a loaded machine does not.

A skin that has rested costs less than one with fingers. What it costs to wake it, all cells at once, is stated in usual
frames of the resting skin.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..cell import Cell
from ..circuits import Design
from ..common.arrays import FloatArray
from ._driver import HARD_OHM, LARGEST_FLOATING, OnBoard, described, design, packets_of, pressed, taken
from .harness import column

LIMIT = 10.0
"""usual frames that a frame may cost"""
REST_OHM, PRESS_SHARE = 10e3, 0.12
"""of a cell at rest, and the share of it that a hard press leaves"""
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

HEAD = (
    f"longest frame of a skin, in usual frames of the same board, at most {LIMIT:g}; the first one of all apart; "
    f"pressed as a whole from rest ({HOLD}, {TAP}) in usual frames of a reader of the skin at rest"
)


@dataclass(frozen=True)
class WorstFrames(OnBoard):
    """One board."""

    columns: int = field(metadata=column("columns", "{}"))
    idle_columns: str = field(metadata=column("idle columns", "{}"))
    segment: float = field(metadata=column("ohm", "{:g}", width=3))
    """of a line from cell to cell"""
    first_ms: float = field(metadata=column("first ms", "{:.1f}"))
    """processor time of the first frame of all"""
    usual_us: float = field(metadata=column("usual us", "{:.0f}"))
    """median processor time of a frame with wandering fingers"""
    wandering: float = field(metadata=column("fingers", "{:.1f}"))
    """longest of these frames, in usual ones"""
    events: dict[str, float] = field(metadata=column("{}", "{:.1f}"))
    """longest frame of each event, in usual frames; frames after the first"""
    asleep: dict[str, float] = field(metadata=column("{}", "{:.1f}"))
    """longest frame after a sleeping skin is pressed as a whole or released, in usual frames of the skin at rest"""


def worst_frames(sizes: Iterable[int]) -> Iterator[WorstFrames]:
    """Measure the boards of :data:`CASES` with so many rows."""
    for size in sizes:
        for circuit, idle_rows, idle_columns, segment, bits, wider in CASES:
            if idle_rows == "ground" or size <= LARGEST_FLOATING:
                board = design(
                    size,
                    circuit,
                    idle_rows,
                    bits,
                    columns=wider * size,
                    readout={"idle_columns": idle_columns}
                    | ({"reference_resistance": 2e3} if circuit.endswith("amplifier") else {}),
                    array={"row_segment": segment, "column_segment": segment},
                )
                yield _measured(board, segment)


def _measured(board: Design, segment: float) -> WorstFrames:
    draw = np.random.default_rng(0)
    rows, columns = board.array.shape
    rest = REST_OHM * 10 ** draw.uniform(-0.05, 0.05, (rows, columns))
    times = _times(board, pressed((rows, columns), USUAL)[1])
    usual = float(np.median(times[5:]))
    return WorstFrames(
        *described(board),
        columns=columns,
        idle_columns=board.readout.idle_columns,
        segment=segment,
        first_ms=1e3 * float(times[0]),
        usual_us=1e6 * usual,
        wandering=float(times[5:].max()) / usual,
        events={
            name: float(_times(board, np.array([rest] * BEFORE + [cells] * DURING + [rest] * AFTER))[1:].max()) / usual
            for name, cells in _events(rest, draw).items()
        },
        asleep={name: _woken(board, lasts) for name, lasts in LASTS.items()},
    )


def _events(rest: FloatArray, draw: np.random.Generator) -> dict[str, FloatArray]:
    """Cells of events that begin from rest and end at once: a hard press of all cells, and of half of them; seven cells
    at a limit; a cell without a contact; a row without a driver.
    """
    rows, columns = rest.shape

    def with_cells(where: Any, ohm: Any) -> FloatArray:
        cells = rest.copy()
        cells[where] = ohm
        return cells

    some = np.unravel_index(draw.choice(rest.size, min(7, rest.size // 2), replace=False), rest.shape)
    half = np.s_[:, : max(1, columns // 2)]
    return {
        "press": rest * PRESS_SHARE * 10 ** draw.uniform(-0.1, 0.1, rest.shape),
        "half": with_cells(half, PRESS_SHARE * rest[half]),
        "saturated": with_cells(some, HARD_OHM),
        "open": with_cells((draw.integers(rows), draw.integers(columns)), np.inf),
        "dead row": with_cells(draw.integers(rows), np.inf),
    }


def _woken(board: Design, lasts: int) -> float:
    """Longest frame after a sleeping skin is pressed as a whole for so many frames, in usual frames of it at rest."""
    rest = np.full(board.array.shape, REST_OHM)
    times = _times(board, np.array([rest] * ASLEEP + [WAKES * rest] * lasts + [rest] * AFTER))
    return float(times[ASLEEP:].max() / np.median(times[SETTLING:ASLEEP]))


def _times(board: Design, frames: FloatArray) -> FloatArray:
    """Processor time in s of each frame of cells (frames, rows, columns) in ohm, packets to kPa with deviations."""
    packets = packets_of(board, frames)
    twice = np.array([[sum(spent) for _, *spent in taken(packets, board, Cell.example())] for _ in range(2)])
    return np.asarray(twice.min(axis=0))
