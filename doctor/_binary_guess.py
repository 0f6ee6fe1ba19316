"""Guesses for binary streams: length of a frame, header, words, checksum."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise, product, takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray, IntArray
from ..wire import CHECKSUMS, FRAMINGS, WORDS, FieldText
from ._guess import Chunk, Guess, board_guess, shapes
from ._tuning import COVERED, FEWEST, LEFT_OVER, PAUSE_S, PAUSES_APART, PROOF, PROVEN, SEVERAL, USUAL
from ._word_guess import CELL_WORDS, MOST_AHEAD, Bytes, Likely, block, column, likelihood, shown, words_in

MOST_BYTES = 2**17
"""of the stream that are looked at"""
LEAST_FRAME = 3
LONGEST_HEADER = 8
MOST_TRIED = 24
_PLACES = ("uint16le", "uint16be", "uint8")
_COUNTERS = ("uint32le", "uint32be", "uint16le", "uint16be", "uint8")


def binary_guesses(chunks: Sequence[Chunk]) -> Iterator[Guess]:
    """Guesses for a binary stream, the likeliest first."""
    data = b"".join(chunk.data for chunk in chunks)[:MOST_BYTES]
    clock = _Clock(chunks)
    yield from _sorted(_delimited_guesses(data, clock))
    starts = _burst_starts(chunks, _pauses(chunks)[-1])
    (burst, seen), *_ = Counter(np.diff(starts).tolist()).most_common(1) or [(0, 0)]
    # Of bursts of one length, each is a frame or a packet: what returns after several of them does so by chance.
    even = seen > USUAL * (len(starts) - 1) and seen >= FEWEST
    found: list[Likely] = []
    for length, phase in _folds(data, chunks):
        count = (len(data) - phase) // length
        if count >= SEVERAL and not (even and length > burst and length % burst == 0):
            frames = np.frombuffer(data[phase : phase + count * length], np.uint8).reshape(-1, length)
            yield from _sorted(_rotated_blocks(data, length, phase, chunks))
            found += _framed_guesses(frames, clock.at(phase + length * np.arange(count)))
    yield from _sorted(found)
    yield from _sorted(_raw_guesses(data, chunks, clock))


class _Clock:
    """When the bytes of a stream came."""

    def __init__(self, chunks: Sequence[Chunk]) -> None:
        self._ends = np.cumsum([len(chunk.data) for chunk in chunks])
        self._times_s = np.array([chunk.time_s for chunk in chunks])

    def at(self, places: IntArray) -> FloatArray:
        """Times of the bytes at some places."""
        return self._times_s[np.minimum(np.searchsorted(self._ends, places, side="right"), len(self._times_s) - 1)]


def _sorted(found: Iterable[Likely]) -> Iterator[Guess]:
    """The likeliest guesses first, not too many of them."""
    yield from (guess for _, guess in sorted(found, key=lambda item: -item[0])[:MOST_TRIED])


def _delimited_guesses(data: bytes, clock: _Clock) -> Iterator[Likely]:
    """Guesses for packets between bytes that stand nowhere else."""
    for name, framing in FRAMINGS.items():
        decoded, places, at, stretches = [], [], 0, data.split(bytes([framing.delimiter]))
        for stretch in stretches:
            at += len(stretch) + 1
            try:
                decoded.append(framing.decode(stretch, MOST_BYTES) if stretch else b"")
                places.append(at)
            except ValueError:
                continue
        lengths = Counter(len(one) for one in decoded[1:] if one)
        if not lengths:
            continue
        (length, seen), *_ = lengths.most_common(1)
        between = sum(bool(stretch) for stretch in stretches[1:-1])
        varied = len({len(one) for one in stretches}) > 2  # else a header that looks like a delimiter
        if length < LEAST_FRAME or seen < max(FEWEST, PROVEN * between) or not varied:
            continue
        kept = [(one, place) for one, place in zip(decoded, places, strict=True) if len(one) == length]
        frames = np.array([list(one) for one, _ in kept], dtype=np.uint8)
        times = clock.at(np.array([place for _, place in kept]) - 1)
        yield from _inner_guesses(frames, {"format": "binary", "framing": name}, 0, times)


def _folds(data: bytes, chunks: Sequence[Chunk]) -> Iterator[tuple[int, int]]:
    """Lengths of a frame with the place of the first frame's header: bytes that return after just that length."""
    stream = np.frombuffer(data, np.uint8).astype(np.int64)
    if len(stream) < FEWEST * LEAST_FRAME:
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
        if len(frames) < FEWEST:
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
    often = seen >= FEWEST - 1
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


def _pauses(chunks: Sequence[Chunk]) -> list[float]:
    """Times from which on a gap may be a pause between frames: that of the widest step between short and long gaps, if
    there is one, and the least."""
    gaps = np.diff([chunk.time_s for chunk in chunks])
    sizes = np.sort(gaps[gaps > PAUSE_S / 10])
    ratios = sizes[1:] / sizes[:-1]
    apart = bool(ratios.size) and float(ratios.max()) >= PAUSES_APART
    return [*([max(float(sizes[int(np.argmax(ratios)) + 1]), PAUSE_S)] if apart else []), PAUSE_S]


def _burst_starts(chunks: Sequence[Chunk], pause_s: float | None = None) -> list[int]:
    """Places in the stream behind a pause of so long, or of the likeliest length."""
    gaps = np.diff([chunk.time_s for chunk in chunks])
    ends = np.cumsum([len(chunk.data) for chunk in chunks])[:-1]
    return [int(end) for end in ends[gaps >= (_pauses(chunks)[0] if pause_s is None else pause_s)]]


def _framed_guesses(frames: Bytes, times_s: FloatArray) -> Iterator[Likely]:
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
        for likely, guess in _inner_guesses(body, frame, header, times_s):
            passed = min(_ahead_of_cells(guess), left_over)
            yield likely + 0.1 * (header + trailer) - LEFT_OVER * (left_over - passed), guess


def _rotated_blocks(data: bytes, length: int, phase: int, chunks: Sequence[Chunk]) -> Iterator[Likely]:
    """Guesses for blocks that begin anywhere in the run of constant bytes at a phase, rather behind a pause.

    Constant bytes may be the end of one block, upper bytes of its counter among them, and the head of the next.
    """
    bursts = {start % length for start in _burst_starts(chunks)}
    for begin in range(phase, phase + MOST_AHEAD):
        packets = np.frombuffer(data[begin : begin + (len(data) - begin) // length * length], np.uint8)
        if len(packets) < FEWEST * length:
            return
        packets = packets.reshape(-1, length)
        for likely, guess in _block_guesses(packets):
            fields = guess.tables["frame"]["block"][0]["fields"]
            counts = sum("number uint32" in one for one in fields) + 0.5 * sum("number uint16" in one for one in fields)
            yield likely + counts + (begin % length in bursts), guess
        if not (packets[:, 0] == packets[0, 0]).all():
            return


def _block_guesses(packets: Bytes) -> Iterator[Likely]:
    """Guesses for packets that are blocks of a frame: one of their numbers counts blocks or cells, over and over.

    Ahead of that number stand constant bytes; behind it the cells, then a counter of packets, a checksum and constant
    bytes, as far as there are any. The number may stand behind the cells.
    """
    constant = (packets == packets[0]).all(axis=0)
    tail = int(np.argmin(constant[::-1])) if not constant.all() else 0
    length = packets.shape[1]
    for at, name in product(range(min(MOST_AHEAD, length - 1)), _PLACES):
        if not constant[:at].all():
            break
        if at + WORDS[name].size_of(1) >= length:
            continue
        cycle = _cycle(column(packets, at, name))
        if cycle is None:
            continue
        blocks, first, step = cycle
        head = [f"const {shown(bytes(packets[0, :at]))}"] if at else []
        begin = at + WORDS[name].size_of(1)
        for behind, end, proof in _block_ends(packets, begin, tail):
            for word in CELL_WORDS:
                cells = WORDS[word].count_in(end - begin)
                if end <= begin or not cells or step not in (1, cells) or (WORDS[word].packed and cells % 2):
                    continue
                place = f"index {name} {first}" if step == 1 else f"start {name}"
                if first > (step == 1):  # places are counted from 0, blocks from 0 or 1
                    continue
                fields = [*head, place, f"cells {word} {cells}", *behind]
                whole = len(packets) // blocks * blocks
                grid = block(packets[:whole], begin, end, word).reshape(-1, blocks * cells)
                is_row = step == 1 and cells > 1
                sides = [(blocks, cells)] if is_row else shapes(blocks * cells)
                if len(grid) < FEWEST or not sides:
                    continue
                frame: dict[str, Any] = {"format": "binary", "block": [{"fields": fields, "repeat": blocks}]}
                guess = board_guess(sides[0][0], sides[0][1], frame, grid, known_shape=is_row, word=word)
                guess.remarks["frame.block"] = "? length and order of the words of cells, by how evenly they change"
                yield likelihood(grid, word) + proof, guess


def _block_ends(packets: Bytes, begin: int, tail: int) -> Iterator[tuple[list[str], int, float]]:
    """Fields that may stand behind the cells, where the cells end then, and how likely that is."""
    length = packets.shape[1]
    for constant in dict.fromkeys((tail, 0)):
        ended = length - constant
        last = [f"const {shown(bytes(packets[0, ended:]))}"] if constant else []
        for name, kind in sorted(CHECKSUMS.items(), key=lambda item: -item[1].size):
            rows = [bytes(row[:ended]) for row in packets[:: max(len(packets) // 16, 1)]]
            starts = range(0, begin + 1) if kind.size > 1 else (0, *range(1, begin + 1))
            if ended - kind.size > begin and any(
                all(kind.of(row[start : -kind.size]) == row[-kind.size :] for row in rows) for start in starts
            ):
                yield [name, *last], ended - kind.size, PROOF if kind.size > 1 else PROOF / 2
                break
        # Zeros behind a counter are its upper bytes, which have not counted yet.
        zeros = int(np.argmax(packets[0, ended:] != 0)) if packets[0, ended:].any() else constant
        for end, word in product(range(ended + min(zeros, 3), ended - 1, -1), _COUNTERS):
            size = WORDS[word].size_of(1)
            if end - size > begin and (np.diff(column(packets, end - size, word)) == 1).mean() > USUAL:
                yield (
                    [f"number {word}", *([f"const {shown(bytes(packets[0, end:]))}"] if end < length else [])],
                    end - size,
                    1.0,
                )
                break
        yield last, ended, 0.0


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


def _ahead_of_cells(guess: Guess) -> int:
    """Bytes between header and cells."""
    frame = guess.tables["frame"]
    if "block" not in frame:
        return int(frame.get("before", 0))
    fields = [FieldText.parse(text) for text in frame["block"][0]["fields"]]
    return sum(one.size for one in takewhile(lambda one: one.kind != "cells", fields) if one.kind != "const")


def _inner_guesses(frames: Bytes, frame: dict[str, Any], header: int, times_s: FloatArray) -> Iterator[Likely]:
    """Guesses for frames without their trailer: the checksum, then the words."""
    for keys, size in _checksums(frames, header):
        kept = frames[:, header : frames.shape[1] - size]
        for likely, guess in words_in(kept, frame | keys, times_s, keys.get("before")):
            yield likely + (PROOF if size > 1 else PROOF / 2 if size else 0.0), guess


def _checksums(frames: Bytes, header: int) -> Iterator[tuple[dict[str, Any], int]]:
    """Checksums that all frames have right, the longest first, with their size; then none."""
    rows = [bytes(row) for row in frames[:: max(len(frames) // 8, 1)]]
    if len(set(rows)) >= FEWEST:
        for name, kind in sorted(CHECKSUMS.items(), key=lambda item: -item[1].size):
            ways: list[tuple[int, dict[str, Any]]] = [(header, {"checksum_of": "body"}), (0, {"checksum_of": "frame"})]
            if kind.size > 1:  # a checksum of one byte may be right by chance where so many places are tried
                ways += [(header + ahead, {"before": ahead}) for ahead in range(1, MOST_AHEAD + 1)]
            for start, keys in ways:
                if all(kind.of(row[start : -kind.size]) == row[-kind.size :] for row in rows):
                    yield {"checksum": name} | keys, kind.size
                    break
    yield {}, 0


def _raw_guesses(data: bytes, chunks: Sequence[Chunk], clock: _Clock) -> Iterator[Likely]:
    """Guesses for frames without a header, between pauses."""
    for pause_s in _pauses(chunks):
        starts = _burst_starts(chunks, pause_s)
        lengths = Counter(np.diff(starts).tolist())
        if not lengths:
            continue
        (length, seen), *_ = lengths.most_common(1)
        if length < LEAST_FRAME or seen < 0.5 * (len(starts) - 1):
            continue
        places = [at for at, after in pairwise(starts) if after - at == length and after <= len(data)]
        if len(places) < FEWEST:
            continue
        frames = np.array([list(data[at : at + length]) for at in places], dtype=np.uint8)
        for likely, guess in words_in(frames, {"format": "binary"}, clock.at(np.array(places)), None):
            guess.remarks["frame.format"] = "? nothing but the pauses between them shows where frames begin"
            yield likely, guess
