"""Speed against error of the estimators, on a material that none of the models describes.

``ohmskin bench --estimators`` prints the table.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from ..cell import ESTIMATORS, Cell, calibrate, checked_recording, estimate_recording, protocol_load
from ..common.arrays import FloatArray
from ..errors import InputError
from . import _independent as independent
from .harness import column


@dataclass(frozen=True)
class Row:
    """One estimator on one material."""

    material: str = field(metadata=column("material", "{}", width=30))
    estimator: str = field(metadata=column("estimator", "{}", width=10))
    rmse_percent: float = field(metadata=column("RMSE, % of FS", "{:.2f}"))
    """of full scale"""
    microseconds: float = field(metadata=column("us per cell and sample", "{:.3f}"))
    """per cell and sample, all cells of a 64 x 64 skin in motion, one core"""
    is_default: bool = field(metadata=column("default"))


INDEPENDENT = "relays and fractional creep"
NOISE = 0.005
"""standard deviation of readings of a simulated cell, relative to R0"""
EXAMPLE = f"the paper's model, {100 * NOISE:g} % noise"


def estimators(
    materials: tuple[str, ...] = (INDEPENDENT, EXAMPLE),
    *,
    seed: int = 0,
    side: int = 64,
    frames: int = 30,
    dt_s: float = 0.05,
    seconds: float = 300.0,
) -> list[Row]:
    """Every estimator that applies, on an independent material and on the shipped example cell.

    Both are calibrated by the 272 s protocol alone and judged on random presses; reproducible but for the times.
    """
    full = 15.5
    rng = np.random.default_rng(seed)
    time, load = protocol_load(dt_s)
    halves = [independent.presses(rng, seconds / 2, dt_s, holds=holds) for holds in (True, False)]
    test = np.concatenate(halves)
    test_time = dt_s * np.arange(float(len(test)))
    rows = []
    for material in materials:
        if material == INDEPENDENT:
            both = independent.resistance(np.concatenate([load, np.zeros(round(600 / dt_s)), test]), dt_s, rng)
            recorded, read = both[: len(load)], both[-len(test) :]
        else:
            recorded, read = (noisy(Cell.example(), kind, dt_s, rng) for kind in (load, test))
        cell = calibrate(checked_recording(time, full * load, recorded, name=material), full_scale_kpa=full).cell
        for name in ESTIMATORS:
            try:
                estimator = cell.estimator((), name)
            except InputError:
                continue  # not for this kind of cell
            pressure, _ = estimate_recording(estimator, test_time, read)
            rmse = float(np.sqrt(np.mean((pressure / full - test) ** 2)))
            moving = read[np.linspace(0, len(read) - frames - 1, side * side).astype(int) + np.arange(frames)[:, None]]
            rows.append(
                Row(material, name, 100 * rmse, _cost(cell, name, moving, dt_s), name == cell.default_estimator)
            )
    return rows


def noisy(cell: Cell, load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Ohm (n,) of one cell under normalised loads ``dt_s`` apart, with noise of :data:`NOISE`."""
    forward = cell.forward(())
    ohms = forward.run(np.full(len(load), dt_s), cell.full_scale_kpa * load)
    return ohms + NOISE * cell.rest_resistance_ohm * rng.standard_normal(len(load))


def _cost(cell: Cell, name: str, moving: FloatArray, dt_s: float) -> float:
    """Microseconds per cell and sample: the median frame of (frames, cells) readings."""
    estimator = cell.estimator(moving.shape[1:], name)
    spent = []
    for frame in moving:
        start = perf_counter()
        estimator.step(dt_s, frame)
        spent.append(perf_counter() - start)
    return 1e6 * float(np.median(spent[3:])) / int(moving.shape[1])
