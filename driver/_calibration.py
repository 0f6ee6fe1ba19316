"""Calibration per cell: rest resistance and gain of each cell, on top of the cell model that all cells share.

The cell model gives the pressure p for a history of R/R0. The cells of a skin differ: each has a rest resistance R0 of
its own, and the pressure on it is gain x p where the common model gives p. A calibration holds both values, their
standard deviations, and the board on which they were measured. :mod:`ohmskin.calibration` measures one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import tomli_w
from pydantic import Field, model_validator

from ..cell import Cell
from ..circuits import Design
from ..common.arrays import BoolArray, FloatArray
from ..common.config import NotNegative, Positive, Section, fingerprint, parse, parse_toml, read_toml
from ..common.tables import write_text
from ..common.text import count_of, printable, shortened
from ..errors import InputError

FORMAT = 1
MOST_LINES = 1024
"""most rows, and most columns, in a file"""
HEAD = """\
# Calibration of the cells of one skin, written by ohmskin calibrate (docs/calibration.md).
# Arrays have a line for each row of cells. The hash covers all values: edited files are refused.
"""

_Text = Annotated[str, Field(max_length=1000)]
_Line = Annotated[list[Positive], Field(min_length=1, max_length=MOST_LINES)]
_LineOrZeros = Annotated[list[NotNegative], Field(min_length=1, max_length=MOST_LINES)]
_Flags = Annotated[list[bool], Field(min_length=1, max_length=MOST_LINES)]


class _Cells(Section):
    """The table ``[cells]``: arrays (rows, columns), the fields of :class:`Calibration`."""

    rest_ohm: Annotated[list[_Line], Field(min_length=1, max_length=MOST_LINES)]
    gain: Annotated[list[_Line], Field(max_length=MOST_LINES)]
    gain_std: Annotated[list[_LineOrZeros], Field(max_length=MOST_LINES)]
    rest_std_kpa: Annotated[list[_LineOrZeros], Field(max_length=MOST_LINES)]
    residual_kpa: Annotated[list[_LineOrZeros], Field(max_length=MOST_LINES)]
    calibrated: Annotated[list[_Flags], Field(max_length=MOST_LINES)]

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        rows, columns = len(self.rest_ohm), len(self.rest_ohm[0])
        for name in type(self).model_fields:
            lines = getattr(self, name)
            if len(lines) != rows or any(len(line) != columns for line in lines):
                raise ValueError(f"'{name}' is no array of {rows} lines with {columns} values each, as 'rest_ohm' is")
        return self


class _File(Section):
    """The contents of a calibration file."""

    format: Annotated[int, Field(ge=FORMAT, le=FORMAT)]
    hash: _Text
    date: _Text
    serial_number: _Text
    design_hash: _Text
    cell_hash: _Text
    loads_kpa: Annotated[list[Positive], Field(max_length=1000)]
    presses: Annotated[int, Field(ge=0)]
    remarks: Annotated[list[_Text], Field(max_length=1000)]
    cells: _Cells


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Rest resistances and gains of a skin's cells. Arrays are (rows, columns)."""

    rest_ohm: FloatArray
    """R0 of each cell"""
    gain: FloatArray
    """pressure on the cell over the pressure that the common cell model gives"""
    gain_std: FloatArray
    """relative standard deviation of ``gain``: by the scatter of presses on one cell, and by errors not measured"""
    rest_std_kpa: FloatArray
    """standard deviation of the pressure by the uncertainty of R0"""
    residual_kpa: FloatArray
    """rms difference between the loads of the calibration and the pressures of the calibrated cell"""
    calibrated: BoolArray
    """False for a cell that could not be calibrated: it gets the median gain of the others, and their scatter"""
    loads_kpa: tuple[float, ...]
    """pressures on the cells during the calibration, each once, in rising order"""
    presses: int
    """number of presses that were used"""
    serial_number: str
    """of the board; empty if the board does not send one"""
    design_hash: str
    """:func:`fingerprint` of the design whose inverse gave the resistances"""
    cell_hash: str
    """:func:`fingerprint` of the common cell"""
    date: str
    """UTC, ISO 8601"""
    remarks: tuple[str, ...] = ()
    """signs against the calibration; one with remarks was accepted nevertheless"""

    def __repr__(self) -> str:
        """Size, gains, resistances, loads, date and board in one line, without the arrays."""
        rows, columns = self.shape
        gain, rest_ohm = self.gain[self.calibrated], self.rest_ohm[self.calibrated]
        range_of = f", gains {gain.min():.3g} to {gain.max():.3g}" if gain.size else ""
        typical = f", typically {np.median(rest_ohm):.6g} ohm at rest" if gain.size else ""
        loads = ", ".join(f"{load:.4g}" for load in self.loads_kpa)
        board = f"; board {printable(self.serial_number)}" if self.serial_number else ""
        accepted = f"; {count_of(len(self.remarks), 'remark')}" if self.remarks else ""
        return (
            f"<Calibration of {rows} x {columns} cells: {gain.size} calibrated{range_of}{typical}; "
            f"{self.presses} presses at {shortened(loads)} kPa; {printable(self.date)}{board}{accepted}>"
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)"""
        rows, columns = self.rest_ohm.shape
        return rows, columns

    @property
    def hash(self) -> str:
        """SHA-256 of all values, in hexadecimal."""
        return fingerprint(self._values())

    def applied(self, pressure_kpa: FloatArray) -> FloatArray:
        """Pressures (rows, columns) in kPa of these cells, from those of the common model."""
        return self.gain * pressure_kpa

    def applied_std(self, pressure_kpa: FloatArray, std_kpa: FloatArray) -> FloatArray:
        """Standard deviations (rows, columns) in kPa of :meth:`applied`, from those of the common model.

        Three independent errors add up: of the estimate (times the gain), of the gain (times the pressure), and of R0.
        """
        pressure = self.gain * pressure_kpa
        variance = (self.gain * std_kpa) ** 2 + (self.gain_std * pressure) ** 2 + self.rest_std_kpa**2
        std: FloatArray = np.sqrt(variance)
        return std

    def check_board(self, design: Design, cell: Cell | None, serial_number: str) -> None:
        """Raises InputError if the calibration is of another board or cell."""
        rows, columns = self.shape
        if (rows, columns) != design.array.shape:
            here = "{} x {}".format(*design.array.shape)
            raise InputError(f"a calibration of {rows} x {columns} cells; this skin has {here}")
        if self.serial_number and serial_number and self.serial_number != serial_number:
            raise InputError(f"a calibration of board {self.serial_number}; this is board {serial_number}")
        if self.design_hash != fingerprint(design):
            raise InputError("a calibration made with another design of the readout; calibrate again with this one")
        if cell is None:
            raise InputError("a calibration needs the data of the cell, and this board does not tell it; give cell=")
        if self.cell_hash != fingerprint(cell):
            raise InputError("a calibration made with other data of the cell; calibrate again with these")

    def as_toml(self) -> str:
        """The content of a calibration file."""
        values = self._values()
        cells = values.pop("cells")
        lines = [f"{name} = {_matrix(array)}\n" for name, array in cells.items()]
        head = tomli_w.dumps({"format": FORMAT, "hash": self.hash, **values})
        return f"{HEAD}{head}\n[cells]\n{''.join(lines)}"

    def save(self, path: str | Path) -> None:
        """Write a TOML file, whole or not at all; InputError if that fails."""
        write_text(path, self.as_toml())

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a file of :meth:`save`.

        Raises:
            InputError: the file cannot be read, is no calibration, or has been edited.

        """
        return cls._read(read_toml(path), str(path))

    @classmethod
    def from_toml(cls, text: str, source: str) -> Calibration:
        """Read a text of :meth:`as_toml`; ``source`` is for messages. Raises InputError."""
        return cls._read(parse_toml(text, source), source)

    @classmethod
    def _read(cls, tables: Mapping[str, Any], source: str) -> Calibration:
        file = parse(tables, _File, source=source)
        found = cls(
            **{name: np.array(getattr(file.cells, name)) for name in _Cells.model_fields},
            loads_kpa=tuple(map(float, file.loads_kpa)),
            presses=file.presses,
            serial_number=file.serial_number,
            design_hash=file.design_hash,
            cell_hash=file.cell_hash,
            date=file.date,
            remarks=tuple(file.remarks),
        )
        if found.hash != file.hash:
            raise InputError(f"{source}: has been edited: its values do not have the hash that it states")
        return found

    def _values(self) -> dict[str, Any]:
        """All values that the hash covers, as lists and plain values."""
        return {
            "date": self.date,
            "serial_number": self.serial_number,
            "design_hash": self.design_hash,
            "cell_hash": self.cell_hash,
            "loads_kpa": list(self.loads_kpa),
            "presses": self.presses,
            "remarks": list(self.remarks),
            "cells": {name: getattr(self, name).tolist() for name in _Cells.model_fields},
        }


def _matrix(lines: list[list[float]]) -> str:
    """A TOML array of arrays, a row of cells on a line."""
    rows = (", ".join(map(_toml_value, line)) for line in lines)
    return "[\n" + "".join(f"    [{row}],\n" for row in rows) + "]"


def _toml_value(value: float) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)
