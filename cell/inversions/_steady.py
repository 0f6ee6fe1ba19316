"""Drift correction of trembling loads in ``m10`` cells: the mean load is pulled back to a level within a band.

The chains that a tremor breaks add up for as long as they take to heal. After a minute a tenth of these chains is as
much as the load, and no count of them is that good. The readings cannot tell such an error from a load that drifts. But
a load that grows or fades by as much as the chains are uncertain, and for as long, is rare, while most loads are held.
The mean of the load is therefore kept at a level: its deviation is taken back within a second, but in a second by no
more than two standard deviations of the chains that become uncertain in that time (the band). A load that drifts by
more takes the level along. A load that goes farther than it swings begins a new level.

The standard deviation of a held load is then that of its own drift rather than that of the broken chains. Where a load
that hardly swings takes the level along, the chains are more uncertain than assumed, and the standard deviation grows.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...common.compiled import Row, SpacedRows, loop

NAMES = ("mean_load", "held_load", "swing", "doubt_per_s")
"""names of the rows of the memory: recent mean of the load; the level at which it is held; mean distance of the load
from its mean; and standard deviation in r per second by which broken chains become uncertain"""
MEAN, HELD, SWING, DOUBT = range(len(NAMES))
MEAN_S, DOUBT_S = 0.5, 1.0
"""time constants in seconds of the mean of the load, and of the other two means"""
BACK_S = 1.0
"""seconds within which the mean is taken back to the level"""
SIGMAS = 2.0
"""half width of the band, in standard deviations of the chains that become uncertain in :data:`BACK_S`"""
SWINGS, LEAST_SWING = 3.0, 0.02
"""a load moves if it is farther from its mean than SWINGS times the swing, plus LEAST_SWING of full scale. A sine goes
1.6 times as far as its mean distance"""
DRIFT_PER_S = 0.005
"""of full scale: standard deviation of the drift of a held load in a second"""
UNSURE, KEPT = 0.2, 0.2
"""standard deviation of the load that is taken back, over this load; and share of the uncertainty of the chains that
remains while a load is held"""
SURPRISE = 4.0
"""times the mean uncertainty of a look: the most by which the standard deviation grows where a load that hardly swings
leaves the band and takes the level along; it grows by no more than the load went beyond the band"""

LOOK_S, MEAN_SHARE, DOUBT_SHARE, BACK_SHARE, BAND_S = range(5)
"""places of the numbers that depend on the time between looks: this time; the shares of a look in the mean of the load
and in the other means; the share of the deviation from the level that is taken back at a look; and the seconds of
growing uncertainty that make half the band"""
_ZERO, _SWINGS, _LEAST_SWING, _UNSURE, _KEPT, _SURPRISE, _DRIFT = (
    np.array(x) for x in (0.0, SWINGS, LEAST_SWING, UNSURE, KEPT, SURPRISE, DRIFT_PER_S)
)
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def constants(look_s: float) -> dict[int, float]:
    """The numbers by their places, for looks ``look_s`` apart."""
    return {
        LOOK_S: look_s,
        MEAN_SHARE: -math.expm1(-look_s / MEAN_S),
        DOUBT_SHARE: -math.expm1(-look_s / DOUBT_S),
        BACK_SHARE: min(look_s / BACK_S, 1.0),
        BAND_S: SIGMAS * BACK_S,
    }


def begin(rows: FloatArray, load: FloatArray) -> None:
    """Begin with cells that have borne ``load`` (m,) for ever; writes their ``rows`` (as :data:`NAMES`, m)."""
    rows[:SWING] = load
    rows[SWING:] = 0.0


def look(
    rows: FloatArray,
    load: FloatArray,
    edges: BoolArray,
    slope: FloatArray,
    doubt: FloatArray,
    most: tuple[FloatArray, FloatArray],
    numbers: tuple[FloatArray, ...],
) -> tuple[FloatArray, FloatArray]:
    """Take the loads of m cells at a look.

    Args:
        rows: (as :data:`NAMES`, m) of the memory, changed.
        load: (m,) of full scale.
        edges: (m,) where it has an edge just now.
        slope: (m,) dr/ds of the load s.
        doubt: (m,) standard deviation in r of the chains broken since the last look.
        most: (m,) the most load that may be added, and (m,) the most that may be taken back.
        numbers: :func:`constants`, each.

    Returns:
        (m,) load to take back, negative where it is to be added; and (m,) the standard deviation in r that remains.
    """
    look_s, mean_share, doubt_share, back_share, band_s = numbers
    mean, held, swing, per_s = rows
    per_s += (doubt / look_s - per_s) * doubt_share
    apart = np.abs(load - mean)
    farthest = swing * _SWINGS + _LEAST_SWING
    moves = edges | (apart > farthest)
    swing += (np.minimum(apart, farthest) - swing) * doubt_share
    mean += (load - mean) * mean_share
    np.copyto(mean, load, where=moves)
    band = per_s * band_s / slope
    off = mean - held
    beyond = np.abs(off) - band
    np.copyto(beyond, _ZERO, where=moves)
    follows = moves | (beyond > _ZERO)
    np.minimum(np.maximum(off, -band, out=off), band, out=off)
    np.copyto(off, _ZERO, where=moves)
    np.subtract(mean, off, out=held)
    back = np.minimum(np.maximum(off * back_share, -most[0]), most[1])
    drifts = slope * (np.abs(back) * _UNSURE + look_s * _DRIFT) + doubt * _KEPT
    surprise = np.where(swing < _LEAST_SWING, np.minimum(beyond * slope, per_s * look_s * _SURPRISE), _ZERO)
    return back, np.where(follows, doubt + surprise, np.minimum(doubt, drifts))


@loop
def look_of(
    memory: SpacedRows,
    first: int,
    i: int,
    load: float,
    edge: bool,
    slope: float,
    doubt: float,
    most_added: float,
    most_back: float,
    numbers: Row,
    at: int,
) -> tuple[float, float]:
    """:func:`look` of cell ``i``, whose rows begin with ``first``; those of ``numbers`` begin with place ``at``."""
    look_s, mean_share, doubt_share = numbers[at + LOOK_S], numbers[at + MEAN_SHARE], numbers[at + DOUBT_SHARE]
    back_share, band_s = numbers[at + BACK_SHARE], numbers[at + BAND_S]
    per_s = memory[first + DOUBT, i]
    per_s += (doubt / look_s - per_s) * doubt_share
    mean, swing = memory[first + MEAN, i], memory[first + SWING, i]
    apart, farthest = abs(load - mean), swing * SWINGS + LEAST_SWING
    moves = edge or apart > farthest
    mean = load if moves else mean + (load - mean) * mean_share
    band, off = per_s * band_s / slope, mean - memory[first + HELD, i]
    beyond = 0.0 if moves else abs(off) - band
    follows = moves or beyond > 0.0
    off = 0.0 if moves else min(max(off, -band), band)
    memory[first + DOUBT, i], memory[first + MEAN, i], memory[first + HELD, i] = per_s, mean, mean - off
    swing += (min(apart, farthest) - swing) * doubt_share
    memory[first + SWING, i] = swing
    back = min(max(off * back_share, -most_added), most_back)
    drifts = slope * (abs(back) * UNSURE + look_s * DRIFT_PER_S) + doubt * KEPT
    surprise = min(beyond * slope, per_s * look_s * SURPRISE) if swing < LEAST_SWING else 0.0
    return back, doubt + surprise if follows else min(doubt, drifts)
