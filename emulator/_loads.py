"""Loads over time: points joined by straight lines, sines, taps, and recordings. All are functions of time alone."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from itertools import pairwise
from math import inf
from typing import Annotated, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..common.arrays import FloatArray
from ..common.config import Finite, LocalFile, NotNegative, Section
from ..common.tables import read_columns
from ..errors import InputError

Seconds = Annotated[float, Field(ge=1e-6, le=1e9)]
LoadPoint = Annotated[tuple[Finite, NotNegative], Field(strict=False)]
LoadPoints = Annotated[list[LoadPoint], Field(min_length=1, max_length=1_000_000)]


class Sine(Section):
    """A load that swings about a mean; where it would be negative there is no contact."""

    mean_kpa: NotNegative
    amplitude_kpa: NotNegative
    frequency_hz: Annotated[float, Field(ge=1e-6, le=1e6)]
    phase_deg: Finite = 0.0
    start_s: Finite = 0.0
    """no load before"""
    stop_s: Annotated[float, Field(gt=-1e9)] = inf
    """no load from then on"""

    def at(self, time_s: FloatArray) -> FloatArray:
        """KPa at each of ``time_s``."""
        phase = 2.0 * np.pi * self.frequency_hz * (time_s - self.start_s) + np.deg2rad(self.phase_deg)
        load = np.maximum(self.mean_kpa + self.amplitude_kpa * np.sin(phase), 0.0)
        return np.where((time_s >= self.start_s) & (time_s < self.stop_s), load, 0.0)


class Taps(Section):
    """Short presses at even intervals, each a trapezoid over time."""

    load_kpa: NotNegative
    every_s: Seconds
    hold_s: NotNegative = 0.05
    """at full load"""
    rise_s: NotNegative = 0.01
    """from nothing to full load, and back"""
    first_s: NotNegative = 0.0
    count: Annotated[int, Field(ge=1)] | None = None
    """None: without end"""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.hold_s + 2.0 * self.rise_s > self.every_s:
            raise ValueError(f"a tap takes hold_s + 2 rise_s, which is more than every_s = {self.every_s} s")
        return self

    def at(self, time_s: FloatArray) -> FloatArray:
        """KPa at each of ``time_s``."""
        since = time_s - self.first_s
        # A time that falls on a tap's beginning but for rounding belongs to that tap.
        number = np.floor(since / self.every_s + 1e-9)
        place = since - number * self.every_s
        length = self.hold_s + 2.0 * self.rise_s
        rise = max(self.rise_s, 1e-9)
        share = np.clip(np.minimum(place / rise + (self.rise_s == 0), (length - place) / rise), 0.0, 1.0)
        tapping = (number >= 0) & (number < (inf if self.count is None else self.count))
        return np.where(tapping, self.load_kpa * share, 0.0)


class Recorded(Section):
    """A load from a CSV file with columns ``time_s`` and ``pressure_kpa``, linear between its lines."""

    file: LocalFile
    """relative to the scene file"""
    scale: NotNegative = 1.0

    @property
    def points(self) -> tuple[FloatArray, FloatArray]:
        """Times in s and loads in kPa. Raises InputError."""
        return self._points

    @cached_property
    def _points(self) -> tuple[FloatArray, FloatArray]:
        columns = read_columns(self.file, ["time_s", "pressure_kpa"])
        times, loads = columns["time_s"], columns["pressure_kpa"]
        if not (np.isfinite(times).all() and (np.diff(times) >= 0).all()):
            raise InputError(f"{self.file}: time_s must be numbers that do not decrease")
        if not ((loads >= 0) & (loads <= 1e30)).all():
            line = int(np.flatnonzero(~((loads >= 0) & (loads <= 1e30)))[0]) + 2
            raise InputError(f"{self.file}: line {line}: pressure_kpa is not a pressure >= 0")
        return times, loads * self.scale


class Load(Section):
    """How hard a contact presses, over time: one of several forms."""

    load_kpa: LoadPoints | None = None
    """[time in s, kPa]: straight lines between, constant before the first and after the last"""
    force_n: LoadPoints | None = None
    """[time in s, N] likewise; the shape's area makes a pressure of it"""
    sine: Sine | None = None
    taps: Taps | None = None
    recorded: Recorded | None = None
    period: Seconds | None = None
    """s, after which points and recordings begin anew; left out: never"""

    @model_validator(mode="after")
    def _one_load(self) -> Self:
        forms = ("load_kpa", "force_n", "sine", "taps", "recorded")
        given = [name for name in forms if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a contact has one load of {', '.join(forms)}; got {' and '.join(given) or 'none'}")
        if self.period is not None and given[0] in {"sine", "taps"}:
            raise ValueError(f"'{given[0]}' repeats by itself and takes no period")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        for name in ("load_kpa", "force_n"):
            check_order(name, getattr(self, name) or ())
        return self

    def load(self, time_s: ArrayLike, area_m2: float = 1.0) -> FloatArray:
        """KPa at each of ``time_s``; where two points share a time the load jumps, to the later one.

        ``area_m2`` is what a force spreads over.
        """
        time = np.asarray(time_s, dtype=np.float64)
        if self.sine is not None:
            return self.sine.at(time)
        if self.taps is not None:
            return self.taps.at(time)
        times, loads = self._points
        if self.period is not None:
            time = within_period(time, self.period)
        if self.force_n is not None:
            loads = loads / (1000.0 * area_m2)
        return np.asarray(np.interp(time, times, loads))

    @cached_property
    def _points(self) -> tuple[FloatArray, FloatArray]:
        if self.recorded is not None:
            return self.recorded.points
        points = np.asarray(self.load_kpa if self.load_kpa is not None else self.force_n, dtype=np.float64)
        return points[:, 0], points[:, 1]

    def read_files(self) -> None:
        """Read what the load names, so that an error comes before the first frame. Raises InputError."""
        if self.recorded is not None:
            _ = self.recorded.points


def check_order(name: str, points: Iterable[tuple[float, *tuple[float, ...]]]) -> None:
    """Raises ValueError for points over time, each with its time ahead, that go back in time."""
    for (before, *_), (after, *_) in pairwise(points):
        if after < before:
            raise ValueError(f"the times of {name} must not decrease; {after} s follows {before} s")


def within_period(time_s: FloatArray, period_s: float) -> FloatArray:
    """Time since the last multiple of the period. A time that falls on one but for rounding counts as that multiple."""
    since: FloatArray = np.maximum(time_s - period_s * np.floor(time_s / period_s + 1e-9), 0.0)
    return since
