"""What the two kinds of guesses about a format share: the bytes with their times, and the numbers in them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..common.arrays import FloatArray
from ..wire import WORDS
from ._tuning import CLOCKS_DIFFER, SEVERAL, USUAL, USUAL_BITS

SIDES = "? bytes do not tell from which corner cells are counted: press one; flip_rows, flip_columns, order"
MOST_APART = 4.0
"""ratio of the sides of an array that is guessed from its number of cells"""


@dataclass(frozen=True)
class Chunk:
    """Bytes that arrived together."""

    time_s: float
    data: bytes


@dataclass(frozen=True)
class Guess:
    """Tables of a BOARD.toml, and remarks for its comments; a remark that begins with ``?`` is a question."""

    tables: dict[str, dict[str, Any]]
    remarks: dict[str, str] = field(default_factory=dict)
    """by dotted key"""


def board_guess(
    rows: int, columns: int, frame: dict[str, Any], numbers: FloatArray, *, known_shape: bool, word: str | None = None
) -> Guess:
    """A guess for an array whose frames have ``numbers``; ``frame`` is the table ``[frame]`` without the range.

    Args:
        rows: of the array.
        columns: of the array.
        frame: keys of ``[frame]``.
        numbers: of all frames, NaN where one is missing.
        known_shape: whether the stream shows the sides of the array.
        word: of the cells, where ``frame`` has blocks.

    """
    bits, span, remark = _range(numbers, word or frame.get("word"))
    board = {"name": "board", "rows": rows, "columns": columns, "bits": bits}
    remarks = {"board.name": "any name", "board.bits": remark, "board.columns": SIDES}
    if not known_shape:
        others = ", ".join(f"{a} x {b}" for a, b in shapes(rows * columns) if (a, b) != (rows, columns))
        remarks["board.rows"] = f"? rows and columns of {rows * columns} cells" + (f": or {others}" if others else "")
    if span is not None:
        frame = frame | {"range": list(span)}
        remarks["frame.range"] = "? the smallest and the largest number that the board can send"
    return Guess({"board": board, "frame": frame}, remarks)


def counting_role(values: FloatArray, times_s: FloatArray) -> str | None:
    """What a number is that only rises: the board's time in some unit, the number of the frame, or not known; None: it
    does not rise.

    Args:
        values: one after the other.
        times_s: when they came.

    """
    steps = np.diff(values)
    risen = steps[steps != 0]
    if len(risen) < SEVERAL or not (risen > 0).all() or len(risen) < 0.1 * len(steps):
        return None
    elapsed_s = float(times_s[-1] - times_s[0])
    whole = bool((values == np.rint(values)).all())
    if whole and (risen == 1).mean() > USUAL:
        return "number"
    for name, unit_s in (("time_us", 1e-6), ("time_ms", 1e-3), ("time_s", 1.0)):
        if elapsed_s > 0 and abs((values[-1] - values[0]) * unit_s / elapsed_s - 1.0) < CLOCKS_DIFFER:
            return name
    return "skip" if len(risen) > USUAL * len(steps) else None


def shapes(cells: int) -> list[tuple[int, int]]:
    """Sides of arrays of so many cells, the most nearly square first."""
    pairs = [(a, cells // a) for a in range(1, math.isqrt(cells) + 1) if cells % a == 0]
    near = [pair for pair in reversed(pairs) if pair[1] <= MOST_APART * pair[0]]
    return [shape for a, b in near for shape in ({(a, b): None, (b, a): None})]


def _range(numbers: FloatArray, word: str | None) -> tuple[int, tuple[float, float] | None, str]:
    """Bits of the counts, range of the numbers if they are not counts, and a remark on the bits."""
    known = numbers[np.isfinite(numbers)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    whole = bool((known == np.rint(known)).all())
    if whole and low >= 0 and high < 2**16:
        if word in ("uint8", "uint12le", "uint12be"):
            return WORDS[word].bits, None, ""
        least = max(math.ceil(math.log2(high + 1)), 1) if high > 0 else 1
        bits = USUAL_BITS if least <= USUAL_BITS else 16
        return bits, None, f"? of the converter; the largest number so far is {high:g}"
    if whole and -(2.0**15) <= low < 0 and high < 2**15:
        bits = math.ceil(math.log2(1.5 * max(-low, high + 1)))
        return min(bits + 1, 16), (-(2.0 ** min(bits, 15)), 2.0 ** min(bits, 15) - 1), "one more than for the sign"
    seen = f"the range is divided into 2^16 counts; numbers so far are {low:.4g} to {high:.4g}"
    for top in (1.0, 3.3, 5.0):
        if low >= 0 and high <= 1.001 * top and not whole:
            return 16, (0.0, top), seen
    top = 2.0 ** math.ceil(math.log2(max(abs(low), abs(high), 1.0) * 1.5))
    if word is not None and "int32" in word:
        top = min(top, 2.0**32 - 1 if word.startswith("u") else 2.0**31 - 1)
    return 16, (0.0 if low >= 0 else -top, top), seen
