"""Guesses for binary streams: length of a frame, header, words, checksum."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise, product
from typing import Any

import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from ..common.arrays import FloatArray, IntArray
from ..wire import CHECKSUMS, WORDS
from ._guess import Chunk, Guess, board_guess, shapes

MOST_BYTES = 2**17
"""of the stream that are looked at"""
LEAST_FRAME = 8
FEWEST_FRAMES = 3
USUAL = 0.8
LONGEST_HEADER = 8
MOST_AHEAD = 8
"""bytes between header and words, at most"""
PAUSE_S = 0.003
COVERED = 0.6
"""share of the stream that the returns of two bytes after one length make up, if these are a header"""
PROOF = 20.0
"""likelihood that a right checksum adds"""
HALF = 0.05
"""ratio of the scatter of every other number to that of the rest, below which they are halves of longer words"""
LEFT_OVER = 6.0
"""likelihood that a constant byte other than zero takes away where it would be a cell's"""
ALIKE = 0.4
"""sum of the differences of two distributions of bytes, below which they are the same up to chance"""
MOST_TRIED = 24
_WORDS = ("uint8", "uint16le", "uint16be", "int16le", "int16be", "uint32le", "uint32be", "float32le", "float32be")
_PLACES = ("uint16le", "uint16be", "uint8")
_COUNTERS = ("uint32le", "uint32be", "uint16le", "uint16be", "uint8")
Bytes = NDArray[np.uint8]
Likely = tuple[float, Guess]
"""how likely a guess is, and the guess"""


def binary_guesses(chunks: Sequence[Chunk]) -> Iterator[Guess]:
    """Guesses for a binary stream, the likeliest first."""
    data = b"".join(chunk.data for chunk in chunks)[:MOST_BYTES]
    yield from _cobs_guesses(data)
    found: list[Likely] = []
    for length, phase in _folds(data, chunks):
        frames = np.frombuffer(data[phase : phase + (len(data) - phase) // length * length], np.uint8)
        if len(frames) >= FEWEST_FRAMES * length:
            yield from _sorted(_rotated_blocks(data, length, phase, chunks))
            found += _framed_guesses(frames.reshape(-1, length))
    yield from _sorted(found)
    yield from _sorted(_raw_guesses(data, chunks))


def _sorted(found: Iterable[Likely]) -> Iterator[Guess]:
    """The likeliest guesses first, not too many of them."""
    yield from (guess for _, guess in sorted(found, key=lambda item: -item[0])[:MOST_TRIED])


def _cobs_guesses(data: bytes) -> Iterator[Guess]:
    decoded = []
    for piece in data.split(b"\0")[1:-1]:
        try:
            decoded.append(bytes(cobs.decode(piece)))
        except cobs.DecodeError:
            continue
    lengths = Counter(map(len, decoded))
    if not decoded:
        return
    (length, seen), *_ = lengths.most_common(1)
    if length < LEAST_FRAME or seen < FEWEST_FRAMES or seen < USUAL * len(data.split(b"\0")[1:-1]):
        return
    frames = np.array([list(frame) for frame in decoded if len(frame) == length], dtype=np.uint8)
    yield from _sorted(_inner_guesses(frames, {"format": "binary", "framing": "cobs"}, 0))


def _folds(data: bytes, chunks: Sequence[Chunk]) -> Iterator[tuple[int, int]]:
    """Lengths of a frame with the place of the first frame's header: bytes that return after just that length."""
    stream = np.frombuffer(data, np.uint8).astype(np.int64)
    if len(stream) < FEWEST_FRAMES * LEAST_FRAME:
        return
    covered: dict[int, int] = {}
    for codes in (stream[:-1] * 256 + stream[1:], stream):
        for length, covers in _returns(codes).items():
            covered[length] = max(covered.get(length, 0), covers)
    starts = _burst_starts(chunks)
    for length in sorted(covered, key=lambda one: -covered[one])[:3]:
        if covered[length] < COVERED * len(data):
            continue
        frames = stream[: len(stream) // length * length].reshape(-1, length)
        if len(frames) < FEWEST_FRAMES:
            continue
        common = np.median(frames, axis=0)
        constant = (frames == common).mean(axis=0) > USUAL
        pauses = Counter(start % length for start in starts)
        paused = [phase for phase, seen in pauses.most_common(1) if constant[phase] and seen > USUAL * len(starts)]
        for phase in paused or _headers(constant, common)[:4]:
            yield length, phase


def _returns(codes: IntArray) -> dict[int, int]:
    """Lengths after which a code returns again and again -> bytes of the stream that its returns cover, at most."""
    order = np.argsort(codes, kind="stable")
    gap, code = np.diff(order), codes[order][:-1]
    returns = (np.diff(codes[order]) == 0) & (gap >= LEAST_FRAME)
    kinds, seen = np.unique(code[returns] * len(codes) + gap[returns], return_counts=True)
    often = seen >= FEWEST_FRAMES - 1
    covered: dict[int, int] = {}
    for length, covers in zip(
        (kinds % len(codes))[often].tolist(), (seen * (kinds % len(codes)))[often].tolist(), strict=True
    ):
        covered[length] = max(covered.get(length, 0), covers)
    return covered


def _headers(constant: NDArray[np.bool_], common: FloatArray) -> list[int]:
    """Places at which constant bytes begin, those first that cells at rest are least likely to show."""
    begins = np.flatnonzero(constant & ~np.roll(constant, 1))
    found = []
    for begin in begins.tolist():
        run = [int(common[(begin + k) % len(common)]) for k in range(LONGEST_HEADER)]
        inside = 0
        while inside < LONGEST_HEADER and constant[(begin + inside) % len(common)]:
            inside += 1
        unusual = sum(byte >= 0x80 for byte in run[:inside]) + (len(set(run[:inside])) > 1) - (run[0] == 0) * 2
        found.append((-unusual, begin))
    return [begin for _, begin in sorted(found)]


def _burst_starts(chunks: Sequence[Chunk]) -> list[int]:
    """Places in the stream behind a pause."""
    starts, place, before = [], 0, -np.inf
    for chunk in chunks:
        if chunk.time_s - before > PAUSE_S:
            starts.append(place)
        place, before = place + len(chunk.data), chunk.time_s
    return starts[1:]


def _framed_guesses(frames: Bytes) -> Iterator[Likely]:
    """Guesses for frames (frames, bytes) that begin with their header."""
    constant = (frames == frames[0]).mean(axis=0) > USUAL
    # Where nothing varies, the header ends where the value begins that most cells have.
    same = frames[0] == np.bincount(frames[0]).argmax()
    run = max(int(np.argmax(same)), 1) if constant.all() else int(np.argmin(constant))
    tail = int(np.argmin(constant[::-1])) if not constant.all() else 0
    ends = [n for n in (2, 1) if n <= tail and bytes(frames[0, -n:]) in (b"\r\n", b"\n\r", b"\n", b"\r")] or []
    trailers = [*ends, 0] + ([1] if tail == 1 and 1 not in ends and frames[0, -1] != 0 else [])
    for header, trailer in product(range(min(run, LONGEST_HEADER), 0, -1), trailers):
        # Constant bytes that are not zero are a header's rather than those of cells.
        left_over = int(np.count_nonzero(frames[0, header:run]))
        frame: dict[str, Any] = {"format": "binary", "header": frames[0, :header].tolist()}
        if trailer:
            frame["trailer"] = frames[0, -trailer:].tolist()
        body = frames[:, : frames.shape[1] - trailer]
        for likely, guess in _inner_guesses(body, frame, header):
            passed = min(guess.tables["frame"].get("before", 0), left_over)
            yield likely + 0.1 * (header + trailer) - LEFT_OVER * (left_over - passed), guess


def _rotated_blocks(data: bytes, length: int, phase: int, chunks: Sequence[Chunk]) -> Iterator[Likely]:
    """Guesses for blocks that begin anywhere in the run of constant bytes at a phase, rather behind a pause.

    Constant bytes may be the end of one block, upper bytes of its counter among them, and the head of the next.
    """
    bursts = {start % length for start in _burst_starts(chunks)}
    for begin in range(phase, phase + MOST_AHEAD):
        packets = np.frombuffer(data[begin : begin + (len(data) - begin) // length * length], np.uint8)
        if len(packets) < FEWEST_FRAMES * length:
            return
        packets = packets.reshape(-1, length)
        for likely, guess in _block_guesses(packets):
            fields = guess.tables["frame"]["block"][0]["fields"]
            counts = sum("number uint32" in one for one in fields) + 0.5 * sum("number uint16" in one for one in fields)
            yield likely + counts + (begin % length in bursts), guess
        if not (packets[:, 0] == packets[0, 0]).all():
            return


def _block_guesses(packets: Bytes) -> Iterator[Likely]:
    """Guesses for packets that are blocks of a frame: one of their first numbers counts blocks or cells, over and over.

    Ahead of that number stand constant bytes; behind the cells, at most a counter of packets and constant bytes.
    """
    constant = (packets == packets[0]).all(axis=0)
    tail = int(np.argmin(constant[::-1])) if not constant.all() else 0
    for at, name in product(range(min(MOST_AHEAD, packets.shape[1] - LEAST_FRAME)), _PLACES):
        if not constant[:at].all():
            break
        cycle = _cycle(_column(packets, at, name))
        if cycle is None:
            continue
        blocks, first, step = cycle
        head = [f"const {_shown(packets[0, :at])}"] if at else []
        begin, end = at + WORDS[name].dtype.itemsize, packets.shape[1] - tail
        behind = []
        # Zeros behind a counter are its upper bytes, which have not counted yet.
        zeros = int(np.argmax(packets[0, end:] != 0)) if packets[0, end:].any() else tail
        ends = range(end + min(zeros, 3), end - 1, -1)
        counted = next(((one, place) for place in ends for one in _COUNTERS if _counts_up(packets, place, one)), None)
        if counted is not None:
            counter, end = counted
            behind.append(f"number {counter}")
        if end < packets.shape[1]:
            behind.append(f"const {_shown(packets[0, end:])}")
        end -= 0 if counted is None else WORDS[counted[0]].dtype.itemsize
        for word in _WORDS:
            size = WORDS[word].dtype.itemsize
            cells = (end - begin) // size
            if end <= begin or (end - begin) % size or step not in (1, cells):
                continue
            place = f"index {name} {first}" if step == 1 and cells > 1 else f"start {name}"
            if place.startswith("start") and first:
                continue
            fields = [*head, place, f"cells {word} {cells}", *behind]
            whole = len(packets) // blocks * blocks
            grid = _column_block(packets[:whole], begin, end, word).reshape(-1, blocks * cells)
            sides = [(blocks, cells)] if step == 1 else shapes(blocks * cells)
            if len(grid) < FEWEST_FRAMES or not sides:
                continue
            frame: dict[str, Any] = {"format": "binary", "block": [{"fields": fields, "repeat": blocks}]}
            guess = board_guess(sides[0][0], sides[0][1], frame, grid, known_shape=step == 1)
            guess.remarks["frame.block"] = "? length and order of the words of cells, by how evenly they change"
            yield _likelihood(grid, word), guess


def _column(packets: Bytes, at: int, name: str) -> FloatArray:
    """A number of each packet."""
    return _column_block(packets, at, at + WORDS[name].dtype.itemsize, name).ravel()


def _column_block(packets: Bytes, begin: int, end: int, name: str) -> FloatArray:
    """(packets, numbers) in a stretch of each packet."""
    part = np.ascontiguousarray(packets[:, begin:end])
    with np.errstate(invalid="ignore"):
        return part.view(WORDS[name].dtype).astype(np.float64)


def _cycle(values: FloatArray) -> tuple[int, int, int] | None:
    """Length, first value and step of a number that rises by equal steps and begins again; None: it does not."""
    steps = np.diff(values)
    falls = np.flatnonzero(steps < 0)
    if len(falls) < 2 or (rise := float(steps[falls[0] + 1])) <= 0:
        return None
    length = int(falls[1] - falls[0])
    first = float(values[falls[0] + 1])
    expected = first + rise * np.mod(np.arange(len(values)) - falls[0] - 1, length)
    return (length, int(first), int(rise)) if length > 1 and (values == expected).mean() > USUAL else None


def _counts_up(packets: Bytes, end: int, name: str) -> bool:
    """Whether the number that ends at a place rises by one from packet to packet."""
    size = WORDS[name].dtype.itemsize
    return end > size and bool((np.diff(_column(packets, end - size, name)) == 1).mean() > USUAL)


def _shown(data: Bytes) -> str:
    return " ".join(f"0x{byte:02X}" for byte in data.tolist())


def _inner_guesses(frames: Bytes, frame: dict[str, Any], header: int) -> Iterator[Likely]:
    """Guesses for frames without their trailer: the checksum, then the words."""
    for keys, size in _checksums(frames, header):
        kept = frames[:, header : frames.shape[1] - size]
        for likely, guess in _word_guesses(kept, frame | keys):
            yield likely + (PROOF if size > 1 else PROOF / 2 if size else 0.0), guess


def _checksums(frames: Bytes, header: int) -> Iterator[tuple[dict[str, Any], int]]:
    """Checksums that all frames have right, the longest first, with their size; then none."""
    rows = [bytes(row) for row in frames[:: max(len(frames) // 8, 1)]]
    if len(set(rows)) >= FEWEST_FRAMES:
        for name, kind in sorted(CHECKSUMS.items(), key=lambda item: -item[1].size):
            ways: list[tuple[int, dict[str, Any]]] = [(header, {"checksum_of": "body"}), (0, {"checksum_of": "frame"})]
            if kind.size > 1:  # a checksum of one byte may be right by chance where so many places are tried
                ways += [(header + ahead, {"before": ahead}) for ahead in range(1, MOST_AHEAD + 1)]
            for start, keys in ways:
                if all(kind.of(row[start : -kind.size]) == row[-kind.size :] for row in rows):
                    yield {"checksum": name} | keys, kind.size
                    break
    yield {}, 0


def _word_guesses(body: Bytes, frame: dict[str, Any]) -> Iterator[Likely]:
    """Guesses for the bytes between header and checksum."""
    counting, free = _counters(body)
    ahead = [frame["before"]] if "before" in frame else range(MOST_AHEAD + 1)
    for before, name in product(ahead, _WORDS):
        word = WORDS[name].dtype
        left = body.shape[1] - before
        for after in range(0, 5):
            size = left - after
            if size <= 0 or size % word.itemsize:
                continue
            cells = size // word.itemsize
            sides = shapes(cells)
            if not sides or cells < 2:
                continue
            part = np.ascontiguousarray(body[:, before : before + size])
            with np.errstate(invalid="ignore"):  # bytes that are no floats
                numbers = part.view(word).astype(np.float64)
            likely = _likelihood(numbers, name) - 0.35 * (max(before - free, 0) + 1.5 * after) - 0.05 * before
            likely -= 3.0 * (before < counting)
            likely -= 3.0 * (word.itemsize > 1 and _halves_alike(part))
            likely += 1.0 if sides[0][0] == sides[0][1] else 0.3 if sides[0][1] <= 2 * sides[0][0] else 0.0
            likely -= 0.8 * (cells % 2 and before + after > 0)
            keys = {"word": name} | ({"before": before} if before else {}) | ({"after": after} if after else {})
            guess = board_guess(*sides[0], frame | keys, numbers, known_shape=False)
            guess.remarks["frame.word"] = "? length and order of the words, by how evenly the numbers change"
            if before:
                guess.remarks["frame.before"] = (
                    "bytes ahead of the cells that are not read: a counter, a length, a time"
                )
            yield likely, guess


def _halves_alike(part: Bytes) -> bool:
    """Whether bytes at even and odd places have one distribution: they are cells, no halves of words."""
    even, odd = (np.bincount(part[:, side::2].ravel(), minlength=256) for side in (0, 1))
    return bool(np.abs(even / even.sum() - odd / odd.sum()).sum() < ALIKE)


def _counters(body: Bytes) -> tuple[int, int]:
    """Bytes at the head up to the last one that counts, and those that may be a counter's or are constant."""
    steps = np.mod(np.diff(body[:, :MOST_AHEAD].astype(np.int64), axis=0), 256)
    usual = np.array([np.bincount(column).argmax() for column in steps.T])
    steady = (steps == usual).mean(axis=0) > USUAL
    counts = np.flatnonzero(steady & (usual != 0))
    free = steady.size if steady.all() else int(np.argmin(steady))
    # A counter of several bytes: those above the lowest are constant for a while.
    word = 4 * -(-(int(counts[0]) + 1) // 4) if counts.size else 0
    return int(counts[-1]) + 1 if counts.size else 0, max(free, min(word, MOST_AHEAD))


def _likelihood(numbers: FloatArray, name: str) -> float:
    """How much the numbers look like readings of cells: small steps from frame to frame, and few odd values.

    A wrong length or order of the words makes the noise of the lowest byte a change of the highest one.
    """
    known = np.isfinite(numbers)
    if name.startswith("float"):
        with np.errstate(over="ignore", invalid="ignore"):
            size = np.abs(numbers)
            plain = ~known | (size == 0) | ((size > 1e-6) & (size < 1e7))
        if plain.mean() < 0.99 or known.mean() < 0.5:
            return -10.0
    filled = np.where(known, numbers, 0.0)
    span = float(filled.max() - filled.min())
    if span == 0.0 or not np.diff(filled, axis=0).any():  # nothing changes, and so nothing tells words apart
        return -1.0 - 0.1 * WORDS[name].dtype.itemsize
    steps = np.abs(np.diff(filled, axis=0)).mean() / span
    across = np.abs(np.diff(filled, axis=1)).mean() / span if filled.shape[1] > 1 else steps
    # Every other number constant beside its neighbours: the high half of a longer word.
    halves = sorted(float(filled[:, side::2].std()) for side in (0, 1)) if filled.shape[1] > 1 else [1.0, 1.0]
    likely = -2.5 * (halves[0] < HALF * halves[1])
    likely += -2.0 * float(np.log10(max(steps, 1e-4))) - 1.0 * float(np.log10(max(across, 1e-4)))
    if name.startswith("uint"):
        bits = 8 * WORDS[name].dtype.itemsize
        signed = np.where(filled < 2.0 ** (bits - 1), filled, filled - 2.0**bits)
        likely -= 4.0 * (float(signed.max() - signed.min()) < 0.5 * span)
    if name.startswith("float"):
        likely += 2.0
    elif name.startswith("int"):
        likely -= 1.0 if float(filled.min()) >= 0 else 0.2
    return likely


def _raw_guesses(data: bytes, chunks: Sequence[Chunk]) -> Iterator[Likely]:
    """Guesses for frames without a header, between pauses."""
    starts = _burst_starts(chunks)
    lengths = Counter(np.diff(starts).tolist())
    if not lengths:
        return
    (length, seen), *_ = lengths.most_common(1)
    if length < LEAST_FRAME or seen < 0.5 * (len(starts) - 1):
        return
    places = [at for at, after in pairwise(starts) if after - at == length and after <= len(data)]
    if len(places) < FEWEST_FRAMES:
        return
    frames = np.array([list(data[at : at + length]) for at in places], dtype=np.uint8)
    for likely, guess in _word_guesses(frames, {"format": "binary"}):
        guess.remarks["frame.format"] = "? nothing but the pauses between them shows where frames begin"
        yield likely, guess
