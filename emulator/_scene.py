"""SCENE.toml: which skin and board to emulate, and what presses on it when. ``docs/scene.md`` is the format."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy.special import erf

from ..arrays import FloatArray, IntArray
from ..cell import Cell
from ..circuits import Design
from ..config import Finite, NotNegative, Positive, Section, parse, read_toml
from ..errors import InputError

Share = Annotated[float, Field(ge=0, lt=1)]
CellIndex = Annotated[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], Field(strict=False)]
LoadPoint = Annotated[tuple[Finite, NotNegative], Field(strict=False)]
Place = Annotated[tuple[Finite, Finite], Field(strict=False)]
"""[row, column]; whole numbers are the middles of cells, each of which is one unit wide and high"""


def _overlap(low: FloatArray, high: FloatArray, count: int) -> FloatArray:
    """(intervals, count) length that each interval shares with each of ``count`` cells in a line."""
    middle = np.arange(count)
    shared: FloatArray = np.minimum(high[:, None], middle + 0.5) - np.maximum(low[:, None], middle - 0.5)
    return shared.clip(min=0.0)


class Disc(Section):
    """Even pressure within a circle; a cell that it covers in part gets that part."""

    center: Place
    radius_cells: Positive

    def coverage(self, shape: tuple[int, int]) -> FloatArray:
        """(rows, columns) share of each cell that the disc covers: chords, over strips of the rows."""
        strips = 256
        across = (np.arange(shape[0] * strips) + 0.5) / strips - 0.5 - self.center[0]
        half = np.sqrt(np.maximum(self.radius_cells**2 - across**2, 0.0))
        chords = _overlap(self.center[1] - half, self.center[1] + half, shape[1])
        covered: FloatArray = chords.reshape(shape[0], strips, shape[1]).mean(axis=1)
        return covered


class Rectangle(Section):
    """Even pressure within a rectangle along the lines of the array."""

    center: Place
    size_cells: Annotated[tuple[Positive, Positive], Field(strict=False)]
    """(height, width) along the columns and along the rows"""

    def coverage(self, shape: tuple[int, int]) -> FloatArray:
        """(rows, columns) share of each cell that the rectangle covers."""
        low = np.subtract(self.center, np.divide(self.size_cells, 2))
        high = np.add(self.center, np.divide(self.size_cells, 2))
        down, along = (_overlap(low[[axis]], high[[axis]], shape[axis])[0] for axis in (0, 1))
        return np.outer(down, along)


class Bump(Section):
    """Pressure like a fingertip's: a bell around ``center``, whose peak is the load."""

    center: Place
    sigma_cells: Positive

    def coverage(self, shape: tuple[int, int]) -> FloatArray:
        """(rows, columns) mean over each cell of exp(-distance^2 / (2 sigma^2))."""
        edges = ((np.arange(n + 1) - 0.5 - c) / self.sigma_cells for n, c in zip(shape, self.center, strict=True))
        down, along = (np.diff(self.sigma_cells * np.sqrt(np.pi / 2) * erf(e / np.sqrt(2))) for e in edges)
        return np.outer(down, along)


class Contact(Section):
    """Something that presses: one shape and its load over time."""

    cells: Annotated[list[CellIndex], Field(min_length=1)] | None = None
    """[row, column] of each cell pressed"""
    disc: Disc | None = None
    rectangle: Rectangle | None = None
    bump: Bump | None = None
    load_kpa: Annotated[list[LoadPoint], Field(min_length=1)]
    """[time in s, kPa]: straight lines between, constant before the first and after the last"""
    period: Positive | None = None
    """s, after which the load begins anew; left out: never"""

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        shapes = [name for name in ("cells", "disc", "rectangle", "bump") if getattr(self, name) is not None]
        if len(shapes) != 1:
            raise ValueError(f"a contact has one of cells, disc, rectangle, bump; got {' and '.join(shapes) or 'none'}")
        return self

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        times = [time for time, _ in self.load_kpa]
        for before, after in pairwise(times):
            if after < before:
                raise ValueError(f"the times of load_kpa must not decrease; {after} s follows {before} s")
        return self

    def coverage(self, shape: tuple[int, int]) -> FloatArray:
        """(rows, columns) pressure on each cell per unit of load."""
        if self.cells is not None:
            covered = np.zeros(shape)
            covered[tuple(np.transpose(self.cells))] = 1.0
            return covered
        area = self.disc or self.rectangle or self.bump
        assert area is not None
        return area.coverage(shape)

    def load(self, time_s: ArrayLike) -> FloatArray:
        """KPa at each of ``time_s``; where two points share a time the load jumps, to the later one."""
        time = np.asarray(time_s, dtype=np.float64)
        times, loads = np.transpose(self.load_kpa)
        if self.period is not None:
            # A tick that falls on a period's end but for rounding belongs to the next period.
            time = np.maximum(time - self.period * np.floor(time / self.period + 1e-9), 0.0)
        return np.asarray(np.interp(time, times, loads))


class Skin(Section):
    """The skin: how it is read, and what it is made of."""

    design: Design
    cell: Cell = Field(default_factory=Cell.example)
    cover_thickness: NotNegative = 0.0
    """m of silicone above the cells, which shares the pressure among them; a continuous sheet does so itself"""

    @property
    def spreading_pitches(self) -> float:
        """Depth, over the pitch, at which the cells feel the pressure: below the cover, mid-way in an uncut sheet."""
        sheet = self.design.sheet
        uncut = sheet.thickness / 2 if self.design.array.sheet == "continuous" else 0.0
        return (self.cover_thickness + uncut) / sheet.pitch


class BoardSettings(Section):
    """The board behind the skin."""

    frame_rate: Annotated[float, Field(ge=1e-3, le=100_000)] = 50.0
    """Hz"""
    serial_number: str = "EMULATED"
    noise: NotNegative = 0.0
    """V rms, white, at the input of the ADC"""
    reference_resistances: Annotated[tuple[Positive, ...], Field(strict=False, max_length=64)] = ()
    """ohm of resistors that the board's self-test can read in place of a cell"""


class LineSettings(Section):
    """What the line to the host does to the bytes."""

    packet_loss: Share = 0.0
    """chance that a packet vanishes"""
    bit_errors: Share = 0.0
    """chance of each bit to be flipped"""


class Scene(Section):
    """A skin, its board, the line, and the contacts. ``Scene.load("scene.toml")``."""

    skin: Skin
    board: BoardSettings = BoardSettings()
    line: LineSettings = LineSettings()
    contact: list[Contact] = Field(default_factory=list)

    @model_validator(mode="after")
    def _converts(self) -> Self:
        adc = self.skin.design.adc
        if adc is None or adc.bits > 16:
            raise ValueError("skin.design needs an [adc] of at most 16 bits: a board sends counts")
        return self

    @model_validator(mode="after")
    def _on_the_skin(self) -> Self:
        rows, columns = self.skin.design.array.shape
        for k, contact in enumerate(self.contact):
            for row, column in contact.cells or ():
                if row >= rows or column >= columns:
                    raise ValueError(f"contact[{k}].cells: [{row}, {column}] lies outside the {rows} x {columns} array")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read SCENE.toml and the files it names; InputError with one located message if one is at fault."""
        return cls.from_tables(read_toml(path), source=str(path), directory=Path(path).parent)

    @classmethod
    def from_tables(cls, tables: Mapping[str, Any], *, source: str, directory: Path) -> Scene:
        """A scene from TOML tables; ``directory`` is where the paths in it start."""
        skin = tables.get("skin")
        if isinstance(skin, Mapping):
            files: dict[str, Any] = {}
            for key, kind in (("design", Design), ("cell", Cell)):
                if isinstance(skin.get(key), str):
                    try:
                        files[key] = kind.load(directory / skin[key])
                    except InputError as error:
                        raise InputError(f"{source}: skin.{key}: {error}") from error
            tables = {**tables, "skin": {**skin, **files}}
        return parse(tables, cls, source=source)

    def pressure_kpa(self, time_s: float) -> FloatArray:
        """(rows, columns) kPa at ``time_s``: contacts add up."""
        total = np.zeros(self.skin.design.array.shape)
        cells, pressure = self.pressure_on(np.array([time_s]))
        total.flat[cells] = pressure[0]
        return total

    def pressure_on(self, time_s: FloatArray) -> tuple[IntArray, FloatArray]:
        """The cells that are pressed at any of ``time_s`` (frames,), and how hard: contacts add up.

        Returns:
            (k,) indices into the flattened array in rising order, and (frames, k) kPa.

        """
        loads = [contact.load(time_s) for contact in self.contact]
        pressing = [k for k, load in enumerate(loads) if load.any()]
        covered = np.zeros(self.skin.design.array.shape, dtype=np.bool_)
        for k in pressing:
            covered |= self._coverage[k] > 0
        cells = np.flatnonzero(covered)
        pressure = np.zeros((len(time_s), len(cells)))
        for k in pressing:
            pressure += loads[k][:, None] * self._coverage[k].flat[cells]
        return cells, pressure

    @cached_property
    def _coverage(self) -> list[FloatArray]:
        return [contact.coverage(self.skin.design.array.shape) for contact in self.contact]
