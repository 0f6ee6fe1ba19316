"""A simulated recording of the calibration protocol, and what the calibration makes of it."""

from __future__ import annotations

import numpy as np

from .._cell import Cell
from ._calibrate import calibrate
from ._protocol import protocol_load
from ._recording import checked_recording

READING_NOISE = 0.005
"""standard deviation of readings of a simulated cell, relative to R0"""


def rehearsed(cell: Cell, dt_s: float = 0.05) -> Cell:
    """The cell as :func:`calibrate` finds it in a noisy recording of the protocol, sampled every ``dt_s``.

    Takes some ten seconds.
    """
    time_s, load = protocol_load(dt_s)
    kpa = cell.full_scale_kpa * load
    ohms = cell.forward(()).run(np.full(len(load), dt_s), kpa)
    noisy = ohms + READING_NOISE * cell.rest_resistance_ohm * np.random.default_rng(0).standard_normal(len(load))
    recording = checked_recording(time_s, kpa, noisy, name="simulated protocol")
    return calibrate(recording, full_scale_kpa=cell.full_scale_kpa).cell
