"""Shapes of contacts: the share of a contact's load that each cell gets.

Every shape answers one question: of a cell at some distance from the shape's middle, how much of the load lies on it,
over its area? Places and sizes are in cells, or in mm. Cells are squares along the axes; distances broadcast, so that
the rows and columns of an array are one axis each, and cells anywhere share one.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import cached_property
from math import pi, sqrt
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.ndimage import map_coordinates
from scipy.special import erf

from ..common.archives import Stored, read_array
from ..common.arrays import FloatArray
from ..common.config import LocalFile, Section
from ..common.extras import install_command
from ..common.files import MOST_BYTES, read_bytes
from ..common.tables import read_matrix
from ..errors import InputError, MissingExtra
from ._tuning import BELL_REACH

Length = Annotated[float, Field(ge=1e-3, le=1e6)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Place = Annotated[tuple[Coordinate, Coordinate], Field(strict=False)]
"""[row, column], or [down, along] in mm. Whole numbers of cells are the middles of cells."""
PlaceInSpace = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(strict=False)]
"""[y, x, z] in mm, on a skin in space"""
Size = Annotated[tuple[Length, Length], Field(strict=False)]
"""[height, width]"""
Side = float | FloatArray
"""of a cell, or of each"""

_MOST_PIXELS = 1024  # along each side of an image
_PIXELS = Stored("numbers", ("rows", "columns"))
_ROUNDING = 1e-12
"""of a share of a cell that is a difference of areas"""


class Shape(Section):
    """An area of contact. Lengths are given either in cells or in mm."""

    center: Place | None = None
    """[row, column]"""
    center_mm: Place | PlaceInSpace | None = None
    """[down, along] from the middle of cell [0, 0]; of a skin with a ``[shape]`` its own [y, x] or [y, x, z]"""

    SIZE: ClassVar[str] = ""
    """name of the length that is given in cells or in mm, without the unit; empty: the shape has none"""
    ROUND: ClassVar[bool] = False
    """the same from all sides, so that it can press on a skin in space"""
    MARGIN: ClassVar[float] = 0.5
    """sides of a cell from its middle to the end of the shape's reach, up to which the shape may cover it"""

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        if self.center is not None and self.center_mm is not None:
            raise ValueError("give center or center_mm, not both")
        if self.SIZE:
            given = [key for key in (f"{self.SIZE}_cells", f"{self.SIZE}_mm") if getattr(self, key) is not None]
            if len(given) != 1:
                raise ValueError(f"expected one of {self.SIZE}_cells and {self.SIZE}_mm; got {len(given)} of them")
        return self

    @property
    def is_in_mm(self) -> bool:
        """Whether all its lengths are given in mm."""
        return self.center is None and (not self.SIZE or getattr(self, f"{self.SIZE}_cells") is None)

    def size(self, unit_mm: float) -> FloatArray:
        """The shape's length or lengths (), (2,) over a unit: cells as they are given, mm over so many of them."""
        in_cells = getattr(self, f"{self.SIZE}_cells")
        return np.asarray(in_cells if in_cells is not None else np.divide(getattr(self, f"{self.SIZE}_mm"), unit_mm))

    def reach(self, unit_mm: float) -> FloatArray:
        """(2,) half the height and half the width of what the shape covers."""
        return np.broadcast_to(self.size(unit_mm), (2,))

    def area(self, unit_mm: float) -> float:
        """Area; for shapes with uneven pressure, the force over the load, as an area."""
        raise NotImplementedError

    def share(self, down: FloatArray, along: FloatArray, side: Side, unit_mm: float) -> FloatArray:
        """Mean pressure on cells, over the load.

        Args:
            down: from the shape's middle to those of the cells, in units along the first axis.
            along: likewise along the second; broadcasts with ``down`` to the shape of the result.
            side: of the cells.
            unit_mm: the unit.

        """
        raise NotImplementedError


class Point(Shape):
    """A load on one point, as a load on one cell that the nearest four cells share while the point moves over them."""

    ROUND: ClassVar[bool] = True
    MARGIN: ClassVar[float] = 1.0

    def reach(self, unit_mm: float) -> FloatArray:
        return np.zeros(2)

    def area(self, unit_mm: float) -> float:
        return 1.0

    def share(self, down: FloatArray, along: FloatArray, side: Side, unit_mm: float) -> FloatArray:
        return _overlap(down, side, side) * _overlap(along, side, side)


class Rectangle(Shape):
    """Even pressure within a rectangle along the lines of the array; a cell covered in part gets that part."""

    SIZE: ClassVar[str] = "size"
    size_cells: Size | None = None
    size_mm: Size | None = None

    def reach(self, unit_mm: float) -> FloatArray:
        return self.size(unit_mm) / 2.0

    def area(self, unit_mm: float) -> float:
        return float(self.size(unit_mm).prod())

    def share(self, down: FloatArray, along: FloatArray, side: Side, unit_mm: float) -> FloatArray:
        height, width = self.size(unit_mm)
        return _overlap(down, side, height) * _overlap(along, side, width)


class Bump(Shape):
    """Pressure like a fingertip's: a Gaussian bell, whose peak is the load; each cell gets the mean over the cell."""

    ROUND: ClassVar[bool] = True
    SIZE: ClassVar[str] = "sigma"
    sigma_cells: Length | None = None
    sigma_mm: Length | None = None

    def reach(self, unit_mm: float) -> FloatArray:
        return BELL_REACH * super().reach(unit_mm)

    def area(self, unit_mm: float) -> float:
        return 2.0 * pi * float(self.size(unit_mm)) ** 2

    def share(self, down: FloatArray, along: FloatArray, side: Side, unit_mm: float) -> FloatArray:
        sigma = float(self.size(unit_mm))

        def factor(away: FloatArray) -> FloatArray:
            high, low = ((away + end * side) / (sigma * sqrt(2.0)) for end in (0.5, -0.5))
            mean = sigma * sqrt(pi / 2.0) * (erf(high) - erf(low)) / side
            return np.where(np.abs(away) <= BELL_REACH * sigma + 0.5 * side, mean, 0.0)

        return factor(down) * factor(along)


class Disc(Shape):
    """Even pressure within a circle; a cell that the circle covers in part gets that part."""

    ROUND: ClassVar[bool] = True
    SIZE: ClassVar[str] = "radius"
    radius_cells: Length | None = None
    radius_mm: Length | None = None

    def area(self, unit_mm: float) -> float:
        return pi * float(self.size(unit_mm)) ** 2

    def share(self, down: FloatArray, along: FloatArray, side: Side, unit_mm: float) -> FloatArray:
        """In closed form.

        With H(x) the area of the half disc to the left of x, the area of the disc above y and to the left of x is
        H(x) plus or minus the area below the half disc and below y.
        """
        radius = float(self.size(unit_mm))

        def left_of(place: FloatArray) -> FloatArray:
            area: FloatArray = 0.5 * (
                place * np.sqrt(np.maximum(radius**2 - place**2, 0.0)) + radius**2 * np.arcsin(place / radius)
            )
            return area + radius**2 * pi / 4.0

        def up_to(y: FloatArray, x: FloatArray) -> FloatArray:
            x, y = np.clip(x, -radius, radius), np.clip(y, -radius, radius)
            chord = np.sqrt(np.maximum(radius**2 - y**2, 0.0))  # half of it, at y
            left, left_of_chord = left_of(x), left_of(-chord)
            right_of_chord = radius**2 * pi / 2.0 - left_of_chord
            below = np.minimum(left, left_of_chord) + np.abs(y) * (np.clip(x, -chord, chord) + chord)
            below += np.maximum(left, right_of_chord) - right_of_chord
            return left + np.sign(y) * below

        return _within(up_to, down, along, side)


class Image(Shape):
    """A picture of the contact: each pixel is the share of the load at its place, from 0 to 1."""

    SIZE: ClassVar[str] = "size"
    file: LocalFile
    """.csv (lines of numbers 0 ... 1), .npy, or a grey .png (white is 1), relative to the scene file"""
    size_cells: Size | None = None
    """[height, width] of the whole picture"""
    size_mm: Size | None = None

    @property
    def pixels(self) -> FloatArray:
        """(height, width) shares of the load. Raises InputError, MissingExtra."""
        return self._pixels

    @cached_property
    def _pixels(self) -> FloatArray:
        path = self.file
        match path.suffix.lower():
            case ".csv":
                pixels = read_matrix(path)
            case ".npy":
                pixels = read_array(path, _PIXELS, what="picture (.npy)", most_bytes=MOST_BYTES)
            case ".png":
                pixels = _png(path)
            case suffix:
                raise InputError(f"{path}: '{suffix}' is no kind of picture; expected .csv, .npy or .png")
        if pixels.ndim != 2 or not 1 <= min(pixels.shape) <= max(pixels.shape) <= _MOST_PIXELS:
            most = f"{_MOST_PIXELS} x {_MOST_PIXELS}"
            raise InputError(f"{path}: has shape {pixels.shape}; expected a picture of at most {most} pixels")
        if not ((pixels >= 0) & (pixels <= 1)).all():
            raise InputError(f"{path}: has pixels outside 0 ... 1; each is a share of the load")
        return pixels

    @cached_property
    def _sums(self) -> FloatArray:
        """(height + 1, width + 1) shares of all pixels above and to the left of a corner, over the number of all."""
        return np.asarray(np.pad(self.pixels.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))) / self.pixels.size)

    def reach(self, unit_mm: float) -> FloatArray:
        return self.size(unit_mm) / 2.0

    def area(self, unit_mm: float) -> float:
        return float(self.size(unit_mm).prod() * self.pixels.mean())

    def share(self, down: FloatArray, along: FloatArray, side: Side, unit_mm: float) -> FloatArray:
        """By the table of sums of all pixels above and to the left of a place."""
        height, width = self.size(unit_mm)
        rows, columns = self.pixels.shape

        def up_to(y: FloatArray, x: FloatArray) -> FloatArray:
            row, column = np.clip(y / height + 0.5, 0.0, 1.0) * rows, np.clip(x / width + 0.5, 0.0, 1.0) * columns
            found: FloatArray = map_coordinates(self._sums, np.broadcast_arrays(row, column), order=1)
            return np.asarray(height * width * found)

        return _within(up_to, down, along, side)


def _overlap(away: FloatArray, side: Side, length: Side) -> FloatArray:
    """Share of a cell's side that a stretch of so much length covers, whose middle is ``away`` from the cell's."""
    shared = np.minimum(length / 2.0, away + side / 2.0) - np.maximum(-length / 2.0, away - side / 2.0)
    return np.asarray(np.maximum(shared, 0.0) / side)


def _within(
    up_to: Callable[[FloatArray, FloatArray], FloatArray], down: FloatArray, along: FloatArray, side: Side
) -> FloatArray:
    """Mean over cells of what has the integral ``up_to`` a place, over all that lies before it on both axes."""
    top, bottom, left, right = down - side / 2.0, down + side / 2.0, along - side / 2.0, along + side / 2.0
    share = (up_to(bottom, right) - up_to(top, right) - up_to(bottom, left) + up_to(top, left)) / np.square(side)
    return np.where(share > _ROUNDING, np.minimum(share, 1.0), 0.0)


def _png(path: Path) -> FloatArray:
    try:
        import PIL.Image
    except ImportError as error:
        raise MissingExtra(f"{path}: .png needs Pillow: {install_command('report')}, or use .csv or .npy") from error
    content = io.BytesIO(read_bytes(path))
    try:
        with PIL.Image.open(content, formats=["PNG"]) as picture:  # others run programs: Ghostscript for .eps
            if max(picture.size) > _MOST_PIXELS:
                raise InputError(f"{path}: has {picture.size} pixels; expected at most {_MOST_PIXELS} along each side")
            return np.asarray(picture.convert("L"), dtype=np.float64) / 255.0
    except InputError:
        raise
    except (OSError, SyntaxError, ValueError, PIL.Image.DecompressionBombError) as error:
        raise InputError(f"{path}: is no .png file that can be read: {error}") from error
