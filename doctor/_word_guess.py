"""Guesses for stretches of bytes: which kind of words the cells are, and what stands ahead of them.

Wrong lengths or orders of words make the noise of a low byte a change of a high one; right ones change least from frame
to frame and from cell to cell. Ahead of the cells stand constant bytes, numbers that count frames, and times.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import FloatArray
from ..wire import WORDS
from ._guess import Guess, board_guess, shapes
from ._tuning import BINS, CLOCKS_DIFFER, EVEN_STEPS, HALF, HALVES_ALIKE, SEVERAL, USUAL

MOST_AHEAD = 12
"""bytes between header and words, at most"""
MOST_BEHIND = 4
CELL_WORDS = (
    *("uint8", "uint16le", "uint16be", "int16le", "int16be", "uint32le", "uint32be", "float32le", "float32be"),
    *("uint12le", "uint12be"),
)
_NUMBER_WORDS = ("uint32le", "uint32be", "uint16le", "uint16be", "uint8")
_TIME_WORDS = _NUMBER_WORDS[:4]
_UNITS = (("time_us", 1e-6), ("time_ms", 1e-3))
Bytes = NDArray[np.uint8]
Likely = tuple[float, Guess]
"""how likely a guess is, and the guess"""


def column(packets: Bytes, at: int, name: str) -> FloatArray:
    """A number of each packet."""
    return block(packets, at, at + WORDS[name].size_of(1), name).ravel()


def block(packets: Bytes, begin: int, end: int, name: str) -> FloatArray:
    """(packets, numbers) in a stretch of each packet."""
    word, part = WORDS[name], np.ascontiguousarray(packets[:, begin:end])
    with np.errstate(invalid="ignore"):  # bytes that are no floats
        if not word.packed:
            return part.view(word.dtype).astype(np.float64)
        return word.decode(np.pad(part, ((0, 0), (0, -part.shape[1] % 3))).ravel(), 2 * part.size).reshape(
            len(part), -1
        )[:, : word.count_in(part.shape[1])]


def counter(packets: Bytes, at: int, times_s: FloatArray) -> list[str]:
    """Fields that count from packet to packet, beginning at a place: ``number WORD``, ``time_ms WORD`` ..."""
    found = []
    for name in _NUMBER_WORDS:
        size = WORDS[name].size_of(1)
        if at + size > packets.shape[1] or len(packets) <= SEVERAL:
            continue
        values, wrap = column(packets, at, name), 2.0 ** (8 * size)
        steps = np.mod(np.diff(values), wrap)
        if (steps == 1).mean() > USUAL:
            found.append(f"number {name}")
        elif name in _TIME_WORDS and times_s[-1] > times_s[0]:
            even = np.abs(steps - np.median(steps)) <= EVEN_STEPS * np.median(steps)
            rate = steps.sum() / float(times_s[-1] - times_s[0])
            units = [unit for unit, unit_s in _UNITS if abs(rate * unit_s - 1.0) < CLOCKS_DIFFER]
            wider = any(one.startswith("time") for one in found)  # a time of fewer bytes would wrap from frame to frame
            found += [f"{unit} {name}" for unit in units if not wider and (steps > 0).all() and even.mean() > USUAL]
    return found


def heads(packets: Bytes, times_s: FloatArray) -> dict[int, list[str]]:
    """Bytes that may stand ahead of the cells -> the fields that they are, of those that count or are constant."""
    constant = (packets == packets[0]).mean(axis=0) > USUAL
    reached: dict[int, list[str]] = {0: []}
    for at in range(min(MOST_AHEAD, packets.shape[1] - 1)):
        if at not in reached:
            continue
        before = reached[at]
        for text in counter(packets, at, times_s):
            kind, name = text.split()
            if not any(one.startswith(kind[:4]) for one in before):
                reached.setdefault(at + WORDS[name].size_of(1), [*before, text])
        if constant[at]:
            reached.setdefault(at + 1, [*before, "skip 1"])
    return reached


def words_in(
    body: Bytes, frame: dict[str, Any], times_s: FloatArray | None = None, ahead: int | None = 0
) -> Iterator[Likely]:
    """Guesses for bytes with cells among them.

    Args:
        body: (frames, bytes).
        frame: keys of ``[frame]`` that are known.
        times_s: of the frames; None: nothing stands ahead or behind.
        ahead: bytes ahead of the cells; None: not known.

    """
    known = {0: []} if times_s is None else heads(body, times_s)
    counting = max((end for end, fields in known.items() if any(one[:4] != "skip" for one in fields)), default=0)
    counting = next((end for end in sorted(known) if _counters(known[end]) == _counters(known[counting])), 0)
    places = range(MOST_AHEAD + 1) if ahead is None else [ahead]
    for before, name in product(places, CELL_WORDS):
        word = WORDS[name]
        for after in range(MOST_BEHIND + 1 if times_s is not None else 1):
            size = body.shape[1] - before - after
            cells = word.count_in(size) if size > 0 else None
            sides = shapes(cells) if cells else []
            if cells is None or cells < 2 or not sides:
                continue
            numbers = block(body, before, before + size, name)
            free = max(end for end in known if end <= before)
            likely = likelihood(numbers, name) - 0.35 * (before - free + 1.5 * after) - 0.05 * before
            likely -= 3.0 * (before < counting)
            likely += 1.0 if sides[0][0] == sides[0][1] else 0.3 if sides[0][1] <= 2 * sides[0][0] else 0.0
            likely -= 0.8 * (cells % 2 and before + after > 0)
            keys = {"word": name} | ({"before": before} if before else {}) | ({"after": after} if after else {})
            guess = board_guess(*sides[0], frame | keys, numbers, known_shape=False)
            guess.remarks["frame.word"] = "? length and order of the words, by how evenly the numbers change"
            if before:
                guess.remarks["frame.before"] = "bytes ahead of the cells that are not read"
            fields = known[free] + ["skip 1"] * (before - free)
            yield likely, _with_fields(guess, fields, cells) if _counters(fields) else guess


def _counters(fields: list[str]) -> list[str]:
    return [one.split()[0] for one in fields if not one.startswith("skip")]


def _with_fields(guess: Guess, ahead: list[str], cells: int) -> Guess:
    """A guess with all that its frames carry as fields of a block."""
    frame = dict(guess.tables["frame"])
    fields = [f"const {shown(bytes(frame['header']))}"] if frame.get("header") else []
    for one in ahead:
        if one == "skip 1" and fields and fields[-1].startswith("skip"):
            fields[-1] = f"skip {int(fields[-1].split()[1]) + 1}"
        else:
            fields.append(one)
    fields.append(f"cells {frame['word']} {cells}")
    fields += [f"skip {frame['after']}"] if frame.get("after") else []
    fields += [frame["checksum"]] if frame.get("checksum") else []
    fields += [f"const {shown(bytes(frame['trailer']))}"] if frame.get("trailer") else []
    kept = {key: frame[key] for key in ("format", "framing", "range") if key in frame}
    remarks = {key: text for key, text in guess.remarks.items() if key not in ("frame.before", "frame.word")}
    remarks["frame.block"] = "? length and order of the words of cells, by how evenly they change"
    return Guess(guess.tables | {"frame": kept | {"block": [{"fields": fields}]}}, remarks)


def shown(data: bytes) -> str:
    """Bytes as a field ``const`` has them."""
    return " ".join(f"0x{byte:02X}" for byte in data)


def likelihood(numbers: FloatArray, name: str) -> float:
    """How much (frames, numbers) look like readings of cells: small steps from frame to frame, and few odd values."""
    known = np.isfinite(numbers)
    if name.startswith("float"):
        with np.errstate(over="ignore", invalid="ignore"):
            size = np.abs(numbers)
            plain = ~known | (size == 0) | ((size > 1e-6) & (size < 1e7))
        if plain.mean() < 0.99 or known.mean() < 0.5:
            return -10.0
    filled = np.where(known, numbers, 0.0)
    # Of each cell: another number among the cells, such as a time, has a range of its own.
    span = float(np.ptp(filled, axis=0).mean())
    if span == 0.0 or not np.diff(filled, axis=0).any():  # nothing changes, and so nothing tells words apart
        return -1.0 - 0.1 * WORDS[name].size_of(1)
    steps = np.abs(np.diff(filled, axis=0)).mean() / span
    across = np.abs(np.diff(filled, axis=1)).mean() / span if filled.shape[1] > 1 else steps
    # Every other number constant beside its neighbours: the high half of a longer word.
    halves = sorted(float(filled[:, side::2].std()) for side in (0, 1)) if filled.shape[1] > 1 else [1.0, 1.0]
    likely = -2.5 * (halves[0] < HALF * halves[1])
    likely += -2.0 * float(np.log10(max(steps, 1e-4))) - 1.0 * float(np.log10(max(across, 1e-4)))
    likely -= 3.0 * _halves_alike(filled, name)
    if name.startswith("uint"):
        signed = np.where(filled < 2.0 ** (WORDS[name].bits - 1), filled, filled - 2.0 ** WORDS[name].bits)
        likely -= 4.0 * (float(np.ptp(signed)) < 0.5 * float(np.ptp(filled)))
    if name.startswith("float"):
        likely += 2.0
    elif name.startswith("int"):
        likely -= 1.0 if float(filled.min()) >= 0 else 0.2
    return likely


def _halves_alike(numbers: FloatArray, name: str) -> bool:
    """Whether the halves of the words are no halves: they have one distribution, as cells have, or one is constant."""
    bits = 4 * WORDS[name].size_of(1)
    if WORDS[name].packed:  # the first and the last of three bytes
        even, odd = numbers[:, ::2], numbers[:, 1::2]
        low, high = np.mod(even, 256.0), np.floor(odd / 16.0)
        if name.endswith("be"):
            low, high = np.floor(even / 16.0), np.mod(odd, 256.0)
    elif name.startswith("float") or bits < 8:
        return False
    else:
        high, low = np.divmod(np.mod(numbers, 2.0 ** (2 * bits)), 2.0**bits)
        if any(half.min() == half.max() and half.max() not in (0.0, 2.0**bits - 1.0) for half in (high, low)):
            return True
    most = max(float(low.max()), float(high.max())) + 1.0
    one, other = (np.histogram(half, BINS, (0.0, most))[0] / half.size for half in (low, high))
    return bool(np.abs(one - other).sum() < HALVES_ALIKE * (1.0 + np.sqrt(2.0 * BINS / low.size)))
