"""Rest measurement of a skin before the first press: mean, noise, and checks that the skin is unloaded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..cell import Cell
from ..common.arrays import BoolArray, FloatArray
from ..errors import InputError
from ._presses import Rest
from ._tuning import CELL_FACTOR, REST_CHANGE, SHEET_FACTOR, SURE_STDS
from ._windows import noise, window_mean


def rest_of(frames: Sequence[tuple[float, FloatArray]]) -> Rest:
    """The skin at rest, averaged over frames: (time in s, resistance in ohm (rows, columns), NaN where not valid)."""
    time_s = np.array([time for time, _ in frames])
    ohm = np.array([reading for _, reading in frames])
    half = max(len(ohm) // 2, 1)
    mean = window_mean(ohm)
    change = (window_mean(ohm[-half:]) - window_mean(ohm[:half])) / mean
    return Rest(float(time_s.mean()), mean, noise(ohm), change, len(ohm))


def check_rest(rest: Rest, cell: Cell) -> None:
    """Raise InputError if the skin does not seem to be unloaded, or is not at rest."""
    measured: BoolArray = rest.measured
    if not measured.any():
        raise InputError("no cell has a valid reading")
    typical = float(np.median(rest.resistance_ohm[measured]))
    falls = cell.falls  # at rest the resistance of electrodes may be anything above that of the data
    ratio = typical / cell.rest_resistance_ohm
    advice = "Take everything off the skin"
    if not falls and not 1 / SHEET_FACTOR <= ratio <= SHEET_FACTOR:
        raise InputError(
            f"the skin seems to be loaded: the typical resistance is {typical:.4g} ohm, {ratio:.2g} times that of the "
            f"cell's data at rest. {advice}, or give the data of this cell (--cell)"
        )
    of_typical = np.where(measured, rest.resistance_ohm / typical, 1.0)
    far = np.abs(np.log(of_typical)) > np.log(CELL_FACTOR)
    if far.any() and not falls:
        worst = _worst(np.abs(np.log(of_typical)))
        raise InputError(
            f"the skin seems to be loaded: cell {worst} has {of_typical[worst]:.2g} times the typical resistance at "
            f"rest. {advice}"
        )
    limit = REST_CHANGE + SURE_STDS * rest.std_ohm / rest.resistance_ohm * 2 / np.sqrt(max(rest.frames, 1))
    moving = measured & (np.abs(rest.change) > limit)
    if moving.any():
        worst = _worst(np.where(moving, np.abs(rest.change), 0.0))
        raise InputError(
            f"the skin is not at rest: the resistance of {int(moving.sum())} cells is changing, most at cell {worst} "
            f"by {100 * rest.change[worst]:.1f} %. {advice}, and wait until it has recovered"
        )


def _worst(amount: FloatArray) -> tuple[int, int]:
    row, column = np.unravel_index(int(np.argmax(amount)), amount.shape)
    return int(row), int(column)
