"""The emulator: frames per second of processor time, contacts to packets, beside the full physics of the same scene.

The full physics steps every cell in every frame, solves every frame exactly and encodes it by itself. The emulator
steps the cells that are not at rest, reads frames as exactly as the ADC can tell, and works in blocks
(:mod:`ohmskin.emulator`). ``tests/test_emulator_skin.py`` holds one against the other.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from ..circuits import adc_codes, scan
from ..emulator import Scene, plan, spread
from ..wire import FramePacket, board_protocol
from ._driver import design
from .harness import column

CONTACTS = (0, 1, 5)
RATE_HZ = 1000.0
_PITCH_MM = 4.0
_BUDGET_S = 0.7
"""of processor time for each measurement"""

HEAD = f"frames per second of processor time, contacts to packets at {RATE_HZ:g} Hz; volts in ADC steps"


@dataclass(frozen=True)
class Row:
    """One scene."""

    size: int = field(metadata=column("cells", "{0} x {0}", width=7))
    contacts: int = field(metadata=column("contacts", "{}"))
    """that move over the array"""
    solved_percent: float = field(metadata=column("solved, %", "{:.1f}"))
    """of the frames, those that were read by the exact method"""
    frames_per_second: float = field(metadata=column("emulator", "{:.0f}"))
    full_frames_per_second: float = field(metadata=column("full physics", "{:.0f}"))
    certified_steps: float = field(metadata=column("certified", "{:.3f}"))
    """largest certified error of the emulator's volts, in ADC steps"""


def emulator(sizes: Iterable[int]) -> Iterator[Row]:
    """Measure scenes of every size and number of contacts."""
    for size in sizes:
        for contacts in CONTACTS:
            yield _measured(_scene(size, contacts))


def _scene(size: int, contacts: int) -> Scene:
    """An N x N skin with fingers that move to and fro and press more and less; always the same."""
    random = np.random.default_rng(size)
    side_mm = (size - 1) * _PITCH_MM
    tables: dict[str, Any] = {
        "skin": {"design": design(size, "inverting-amplifier", "ground", 12), "pitch_mm": _PITCH_MM},
        "board": {"frame_rate": RATE_HZ},
        "contact": [
            {
                "bump": {"sigma_mm": 3.0},
                "path_mm": [(time_s, *place) for time_s, place in zip((0.0, 1.0, 2.0), (a, b, a), strict=True)],
                "path_period": 2.0,
                "sine": {"mean_kpa": 8.0, "amplitude_kpa": 5.0, "frequency_hz": float(random.uniform(0.3, 1.5))},
            }
            for a, b in random.uniform(0.0, side_mm, (contacts, 2, 2)).tolist()
        ],
    }
    return Scene.from_tables(tables, source="bench", directory=Path())


def _measured(scene: Scene) -> Row:
    tried = plan(scene, budget_s=_BUDGET_S)
    return Row(
        size=scene.skin.design.array.rows,
        contacts=len(scene.contact),
        solved_percent=100.0 * tried.methods.get("exact", 0) / tried.frames,
        frames_per_second=tried.frames_per_second,
        full_frames_per_second=_full_physics(scene),
        certified_steps=tried.error_steps,
    )


def _full_physics(scene: Scene) -> float:
    """Frames per second of processor time, contacts to packets, of the first frames of a scene."""
    skin, protocol = scene.skin, board_protocol("ohmskin")
    cells = skin.cell.forward(skin.design.array.shape)
    start, before_us, frames = process_time(), 0, 0
    while process_time() < start + _BUDGET_S or frames < 2:
        time_us = round(frames * 1e6 / scene.board.frame_rate)
        felt = spread(scene.pressure_kpa(time_us / 1e6), skin.spreading_pitches)
        resistance = cells.step((time_us - before_us) / 1e6, felt)
        counts = adc_codes(skin.design, scan(skin.design, resistance, method="exact").volts)
        protocol.frame(FramePacket.of(counts, sequence=frames, time_us=time_us, boot_id=1))
        before_us, frames = time_us, frames + 1
    return frames / (process_time() - start)
