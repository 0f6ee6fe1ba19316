"""Guesses for JSON documents in lines: the key of the cells, and those of time, number and row."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..common.arrays import FloatArray
from ._guess import Guess, board_guess, counting_role, shapes
from ._tuning import FEWEST

MOST_LEVELS = 6
MOST_LEAVES = 4096
_LIST = re.compile(r"(?<=[\[,:\s])[+-]?(nan|inf|ovf)(?=[\],\s}])", re.I)
_DIGITS = re.compile(r"\d+")
_TIMES = ("time_s", "time_ms", "time_us")


def json_guesses(lines: Sequence[tuple[str, float]]) -> Iterator[Guess]:
    """Guesses for a document in each line; the lines have times of arrival."""
    arrays: dict[tuple[str, tuple[int, ...]], list[FloatArray]] = {}
    scalars: dict[str, list[tuple[float, float]]] = {}
    documents = 0
    for text, time_s in lines:
        if text[:1] not in ("{", "["):
            continue
        try:
            leaves = list(_leaves(json.loads(_LIST.sub("NaN", text)), "", MOST_LEVELS))
        except (ValueError, RecursionError):
            continue
        documents += 1
        for key, array in _arrays(leaves):
            arrays.setdefault((key, array.shape), []).append(array)
        for key, leaf in leaves:
            if leaf.ndim == 0:
                scalars.setdefault(key, []).append((time_s, float(leaf)))
    named = _named(scalars, documents)

    def worth(item: tuple[tuple[str, tuple[int, ...]], list[FloatArray]]) -> tuple[float, bool]:
        (_, shape), seen = item
        return -len(seen) * float(np.prod(shape)), bool(np.ptp(np.array(seen), axis=0).max() == 0)

    for (key, shape), seen in sorted(arrays.items(), key=worth):
        if len(seen) < FEWEST:
            continue
        frame: dict[str, Any] = {"format": "json"} | ({"key": key} if key else {})
        numbers = np.concatenate([array.ravel() for array in seen])
        frame |= {name: other for name, other in named.items() if name != "row_number"}
        if "row_number" in named and len(shape) == 1:
            rows = {value for _, value in scalars[named["row_number"]]}
            keys = {"row_number": named["row_number"], "layout": "row-per-line"}
            yield board_guess(len(rows), shape[0], frame | keys, numbers, known_shape=True)
        guessed = [shape] if len(shape) == 2 else shapes(shape[0])[:1] or [(1, shape[0])]
        keys = {"layout": "frame-per-line"}
        yield board_guess(guessed[0][0], guessed[0][1], frame | keys, numbers, known_shape=len(shape) == 2)


def _named(scalars: dict[str, list[tuple[float, float]]], documents: int) -> dict[str, str]:
    """Keys of the frame's number, time and row."""
    named: dict[str, str] = {}
    for key, seen in scalars.items():
        if len(seen) < max(documents - 1, FEWEST):
            continue
        times, values = np.array(seen).T
        steps, rows = np.diff(values), np.unique(values)
        if len(rows) > 1 and rows[0] in (0, 1) and (np.diff(rows) == 1).all() and ((steps == 1) | (steps < 0)).all():
            wraps = set(steps[steps < 0].tolist())
            if wraps == {-float(len(rows) - 1)}:
                named.setdefault("row_number", key)
                continue
        role = counting_role(values, times)
        if role == "number" or (role in _TIMES and not set(_TIMES) & set(named)):
            named.setdefault(role, key)
    return named


def _leaves(document: Any, key: str, levels: int) -> Iterator[tuple[str, FloatArray]]:
    """Numbers, and lists and grids of numbers, in a document with their dotted keys."""
    if isinstance(document, dict):
        for name, value in document.items():
            if "." not in name and levels:
                yield from _leaves(value, f"{key}.{name}" if key else name, levels - 1)
    elif isinstance(document, list):
        try:
            grid = np.array(document, dtype=np.float64)  # null is NaN
        except (ValueError, TypeError):
            for k, value in enumerate(document[:MOST_LEAVES] if levels else []):
                yield from _leaves(value, f"{key}.{k}" if key else str(k), levels - 1)
            return
        if grid.ndim in (1, 2) and grid.size > 1:
            yield key, grid
    elif isinstance(document, int | float) and not isinstance(document, bool) and abs(document) < 2.0**62:
        yield key, np.array(float(document))


def _arrays(leaves: Sequence[tuple[str, FloatArray]]) -> Iterator[tuple[str, FloatArray]]:
    """Leaves that are arrays, and leaves whose keys differ by a number only, taken together."""
    alike: dict[str, list[FloatArray]] = {}
    for key, leaf in leaves:
        if leaf.ndim:
            yield key, leaf
        if _DIGITS.search(key) and leaf.ndim < 2:
            alike.setdefault(".".join(_DIGITS.sub("*", part) for part in key.split(".")), []).append(leaf)
    for pattern, found in alike.items():
        if len(found) > 1 and len({one.shape for one in found}) == 1:
            yield pattern, np.array(found)
