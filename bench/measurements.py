"""The tables of ``ohmskin bench`` that measure one thing at some sizes: the head of each, and its rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from . import _driver, _emulator, _worst_frames, contacts, scenarios

Table = tuple[str, Iterable[Any]]
"""head, and rows as dataclasses, which come as they are measured"""

TABLES: Mapping[str, Callable[[Sequence[int]], Sequence[Table]]] = {
    "estimators": lambda _: [("", scenarios.by_estimator())],
    "emulator": lambda sizes: [(_emulator.HEAD, _emulator.emulator(sizes))],
    "driver": lambda sizes: [
        (_driver.HEAD, _driver.driver(sizes)),
        (_worst_frames.HEAD, _worst_frames.worst_frames(sizes)),
        ("the same by estimator", _driver.live_estimators(sizes)),
        (_driver.AGES, _driver.freshness(sizes)),
    ],
    "contacts": lambda sizes: [(contacts.HEAD, contacts.fingers(sizes))],
}
"""option of the command -> tables for arrays of some sizes"""
