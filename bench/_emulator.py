"""The emulator: frames per second of processor time, beside the full physics of the same scene.

The full physics steps every cell of the array from frame to frame, solves every frame exactly and encodes it by itself.
The emulator steps the cells that are not at rest, solves few frames exactly and works in blocks
(:mod:`ohmskin.emulator`). Both start from the same scene, and the difference of their volts is part of the table.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from ..circuits import Design, adc_codes, scan
from ..common.arrays import FloatArray
from ..emulator import Board, Scene, spread
from ..wire import FramePacket, board_protocol
from .harness import column

CONTACTS = (0, 1, 5)
RATES_HZ = (100.0, 1000.0)
LINE_OHM = 0.254
"""per segment: fabric of 0.1 ohm/cm on a pitch of one inch (paper, VII)"""
LEAD_OHM = 25.0
"""an analog switch and some wire"""
PITCH_MM = 4.0
FINGER_MM = 3.0
"""sigma of the bell of pressure under each contact"""
SPEED_MM_PER_S = 20.0
_BUDGET_S = 0.7
"""s of processor time for each measurement"""


HEAD = "frames per second of processor time on one core, contacts to encoded packets; volts in ADC steps"


@dataclass(frozen=True)
class Row:
    """One scene."""

    size: int = field(metadata=column("cells", "{0} x {0}"))
    """of the N x N array"""
    contacts: int = field(metadata=column("contacts", "{}"))
    """that move over the array"""
    frame_rate_hz: float = field(metadata=column("Hz", "{:g}"))
    frames: int
    """measured"""
    touched_cells: int = field(metadata=column("touched", "{}"))
    """cells that were pressed at any time"""
    solved_percent: float = field(metadata=column("solved, %", "{:.1f}"))
    """of the frames, those whose circuit was solved exactly"""
    frames_per_second: float = field(metadata=column("emulator", "{:.0f}"))
    """per second of processor time, from contacts to encoded packets"""
    full_frames_per_second: float = field(metadata=column("full physics", "{:.0f}"))
    """the same of the full physics"""
    difference_steps: float = field(metadata=column("difference", "{:.3f}"))
    """largest difference of their volts in ADC steps"""
    certified_steps: float = field(metadata=column("certified", "{:.3f}"))
    """largest certified error of the emulator's volts"""


def emulator(
    sizes: Iterable[int], *, contacts: Iterable[int] = CONTACTS, rates_hz: Iterable[float] = RATES_HZ
) -> Iterator[Row]:
    """Measure scenes of every size, number of contacts and frame rate."""
    for size in sizes:
        for count in contacts:
            for rate in rates_hz if count == max(contacts) else [max(rates_hz)]:
                yield _measured(scene(size, count, rate))


def scene(size: int, contacts: int, rate_hz: float) -> Scene:
    """An N x N skin of example cells with contacts that move to and fro and press more and less; always the same."""
    random = np.random.default_rng(size)
    side_mm = (size - 1) * PITCH_MM
    touching: list[dict[str, Any]] = []
    for _ in range(contacts):
        start, way = random.uniform(0.1, 0.9, 2) * side_mm, random.uniform(0.0, 2.0 * np.pi)
        end = np.clip(start + 0.4 * side_mm * np.array([np.sin(way), np.cos(way)]), 0.0, side_mm)
        half_s = float(np.linalg.norm(end - start) / SPEED_MM_PER_S) + 0.1
        path = [(0.0, *start.tolist()), (half_s, *end.tolist()), (2.0 * half_s, *start.tolist())]
        touching.append(
            {
                "bump": {"sigma_mm": FINGER_MM},
                "path_mm": path,
                "path_period": 2.0 * half_s,
                "sine": {"mean_kpa": 8.0, "amplitude_kpa": 5.0, "frequency_hz": float(random.uniform(0.3, 1.5))},
            }
        )
    tables = {"skin": {"design": design(size), "pitch_mm": PITCH_MM}, "board": {"frame_rate": rate_hz}}
    return Scene.from_tables({**tables, "contact": touching}, source="bench", directory=Path())


def design(size: int) -> Design:
    """An N x N board of the paper's kind with ordinary parts."""
    return Design.model_validate(
        {
            "array": {
                "rows": size,
                "columns": size,
                "row_segment": LINE_OHM,
                "column_segment": LINE_OHM,
                "row_lead": LEAD_OHM,
                "column_lead": LEAD_OHM,
            },
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 20e3, "open_loop_gain": 1e5},
            "adc": {"bits": 12, "range": [0.0, 3.3]},
        }
    )


def _measured(what: Scene) -> Row:
    adc = what.skin.design.adc
    assert adc is not None
    full_volts, full_s = _full_physics(what)
    recorded: list[FloatArray] = []
    recorder = Board(what, record=lambda sample: recorded.append(sample.volts))
    for _ in full_volts:
        recorder.tick()
    difference = max(float(np.abs(ours - full).max()) for ours, full in zip(recorded, full_volts, strict=True))

    board, block = Board(what), None
    frames = counted = solved = 0
    certified = 0.0
    touched = np.zeros(what.skin.design.array.shape, dtype=np.bool_)
    spent_s = 0.0
    while spent_s < _BUDGET_S:
        start = process_time()
        board.tick()
        while board.skin.frames_ready:  # blocks are whole, so that each frame counts with its share of the block
            board.tick()
            frames += 1
        spent_s += process_time() - start
        frames += 1
        block = board.skin.block
        assert block is not None
        counted += len(block)
        solved += sum(method != "interpolation" for method in block.method)
        certified = max(certified, float(block.error_volts.max()))
        touched |= (block.pressure_kpa > 0).any(axis=0)
    return Row(
        size=what.skin.design.array.rows,
        contacts=len(what.contact),
        frame_rate_hz=what.board.frame_rate,
        frames=frames,
        touched_cells=int(touched.sum()),
        solved_percent=100.0 * solved / counted,
        frames_per_second=frames / spent_s,
        full_frames_per_second=len(full_volts) / full_s,
        difference_steps=difference / adc.step,
        certified_steps=certified / adc.step,
    )


def _full_physics(what: Scene) -> tuple[list[FloatArray], float]:
    """Volts of the first frames of a scene, and the processor time from contacts to encoded packets."""
    skin, protocol = what.skin, board_protocol("ohmskin")
    cells = skin.cell.forward(skin.design.array.shape)
    period_us = 1e6 / what.board.frame_rate
    volts: list[FloatArray] = []
    start, before_us = process_time(), 0
    while process_time() < start + _BUDGET_S or len(volts) < 2:
        time_us = round(len(volts) * period_us)
        felt = spread(what.pressure_kpa(time_us / 1e6), skin.spreading_pitches)
        resistance = cells.step((time_us - before_us) / 1e6, felt)
        read = scan(skin.design, resistance, method="exact").volts
        counts = adc_codes(skin.design, read)
        protocol.frame(FramePacket.of(counts, sequence=len(volts), time_us=time_us, boot_id=1))
        volts.append(read)
        before_us = time_us
    return volts, process_time() - start
