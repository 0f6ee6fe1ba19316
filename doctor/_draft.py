"""Format identification: a BOARD.toml drafted from the bytes that an unknown board sends.

Several descriptions are guessed from the stream: separators, numbers in a line and lines in a frame of text; header,
length, words and checksum of binary frames. Each guess is tried with the host protocol that it describes, and the first
is taken that accounts for the bytes. What the bytes do not tell is left as a question in a comment of the file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from ..common.config import toml_value
from ..errors import InputError
from ..wire import BoardFile, Corrupt, Family, FramePacket
from ._binary_guess import binary_guesses
from ._guess import Chunk, Guess
from ._text_guess import is_text, text_guesses
from ._tuning import (
    AS_GOOD,
    DOUBTFUL,
    FEWEST_FRAMES,
    GOOD_ACCOUNTED,
    LEAST_ACCOUNTED,
    MANY_FRAMES,
    MOST_OTHERS,
    OTHERS_TRIED,
    SEVERAL,
    SURE,
)

MOST_COPIES = 16
MOST_GUESSES = 200


@dataclass(frozen=True)
class Draft:
    """A description that accounts for the bytes of a board."""

    guess: Guess
    frames: int
    accounted: float
    """share of the bytes after the first frame that belong to frames"""
    rate_hz: float
    """frames in a second; NaN: not known"""
    others: tuple[tuple[str, float], ...] = ()
    """other layouts, and the share of the bytes that each accounts for"""

    def toml(self, head: Sequence[str]) -> str:
        """The text of a BOARD.toml, with ``head`` as comments at its top."""
        lines = [f"# {line}".rstrip() for line in head]
        lines += [f"# Other layouts: {text} explain {100 * share:.0f} % of the bytes." for text, share in self.others]
        for table, values in self.guess.tables.items():
            lines += ["", f"[{table}]"]
            for key, value in values.items():
                remark = self.guess.remarks.get(f"{table}.{key}", "")
                lines.append(f"{key} = {_toml(key, value)}" + (f"  # {remark}" if remark else ""))
        return "\n".join(lines) + "\n"

    @property
    def is_clear(self) -> bool:
        """Whether more bytes could hardly change the draft: they are all in frames, and many."""
        return self.frames >= MANY_FRAMES and self.accounted >= SURE

    @property
    def summary(self) -> str:
        """The format in one line."""
        board, frame = self.guess.tables["board"], self.guess.tables["frame"]
        kind = {"text": "lines of text", "json": "JSON documents"}.get(frame["format"], "")
        if frame["format"] == "binary":
            words = [word for block in frame.get("block", []) for word in _words_of(block["fields"])]
            kind = f"words {frame.get('word') or ' '.join(dict.fromkeys(words))}"
        kind += f", {frame['layout']}" if "layout" in frame else " in blocks of fields" if "block" in frame else ""
        rate = f", {self.rate_hz:.3g} frames/s" if math.isfinite(self.rate_hz) else ""
        return f"{board['rows']} x {board['columns']} cells in {kind}{rate}"

    @property
    def questions(self) -> list[str]:
        """What the bytes do not tell."""
        tables, remarks = self.guess.tables, self.guess.remarks
        keys = [f"{table}.{key}" for table, values in tables.items() for key in values]
        return [f"{key}: {remarks[key].removeprefix('? ')}" for key in keys if remarks.get(key, "").startswith("?")]


def draft(
    chunks: Sequence[Chunk], *, baudrate: int, send: bytes = b"", poll: bytes = b"", every_s: float = 0.0
) -> Draft | None:
    """The description that accounts best for what a board has sent; None where none does.

    Args:
        chunks: what came, with the times.
        baudrate: at which it came.
        send: bytes after which it came.
        poll: bytes that asked for each frame.
        every_s: time after which ``send`` is sent again; 0: once is enough.

    """
    if not any(chunk.data for chunk in chunks):
        return None
    guesses = text_guesses(chunks) if is_text(chunks) else binary_guesses(chunks)
    tried: list[Draft] = []
    best: Draft | None = None
    enough = MOST_GUESSES
    for number, guess in enumerate(guesses):
        found = _tried(_with_port(guess, baudrate, send, poll, every_s), chunks)
        if found is not None:
            tried.append(found)
            if best is None or found.accounted > best.accounted + AS_GOOD:
                best = found
        if best is not None and best.accounted >= GOOD_ACCOUNTED:
            enough = min(enough, number + OTHERS_TRIED)
        if number >= enough:
            break
    return None if best is None else _with_doubts(best, tried)


def _with_doubts(best: Draft, tried: Sequence[Draft]) -> Draft:
    """A draft with the other layouts that were tried, and a question where it leaves bytes unexplained."""
    shown: dict[str, float] = {}
    for one in sorted(tried, key=lambda other: -other.accounted):
        if one.summary != best.summary:
            shown.setdefault(one.summary, one.accounted)
    others = tuple(shown.items())[:MOST_OTHERS]
    guess = best.guess
    if best.accounted < DOUBTFUL:
        left = f"{100 * (1 - best.accounted):.0f} % of the bytes are in no frame"
        share = f"? {left}: other lines or packets, or another format"
        guess = Guess(guess.tables, {"frame.format": share} | guess.remarks)
    return replace(best, guess=guess, others=others)


def _with_port(guess: Guess, baudrate: int, send: bytes, poll: bytes, every_s: float) -> Guess:
    tables = {name: dict(values) for name, values in guess.tables.items()}
    tables["board"]["baudrate"] = baudrate
    remarks = dict(guess.remarks)
    asked = {"send": send, "poll": poll}
    start: dict[str, Any] = {
        key: data.decode() if data.isalnum() else list(data) for key, data in asked.items() if data
    }
    if every_s:
        start["every"] = every_s
        remarks["start.every"] = "? s; the board stopped when it heard nothing"
    if start:
        tables["start"] = start
        remarks["start.send"] = "? the board was silent, and sent frames after this; it may have begun by itself"
    return Guess(tables, remarks)


def _tried(guess: Guess, chunks: Sequence[Chunk]) -> Draft | None:
    """What the described protocol makes of the bytes; None if they are hardly frames."""
    try:
        family = BoardFile.parse(guess.tables, "draft").family()
    except InputError:
        return None
    frames, accounted = decoded(family, chunks)
    copies = _copies([frame.payload for _, frame in frames])
    if copies > 1 and "copies" not in guess.tables["frame"]:
        tables = guess.tables | {"frame": guess.tables["frame"] | {"copies": copies}}
        remark = {"frame.copies": "? frames come so many times, one like the other"}
        return _tried(Guess(tables, guess.remarks | remark), chunks)
    if len(frames) < FEWEST_FRAMES or accounted < LEAST_ACCOUNTED:
        return None
    elapsed_s = frames[-1][0] - frames[0][0]
    return Draft(guess, len(frames), accounted, (len(frames) - 1) / elapsed_s if elapsed_s > 0 else math.nan)


def _copies(frames: Sequence[bytes]) -> int:
    """How many times each frame comes: the length of all runs of equal ones but the first and the last."""
    runs = [len(list(run)) for _, run in groupby(frames)][1:-1]
    return runs[0] if len(runs) >= SEVERAL and len(set(runs)) == 1 and runs[0] <= MOST_COPIES else 1


def decoded(family: Family, chunks: Sequence[Chunk]) -> tuple[list[tuple[float, FramePacket]], float]:
    """Frames of a family with their times, and the share of the bytes after the first one that they make up."""
    received = sum(len(chunk.data) for chunk in chunks)
    host = family.host(family, family.layout)
    times: list[tuple[float, FramePacket]] = []
    before = corrupt = passed = 0
    for chunk in chunks:
        passed += len(chunk.data)
        for event in host.feed(chunk.data, chunk.time_s):
            if isinstance(event, FramePacket):
                times.append((chunk.time_s, event))
                # What comes ahead of the first frame is the rest of another one, or a boot message.
                before = before if len(times) > 1 else passed
            elif isinstance(event, Corrupt) and times:
                corrupt += event.size
    left = received - before
    return times, 1.0 - min(corrupt / left, 1.0) if left else 0.0


def _words_of(fields: Sequence[str]) -> list[str]:
    """Kinds of the cells among the fields of a block."""
    return [text.split()[1] for text in fields if text.startswith("cells")]


def _toml(key: str, value: Any) -> str:
    """A value as TOML, bytes in hexadecimal."""
    if key in ("header", "trailer", "poll", "send") and not isinstance(value, str):
        return f"[{', '.join(f'0x{byte:02X}' for byte in value)}]"
    return toml_value(value)
