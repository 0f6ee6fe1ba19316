"""Contacts: a shape, a load over time, and the path that the shape takes over the skin."""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from ..common.arrays import FloatArray, IntArray
from ..common.config import Finite
from ..common.geometry import Geometry
from ..errors import InputError
from ._loads import Load, Seconds, check_order, within_period
from ._shapes import Bump, Coordinate, Disc, Image, Point, Rectangle, Shape

CellIndex = Annotated[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]], Field(strict=False)]
PathPoint = Annotated[tuple[Finite, Coordinate, Coordinate], Field(strict=False)]
PathPointInSpace = Annotated[tuple[Finite, Coordinate, Coordinate, Coordinate], Field(strict=False)]
Path = Annotated[list[PathPoint], Field(min_length=1, max_length=1_000_000)]
PathInSpace = Annotated[list[PathPointInSpace], Field(min_length=1, max_length=1_000_000)]
_SHAPES = ("cells", "point", "disc", "rectangle", "bump", "image")


class Contact(Load):
    """Something that presses on the skin."""

    cells: Annotated[list[CellIndex], Field(min_length=1)] | None = None
    """[row, column] of each cell pressed"""
    point: Point | None = None
    disc: Disc | None = None
    rectangle: Rectangle | None = None
    bump: Bump | None = None
    image: Image | None = None
    path_cells: Path | None = None
    """[time in s, row, column] of the shape's middle: straight lines between, at rest before and after"""
    path_mm: Path | PathInSpace | None = None
    """[time in s, down, along] likewise, from the middle of cell [0, 0]; of a skin with a ``[shape]`` its own [time, y,
    x] or [time, y, x, z]"""
    path_period: Seconds | None = None
    """s, after which the path begins anew; left out: never"""

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        given = [name for name in _SHAPES if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a contact has one of {', '.join(_SHAPES)}; got {' and '.join(given) or 'none'}")
        return self

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        paths = [path for path in (self.path_cells, self.path_mm) if path is not None]
        if len(paths) == 2:
            raise ValueError("give path_cells or path_mm, not both")
        if self.path_period is not None and not paths:
            raise ValueError("path_period needs a path")
        if self.cells is not None:
            if paths:
                raise ValueError("'cells' stay where they are; a path needs one of the other shapes")
            return self
        placed = self._shape.center is not None or self._shape.center_mm is not None
        if placed and paths:
            raise ValueError("give the shape a center or the contact a path, not both")
        if not placed and not paths:
            raise ValueError("the shape needs center or center_mm, or the contact a path")
        check_order("a path", paths[0] if paths else ())
        return self

    @property
    def _shape(self) -> Shape:
        shape = self.point or self.disc or self.rectangle or self.bump or self.image
        assert shape is not None
        return shape

    def read_files(self) -> None:
        """Read what the contact names, so that an error comes before the first frame. Raises InputError."""
        super().read_files()
        if self.image is not None:
            _ = self.image.pixels

    def _is_placed_in_mm(self, geometry: Geometry) -> bool:
        """Whether its place is one on a skin with places of its own, not one in the array."""
        return self.cells is None and geometry.pitch_m is None and self.path_cells is None and self._shape.is_in_mm

    def _middles(self, time_s: FloatArray, unit_mm: float) -> FloatArray:
        """(frames, 2 or 3) where the middle of the shape is, or (1, 2 or 3) if it rests; mm are divided by a unit."""
        path, shape = self.path_cells or self.path_mm, self._shape
        unit = unit_mm if (self.path_mm if path else shape.center_mm) is not None else 1.0
        if not path:
            return np.array([shape.center or shape.center_mm]) / unit
        points = np.asarray(path, dtype=np.float64)
        time = time_s if self.path_period is None else within_period(time_s, self.path_period)
        return np.stack([np.interp(time, points[:, 0], along) for along in points[:, 1:].T], axis=1) / unit

    def coverage(self, geometry: Geometry) -> FloatArray:
        """(rows, columns) pressure on each cell per unit of load, at the beginning of a path."""
        covered = np.zeros(geometry.shape)
        cells, share = self._cover(np.zeros(1), geometry)
        covered.flat[cells] = share[0]
        return covered

    def pressure_on(self, time_s: FloatArray, geometry: Geometry) -> tuple[IntArray, FloatArray]:
        """The cells that the contact presses at any of ``time_s``, and how hard.

        Returns:
            (k,) indices into the flattened array in rising order, and (frames, k) kPa.

        """
        load = self.load(time_s, area_m2=1e-6 * self._area_mm2(geometry))
        pressing = load > 0
        if not pressing.any():
            return np.empty(0, dtype=np.intp), np.empty((len(time_s), 0))
        cells, share = self._cover(time_s, geometry)
        touched = (share[pressing] > 0).any(axis=0) if len(share) > 1 else share[0] > 0
        return cells[touched], load[:, None] * share[:, touched]

    def _area_mm2(self, geometry: Geometry) -> float:
        if self.cells is not None:
            return float(geometry.areas_mm2[tuple(np.transpose(self.cells))].sum())
        pitch_mm = _pitch_mm(geometry)
        return self._shape.area(pitch_mm) * pitch_mm**2

    def _cover(self, time_s: FloatArray, geometry: Geometry) -> tuple[IntArray, FloatArray]:
        """Cells (k,) and their shares (frames, k), or (1, k) if these do not change."""
        count, pitch_mm = geometry.shape[1], _pitch_mm(geometry)
        if self._is_placed_in_mm(geometry):
            middles = self._middles(time_s, 1.0)
            cells, places, sides = self._near(middles, geometry)
            away = places - middles[:, None]
            if len(geometry.axes) == 3:  # as far away as in space, along one axis
                away = np.linalg.norm(away, axis=-1, keepdims=True) * [1.0, 0.0]
            return cells, self._shape.share(away[..., 0], away[..., 1], sides, 1.0)
        if self.cells is not None:
            rows, columns = np.transpose(self.cells)
            cells = np.unique(rows * count + columns)
            return cells, np.ones((1, len(cells)))
        middles = self._middles(time_s, pitch_mm)
        rows, columns = self._window(middles, geometry)
        cells = (rows[:, None] * count + columns).ravel()
        down, along = rows[:, None] - middles[:, 0, None, None], columns - middles[:, 1, None, None]
        return cells, self._shape.share(down, along, 1.0, pitch_mm).reshape(len(middles), -1)

    def _window(self, middles: FloatArray, geometry: Geometry) -> tuple[IntArray, IntArray]:
        """Rows (r,) and columns (c,) of the array that the shape reaches at any time."""
        reach = self._shape.reach(_pitch_mm(geometry)) + self._shape.MARGIN
        first, last = np.ceil(middles.min(axis=0) - reach), np.floor(middles.max(axis=0) + reach) + 1.0
        ends = np.clip([first, last], 0.0, geometry.shape).astype(np.intp)
        return np.arange(*ends[:, 0]), np.arange(*ends[:, 1])

    def _near(self, middles_mm: FloatArray, geometry: Geometry) -> tuple[IntArray, FloatArray, FloatArray]:
        """On a skin with places of its own, the cells (k,) that the shape comes near, their places and their sides."""
        there, axes = np.flatnonzero(geometry.exists), len(geometry.axes)
        places = geometry.places_mm.reshape(-1, axes)[there][:, [1, 0, 2][:axes]]  # y before x, as in a scene
        sides = np.sqrt(geometry.areas_mm2.flat[there])
        reach = self._shape.reach(1.0)[[0, 1, 0][:axes]] + self._shape.MARGIN * sides[:, None]
        near = ((places >= middles_mm.min(axis=0) - reach) & (places <= middles_mm.max(axis=0) + reach)).all(axis=1)
        return there[near], places[near], sides[near]

    def check(self, geometry: Geometry) -> None:
        """Raises InputError for cells beside the array, or a shape that nowhere on its path reaches the skin."""
        shape = geometry.shape
        for row, column in self.cells or ():
            if row >= shape[0] or column >= shape[1]:
                raise InputError(f"cells: [{row}, {column}] lies outside the {shape[0]} x {shape[1]} array")
        if self.cells is not None:
            return
        in_mm = self._is_placed_in_mm(geometry)
        if geometry.pitch_m is None and not in_mm and (self.path_cells is None or self._shape.center_mm is not None):
            lengths = "path_mm" if self.path_cells is None else "path_cells"
            raise InputError(f"{lengths}: places on a skin with a [shape] and sizes are both in mm, or both in cells")
        axes = ("y", "x", "z")[: len(geometry.axes)] if in_mm else ("down", "along")
        path = self.path_cells or self.path_mm
        times = np.array([time for time, *_ in path] if path else [0.0])
        middles = self._middles(times, 1.0 if in_mm else _pitch_mm(geometry))
        if middles.shape[1] != len(axes):
            raise InputError(f"a place of {middles.shape[1]} numbers; expected [{', '.join(axes)}]")
        if len(axes) == 3 and not self._shape.ROUND:
            raise InputError("a rectangle or an image on a skin in space; expected a point, a disc, a bump, or cells")
        never = ", nor does its path" if path else ""
        if in_mm and not len(self._near(middles, geometry)[0]):
            raise InputError(f"its shape around {middles[0].tolist()} mm does not reach a cell{never}")
        if not in_mm and not all(len(lines) for lines in self._window(middles, geometry)):
            row, column = middles[0]
            raise InputError(
                f"its shape around row {row:.4g}, column {column:.4g} does not reach the {shape[0]} x {shape[1]} array"
                f"{never}; rows and columns count from 0, and mm from the middle of cell [0, 0]"
            )


def _pitch_mm(geometry: Geometry) -> float:
    """Side of a cell, which is square in a scene; on a skin with places of its own that of a typical cell."""
    if geometry.pitch_m is not None:
        return 1e3 * geometry.pitch_m[0]
    return math.sqrt(float(np.median(geometry.areas_mm2[geometry.exists])))
