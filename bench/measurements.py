"""The tables of ``ohmskin bench`` that measure one thing at some sizes: the head of each, and its rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from . import _driver, _emulator, _estimators, _fingers, _freshness, _taps, _worst_frames

Table = tuple[str, Iterable[Any]]
"""head, and rows as dataclasses, which come as they are measured"""


def of_estimators() -> Sequence[Table]:
    """The pressure estimators, on a material of their own."""
    return [("", _estimators.estimators())]


def of_emulator(sizes: Iterable[int]) -> Sequence[Table]:
    """The virtual board."""
    return [(_emulator.HEAD, _emulator.emulator(sizes))]


def of_contacts(sizes: Iterable[int]) -> Sequence[Table]:
    """Short taps found, fingers followed, false contacts."""
    sizes = list(sizes)
    return [(_taps.HEAD, _taps.taps_and_faults(sizes)), (_fingers.HEAD, _fingers.fingers(sizes))]


def of_driver(sizes: Iterable[int]) -> Sequence[Table]:
    """The live path: boards, sudden events, estimators, and a whole skin."""
    sizes = list(sizes)
    return [
        (_driver.head(), _driver.driver(sizes)),
        (_worst_frames.HEAD, _worst_frames.worst_frames(sizes)),
        ("the same by estimator", _driver.live_estimators(sizes)),
        (_freshness.HEAD, _freshness.freshness(sizes)),
    ]
