"""Light loads that go to and fro within the noise, told by the Allan variance of the readings.

Taps that go back by less than noise does are never noticed as turns. The paper's cell answers a rise by more than a
fall, so that an inverse keeps a part of each tap, and the parts add up. What tells of such taps is that means of
successive blocks of readings differ, both up and down, by more than noise lets them: half the mean square of these
differences is the Allan variance, and that of white noise is known. Blocks of several lengths are compared, since
nobody knows how fast the taps are.

A load that rises, and one that falls, moves the means to one side only. What an inverse keeps of taps does so, too, and
would hide the taps: from each difference the mean of the late ones is subtracted, the drift.

Turns that are noticed leave nothing behind: blocks before one are not compared with those after it. What both sides
have in common is kept over a turn, since of light taps some are noticed and others are not. What may have been kept of
motion that remains is added to the standard deviation of the memory, up to the pressure that is shown: what is kept of
a tap is never less than none.
"""

from __future__ import annotations

import math

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...compiled import Places, Row, Rows, loop
from ..estimation import NOISE, PRESSURE, RECENT, VARIANCE, recent_mean
from ..materials import PaperModel
from ._turning_rows import SIGN, TURNED

SCALES = 3
"""lengths of blocks: two, four and eight times the readings of which the noise meter takes the mean"""
SHARE = 1.0 / 16.0
"""of a block in the mean square"""
MOST = 10.0
"""times the variance of noise: no squared difference of two blocks counts for more"""
JUMP = 1e4
"""times that variance: a difference that cannot pass unnoticed, as after a bad contact"""
BOTH = 0.2
"""times that variance: excess that differences to either side must have"""
MAY, DOES = 0.4, 0.8
"""times that variance: mean excess of both sides from which a load may go to and fro, and from which it does"""
KEPT = 2.0
"""times the size of such motion, for each block: how much of it the cell may keep. It may also have begun unnoticed"""

NAMES = (
    *("half_block", "looks", "looks_since_turn", "sign_before"),
    *("mean_8", "mean_16", "mean_32", "up_8", "up_16", "up_32", "down_8", "down_16", "down_32"),
    *("drift_8", "drift_16", "drift_32"),
)
"""names of the rows of the memory"""
HALF, LOOKS, SINCE, SIGN_BEFORE, MEAN, UP, DOWN, DRIFT = 25, 26, 27, 28, 29, 32, 35, 38
"""rows: mean of the readings at the last look; looks; looks since a turn was noticed last, or a jump; 1 where the load
rose at the last look, -1 where it fell. Then three rows each, one for each length: mean of the last block; mean square
of the differences upwards, and downwards, over the variance of noise, less what noise alone makes; mean difference"""
_MEANS, _UPS, _DOWNS = slice(MEAN, MEAN + SCALES), slice(UP, UP + SCALES), slice(DOWN, DOWN + SCALES)
_DRIFTS = slice(DRIFT, DRIFT + SCALES)
_OF_MOTION = slice(UP, DRIFT + SCALES)
LOOKS_IN_BLOCK = np.array([2.0, 4.0, 8.0])
"""(SCALES,) powers of two"""
_LOOKS = LOOKS_IN_BLOCK[:, None]
_BEFORE_END = _LOOKS.astype(np.intp) - 1
"""bits of the number of looks that are 0 at the end of a block"""
_FRESH = 2.0 * _LOOKS
"""looks since a turn from which a block and the one before it tell of no motion before the turn"""
_PER_BLOCK = 1.0 / (RECENT * _LOOKS)
"""(SCALES, 1) variance of the mean of a block, over that of a reading"""
_PER_SHORTEST = _LOOKS[0] / _LOOKS
_ZERO, _HALF, _ONE = (np.array(x) for x in (0.0, 0.5, 1.0))
_SHARE, _MOST, _JUMP, _BOTH = (np.array(x) for x in (SHARE, MOST, JUMP, BOTH))
# As arrays: NumPy makes an array of a float in every call, which takes as long as the operation itself.


def kpa_kept(model: PaperModel) -> float:
    """KPa that an inverse keeps of a load that goes to and fro unnoticed, per r that the reading goes."""
    rise_r, fall_r = 1.0 / model.eu1_kpa + 1.0 / model.etau2_kpa, 1.0 / model.e1_kpa
    return (rise_r - fall_r) / (rise_r * fall_r)


def begin(memory: FloatArray, r: FloatArray) -> None:
    """Begin with cells whose reading has been ``r`` (m,) for ever; changes their ``memory`` (rows, m)."""
    memory[HALF], memory[_MEANS], memory[SIGN_BEFORE] = r, r, memory[SIGN]


def look(memory: FloatArray, mean: FloatArray, noise: FloatArray, kpa_per_r: float) -> None:
    """Take the last readings of m cells; changes their ``memory`` (rows, m).

    To be called every :data:`..estimation._noise.RECENT` frames.

    Args:
        memory: of the cells.
        mean: (m,) of as many readings.
        noise: (m,) standard deviation of one of them.
        kpa_per_r: :func:`kpa_kept`.
    """
    memory[LOOKS : SINCE + 1] += _ONE
    ends: BoolArray = memory[LOOKS].astype(np.intp) & _BEFORE_END == 0
    if np.count_nonzero(ends[0]):
        turned = memory[SIGN] != memory[SIGN_BEFORE]
        turned &= ends[0]
        if np.count_nonzero(turned):
            np.copyto(memory[SIGN_BEFORE], memory[SIGN], where=turned)
            np.copyto(memory[SINCE], _ZERO, where=turned)
            both = np.minimum(memory[_UPS], memory[_DOWNS])
            np.copyto(memory[_UPS], both, where=turned)
            np.copyto(memory[_DOWNS], both, where=turned)
            np.copyto(memory[_DRIFTS], _ZERO, where=turned)
        _end_blocks(memory, mean, noise, ends, kpa_per_r)
    memory[HALF] = mean


def begin_anew(memory: FloatArray, cells: BoolArray) -> None:
    """Compare only readings from now on in those ``cells`` (m,) that are marked; changes their ``memory`` (rows, m)."""
    np.copyto(memory[SINCE], _ZERO, where=cells)
    np.copyto(memory[_OF_MOTION], _ZERO, where=cells)


def _end_blocks(memory: FloatArray, mean: FloatArray, noise: FloatArray, ends: BoolArray, kpa_per_r: float) -> None:
    """Compare the blocks that end with those before, where ``ends`` (SCALES, m); doubt what cells may have kept."""
    means, shorter = memory[_MEANS], memory[HALF]
    block = np.empty_like(means)
    for scale in range(SCALES):
        np.add(shorter, mean, block[scale])
        block[scale] *= _HALF
        shorter, mean = means[scale], block[scale]
    variance = noise * noise * _PER_BLOCK
    change = block - means
    np.copyto(means, block, where=ends)
    counts = memory[SINCE] >= _FRESH
    counts &= ends
    drift = memory[_DRIFTS]
    change -= drift
    np.copyto(drift, change * _SHARE + drift, where=counts)
    size = change * change
    size /= variance
    jumped = (size > _JUMP) & ends if size.item(size.argmax()) > JUMP else None
    np.minimum(size, _MOST, out=size)
    ups, downs = memory[_UPS], memory[_DOWNS]
    for side, moved in ((ups, change > _ZERO), (downs, change < _ZERO)):
        beyond = np.zeros_like(size)
        np.copyto(beyond, size, where=moved)
        beyond -= _ONE
        beyond -= side
        beyond *= _SHARE
        beyond += side
        np.copyto(side, beyond, where=counts)
    if jumped is not None:
        begin_anew(memory, np.logical_or.reduce(jumped))
    sways = np.minimum(ups, downs) > _BOTH
    sways &= ends[0]
    if not np.count_nonzero(sways):
        return
    excess = (ups + downs) * _HALF
    share = np.minimum(np.maximum((excess - MAY) * (1.0 / (DOES - MAY)), _ZERO), _ONE)
    size = share * np.sqrt(np.maximum(excess, _ZERO) * variance) * _PER_SHORTEST
    kept = np.where(sways, size, _ZERO).max(axis=0) * (KEPT * kpa_per_r)
    before, shown = memory[TURNED], np.maximum(memory[PRESSURE], 0.0)
    after = np.sqrt(before) + kept
    after = np.minimum(after * after, np.maximum(before, shown * shown))
    after = np.where(kept > 0.0, after, before)  # the square of a root is not always what it was
    memory[VARIANCE] += after - before
    memory[TURNED] = after


@loop
def look_each(
    memory: Rows, taken: Rows, ring: Rows, newest: int, cells: Places, lengths: Row, kpa_per_r: float
) -> None:
    """:func:`look` as a loop over cells, which takes the mean of the readings itself.

    Args:
        memory: (rows, m), changed.
        taken: (4, m) readings of the frame.
        ring: (k, n) the last readings of all cells.
        newest: row of the last of them.
        cells: (m,) indices.
        lengths: (SCALES,) :data:`LOOKS_IN_BLOCK`.
        kpa_per_r: :func:`kpa_kept`.
    """
    for i in range(cells.size):
        mean = recent_mean(ring, newest, cells[i])
        looks, since = memory[LOOKS, i] + 1.0, memory[SINCE, i] + 1.0
        half = memory[HALF, i]
        memory[HALF, i], memory[LOOKS, i], memory[SINCE, i] = mean, looks, since
        if looks % lengths[0] != 0.0:
            continue
        if memory[SIGN, i] != memory[SIGN_BEFORE, i]:
            memory[SIGN_BEFORE, i], memory[SINCE, i], since = memory[SIGN, i], 0.0, 0.0
            for scale in range(SCALES):
                both = min(memory[UP + scale, i], memory[DOWN + scale, i])
                memory[UP + scale, i], memory[DOWN + scale, i], memory[DRIFT + scale, i] = both, both, 0.0
        noise2, shorter, jumped = taken[NOISE, i] * taken[NOISE, i], half, False
        for scale in range(SCALES):
            mean = (shorter + mean) * 0.5
            if looks % lengths[scale] != 0.0:
                break
            shorter = memory[MEAN + scale, i]
            memory[MEAN + scale, i] = mean
            drift = memory[DRIFT + scale, i]
            change = mean - shorter - drift
            beyond = change * change / (noise2 * (1.0 / (RECENT * lengths[scale])))
            jumped |= beyond > JUMP
            if since >= 2.0 * lengths[scale]:
                memory[DRIFT + scale, i] = change * SHARE + drift
                beyond = min(beyond, MOST)
                up, down = memory[UP + scale, i], memory[DOWN + scale, i]
                memory[UP + scale, i] += ((beyond if change > 0.0 else 0.0) - 1.0 - up) * SHARE
                memory[DOWN + scale, i] += ((beyond if change < 0.0 else 0.0) - 1.0 - down) * SHARE
        if jumped:
            memory[SINCE, i] = 0.0
            for row in range(UP, DRIFT + SCALES):
                memory[row, i] = 0.0
            continue
        kept = 0.0
        for scale in range(SCALES):
            up, down = memory[UP + scale, i], memory[DOWN + scale, i]
            if not min(up, down) > BOTH:
                continue
            excess = (up + down) * 0.5
            share = min(max((excess - MAY) * (1.0 / (DOES - MAY)), 0.0), 1.0)
            motion = share * math.sqrt(max(excess, 0.0) * (noise2 * (1.0 / (RECENT * lengths[scale]))))
            kept = max(kept, motion * (lengths[0] / lengths[scale]))
        if kept > 0.0:
            before, shown = memory[TURNED, i], max(memory[PRESSURE, i], 0.0)
            after = math.sqrt(before) + kept * (KEPT * kpa_per_r)
            after = min(after * after, max(before, shown * shown))
            memory[VARIANCE, i] += after - before
            memory[TURNED, i] = after


LOOPS = (look_each,)
