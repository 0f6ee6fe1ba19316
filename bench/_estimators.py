"""Speed against error of the estimators, on a material that none of the models describes.

``ohmskin bench --estimators`` prints the table.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..cell import ESTIMATORS, Cell, estimate_recording
from ..common.arrays import FloatArray
from ..errors import InputError
from . import panel
from .harness import column, timed


@dataclass(frozen=True)
class Row:
    """One estimator on one material."""

    material: str = field(metadata=column("material", "{}", width=8))
    estimator: str = field(metadata=column("estimator", "{}", width=10))
    rmse_percent: float = field(metadata=column("RMSE, % of FS", "{:.2f}"))
    """of full scale"""
    microseconds: float = field(metadata=column("us per cell and sample", "{:.3f}"))
    """per cell and sample, all cells of a 64 x 64 skin in motion, one core"""
    is_default: bool = field(metadata=column("default"))


INDEPENDENT = "relays"


def estimators(
    materials: tuple[str, ...] = (INDEPENDENT, "paper"), *, seed: int = 0, side: int = 64, frames: int = 30
) -> list[Row]:
    """Every estimator that applies, on an independent material of :mod:`._materials` and on one of the product's.

    Each is calibrated on some random presses and judged on others; reproducible but for the times.
    """
    rows = []
    for material in materials:
        of = panel.scene("random", material, seed)
        cell, later = panel.calibrated(of).cell, of.time_s >= of.head_s
        for name in ESTIMATORS:
            try:
                estimator = cell.estimator((), name)
            except InputError:
                continue  # not for this kind of cell
            pressure, _ = estimate_recording(estimator, of.time_s, of.resistance_ohm)
            error = (pressure - of.pressure_kpa)[later] / cell.full_scale_kpa
            read = of.resistance_ohm[later]
            moving = read[np.linspace(0, len(read) - frames - 1, side * side).astype(int) + np.arange(frames)[:, None]]
            rmse = 100 * float(np.sqrt(np.mean(error**2)))
            rows.append(Row(material, name, rmse, _cost(cell, name, moving), name == cell.default_estimator))
    return rows


def _cost(cell: Cell, name: str, moving: FloatArray) -> float:
    """Microseconds per cell and sample: the median frame of (frames, cells) readings."""
    estimator = cell.estimator(moving.shape[1:], name)
    spent = timed(lambda frame: estimator.step(panel.DT_S, frame), moving)
    return 1e6 * float(np.median(spent[3:])) / int(moving.shape[1])
