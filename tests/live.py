"""Streams of frames through the live recovery, in none of which a valid cell is off by more than it states."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader, Measurement


def counts_of(
    design: Design, cells: FloatArray, noise_steps: float = 0.0, draw: np.random.Generator | None = None
) -> np.ndarray[Any, Any]:
    """ADC codes of a frame, with noise of so many steps."""
    volts = scan(design, cells, method="exact").volts
    if noise_steps and draw is not None and design.adc is not None:
        volts = volts + draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
    return adc_codes(design, volts)


def assert_bounded(reading: Measurement, cells: FloatArray, most: float = 1.0) -> None:
    """No valid cell is off by more than ``most`` of its uncertainties."""
    valid = reading.valid
    used = np.abs(reading.resistance[valid] / cells[valid] - 1.0) / reading.uncertainty[valid]
    assert used.max(initial=0.0) <= most + 1e-9


def follow(
    design: Design,
    frames: Iterable[FloatArray],
    noise_steps: float = 0.0,
    draw: np.random.Generator | None = None,
    *,
    read: CountReader | None = None,
) -> list[Measurement]:
    """The readings of frames of cells by one reader.

    An uncertainty covers three standard deviations of noise. Nobody knows in the first two frames of a noise of more
    than half a step, which a reader assumes.
    """
    read, readings = read or CountReader(design), []
    for number, cells in enumerate(frames):
        readings.append(read(counts_of(design, cells, noise_steps, draw)))
        if noise_steps <= 0.5 or number > 1:
            assert_bounded(readings[-1], cells, 5.0 / 3.0 if noise_steps else 1.0)
    return readings
