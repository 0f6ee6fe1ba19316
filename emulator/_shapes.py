"""Shapes of contacts: the share of a contact's load that each cell gets, for a shape at rest or on its way.

Places and sizes are in cells, or in mm from the middle of cell [0, 0]. Every shape answers one question: where its
middle is at each of a number of frames, which share of the load does each cell of a small window get? The coverage of
points, rectangles and bumps is a product of a factor for the row and one for the column.
"""

from __future__ import annotations

import io
from functools import cached_property
from math import ceil, floor, pi, sqrt
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator
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

_MOST_PIXELS = 1024  # along each side of an image
_PIXELS = Stored("numbers", ("rows", "columns"))


class Shape(Section):
    """An area of contact. Lengths are given either in cells or in mm."""

    center: Place | None = None
    """[row, column]"""
    center_mm: Place | PlaceInSpace | None = None
    """[down, along] from the middle of cell [0, 0]; of a skin with a ``[shape]`` its own [y, x] or [y, x, z]"""

    SIZE: ClassVar[str] = ""
    """name of the length that is given in cells or in mm, without the unit; empty: the shape has none"""

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        if self.center is not None and self.center_mm is not None:
            raise ValueError("give center or center_mm, not both")
        if self.SIZE:
            given = [key for key in (f"{self.SIZE}_cells", f"{self.SIZE}_mm") if getattr(self, key) is not None]
            if len(given) != 1:
                raise ValueError(f"expected one of {self.SIZE}_cells and {self.SIZE}_mm; got {len(given)} of them")
        return self

    def middle(self, pitch_mm: float) -> tuple[float, float] | None:
        """[row, column] of the middle, in cells; None where the scene file gives none."""
        if self.center_mm is not None:
            return self.center_mm[0] / pitch_mm, self.center_mm[1] / pitch_mm
        return self.center

    @property
    def is_in_mm(self) -> bool:
        """Whether all its lengths are given in mm."""
        return self.center is None and (not self.SIZE or getattr(self, f"{self.SIZE}_cells") is None)

    ROUND: ClassVar[bool] = False
    """the same from all sides, so that it can press on a skin in space"""

    def cover_places(self, middles_mm: FloatArray, places_mm: FloatArray, areas_mm2: FloatArray) -> FloatArray:
        """Share of the load on cells anywhere, each taken for a square of its area along the axes.

        Args:
            middles_mm: (frames, 2 or 3) where the shape's middle is, [y, x] or [y, x, z].
            places_mm: (cells, 2 or 3) likewise.
            areas_mm2: (cells,)

        Returns:
            (frames, cells)

        """
        if places_mm.shape[1] == 3:  # as far away as in space, along one axis
            away = np.linalg.norm(places_mm - middles_mm[:, None], axis=-1)
            still = np.zeros((len(away), 1))
            found = [
                self.cover(np.concatenate([-far[:, None] / side, still], axis=1), np.zeros(1), np.zeros(1), side)
                for far, side in zip(away.T, np.sqrt(areas_mm2).tolist(), strict=True)
            ]
        else:
            found = [
                self.cover(middles_mm / side, place[:1] / side, place[1:] / side, side)
                for place, side in zip(places_mm, np.sqrt(areas_mm2).tolist(), strict=True)
            ]
        return np.stack([share[:, 0, 0] for share in found], axis=1)

    def size(self, pitch_mm: float) -> Any:
        """The shape's length or lengths, in cells."""
        in_cells = getattr(self, f"{self.SIZE}_cells")
        return in_cells if in_cells is not None else np.divide(getattr(self, f"{self.SIZE}_mm"), pitch_mm)

    def reach(self, pitch_mm: float) -> tuple[float, float]:
        """Half the height and half the width of what the shape can cover, in cells."""
        raise NotImplementedError

    def area_cells(self, pitch_mm: float) -> float:
        """Area in cells; for shapes with uneven pressure, the force over the load, as an area."""
        raise NotImplementedError

    def cover(self, middles: FloatArray, rows: FloatArray, columns: FloatArray, pitch_mm: float) -> FloatArray:
        """Share of the load on each cell of a window.

        Args:
            middles: (frames, 2) where the shape's middle is, [row, column].
            rows: (r,) indices of the window's rows.
            columns: (c,) likewise; neither is empty.
            pitch_mm: from cell to cell.

        Returns:
            (frames, r, c)

        """
        raise NotImplementedError

    def window(
        self, middles: FloatArray, shape: tuple[int, int], pitch_mm: float
    ) -> tuple[tuple[int, int], tuple[int, int]]:
        """First row and the row behind the last one, and the same of columns, that the shape reaches at any time."""
        reach = self.reach(pitch_mm)
        limits = []
        for axis in (0, 1):
            low = max(ceil(middles[:, axis].min() - reach[axis] - 0.5), 0)
            high = min(floor(middles[:, axis].max() + reach[axis] + 0.5) + 1, shape[axis])
            limits.append((low, max(low, high)))
        return limits[0], limits[1]


class _Product(Shape):
    """A shape whose coverage is a product of a factor for the row and one for the column."""

    def cover(self, middles: FloatArray, rows: FloatArray, columns: FloatArray, pitch_mm: float) -> FloatArray:
        down = self._factor(rows - middles[:, :1], 0, pitch_mm)
        along = self._factor(columns - middles[:, 1:], 1, pitch_mm)
        product: FloatArray = down[:, :, None] * along[:, None, :]
        return product

    def _factor(self, away: FloatArray, axis: int, pitch_mm: float) -> FloatArray:
        """Factor of cells whose middles are ``away`` cells from the shape's middle along an axis."""
        raise NotImplementedError


class Point(_Product):
    """A load on one point, as a load on one cell that the nearest four cells share while the point moves over them."""

    ROUND: ClassVar[bool] = True

    def reach(self, pitch_mm: float) -> tuple[float, float]:
        return 0.5, 0.5

    def area_cells(self, pitch_mm: float) -> float:
        return 1.0

    def _factor(self, away: FloatArray, axis: int, pitch_mm: float) -> FloatArray:
        return np.maximum(1.0 - np.abs(away), 0.0)


class Rectangle(_Product):
    """Even pressure within a rectangle along the lines of the array; a cell covered in part gets that part."""

    SIZE: ClassVar[str] = "size"
    size_cells: Size | None = None
    size_mm: Size | None = None

    def reach(self, pitch_mm: float) -> tuple[float, float]:
        height, width = self.size(pitch_mm)
        return float(height) / 2.0, float(width) / 2.0

    def area_cells(self, pitch_mm: float) -> float:
        height, width = self.size(pitch_mm)
        return float(height * width)

    def _factor(self, away: FloatArray, axis: int, pitch_mm: float) -> FloatArray:
        half = self.reach(pitch_mm)[axis]
        shared: FloatArray = np.minimum(half, away + 0.5) - np.maximum(-half, away - 0.5)
        return shared.clip(min=0.0)


class Bump(_Product):
    """Pressure like a fingertip's: a Gaussian bell, whose peak is the load; each cell gets the mean over the cell."""

    ROUND: ClassVar[bool] = True

    SIZE: ClassVar[str] = "sigma"
    sigma_cells: Length | None = None
    sigma_mm: Length | None = None

    def reach(self, pitch_mm: float) -> tuple[float, float]:
        return (BELL_REACH * float(self.size(pitch_mm)),) * 2

    def area_cells(self, pitch_mm: float) -> float:
        return 2.0 * pi * float(self.size(pitch_mm)) ** 2

    def _factor(self, away: FloatArray, axis: int, pitch_mm: float) -> FloatArray:
        sigma = float(self.size(pitch_mm))
        # Neighbouring cells share an edge: one more edge than cells.
        edges = np.concatenate([away - 0.5, away[:, -1:] + 0.5], axis=1) / (sigma * sqrt(2.0))
        mean = sigma * sqrt(pi / 2.0) * np.diff(erf(edges), axis=1)
        return np.where(np.abs(away) <= BELL_REACH * sigma + 0.5, mean, 0.0)


class Disc(Shape):
    """Even pressure within a circle; a cell that the circle covers in part gets that part."""

    ROUND: ClassVar[bool] = True

    SIZE: ClassVar[str] = "radius"
    radius_cells: Length | None = None
    radius_mm: Length | None = None

    def reach(self, pitch_mm: float) -> tuple[float, float]:
        return (float(self.size(pitch_mm)),) * 2

    def area_cells(self, pitch_mm: float) -> float:
        return pi * float(self.size(pitch_mm)) ** 2

    def cover(self, middles: FloatArray, rows: FloatArray, columns: FloatArray, pitch_mm: float) -> FloatArray:
        """Areas of circle and cell in closed form.

        With H(x) the area of the half disc to the left of x, the area of the disc above y and to the left of x is
        H(x) plus or minus the area below the half disc and below y. The area of a cell is a second difference of these.
        """
        radius = float(self.size(pitch_mm))
        x = np.clip(np.append(columns - 0.5, columns[-1] + 0.5) - middles[:, 1:], -radius, radius)[:, None, :]
        y = np.clip(np.append(rows - 0.5, rows[-1] + 0.5) - middles[:, :1], -radius, radius)[:, :, None]

        def left_of(place: FloatArray) -> FloatArray:
            area: FloatArray = 0.5 * (
                place * np.sqrt(np.maximum(radius**2 - place**2, 0.0)) + radius**2 * np.arcsin(place / radius)
            )
            return area + radius**2 * pi / 4.0

        chord = np.sqrt(np.maximum(radius**2 - y**2, 0.0))  # half of it, at y
        left, left_of_chord = left_of(x), left_of(-chord)
        right_of_chord = radius**2 * pi / 2.0 - left_of_chord
        below = np.minimum(left, left_of_chord) + np.abs(y) * (np.clip(x, -chord, chord) + chord)
        below += np.maximum(left, right_of_chord) - right_of_chord
        corner = left + np.sign(y) * below
        covered = np.diff(np.diff(corner, axis=1), axis=2)
        return np.clip(covered, 0.0, 1.0)


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

    def reach(self, pitch_mm: float) -> tuple[float, float]:
        height, width = self.size(pitch_mm)
        return float(height) / 2.0, float(width) / 2.0

    def area_cells(self, pitch_mm: float) -> float:
        height, width = self.size(pitch_mm)
        return float(height * width * self.pixels.mean())

    def cover(self, middles: FloatArray, rows: FloatArray, columns: FloatArray, pitch_mm: float) -> FloatArray:
        size = self.size(pitch_mm)
        down = _pixel_overlap(rows - middles[:, :1], float(size[0]), self.pixels.shape[0])
        along = _pixel_overlap(columns - middles[:, 1:], float(size[1]), self.pixels.shape[1])
        covered: FloatArray = down @ self.pixels @ along.transpose(0, 2, 1)
        return covered


def _pixel_overlap(away: FloatArray, size: float, pixels: int) -> FloatArray:
    """(frames, cells, pixels) length that each cell, ``away`` from the picture's middle, shares with each pixel."""
    edges = np.linspace(-size / 2.0, size / 2.0, pixels + 1)
    low, high = away[:, :, None] - 0.5, away[:, :, None] + 0.5
    shared: FloatArray = np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1])
    return np.maximum(shared, 0.0)


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
