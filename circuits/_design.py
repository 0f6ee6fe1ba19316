"""DESIGN.toml: the array, its drive, its readout and its ADC. Everything not named is ideal."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from ..common.arrays import FloatArray
from ..common.config import OWN_TABLES, Section, load
from ..common.geometry import Geometry
from ..errors import InputError
from ._board import Board
from ._parts_list import BoughtParts, Document
from ._readout import PER_LINE, Readout
from ._requirement import Requirement
from ._sections import Adc, Array, Cells, Drive, Fault, Operation, Requirements, Sheet
from ._shape import Shape
from ._spread import Spread
from .ends import ColumnEnd, Crosspoint, Reference, RowEnd, Scan
from .readouts import CIRCUITS

_SAID_BY_COLUMN_END = (
    *("open_loop_gain", "gain_bandwidth", "offset_voltage", "bias_current", "supply", "columns", "idle_columns"),
    *("feedback_capacitance", "voltage_noise", "current_noise", "amplifier_model"),
)
_NETWORKS = ("row_end", "column_end", "reference", "crosspoint")
_SAID_BY_IDLE_ROW = ("idle_rows", "idle_row_resistance")


class Design(Section):
    """A complete readout design. ``Design.load("design.toml")``."""

    array: Array
    drive: Drive
    readout: Readout
    adc: Adc | None = None
    """None: the column outputs are not converted"""
    sheet: Sheet = Sheet()
    """geometry of the material, if array.sheet is "continuous"; a sliced one needs none"""
    shape: Shape | None = None
    """where the cells are; None: a rectangle with ``sheet.pitch``"""
    fault: Annotated[tuple[Fault, ...], Field(strict=False)] = ()
    requirements: Requirements = Requirements()
    requirement: Annotated[tuple[Requirement, ...], Field(strict=False, exclude=True), OWN_TABLES] = ()
    """for the verification only; a board does not send them, and may not"""
    document: Annotated[Document, Field(exclude=True), OWN_TABLES] = Document()
    """of the verification's report; a board does not send it, and may not"""
    parts: Annotated[BoughtParts, Field(exclude=True), OWN_TABLES] = BoughtParts()
    """part numbers and ratings, likewise"""
    cells: Cells | None = None
    """None: as in a CELL.toml, or as the shipped example cell"""
    operation: Operation = Operation()
    row_end: RowEnd | None = None
    """networks at the rows; None: as ``[drive]`` says"""
    column_end: ColumnEnd | None = None
    """networks at the columns; None: as ``[readout]`` says"""
    reference: Reference | None = None
    """network at the node ``ref``; None: a stiff source of ``readout.reference_voltage``"""
    crosspoint: Crosspoint | None = None
    """network between each row and its cells; None: nothing"""
    scan: Scan | None = None
    """None: the verification asks for a constant row period"""

    @model_validator(mode="before")
    @classmethod
    def _described(cls, given: Any) -> Any:
        """Sections that say nothing beside described ends may be left out."""
        if not isinstance(given, Mapping):
            return given
        usual: dict[str, Any] = {}
        if given.get("row_end"):
            usual["drive"] = {"voltage": 1.0}
        if given.get("column_end"):
            usual["readout"] = {"circuit": "voltage-divider", "reference_resistance": 1.0}
        filled = {
            key: table | given[key] if isinstance(given.get(key), Mapping) else given.get(key, table)
            for key, table in usual.items()
        }
        return {**given, **filled}

    @model_validator(mode="after")
    def _fits(self) -> Self:
        rows, columns = self.array.shape
        keys = [("array.row_segment", self.array.row_segment, rows), ("array.row_lead", self.array.row_lead, rows)]
        keys += [(f"array.{name}", getattr(self.array, name), columns) for name in ("column_segment", "column_lead")]
        sensed_rows = CIRCUITS[self.readout.circuit].senses == "rows"
        sensed = rows if sensed_rows else columns
        keys += [(f"readout.{name}", getattr(self.readout, name), sensed) for name in PER_LINE]
        for key, value, lines in keys:
            if isinstance(value, tuple) and len(value) != lines:
                by_row = sensed_rows if key.startswith("readout") else key.startswith("array.row")
                line = "row" if by_row else "column"
                raise ValueError(f"{key} has {len(value)} entries, expected one number or {lines} (one per {line})")
        if self.shape is not None:
            self.shape.refuse_beyond(self.array.shape)
        self._refuse_ties_to_nothing()
        self._refuse_keys_beside_networks()
        self._refuse_keys_without_effect()
        for number, fault in enumerate(self.fault):
            for row, column in fault.ends if fault.bridge else [fault.place]:
                if not (0 <= row < rows and 0 <= column < columns):
                    raise ValueError(
                        f"fault[{number}] ({fault.kind}) reaches row {row}, column {column}; "
                        f"the array has rows 0 to {rows - 1} and columns 0 to {columns - 1}"
                    )
            if fault.bridge and fault.ends[0] == fault.ends[1]:
                raise ValueError(
                    f"fault[{number}] ({fault.kind}) joins a line to itself; expected another line in 'to'"
                )
        return self

    def _refuse_ties_to_nothing(self) -> None:
        for key, spread in self.spreads.items():
            if spread.tied_to is None:
                continue
            section, name = spread.tied_to.split(".")
            other = self.spreads.get(spread.tied_to)
            if key == spread.tied_to or (other is not None and other.tied_to is not None):
                raise ValueError(
                    f"{key} is tied to {spread.tied_to}, which follows another part; expected one that leads"
                )
            if not getattr(getattr(self, section), name):
                raise ValueError(f"{key} is tied to {spread.tied_to}, which is 0 V; expected a part to follow")

    def _refuse_keys_beside_networks(self) -> None:
        """Raise ValueError if networks at the lines' ends leave a key without effect, or have none themselves."""
        networks = [name for name, _ in self._networks()]
        if not networks:
            return
        circuit = CIRCUITS[self.readout.circuit]
        if circuit.drives_idle_lines or circuit.senses == "rows":
            raise ValueError(
                f'{networks[0]} has no effect with readout.circuit = "{circuit.name}"; expected a circuit that senses '
                "columns and drives rows only"
            )
        lines = self.array.row_segment, self.array.column_segment
        if self.crosspoint is not None and (any(map(np.any, lines)) or self.fault or self.array.sheet != "sliced"):
            raise ValueError(
                "crosspoint: expected lines without resistance between cells, a sliced sheet and no faults"
            )
        keys: list[tuple[str, str, str]] = []
        if self.column_end is not None:
            keys += [("column_end", "readout", key) for key in _SAID_BY_COLUMN_END]
        if self.row_end is not None:
            keys += [("row_end.idle", "drive", key) for key in _SAID_BY_IDLE_ROW if self.row_end.idle is not None]
        for section, end in self._networks():
            for name, values in end.values.items():
                expected = self._ends_of(section, name)
                if len(values) != expected:
                    raise ValueError(f"{section}.values.{name} has {len(values)} entries, expected {expected}")
        if self.reference is not None:
            keys.append(("reference", "readout", "reference_voltage"))
        for network, section, key in keys:
            table = getattr(self, section)
            if getattr(table, key) != type(table).model_fields[key].default:
                raise ValueError(f"{section}.{key} has no effect beside {network}, which describes the circuit itself")

    def _refuse_keys_without_effect(self) -> None:
        """Raise ValueError if a key about idle lines has no effect on the chosen circuit."""
        readout, circuit = self.readout, CIRCUITS[self.readout.circuit]
        given = f'with readout.circuit = "{circuit.name}"'
        if circuit.drives_idle_lines:
            for key, value, usual in (
                ("drive.idle_rows", self.drive.idle_rows, "ground"),
                ("readout.columns", readout.columns, "parallel"),
                ("readout.idle_columns", readout.idle_columns, "float"),
            ):
                if value != usual:
                    raise ValueError(f'{key} = "{value}" has no effect {given}, which drives all idle lines itself')
        if readout.columns == "multiplexed":
            for key in PER_LINE:
                if isinstance(getattr(readout, key), tuple):
                    raise ValueError(
                        f'readout.{key} has one entry per line, but readout.columns = "multiplexed" shares one part; '
                        "expected one number"
                    )
        elif readout.idle_columns != "float" and circuit.virtual_ground:
            raise ValueError(
                f'readout.idle_columns = "{readout.idle_columns}" has no effect {given} and readout.columns = '
                '"parallel": every line ends in an amplifier of its own; expected columns = "multiplexed", or no '
                "idle_columns"
            )
        elif readout.idle_columns == "ground" and not circuit.drives_idle_lines:
            raise ValueError(
                'readout.idle_columns = "ground" needs readout.columns = "multiplexed": lines that have a load each '
                'cannot be grounded; expected "float" or "load"'
            )

    @classmethod
    def load(cls, path: str | Path) -> Design:
        """Read DESIGN.toml; InputError with one located message if it is not a valid design."""
        return load(path, cls)

    @cached_property
    def geometry(self) -> Geometry:
        """Where the cells are."""
        if self.shape is not None:
            return self.shape.geometry(self.array.shape)
        return Geometry.rectangle(self.array.shape, (self.sheet.pitch, self.sheet.pitch))

    @property
    def spreads(self) -> dict[str, Spread]:
        """Tolerances of the parts, by section and key such as ``"readout.offset_voltage"``."""
        found: dict[str, Spread] = {}
        for name in ("array", "drive", "readout", "adc", "cells"):
            section = getattr(self, name)
            if section is not None:
                found |= {f"{name}.{key}": spread for key, spread in section.spread.items()}
        for name, end in self._networks():
            found |= {f"{name}.{part}": spread for part, spread in end.spreads.items()}
        return found

    @property
    def ages(self) -> bool:
        """Whether a part has another tolerance at the end of its life."""
        return any(any(spread.ageing) for spread in self.spreads.values())

    def _networks(self) -> list[tuple[str, RowEnd | ColumnEnd | Reference | Crosspoint]]:
        """The sections that describe ends of lines, with their names."""
        sections = (self.row_end, self.column_end, self.reference, self.crosspoint)
        return [(name, end) for name, end in zip(_NETWORKS, sections, strict=True) if end is not None]

    def _ends_of(self, section: str, part: str) -> int:
        """How many a board has of one part of a network."""
        if section in {"reference", "crosspoint"}:
            return 1
        if section == "row_end" or self.column_end is None:
            return self.array.rows
        names = {card.name for card in self.column_end.networks["parts"]}
        shared = self.column_end.shared_by if part.rpartition(".")[2] in names and not part.startswith("idle.") else 1
        return -(-self.array.columns // shared)

    @property
    def end_parts(self) -> dict[str, FloatArray]:
        """Nominal values (ends,) of the parts of networks at the lines' ends, by section and name."""
        found: dict[str, FloatArray] = {}
        for section, end in self._networks():
            for part, value in end.nominal.items():
                count = self._ends_of(section, part)
                found[f"{section}.{part}"] = np.array(end.values.get(part, (value,) * count))
        return found

    def with_end_parts(self, values: Mapping[str, ArrayLike]) -> Design:
        """A copy with other values of some of the :attr:`end_parts`."""
        tables: dict[str, dict[str, tuple[float, ...]]] = {}
        for key, each in values.items():
            section, part = key.split(".", 1)
            tables.setdefault(section, dict(getattr(self, section).values))[part] = tuple(np.ravel(each).tolist())
        return self.replace(**{section: {"values": table} for section, table in tables.items()})

    def with_circuit(self, circuit: str) -> Design:
        """A copy of the design with another readout circuit; keys of idle lines that it lacks have their defaults."""
        other = CIRCUITS[circuit]
        drive: dict[str, object] = {}
        readout: dict[str, object] = {"circuit": circuit}
        if other.drives_idle_lines:
            drive = {"idle_rows": "ground", "idle_row_resistance": inf}
            readout |= {"columns": "parallel", "idle_columns": "float"}
        elif other.virtual_ground and self.readout.columns == "parallel":
            readout["idle_columns"] = "float"
        return self.replace(
            drive=drive, readout=readout, row_end=None, column_end=None, reference=None, crosspoint=None
        )

    @cached_property
    def board(self) -> Board:
        """The design expanded into arrays, once."""
        return Board.of(self)

    @cached_property
    def board_by_nodes(self) -> Board:
        """The same board with a network at the end of each line, and no pull-downs or drivers in its grid."""
        return Board.of(self, by_nodes=True)

    @property
    def is_described(self) -> bool:
        """Whether networks describe ends of lines."""
        return bool(self._networks())

    def resistance(self, cells: ArrayLike) -> FloatArray:
        """``cells`` as a checked (rows, columns) array in ohm; inf is an open cell, 0 a short.

        Raises:
            InputError: wrong shape, NaN or negative entries.

        """
        try:
            resistance = np.array(cells, dtype=np.float64)  # a copy: results refer to it later
        except (TypeError, ValueError) as error:
            raise InputError(f"cell resistances are not numbers: {error}") from error
        if resistance.shape != self.array.shape:
            raise InputError(
                f"cell resistances have shape {resistance.shape}, expected {self.array.shape} (rows, columns)"
            )
        if not resistance.min() >= 0:
            row, column = np.argwhere(~(resistance >= 0))[0]
            raise InputError(
                f"cell resistance at row {row}, column {column} is {resistance[row, column]}; "
                "expected ohm >= 0 (inf = open, 0 = short)"
            )
        return resistance
