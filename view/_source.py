"""What a page shows: a source of frames, with what is known of the skin and its link."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Any, Self

import numpy as np

from ..circuits import Reason
from ..common.geometry import Geometry
from ..common.text import printable
from ..driver import Frame, Skin
from ..errors import InputError
from ._orders import FrameOrder, TraceCells

Report = dict[str, Any]
"""an object for JSON, without NumPy; NaN becomes null"""


class Source(ABC):
    """Frames for any number of browsers. Methods are called in the thread of the event loop.

    The skin belongs to the source, which closes it.
    """

    def __init__(self, skin: Skin, *, name: str = "") -> None:
        """``name``: for the page's head; empty: the name of the skin's port."""
        self.skin = skin
        self.name = name or skin.port_name
        self._thread = threading.Thread(target=self._take_frames, name=f"ohmskin view {skin.port_name}", daemon=True)

    def __enter__(self) -> Self:
        self.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(self) -> None:
        """Start to take frames, in a thread."""
        self._thread.start()

    def close(self) -> None:
        """Give back the port or the file. Those who wait for a frame get a LinkEnded."""
        self.skin.close()
        self._thread.join()

    @abstractmethod
    def _take_frames(self) -> None:
        """Take frames of the skin until it ends or is closed; runs in the thread."""

    def handshake(self) -> Report:
        """What stays as it is: array, board, cell, scales."""
        skin, identity, geometry = self.skin, self.skin.identity, self.skin.geometry
        rows, columns = skin.shape
        return {
            "kind": "handshake",
            "source": printable(self.name),
            "rows": rows,
            "columns": columns,
            "pitch_mm": None if geometry.pitch_m is None else [1e3 * pitch_m for pitch_m in geometry.pitch_m],
            "cells": _cells(geometry),
            "full_scale_kpa": skin.full_scale_kpa,
            "full_scale_counts": 2**skin.count_bits - 1,
            "board": skin.family.name,
            "serial_number": skin.serial_number,
            "firmware": "" if identity is None else identity.firmware,
            "circuit": skin.circuit_name,
            "reasons": [reason.name.lower().replace("_", " ") for reason in Reason],
            "live": self.live,
            "estimator": self.skin.estimator_name,
        }

    @property
    @abstractmethod
    def live(self) -> bool:
        """Whether frames come by themselves; False for a recording."""

    @abstractmethod
    def status(self) -> Report:
        """What changes: the state of the link, statistics, the tare in use."""

    @abstractmethod
    async def frame(self, order: FrameOrder) -> bytes:
        """The message of the frame that is asked for; waits for it.

        Raises:
            InputError: this source has no such frames.
            LinkEnded: no frame will come.

        """

    async def trace(self, order: TraceCells) -> Report:
        """Pressures of some cells over the whole recording; InputError unless it is one."""
        raise InputError("only a recording has traces; a live page draws what it has seen")

    async def make_tare(self, *, force: bool) -> Report:
        """Tare, and say what was done; InputError where that is not possible."""
        raise InputError("a recording takes no tare")

    async def undo_tare(self) -> Report:
        """Go back to the tare before, and say so; InputError where that is not possible."""
        raise InputError("a recording takes no tare")

    async def record(self, *, on: bool) -> None:
        """Begin or end a recording; InputError where that is not possible."""
        raise InputError("a recording is not recorded again")


class TimeAxis:
    """Time of frames since the first one, by the board's clock; by the host's where the board has none or reboots."""

    def __init__(self) -> None:
        self._before: Frame | None = None
        self._time_s = 0.0

    def of(self, frame: Frame) -> float:
        """The time of the next frame in s; never less than the one before."""
        before, self._before = self._before, frame
        if before is not None:
            if frame.rebooted or frame.device_time is None or before.device_time is None:
                step_s = frame.monotonic_time - before.monotonic_time
            else:
                step_s = frame.device_time - before.device_time
            self._time_s += max(step_s, 0.0)
        return self._time_s


def statistics(skin: Skin) -> Report:
    """The link statistics of a skin, for JSON."""
    reported = skin.stats().as_dict()
    for name in ("age_s", "jitter_s"):
        percentiles = reported[name]
        assert isinstance(percentiles, dict)
        reported[name] = {str(percent): value for percent, value in percentiles.items()}
    return reported


def _cells(geometry: Geometry) -> Report | None:
    """Index, place and area of each cell of a skin that is no rectangle."""
    if geometry.pitch_m is not None:
        return None
    there = geometry.exists
    return {
        "index": np.flatnonzero(there).tolist(),
        "place_mm": geometry.places_mm[there].tolist(),
        "area_mm2": geometry.areas_mm2[there].tolist(),
    }
