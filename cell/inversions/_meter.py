"""Meter of tremor: path length ("way") of each cell's load within the noise, and the part not counted by the inverse.

A load that trembles moves by less than the noise lets an inverse follow. How this motion changes a cell depends on the
material, and is left to the inverse. This module estimates the way, in two manners: from the variances of each cell's
own readings (:mod:`._way`), and from the motion that the cells beside have in common with it (:mod:`._together`). Both
are weighted by how well they know it. Own readings alone are believed where they leave no doubt that the load goes to
and fro, as beside a finger that rubs.

The inverse itself follows edges of a load, as of presses and taps. After an edge no way is told for as long as the mean
squares remember it. From the way that is told we subtract what the inverse has counted meanwhile (:func:`uncounted`).
The mean squares see a motion later than the inverse counts it, so that what is counted too early or too late is carried
over for as long.

All is in the unit of the quantity that is read, r or the load. The rows are a part of the memory of an inversion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Rows, SpacedPlaces, SpacedRows, loop
from . import _together as together
from . import _variances as variances
from . import _way as way
from ._paper_steps import numbered
from ._together import KNOWN, WEIGHTED
from ._together import look_of as told_beside_of
from ._variances import SCALES, forget_of, look_of
from ._way import tell_of as way_of_squares

NAMES = (
    *("looks", *variances.SERIES, *together.SERIES),
    *variances.SQUARES,
    *(f"{name}_beside" for name in variances.SQUARES),
    *together.LOADS,
    *together.APART,
    *("held", "told", "may"),
)
"""names of the rows of the memory: number of looks; series and mean squares of :mod:`._variances`, own ones and those
of neighbours; loads and differences of the two groups of :mod:`._together`; looks since an edge; the balance of the way
that is told less what is counted, and of the way that may be"""
LOOKS, SERIES = 0, 1
SERIES_BESIDE = SERIES + variances.ALL_SERIES
SQUARES = SERIES + 3 * variances.ALL_SERIES
SQUARES_BESIDE = SQUARES + variances.ALL_SQUARES
LOADS = SQUARES + 2 * variances.ALL_SQUARES
APART = LOADS + len(together.LOADS)
HELD, TOLD, MAY = range(APART + SCALES, len(NAMES))
_SERIES, _SQUARES = slice(SERIES, SQUARES), slice(SQUARES, LOADS)
_LOADS, _APART = slice(LOADS, APART), slice(APART, HELD)
HELD_FOR_EVER = 1e6
"""looks: stands for no edge so far"""
LEAST_LOAD = 1e-3
"""avoids division by zero"""
_BY_NOISE = np.array([1.0, 0.0])[:, None, None]
"""(2, 1, 1) mean by noise of own squares, and of products of two groups with independent noise"""
_ZERO, _ONE, _LEAST_LOAD = (np.array(x) for x in (0.0, 1.0, LEAST_LOAD))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


class Limits(NamedTuple):
    """When the way is told; without axes, or (m,)."""

    largest: FloatArray
    """how far a load may go from one look to the next without an edge"""
    owed: FloatArray
    """:func:`owed_looks`"""
    late: FloatArray
    """looks by which the readings lag behind the edges"""


class Constants(NamedTuple):
    """Numbers of a material in whose cells the way leaves an error; they depend on the time between frames."""

    row: FloatArray
    """for machine code"""
    each: tuple[FloatArray, ...]
    """the same numbers, as arrays without axes"""
    way: way.Constants


def constants(numbers: dict[int, float], dt_s: float, readings: int, caution: way.Caution) -> Constants:
    """The ``numbers`` by their places, and those of :mod:`._way`, for frames ``dt_s`` apart."""
    row, each = numbered(numbers)
    return Constants(row, each, way.constants(dt_s, readings, caution))


def edge(readings: int) -> float:
    """The largest difference by noise of two means of ``readings`` readings, in standard deviations of a reading."""
    return variances.CLEAR * math.sqrt(2.0 / readings)


def owed_looks(dt_s: float, readings: int) -> float:
    """Looks that the mean squares remember, for frames ``dt_s`` apart and ``readings`` from look to look."""
    return way.MEMORY_S / (readings * dt_s)


def begin(rows: FloatArray, level: FloatArray | float) -> None:
    """Begin with m cells that have read ``level`` (m,) for ever; writes their ``rows`` (as :data:`NAMES`, m)."""
    rows[...] = 0.0
    rows[SERIES:SERIES_BESIDE] = level
    rows[HELD] = HELD_FOR_EVER


def look(
    rows: FloatArray,
    newest: FloatArray,
    noise: FloatArray,
    load: FloatArray,
    edges: BoolArray,
    near: IntArray,
    limits: Limits,
    of_way: way.Constants,
) -> FloatArray:
    """Take the readings of m cells since the last look; changes their ``rows``.

    Args:
        rows: (as :data:`NAMES`, m) of the memory.
        newest: (m,) mean of the readings, less the motion that the inverse has explained.
        noise: (m,) standard deviation of one of them.
        load: (m,) the load that goes to and fro, in the unit of the readings.
        edges: (m,) where it has an edge just now.
        near: (k, m) neighbours, see :class:`..estimation._neighbours.Neighbours`.
        limits: largest motion without an edge, and when the way is told.
        of_way: numbers of :mod:`._way`.

    Returns:
        (2, m) way since the last look that is told from noise; and the way that may be, no less.
    """
    largest, owed, late = limits
    held = rows[HELD]
    held += _ONE
    np.copyto(held, _ZERO, where=edges)
    forgotten = held <= late
    tells = np.empty((together.TELLS, load.size))
    per_variance = load / (noise * noise)
    known = load * per_variance
    per_variance *= held > late + _ONE
    np.multiply(per_variance, newest - rows[SERIES], tells[together.WEIGHTED])
    np.multiply(per_variance, load, tells[together.KNOWN])
    loads = rows[_LOADS]
    knows = together.look(loads, tells, near)
    series, noises, most = np.empty((3, 3, load.size))
    series[0], series[1:] = newest, loads
    noises[0], noises[1:] = noise, _ONE / np.sqrt(knows)
    most[0], most[1:] = largest, largest / np.maximum(load, _LEAST_LOAD)
    looks = rows[LOOKS]
    looks += _ONE
    ends = variances.ends_of_blocks(looks)
    kept = rows[_SERIES].reshape(3, variances.ALL_SERIES, -1)
    change = variances.differences(kept, series, noises, most, ends, of_way.std)
    product = change[0::2] * change[:2]  # own squares, and products of the two groups
    bends = change[1:, SCALES:].copy()
    side = change[:2]
    side[1] += change[2]
    squares = rows[_SQUARES].reshape(2, variances.ALL_SQUARES, -1)
    shares = ends * of_way.shares
    variances.take(squares, product, _BY_NOISE, side, shares, forgotten)
    apart = rows[_APART]
    together.compare(apart, bends, knows, shares, forgotten)
    scatter = np.maximum(apart, _ZERO) + _ONE
    own, beside = way.weights(known, together.known(knows), scatter)
    alone = way.told_by_own(squares[0], of_way)
    np.maximum(own, alone, out=own)
    beside *= _ONE - alone
    by_scale = squares.reshape(2, -1, *own.shape)
    both = by_scale[0] * own
    both += by_scale[1] * beside
    found = way.tell(both.reshape(squares[0].shape), own, beside, scatter, noise, of_way)
    found *= (load > _ZERO) & (held >= owed)
    return found


def uncounted(rows: FloatArray, found: FloatArray, counted: FloatArray, owed: FloatArray) -> FloatArray:
    """(2, m) ways ``found`` (2, m) by :func:`look` less the way ``counted`` (m,) by the inverse; changes ``rows``.

    A way that was counted too much or not yet found is carried over, up to ``owed`` times the way found in a look.
    """
    balance = rows[TOLD : MAY + 1]
    balance += found
    balance -= counted
    most = found * owed
    np.minimum(np.maximum(balance, -most, out=balance), most, out=balance)
    remains: FloatArray = np.maximum(balance, _ZERO)
    balance -= remains
    return remains


# -- machine code ----------------------------------------------------------------------------------------------------


@loop
def see_of(
    memory: SpacedRows,
    first: int,
    i: int,
    newest: float,
    noise: float,
    load: float,
    edge: bool,
    late: float,
    largest: float,
    way_numbers: Rows,
    seen: Rows,
) -> None:
    """The first half of :func:`look` for cell ``i``, whose rows begin with ``first``.

    Writes what its neighbours need into ``seen`` (TELLS, m).
    """
    held = memory[first + HELD, i] + 1.0
    if edge:
        held = 0.0
    if held <= late:
        forget_of(memory, first + SQUARES, i)
        forget_of(memory, first + SQUARES_BESIDE, i)
        for row in range(first + APART, first + HELD):
            memory[row, i] = 0.0
    memory[first + HELD, i] = held
    memory[first + LOOKS, i] += 1.0
    unseen = newest - memory[first + SERIES, i]
    looks = memory[first + LOOKS, i]
    look_of(memory, first + SERIES, first + SQUARES, i, looks, newest, noise, largest, way_numbers)
    per_variance = load / (noise * noise) if held > late + 1.0 else 0.0
    seen[WEIGHTED, i], seen[KNOWN, i] = per_variance * unseen, per_variance * load


@loop
def tell_of(
    memory: SpacedRows,
    first: int,
    i: int,
    noise: float,
    load: float,
    largest: float,
    owed: float,
    seen: Rows,
    near: SpacedPlaces,
    way_numbers: Rows,
) -> tuple[float, float]:
    """The second half of :func:`look` for cell ``i``, after the first half of all cells."""
    relative, looks = largest / max(load, LEAST_LOAD), memory[first + LOOKS, i]
    squares, beside, apart = first + SQUARES, first + SQUARES_BESIDE, first + APART
    known = told_beside_of(
        memory, first + SERIES_BESIDE, beside, first + LOADS, apart, i, seen, near, relative, looks, way_numbers
    )
    if not (load > 0.0 and memory[first + HELD, i] >= owed):
        return 0.0, 0.0
    own = load * (load / (noise * noise))
    return way_of_squares(memory, squares, beside, apart, i, own, known, noise, way_numbers)


@loop
def uncounted_of(
    memory: SpacedRows, first: int, i: int, told: float, may: float, counted: float, owed: float
) -> tuple[float, float]:
    """:func:`uncounted` of cell ``i``."""
    way = min(max(memory[first + TOLD, i] + told - counted, -owed * told), owed * told)
    most = min(max(memory[first + MAY, i] + may - counted, -owed * may), owed * may)
    memory[first + TOLD, i], memory[first + MAY, i] = min(way, 0.0), min(most, 0.0)
    return max(way, 0.0), max(most, 0.0)
