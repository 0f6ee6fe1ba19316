"""``[shape]`` of DESIGN.toml: where the cells of a skin are that is no rectangle, and where there are none."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from ..common.arrays import FloatArray
from ..common.config import MOST_CELLS, LocalFile, Positive, Section, parse
from ..common.geometry import Geometry
from ..common.tables import Table, write_text
from ..common.text import shortened
from ..errors import InputError

FURTHEST_MM = 1e6
"""from the origin: a kilometre"""
RESOLVED_MM = 1e-6
"""places that differ by less are one"""
_NUMBERS, _PLACES, _AREA = ("row", "column"), ("x_mm", "y_mm", "z_mm"), "area_mm2"

Index = Annotated[int, Field(ge=0, lt=MOST_CELLS)]
Coordinate = Annotated[float, Field(ge=-FURTHEST_MM, le=FURTHEST_MM, allow_inf_nan=False)]
Indices = Annotated[tuple[Index, ...], Field(strict=False, min_length=1, max_length=MOST_CELLS)]
Coordinates = Annotated[tuple[Coordinate, ...], Field(strict=False, max_length=MOST_CELLS)]
Areas = Annotated[tuple[Positive, ...], Field(strict=False, max_length=MOST_CELLS)]


class ShapeFile(Section):
    """The lists of a :class:`Shape`, as the columns of a CSV file. They take its place where the design is read."""

    file: LocalFile
    """path, relative to the design"""


class Shape(Section):
    """The cells that there are, one entry of each list for a cell; crossings without an entry have no cell."""

    row: Indices
    column: Indices
    x_mm: Coordinates
    y_mm: Coordinates
    z_mm: Coordinates | None = None
    """None: the skin is flat"""
    area_mm2: Areas | None = None
    """None: each cell is as long and as wide as its neighbours are away"""

    @model_validator(mode="before")
    @classmethod
    def _read(cls, given: Any, info: ValidationInfo) -> Any:
        if not isinstance(given, Mapping) or "file" not in given:
            return given
        if len(given) > 1:
            other = next(key for key in given if key != "file")
            raise ValueError(f"'file' has all columns; expected no '{shortened(str(other))}' beside it")
        return columns_of(ShapeFile.model_validate(given, context=info.context).file)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        lists = {name: getattr(self, name) for name in type(self).model_fields}
        for name, values in lists.items():
            if values is not None and len(values) != len(self.row):
                raise ValueError(f"{name} has {len(values)} entries; expected {len(self.row)}, one for each cell")
        cells = list(zip(self.row, self.column, strict=True))
        if len(set(cells)) < len(cells):
            twice = next(cell for k, cell in enumerate(cells) if cell in cells[:k])
            raise ValueError(f"cell {twice} is there twice; expected one entry for each cell")
        rounded = np.round(self._places() / RESOLVED_MM)
        _, first, count = np.unique(rounded, axis=0, return_index=True, return_counts=True)
        if count.max() > 1:
            same = np.flatnonzero((rounded == rounded[first[count.argmax()]]).all(axis=1)).tolist()
            raise ValueError(f"cells {cells[same[0]]} and {cells[same[1]]} are at one place; expected different ones")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a CSV file with the columns row, column, x_mm, y_mm and maybe z_mm, area_mm2. Raises InputError."""
        return parse(columns_of(Path(path)), cls, source=str(path))

    def _places(self) -> FloatArray:
        """(n, 2 or 3) mm."""
        lists = (self.x_mm, self.y_mm) if self.z_mm is None else (self.x_mm, self.y_mm, self.z_mm)
        return np.array(lists, dtype=np.float64).T

    def refuse_beyond(self, shape: tuple[int, int]) -> None:
        """InputError for a cell outside an array of ``shape``."""
        for cell in zip(self.row, self.column, strict=True):
            if cell[0] >= shape[0] or cell[1] >= shape[1]:
                raise InputError(f"shape: cell {cell} lies outside the array of {shape[0]} x {shape[1]} cells")

    def geometry(self, shape: tuple[int, int]) -> Geometry:
        """The places in an array of ``shape``; InputError for a cell outside of it."""
        self.refuse_beyond(shape)
        areas = None if self.area_mm2 is None else np.array(self.area_mm2, dtype=np.float64)
        return Geometry.of(shape, np.array([self.row, self.column]).T, self._places(), areas)

    @classmethod
    def of(cls, geometry: Geometry) -> Self:
        """The shape with these places."""
        rows, columns = np.nonzero(geometry.exists)
        places = geometry.places_mm[rows, columns].T.tolist()
        lists: dict[str, Any] = {"row": rows.tolist(), "column": columns.tolist()}
        lists |= dict(zip(_PLACES, places, strict=False))
        lists[_AREA] = geometry.areas_mm2[rows, columns].tolist()
        return parse(lists, cls, source="shape")

    def text(self) -> str:
        """The CSV file, bit for bit."""
        lists = {name: values for name in type(self).model_fields if (values := getattr(self, name)) is not None}
        return "".join(",".join(map(str, line)) + "\n" for line in [tuple(lists), *zip(*lists.values(), strict=True)])

    def save(self, path: str | Path) -> None:
        """Write :meth:`text` to a file. Raises InputError."""
        write_text(path, self.text())


def columns_of(path: Path) -> dict[str, list[float] | list[int]]:
    """The columns of a shape's file, by name; ValueError (InputError) that names the file and the line."""
    table = Table(path)
    known = (*_NUMBERS, *_PLACES, _AREA)
    expected = "expected row,column,x_mm,y_mm and maybe z_mm, area_mm2"
    for name in table.header:
        if name not in known or table.header.count(name) > 1:
            raise InputError(f"{path}: line 1: column '{name}'; {expected}")
    columns: dict[str, list[float] | list[int]] = {}
    for place, name in enumerate(table.header):
        values = table.numbers(place)
        wrong = ~np.isfinite(values)
        if name in _NUMBERS:
            wrong |= (values != np.round(values)) | (values < 0) | (values >= MOST_CELLS)
        if wrong.any():
            first = int(wrong.argmax())
            what = "a whole number from 0 on" if name in _NUMBERS else "a number"
            raise InputError(
                f"{path}: line {table.lines[first]}: {name} is '{table.texts(place)[first]}'; expected {what}"
            )
        columns[name] = values.astype(int).tolist() if name in _NUMBERS else values.tolist()
    for name in known[:4]:
        if name not in columns:
            raise InputError(f"{path}: line 1: no column '{name}'; {expected}")
    return columns
