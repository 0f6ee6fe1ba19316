"""Noise of readings, estimated frame by frame while they may move (noise-subspace and difference-based estimation).

Readings are taken frame by frame, in a unit in which noise is about the same at rest and under load: volts of a board,
or conductances. There are two answers, for two uses:

* **How large may the noise be now?** (:attr:`NoiseEstimate.std`: one number for all readings, known in the third frame
  of a noise, rarely too small.) The mean absolute change of the readings between two frames is 1.13 sigma. A press
  enlarges this mean. If it exceeds the noise so far, motion is removed first (Pisarenko 1973): under noise alone each
  weighted sum of the last changes has a known variance, and motion that follows one pattern over the readings, whatever
  its course in time, vanishes from one of these sums. The weights of this *quietest* sum are the eigenvector to the
  smallest eigenvalue of the changes' second moments, relative to those of noise. Its scatter over the readings is the
  noise. With few readings the quietest sum is quiet by chance; there the alternating part of two successive changes is
  the measure: noise goes back and forth, a press moves a reading once, or goes on in one direction.
* **How noisy is each reading, best guess?** (:attr:`NoiseEstimate.each`, for the weights of a filter.) The third
  difference of successive readings contains almost nothing of smooth motion, and 20 times the variance of white noise,
  the sum of its squared coefficients 1, -3, 3, -1. Its squares are averaged over a few hundred frames, without outliers
  (edges of a load). In an array, readings lean on the mean of all.

The first estimate is kept for as many frames as have shown the noise, up to twenty. Motion that was mistaken for noise
in one frame is thus soon forgotten. Each frame whose readings move too little for this noise shortens the memory.
Readings at a limit show no noise; while they stand there, the noise is not forgotten. A noise of several frames that
pauses for less than twenty is known again in the frame in which it returns: it, not motion, is then the likelier cause
of changes of its size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import NormalDist

import numpy as np

from .arrays import MEDIAN_OF_NORMAL, FloatArray
from .compiled import Record, Records, Row, Rows, loop, values, zeros

# -- the noise of all readings -----------------------------------------------------------------------------------------
MEMORY = 20.0
"""frames over which a noise that has been seen for long is forgotten"""
BARELY_SEEN = 1.5
"""frames added to those in which a noise was seen: after its first frame, 0.6 of it is assumed a frame later"""
CONTRADICTED, FADING = 0.5, 0.8
"""fraction of the assumed noise below which a frame may contradict it, and the factor on the frames in which it was
seen if so"""
TELLING = 8
"""readings free to change from which on a noise that has vanished is forgotten as fast as possible"""
FEW = 6
"""with fewer readings the alternating part is the measure"""
CLIP = 1.5
"""standard deviations of a reading at which its change is clipped: motion of few readings hardly counts"""
MEAN_CHANGE = 2.0 * (1.0 - math.exp(-((CLIP / 2.0) ** 2))) / math.sqrt(math.pi) + CLIP * math.erfc(CLIP / 2.0)
"""mean in sigma of changes that are clipped there: the difference of two normal variables has twice their variance"""
ALTERNATING = 0.438
"""mean in sigma^2 of minus the product of two such changes that follow each other"""
MEDIAN_CHANGE = math.sqrt(2.0) * MEDIAN_OF_NORMAL
"""median of the absolute change in sigma"""
TOGETHER = 0.99
"""sum of signs of changes that go on, over that of one such reading, from which on they move: of five readings four, of
fewer all"""
AT_FIRST = 4.0
"""quanta, the largest noise accepted from the first two frames, which may also differ because all cells were pressed"""
QUIET_OF_TWO, QUIET_OF_THREE = 0.8, 1.4
"""times 1/sqrt(n): how far the quietest sum of two or three changes of n readings lies below the noise by chance; about
the lower third of simulated noise of 6 to 256 readings (its medians: 0.6 and 1.1)"""
ABOVE = 1.1
"""ratio to the noise so far above which motion of two patterns may be the cause"""
GROWING = 1.3
"""ratio to the noise so far above which the noise may have changed"""
ROUNDED = 1.0 + 1e-9
"""tolerance for rounding: the order of summation must not make equal changes exceed the earlier ones"""
DOUBT, RARE = 0.05, 0.01
"""probabilities: that the stated noise gives readings as quiet as those seen; and of changes so small, below which the
noise must have been smaller"""
DEVIATIONS = NormalDist().inv_cdf(1.0 - DOUBT)
"""standard deviations of a mean with this probability"""
TABULATED = 2000
"""changes up to which quantiles are tabulated; beyond, the normal limit holds to a percent"""

# -- the noise of each reading -----------------------------------------------------------------------------------------
READINGS = 200.0
"""number of readings over which a variance is averaged"""
EVERY = 3
"""frames between two evaluations of the third difference, whose overlapping windows tell nearly the same"""
OUTLIER = 9.0
"""multiple of the variance beyond which a squared third difference is an outlier: three standard deviations"""
_CUT = math.sqrt(OUTLIER)
UNCUT = 1.0 / (1.0 - 2.0 * _CUT * NormalDist().pdf(_CUT) / math.erf(_CUT / math.sqrt(2.0)))
"""variance of a normal variable over that of its values that are no outliers"""
CROWD, CROWDED = 24.0, 0.75
"""evaluations over which the fraction of outliers is averaged, and the fraction from which on they count: taps at three
hertz, read by a slow board, leave half of the readings clean"""
FIRST = 9
"""evaluations, one in each frame, of which few readings take the geometric mean, in which edges hardly count; many take
the mean, and lean on that of the array"""
GEOMETRIC = float(np.euler_gamma) + math.log(2.0)
"""mean of minus the logarithm of the square of a standard normal variable"""
PRIOR, PRIOR_OF_ARRAY = 4.0, 48.0
"""weight, in evaluations, of a first guess as prior; and of the array's median"""
MANY = 9
"""least number of readings for which their median is trusted"""
ABOVE_MEDIAN = 4.0
"""largest variance of a reading over that of the median one; a reading that flips between two codes has more"""
RISEN, CONFIRMED = 9.0, 3.0
"""ratio of the variance of all readings now to the median of the averages, from which on these are raised to it, if so
many frames have shown it"""

LEAST_VARIANCE = 1e-6
"""squared quanta: smaller variances count as none"""
FLIP = 3.2
"""squared quanta of a third difference that a reading gives that flips between two codes: no outlier"""
KEPT = 4
"""frames that a third difference and three changes need"""
ROOT_20 = math.sqrt(20.0)


class BoardNoise(Record):
    """State of the noise of all readings; the unit is that of the readings unless stated."""

    frames: float
    """taken so far"""
    stored: float
    """those that differed from the one before; a frame that a board sends twice is no new sample"""
    seen: float
    """noise without the sampling error of few readings"""
    confirmed: float
    """frames in which it was seen"""
    changes: float
    """changes of readings in which it was seen"""
    stills: float
    """frames since one that differed"""
    usable: float
    """successive changes that are known, up to 3"""
    free: float
    """readings that could change in the last frame"""
    largest: float
    """absolute change of a reading in the last frame"""
    evaluations: float
    """evaluations of third differences"""
    before: float
    """largest noise seen in the last :data:`MEMORY` frames"""
    since: float
    """frames since then"""
    middle: float
    """mean of the variances of the readings, each at most a few times the median"""


class ReadingNoise(Record):
    """State of the noise of one reading."""

    variance: float
    log_mean: float
    """mean logarithm of the squares until the variance is known"""
    crowd: float
    """recent fraction of outliers"""
    blind: float
    """further frames whose third differences contain a reading that was not read"""


class NoiseEstimate:
    """The noise of n readings of one board, in the unit of the readings."""

    def __init__(self, count: int, *, quantum: float, assumed: float = 0.0, expected: float = 0.0) -> None:
        """Start without a frame.

        Args:
            count: of readings.
            quantum: step of the readings; smaller changes are never clipped.
            assumed: standard deviation that is assumed before anything is measured.
            expected: likewise, of an earlier recording, as prior of :attr:`each`; 0: unknown.

        """
        self._quantum, self._assumed = quantum, assumed
        self._board, self._readings = zeros(BoardNoise, 1), zeros(ReadingNoise, count)
        self._ring, self._scratch = np.zeros((KEPT, count)), np.zeros((3, count))
        self._board["seen"] = assumed
        self._readings["variance"] = self._board["middle"] = expected**2
        self._expected = expected**2
        self.each = np.full(count, max(expected, assumed))
        """(n,) standard deviation of each reading, best guess; renewed in place"""
        self.std = assumed
        """standard deviation of any reading, with the sampling error of few readings: rarely too small"""
        self.usual = self.each.item(0)
        """root of the mean variance of the readings, best guess: what counts in sums of many"""
        self.largest_change = 0.0
        """largest absolute change of a reading since the last frame; 0 if none is known"""
        self.frames = 0
        """number of frames taken"""
        self._few = _few_at_most(min(TABULATED, round(MEMORY * count)))
        """(2, k) by number of changes: sampling error, and :data:`RARE` quantile"""

    @property
    def change(self) -> FloatArray:
        """(n,) change of the readings since the last frame; 0 if none is known."""
        if not self._board["largest"][0]:
            return np.zeros(self.each.size)
        newest = int(self._board["stored"][0]) - 1
        change: FloatArray = self._ring[newest % KEPT] - self._ring[(newest - 1) % KEPT]
        return change

    @property
    def last(self) -> FloatArray | None:
        """(n,) readings of the last frame; None before the first."""
        return self._ring[(int(self._board["stored"][0]) - 1) % KEPT].copy() if self.frames else None

    @property
    def if_all_noise(self) -> float:
        """The noise if the last change were all noise: a single change does not tell noise from motion."""
        sizes = np.sort(np.abs(self.change))
        silent = sizes.size - max(int(self._board["free"][0]), 1)
        return float(sizes[silent + (sizes.size - silent) // 2]) / MEDIAN_CHANGE

    def update(self, readings: FloatArray, silent: int = 0) -> float:
        """Take a frame.

        Args:
            readings: (n,)
            silent: number of them that stood at a limit in the frame before, and could not change.

        Returns:
            :attr:`std`.

        """
        self.frames += 1
        self.std, self.usual, self.largest_change = take_frame.unchecked(
            readings if readings.flags.c_contiguous else readings.copy(),
            *(self._ring, self._board, self._readings, self._scratch, self._few),
            *(self._quantum, self._assumed, self._expected, silent, self.each),
        )
        return self.std

    def run(self, readings: FloatArray) -> FloatArray:
        """Take frames (frames, n), contiguous, of which NaN was not read, and counts as unchanged.

        A frame of which nothing was read is left out. NaN become the readings before.

        Returns:
            (frames, n) :attr:`each` after every frame.

        """
        stds = np.empty_like(readings)
        found = take_frames.unchecked(
            readings,
            *(self._ring, self._board, self._readings, self._scratch, self._few),
            *(self._quantum, self._assumed, self._expected, self.each, stds),
        )
        frames = int(self._board["frames"][0])
        if frames > self.frames:
            self.frames, (self.std, self.usual, self.largest_change) = frames, found
        return stds

    def resume(self, std: float, last: FloatArray | None) -> None:
        """Continue after the frame ``last`` (n,) with a noise measured until then."""
        self._board[0] = self._readings[:] = 0
        self._board["seen"], self.std = std, std
        self._board["middle"] = self._readings["variance"] = std * std
        self.each[:] = self.usual = std
        self.frames = 0 if last is None else 1
        if last is not None:
            self._ring[0] = last
            self._board["frames"] = self._board["stored"] = 1.0
            self._board["confirmed"], self._board["changes"] = MEMORY, math.inf

    def state(self) -> dict[str, FloatArray]:
        """The state, by name."""
        return {
            "noise_ring": self._ring,
            "noise_board": values(self._board),
            "noise_readings": values(self._readings),
            "noise_each": np.append(self.each, self.std),
        }

    def restore(self, state: Mapping[str, FloatArray]) -> None:
        """Continue from a :meth:`state`."""
        self._ring[...], values(self._board)[...] = state["noise_ring"], state["noise_board"]
        values(self._readings)[...], self.each[...] = state["noise_readings"], state["noise_each"][:-1]
        self.std = float(state["noise_each"][-1])
        self.usual = math.sqrt(self.each.dot(self.each) / self.each.size)
        self.frames, self.largest_change = int(self._board["frames"][0]), float(self._board["largest"][0])


@loop
def constant_part(steps: float) -> float:
    """Fraction of the quantisation error that averaging does not reduce, at a measured noise in quantisation ``steps``.

    Noise sigma ahead of the converter leaves the fraction s = exp(-2 (pi sigma)^2) of the mean error (Widrow and
    Kollar, Quantization Noise, 2008) and makes the rest random, so that readings change by sigma^2 + (1 - s^2) / 12.
    """
    low, high = 0.0, steps
    for _ in range(24):
        sigma = 0.5 * (low + high)
        left = math.exp(-2.0 * (math.pi * sigma) * (math.pi * sigma))
        if sigma * sigma + (1.0 - left * left) / 12.0 > steps * steps:
            high = sigma
        else:
            low = sigma
    return math.exp(-2.0 * (math.pi * low) * (math.pi * low))


def _few_at_most(most: int) -> FloatArray:
    """(2, most + 1) by number of changes: sampling error of a standard deviation, and least sum of squares.

    The first is the relative error by which an estimate from so many changes may be too small (chi-square below its
    :data:`DOUBT` quantile), the second the :data:`RARE` quantile of chi-square.
    """
    from scipy.special import chdtri

    changes = np.arange(most + 1.0)
    changes[0] = 1.0
    return np.array([np.sqrt(changes / chdtri(changes, 1.0 - DOUBT)) - 1.0, chdtri(changes, 1.0 - RARE)])


@loop
def take_frames(
    readings: Rows,
    ring: Rows,
    boards: Records[BoardNoise],
    each: Records[ReadingNoise],
    scratch: Rows,
    few: Rows,
    quantum: float,
    assumed: float,
    expected: float,
    std: Row,
    stds: Rows,
) -> tuple[float, float, float]:
    """Take frames (frames, n), see :meth:`NoiseEstimate.run`; the further arguments as of :func:`take_frame`."""
    count, found = std.size, (0.0, 0.0, 0.0)
    for frame in range(readings.shape[0]):
        read = readings[frame]
        silent = 0
        for i in range(count):
            silent += 1 if math.isnan(read[i]) else 0
        if silent < count:
            newest = (int(boards[0].stored) - 1) % KEPT
            for i in range(count):
                if math.isnan(read[i]):
                    read[i], each[i].blind = ring[newest, i], KEPT + 1.0
            found = take_frame(read, ring, boards, each, scratch, few, quantum, assumed, expected, silent, std)
        for i in range(count):
            stds[frame, i] = std[i]
    return found


@loop
def take_frame(
    readings: Row,
    ring: Rows,
    boards: Records[BoardNoise],
    each: Records[ReadingNoise],
    scratch: Rows,
    few: Rows,
    quantum: float,
    assumed: float,
    expected: float,
    silent: int,
    std: Row,
) -> tuple[float, float, float]:
    """Take a frame of readings (n,); the further arguments are those of :class:`NoiseEstimate`.

    Returns:
        The standard deviation of any reading, the root of their mean variance, and the largest change; ``std`` (n,)
        becomes the standard deviation of each.
    """
    board, count = boards[0], readings.size
    newest, still = int(board.stored) % KEPT, board.stored > 0.0
    for i in range(count):
        still = still and readings[i] == ring[(newest - 1) % KEPT, i]
        ring[newest, i] = readings[i]
    board.frames += 1.0
    board.free, board.largest = count - silent, 0.0
    board.stills = board.stills + 1.0 if still else 0.0
    if board.stills > 1.0 or (still and board.stored == 1.0):  # what was before is no neighbour of what comes
        board.usable = 0.0
        show_noise(board, few, 0.0, 0.0, quantum, count)
        if board.frames == 2.0:
            board.seen, board.confirmed = 0.0, 1.0
    elif not still:
        board.stored += 1.0
    if board.stored > 1.0 and not still:
        noise_of_all(ring, newest, board, scratch, few, quantum)
    if board.stills != 1.0 or board.stored == 1.0:
        noise_of_each(ring, newest, board, each, scratch, quantum, expected, std)
    if board.frames > 1.0:
        board.changes = (1.0 - 1.0 / MEMORY) * min(board.changes, count * MEMORY) + board.free
    known = max(int(board.changes + 0.5), 1)
    left_open = few[0, known] if known < few.shape[1] else DEVIATIONS / math.sqrt(2.0 * known)
    if board.frames == 1.0 and board.changes == 0.0:
        left_open = 0.0
    total = 0.0
    for i in range(count):
        total += std[i] * std[i]
    return board.seen + left_open * max(board.seen, assumed), math.sqrt(total / count), board.largest


@loop
def noise_of_all(ring: Rows, newest: int, board: BoardNoise, scratch: Rows, few: Rows, quantum: float) -> None:
    """Update the noise of all readings."""
    count, before = ring.shape[1], (newest - 1) % KEPT
    moving = max(board.free, 1.0)
    most, cut, square = max(quantum, CLIP * board.seen), 0.0, 0.0
    for i in range(count):
        change = ring[newest, i] - ring[before, i]
        cut += min(abs(change), most)
        square += change * change
        board.largest = max(board.largest, abs(change))
    board.usable = min(board.usable + 1.0, KEPT - 1.0)
    if board.frames == 2.0 and board.confirmed == 0.0:
        expected = max(board.seen, min(median_change(ring, newest, 1, 0, board, scratch), AT_FIRST * quantum))
        board.seen = mean_change(ring, newest, 1, max(quantum, CLIP * expected)) / (moving * MEAN_CHANGE)
        board.confirmed = 1.0
        return
    mean = cut / (moving * MEAN_CHANGE)
    shown = mean
    if mean > ROUNDED * board.seen:  # motion only adds to the mean
        shown = 0.0
        if board.usable > 1.0 and moving < FEW:
            shown = noise_of_few(ring, newest, board, scratch, mean, quantum)
        elif board.usable > 1.0:
            shown = noise_of_quietest(ring, newest, board, scratch, quantum, False)
            if shown > ABOVE * board.seen and board.usable > 2.0:
                shown = min(shown, noise_of_quietest(ring, newest, board, scratch, quantum, True))
    if board.since >= MEMORY or (min(shown, board.seen) >= board.before and board.confirmed >= CONFIRMED):
        board.before, board.since = min(shown, board.seen), 0.0
    board.since += 1.0
    # A noise that has paused is the likelier cause of changes of its size.
    if mean > ROUNDED * board.seen and board.seen < CONTRADICTED * board.before:
        again = mean_change(ring, newest, 1, max(quantum, CLIP * board.before)) / (moving * MEAN_CHANGE)
        shown = max(shown, min(again, board.before))
    show_noise(board, few, shown, square, quantum, count)


@loop
def show_noise(board: BoardNoise, few: Rows, shown: float, square: float, quantum: float, count: int) -> None:
    """Combine the noise ``shown`` by this frame, whose changes have this sum of squares, with the noise so far."""
    moving = max(board.free, 1.0)
    rarely_less = few[1, int(moving)] if moving < few.shape[1] else moving
    contradicts = math.sqrt((square + moving * quantum * quantum) / (2.0 * rarely_less))
    weight = min(1.0, board.free / min(TELLING, count))
    kept = board.seen * (1.0 - weight / min(board.confirmed + BARELY_SEEN, MEMORY))
    if shown > GROWING * board.seen:  # earlier changes showed another noise
        board.changes, board.confirmed = board.free if moving < FEW else 0.0, 0.0
    if shown > kept:
        board.confirmed += 1.0
    elif shown < CONTRADICTED * kept and contradicts < kept:
        board.confirmed *= FADING
    if board.stills == 0.0 and 0.0 < board.free < FEW:
        kept = min((1.0 - 1.0 / MEMORY) * board.seen, contradicts)
    board.seen = max(kept, shown)


@loop
def noise_of_few(ring: Rows, newest: int, board: BoardNoise, scratch: Rows, mean: float, quantum: float) -> float:
    """The noise of few readings by the alternation of two changes; ``mean`` is that by the size of the last one."""
    shown = min(mean, alternation(ring, newest, board, max(quantum, CLIP * board.seen)))
    if shown <= GROWING * board.seen:
        return shown
    # Clipping by the noise so far removes too much of a larger noise. The median of either change is that of noise
    # unless half of the cells move. The median of both together also is where all cells come and go.
    expected = min(
        median_change(ring, newest, 1, 0, board, scratch),
        median_change(ring, newest, 1, 1, board, scratch),
        median_change(ring, newest, 2, 0, board, scratch),
    )
    most = max(quantum, CLIP * max(board.seen, expected))
    shown = mean_change(ring, newest, 1, most) / (max(board.free, 1.0) * MEAN_CHANGE)
    return min(shown, alternation(ring, newest, board, most))


@loop
def alternation(ring: Rows, newest: int, board: BoardNoise, most: float) -> float:
    """Upper estimate of the noise by the alternating part of the last two changes, each clipped at ``most``.

    The smaller one of both changes counts, so that a jump before or after a quiet frame is no noise.
    """
    squares = fourths = 0.0
    for i in range(ring.shape[1]):
        change = ring[newest, i] - ring[(newest - 1) % KEPT, i]
        earlier = ring[(newest - 1) % KEPT, i] - ring[(newest - 2) % KEPT, i]
        back = min(abs(change), abs(earlier), most)
        squares += math.copysign(back * back, change * earlier)
        fourths += back * back * back * back
    # Of readings known for some frames, motion is the likelier cause if they go on together.
    if squares >= TOGETHER * math.sqrt(fourths) and board.frames > FEW:
        return 0.0
    # By chance, few cells may alternate less than their noise does.
    part = DEVIATIONS * math.sqrt(fourths) - squares
    return math.sqrt(max(part, 0.0) / (max(board.free, 1.0) * ALTERNATING))


@loop
def mean_change(ring: Rows, newest: int, apart: int, most: float) -> float:
    """Sum of the absolute changes since ``apart`` frames before the newest one, each clipped at ``most``."""
    total = 0.0
    for i in range(ring.shape[1]):
        total += min(abs(ring[newest, i] - ring[(newest - apart) % KEPT, i]), most)
    return total


@loop
def median_change(ring: Rows, newest: int, apart: int, age: int, board: BoardNoise, scratch: Rows) -> float:
    """The noise by the median absolute change over ``apart`` frames, up to ``age`` frames before the newest one."""
    last, count = (newest - age) % KEPT, ring.shape[1]
    for i in range(count):
        scratch[0, i] = abs(ring[last, i] - ring[(last - apart) % KEPT, i])
    return middle_of(scratch[0], count, board) / MEDIAN_CHANGE


@loop
def middle_of(sizes: Row, count: int, board: BoardNoise) -> float:
    """The median of the first ``count`` sizes, reordered, of which those of silent readings are the least."""
    silent = count - int(max(board.free, 1.0))
    return select(sizes, count, silent + (count - silent) // 2)


@loop
def select(sizes: Row, count: int, place: int) -> float:
    """The value at a ``place`` of the sorted first ``count`` sizes, which are reordered (quickselect, Hoare 1961)."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = sizes[(low + high) // 2], low, high
        while i <= j:
            while sizes[i] < pivot:
                i += 1
            while sizes[j] > pivot:
                j -= 1
            if i <= j:
                sizes[i], sizes[j] = sizes[j], sizes[i]
                i += 1
                j -= 1
        if place <= j:
            high = j
        elif place >= i:
            low = i
        else:
            break
    return float(sizes[place])


@loop
def noise_of_quietest(ring: Rows, newest: int, board: BoardNoise, scratch: Rows, quantum: float, three: bool) -> float:
    """The noise by the scatter over the readings of the quietest sum of the last two changes, or of ``three``."""
    count, moving = ring.shape[1], max(board.free, 1.0)
    # Coordinates that are independent under noise, with the variance 2 sigma^2 of one change: of three changes the
    # linear, quadratic and cubic Legendre weights of four readings, of two changes the same of three readings.
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(count):
        a, b, c = ring[newest, i], ring[(newest - 1) % KEPT, i], ring[(newest - 2) % KEPT, i]
        if three:
            d = ring[(newest - 3) % KEPT, i]
            x = (3.0 * (a - d) + b - c) * (1.0 / math.sqrt(10.0))
            y = (a - b - c + d) * (1.0 / math.sqrt(2.0))
            z = (a - d - 3.0 * (b - c)) * (1.0 / math.sqrt(10.0))
        else:
            x, y, z = a - c, (a - 2.0 * b + c) * (1.0 / math.sqrt(3.0)), 0.0
        scratch[0, i], scratch[1, i], scratch[2, i] = x, y, z
        xx, xy, xz, yy, yz, zz = xx + x * x, xy + x * y, xz + x * z, yy + y * y, yz + y * z, zz + z * z
    if three:
        p, q, r = least_axis(xx, xy, xz, yy, yz, zz)
    else:
        angle = 0.5 * math.atan2(2.0 * xy, yy - xx)
        p, q, r = math.cos(angle), -math.sin(angle), 0.0
    cut, most = 0.0, max(quantum, CLIP * board.seen)
    for i in range(count):
        scratch[1, i] = abs(p * scratch[0, i] + q * scratch[1, i] + r * scratch[2, i])
        scratch[0, i] = scratch[1, i]
        cut += min(scratch[1, i], most)
    if (
        cut > GROWING * board.seen * moving * MEAN_CHANGE
    ):  # clipping by the noise so far removes too much of a larger one
        expected = middle_of(scratch[0], count, board) / MEDIAN_CHANGE
        cut, most = 0.0, max(quantum, CLIP * max(board.seen, expected))
        for i in range(count):
            cut += min(scratch[1, i], most)
    return cut / (moving * MEAN_CHANGE) / (1.0 - (QUIET_OF_THREE if three else QUIET_OF_TWO) / math.sqrt(moving))


@loop
def least_axis(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> tuple[float, float, float]:
    """Unit eigenvector to the smallest eigenvalue of a symmetric matrix (inverse iteration).

    Its adjugate has the same eigenvectors, and the product of the other two eigenvalues as eigenvalues: squared a few
    times, its largest column is the axis.
    """
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    for _ in range(5):
        size = a + d + f
        if not size > 0.0:
            break
        a, b, c, d, e, f = a / size, b / size, c / size, d / size, e / size, f / size
        a, b, c, d, e, f = (
            a * a + b * b + c * c,
            a * b + b * d + c * e,
            a * c + b * e + c * f,
            b * b + d * d + e * e,
            b * c + d * e + e * f,
            c * c + e * e + f * f,
        )
    x, y, z = a, b, c
    if d > a and d >= f:
        x, y, z = b, d, e
    elif f > a:
        x, y, z = c, e, f
    size = math.sqrt(x * x + y * y + z * z)
    if not size > 0.0:
        return 0.0, 0.0, 1.0
    return x / size, y / size, z / size


@loop
def noise_of_each(
    ring: Rows,
    newest: int,
    board: BoardNoise,
    each: Records[ReadingNoise],
    scratch: Rows,
    quantum: float,
    expected: float,
    std: Row,
) -> None:
    """Update the noise of each reading, and write the standard deviations (n,)."""
    count = ring.shape[1]
    still = board.stills > 0.0
    due = (board.usable > 2.0 or still) and (board.evaluations < FIRST or int(board.frames) % EVERY == 0)
    if due:
        board.evaluations += 1.0
    done, prior, floor = board.evaluations, PRIOR if expected > 0.0 else 0.0, quantum * quantum * LEAST_VARIANCE
    share = max(1.0 / max(done + prior, 1.0), EVERY / READINGS)
    of_crowd = 1.0 / CROWD if done > FIRST else 0.0
    for i in range(count):
        one = each[i]
        if due and one.blind <= 0.0:
            third = ring[newest, i] - ring[(newest - 3) % KEPT, i]
            third = (third - 3.0 * (ring[(newest - 1) % KEPT, i] - ring[(newest - 2) % KEPT, i])) / ROOT_20
            square = 0.0 if still else third * third
            if done <= FIRST and count < MANY:
                one.log_mean += (math.log(max(square, floor, 1e-300)) - one.log_mean) / done
                one.variance = (done * math.exp(one.log_mean + GEOMETRIC) + prior * expected) / (done + prior)
            else:
                usual = one.variance if done > FIRST else board.middle
                limit = max(OUTLIER * usual, FLIP * quantum * quantum)
                outlies = square > limit and done > 1.0
                one.crowd += ((1.0 if outlies else 0.0) - one.crowd) * of_crowd
                if one.crowd > CROWDED:
                    one.variance += (min(square, limit) - one.variance) * max(share, 1.0 / CROWD)
                elif not outlies:
                    one.variance += (square * (UNCUT if done > 1.0 else 1.0) - one.variance) * share
        one.blind = max(one.blind - 1.0, 0.0)
        scratch[0, i] = one.variance
    if count >= MANY and due:
        most, total = max(OUTLIER * select(scratch[0], count, count // 2), quantum * quantum), 0.0
        for i in range(count):
            total += min(scratch[0, i], most)
        board.middle = total / count
    now = board.seen * board.seen
    if count >= MANY and done > FIRST and now > RISEN * board.middle and board.confirmed >= CONFIRMED:
        for i in range(count):
            each[i].variance *= now / max(board.middle, 1e-300)
        board.middle = now
    for i in range(count):
        variance = each[i].variance
        if done < 1.0:
            variance = max(now, variance)
        elif count >= MANY:
            known = min(done, READINGS)
            variance = min(variance, max(ABOVE_MEDIAN * board.middle, quantum * quantum))
            variance = (known * variance + PRIOR_OF_ARRAY * board.middle) / (known + PRIOR_OF_ARRAY)
        std[i] = math.sqrt(max(variance, 0.0))
