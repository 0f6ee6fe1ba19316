"""The distilled estimator of a cell that was not calibrated, learned from simulations of its own model."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ...common.arrays import FloatArray
from .._cell import Calibrated, Cell
from ..inversions import LearnedInversion
from ..materials import equilibrium_gain, simulate
from . import _training as training
from ._curves import answers, static_curve
from ._held_out import Judged, conformal

DT_S, SECONDS, CELLS = 0.02, 120.0, 96
"""time step, length and number of the simulated recordings"""
SPEEDS = 1.0, 4.0, 16.0
"""factors by which loads are faster than usual random ones, a third of the cells each"""


@lru_cache(maxsize=16)
def learned_from_model(cell: Cell) -> Calibrated:
    """Estimators of a cell whose model is taken to be right; this takes about a second, once for each cell.

    The deviations are those of the errors on further simulations. They know nothing of the error of the model.
    """
    plain = cell.replace(log_span=None, estimators=None)

    def run(rng: np.random.Generator, load: FloatArray, dt_s: float) -> FloatArray:
        forward = plain.forward(load.shape[1:])
        return forward.run(np.full(len(load), dt_s), cell.full_scale_kpa * load)

    def played(seed: int, cells: int) -> tuple[FloatArray, FloatArray]:
        rng, samples = np.random.default_rng(seed), round(SECONDS / DT_S)
        slow = [simulate.random_loads(rng, samples, cells // len(SPEEDS), speed * DT_S) for speed in SPEEDS]
        load = np.concatenate(slow, axis=1)
        return load, run(rng, load, DT_S) / cell.rest_resistance_ohm - 1

    load, r = played(0, CELLS)
    time = DT_S * np.arange(float(len(load)))
    first = training.NormalisedRecording(time, r[:, -1], load[:, -1], cell.rest_resistance_ohm, run, 0.0)
    curve = static_curve("cubic", r.ravel(), load.ravel())
    map_ = training.distilled(first, (load, r, DT_S), exact=True).replace(beyond_recorded=True)
    full_r = equilibrium_gain(cell.model, cell.full_scale_kpa, cell.rest_resistance_ohm)
    inversion = LearnedInversion(map_, curve, cell.full_scale_kpa, full_r, exact=False)
    judged, of_curve = [], []
    for truth, read in zip(*(each.T for each in played(1, len(SPEEDS))), strict=True):
        found, expected, beyond = inversion.run(np.full(len(read), DT_S), np.ascontiguousarray(read))
        judged.append(Judged(0, 0, found - truth, expected, beyond))
        own = answers(curve, read) - truth
        of_curve.append(Judged(0, 0, own, np.zeros_like(own), np.zeros_like(own)))
    factor, floor = conformal(judged)
    return Calibrated(
        default="distilled",
        reason="the model is taken to be right",
        held_out_percent={},
        static=curve.replace(std_kpa=conformal(of_curve)[1] * cell.full_scale_kpa),
        distilled=map_.replace(std_factor=max(factor, 1e-9), std_floor=floor),
    )
