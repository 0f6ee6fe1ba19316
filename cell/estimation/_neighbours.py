"""Neighbours as prior of a cell whose reading is missing or not believed (conditional autoregression; Besag 1974).

A finger presses several cells. The loads of the cells beside one, whose readings are believed, therefore give its load
a Gaussian prior: their mean, and their spread about it. Now and then they say nothing, as some contacts cover one cell
alone. The prior enters

- as odds of a bad contact: a jump of a cell whose neighbours are untouched is one, beside pressed ones it is a press;
- as evidence of a load that is not read, as far as the cell was like its neighbours when it was read last.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import IntArray
from ...common.compiled import PlaceRows, Rows, loop

LOAD, VARIANCE, BELIEVED = 0, 1, 2
"""rows (n,) of what neighbours tell: a load or a pressure, its variance, and 1 where it is from a reading"""


@loop
def prior(cell: int, beside: PlaceRows, loads: Rows) -> tuple[float, float]:
    """Mean and variance of a cell's load by its neighbours; a negative variance where none of them is believed.

    The load of a cell differs from their mean by as much as they do, and by that mean (fingertips may be sharp).
    """
    count = mean = square = 0.0
    for other in beside[cell]:
        if other < loads.shape[1] and loads[BELIEVED, other] > 0.0:
            load = loads[LOAD, other]
            count += 1.0
            mean += load
            square += load * load + loads[VARIANCE, other]
    if count == 0.0:
        return 0.0, -1.0
    mean /= count
    return mean, max(square / count - mean * mean, 0.0) + mean * mean


@loop
def agreement(load: float, variance: float, mean: float, spread: float, sudden: float) -> float:
    """Density of a load under its neighbours' prior, over the largest one: of Cauchy, as fingertips may be sharp."""
    off = load - mean
    return sudden + (1.0 - sudden) / (1.0 + off * off / max(spread + variance, 1e-12))


@loop
def alike(load: float, variance: float, mean: float, spread: float, full: float, alone: float) -> float:
    """Probability that a load of this mean and variance is one that its neighbours tell, and not any other one."""
    var, off = max(spread + variance, 1e-12), load - mean
    density = (1.0 - alone) * full * math.exp(-0.5 * off * off / var) / math.sqrt(2.0 * math.pi * var)
    return density / (density + alone)


@loop
def fuse(load: float, variance: float, mean: float, spread: float, like: float) -> tuple[float, float]:
    """Mean and variance of a load by its past, and with probability ``like`` by its neighbours, too."""
    part = variance / max(variance + spread, 1e-12)
    move = part * (mean - load)
    return load + like * move, variance - like * part * variance + like * (1.0 - like) * move * move


def beside_in(shape: tuple[int, ...]) -> IntArray:
    """(cells, most) neighbours in a rectangle of rows and columns; (cells, 0) of other shapes: those are alone."""
    count = math.prod(shape)
    if len(shape) != 2:
        return np.empty((count, 0), dtype=np.intp)
    number = np.pad(np.arange(count).reshape(shape), 1, constant_values=count)
    sides = number[:-2, 1:-1], number[1:-1, :-2], number[1:-1, 2:], number[2:, 1:-1]
    return np.stack(sides, axis=-1).reshape(count, 4)
