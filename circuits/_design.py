"""DESIGN.toml: the array, its drive, its readout and its ADC. Everything not named is ideal."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field, PlainValidator, model_validator

from ..arrays import FloatArray
from ..config import LEAST, MOST, Finite, NotNegative, Positive, Section, load
from ..errors import InputError
from ._amplifier_model import AmplifierModel
from ._board import Board
from ._requirement import Requirement
from ._spread import Spread, Spreadable
from .readouts import CIRCUITS

LEAST_DRIVE_V, MOST_V, LEAST_REFERENCE_OHM = 1e-6, 1e4, 1e-6
"""Limits far beyond any board. Within them an offset is at most 1e16 times what the drive makes of 1 ohm, so that the
solvers do not take a finite output for that of a short."""


def _known_circuit(name: str) -> str:
    if name not in CIRCUITS:
        raise ValueError(f"unknown circuit; expected one of {', '.join(map(repr, CIRCUITS))}")
    return name


Circuit = Annotated[str, AfterValidator(_known_circuit)]

FaultKind = Literal["open-cell", "shorted-cell", "broken-row", "broken-column", "bridged-rows", "bridged-columns"]


def _per_line(expected: str, allowed: Callable[[float], bool]) -> PlainValidator:
    """A number for all lines, or a list of one per line; its length is checked by :class:`Design`."""

    def check(value: object) -> float | tuple[float, ...]:
        for number in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(number, bool) or not isinstance(number, (int, float)) or not allowed(number):
                raise ValueError(f"must be {expected}, or a list of one such number per line")
        return tuple(map(float, value)) if isinstance(value, (list, tuple)) else float(value)  # type: ignore[arg-type]  # checked above

    return PlainValidator(check)


Volts = Annotated[float, Field(ge=-MOST_V, le=MOST_V, allow_inf_nan=False)]
PerLine = float | tuple[float, ...]
Ohms = Annotated[PerLine, _per_line("a number of ohm >= 0", lambda x: 0 <= x <= MOST)]
PositiveOhms = Annotated[
    PerLine,
    _per_line(f"a number of ohm > 0, at least {LEAST_REFERENCE_OHM:g}", lambda x: LEAST_REFERENCE_OHM <= x <= MOST),
]
Gains = Annotated[PerLine, _per_line("a number >= 1 (or inf)", lambda x: 1 <= x <= MOST or x == inf)]
Numbers = Annotated[PerLine, _per_line(f"a finite number of at most {MOST_V:g} V or A", lambda x: abs(x) <= MOST_V)]


class Array(Spreadable):
    """The passive grid. Column j's line starts at row 0 and its amplifier follows row N-1;
    row i is driven at column 0. Each resistance is one number, or a list of one per line.
    """

    PARTS: ClassVar[tuple[str, ...]] = ("row_lead", "row_segment", "column_lead", "column_segment")

    rows: Annotated[int, Field(ge=1, le=1024)]
    columns: Annotated[int, Field(ge=1, le=1024)]
    row_segment: Ohms = 0.0
    """ohm between neighbouring crosspoints of a row line"""
    column_segment: Ohms = 0.0
    row_lead: Ohms = 0.0
    """ohm in series with each row line: driver, switch, lead up to its first crosspoint"""
    column_lead: Ohms = 0.0
    """ohm between the last crosspoint of a column line and the amplifier"""
    sheet: Literal["sliced", "continuous"] = "sliced"
    """cut between the cells, or in one piece that conducts from cell to cell"""

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns


class Sheet(Section):
    """The continuous sheet's geometry and how finely it is cut; see :mod:`._sheet`. The defaults are the project's own:
    cells on a 1 inch pitch, 1/8 inch thick, under strips of 3/4 inch.
    """

    pitch: Positive = 0.0254
    """m"""
    thickness: Positive = 0.003175
    """m"""
    electrode_width: Positive = 0.01905
    """m, of a row's or column's strip"""
    divisions: Annotated[int, Field(ge=2, le=32)] = 8
    """boxes along a cell's side"""
    layers: Annotated[int, Field(ge=1, le=16)] = 2
    """boxes through the thickness"""

    @model_validator(mode="after")
    def _apart(self) -> Self:
        if self.electrode_width > self.pitch:
            raise ValueError(f"electrode_width {self.electrode_width} m exceeds the pitch {self.pitch} m")
        return self


class Drive(Spreadable):
    """What the rows are driven with."""

    PARTS: ClassVar[tuple[str, ...]] = ("voltage",)

    voltage: Volts
    """V, selected row against the reference"""
    idle_rows: Literal["ground", "float"] = "ground"
    """driven lines that are not selected: at the reference, or open; "voltage-feedback" drives them itself"""

    @model_validator(mode="after")
    def _drives(self) -> Self:
        if abs(self.voltage) < LEAST_DRIVE_V:
            raise ValueError(f"voltage must be at least {LEAST_DRIVE_V:g} V, up or down: nothing would be read")
        return self


class Readout(Spreadable):
    """What each sensed line ends in. Keys of a single line's parts take one number, or a list of one per line.

    ======================  =========================================================================================
    inverting-amplifier     a transimpedance amplifier on each column; rows are driven
    row-amplifier           a transimpedance amplifier on each row; columns are driven
    voltage-divider         a load on each column; rows are driven
    voltage-feedback        a divider whose sensed column feeds a follower, which drives all idle rows and columns;
                            the follower's output is read
    ======================  =========================================================================================
    """

    PARTS: ClassVar[tuple[str, ...]] = (
        "reference_resistance",
        "reference_voltage",
        "open_loop_gain",
        "gain_bandwidth",
        "offset_voltage",
        "bias_current",
        "column_capacitance",
        "feedback_capacitance",
    )

    circuit: Circuit
    reference_resistance: PositiveOhms
    """ohm: Rref, or the divider's load"""
    reference_voltage: Volts = 0.0
    """V: non-inverting input and idle rows (single-supply boards)"""
    open_loop_gain: Gains = inf
    gain_bandwidth: Annotated[float, Field(ge=LEAST)] = inf
    """Hz"""
    offset_voltage: Numbers = 0.0
    """V, added to the non-inverting input"""
    bias_current: Numbers = 0.0
    """A, into the input that the column is tied to"""
    supply: Annotated[tuple[float, float], Field(strict=False)] = (-inf, inf)
    """V, output swing"""
    idle_columns: Literal["float", "load"] = "float"
    """"voltage-divider" only: what the columns that are not being read end in"""
    column_capacitance: NotNegative = 0.0
    """F, from each inverting input to ground: column line and amplifier"""
    feedback_capacitance: NotNegative = 0.0
    """F, across Rref"""
    voltage_noise: NotNegative = 0.0
    """V/sqrt(Hz), of each amplifier"""
    current_noise: NotNegative = 0.0
    """A/sqrt(Hz), at each inverting input"""
    temperature: NotNegative = 0.0
    """K, of all resistors, for their noise; 0: they have none"""
    amplifier_model: Annotated[AmplifierModel | None, Field(exclude=True)] = None
    """the maker's macro-model, for SPICE netlists in time; boards do not send it"""

    @model_validator(mode="after")
    def _swing(self) -> Self:
        low, high = self.supply
        if not low < high:
            raise ValueError(f"supply must be [lowest, highest] output in V, got [{low}, {high}]")
        if not low <= self.reference_voltage <= high:
            raise ValueError(f"reference_voltage {self.reference_voltage} V lies outside supply [{low}, {high}] V")
        return self


PER_LINE = ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")


class Adc(Spreadable):
    """The converter behind the column outputs."""

    PARTS: ClassVar[tuple[str, ...]] = ("offset_voltage", "gain_error", "inl_steps")

    bits: Annotated[int, Field(ge=1, le=32)]
    range: Annotated[tuple[Finite, Finite], Field(strict=False)]
    """V at code 0 and at full scale"""
    sampling_capacitance: NotNegative = 0.0
    """F"""
    switch_resistance: NotNegative = 0.0
    """ohm, between an output and the sampling capacitor"""
    acquisition_time: NotNegative = 0.0
    """s that one sampling capacitor spends on each column in turn; 0: each column has its own, always connected"""
    offset_voltage: Finite = 0.0
    """V that the converter adds to its input"""
    gain_error: Annotated[float, Field(gt=-1, le=MOST, allow_inf_nan=False)] = 0.0
    """by which its slope exceeds 1, about the lower end of the range"""
    inl_steps: Finite = 0.0
    """integral nonlinearity in steps: a bow, largest at mid-range and 0 at both ends"""

    @model_validator(mode="after")
    def _span(self) -> Self:
        if not self.range[0] < self.range[1]:
            raise ValueError(f"range must be [lowest, highest] input in V, got {list(self.range)}")
        return self

    @property
    def step(self) -> float:
        """V of one code."""
        return (self.range[1] - self.range[0]) / 2.0**self.bits


class Fault(Section):
    """One thing that is broken, at the crosspoint ``place = [row, column]``.

    ========================  ==================================================================================
    open-cell                 ``resistance`` (default inf) in series with the cell
    shorted-cell              ``resistance`` (default 0) across the cell
    broken-row                ``resistance`` (default inf) in series with the row line, just ahead of the crosspoint
                              as seen from the driver
    broken-column             the same in the column line, between the crosspoint and its amplifier
    bridged-rows              ``resistance`` (default 0) from the crosspoint's row line to row ``to`` (default: the
                              next one), at the place's column
    bridged-columns           the same between column lines, at the place's row
    ========================  ==================================================================================
    """

    kind: FaultKind
    place: Annotated[tuple[int, int], Field(strict=False)]
    resistance: Annotated[float | None, Field(ge=0)] = None
    """ohm"""
    to: Annotated[int | None, Field(ge=0)] = None
    """bridges only: the other line"""

    @model_validator(mode="after")
    def _only_bridges_lead_somewhere(self) -> Self:
        if self.to is not None and not self.bridge:
            raise ValueError(f"a fault of kind '{self.kind}' has no key 'to'; only bridges join another line")
        return self

    @property
    def bridge(self) -> bool:
        return self.kind in {"bridged-rows", "bridged-columns"}

    @property
    def ohms(self) -> float:
        """The resistance given, or that of a complete fault of its kind."""
        if self.resistance is not None:
            return self.resistance
        return 0.0 if self.bridge or self.kind == "shorted-cell" else inf

    @property
    def ends(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """The crosspoints that a bridge joins lines at."""
        row, column = self.place
        if self.kind == "bridged-rows":
            return self.place, (row + 1 if self.to is None else self.to, column)
        return self.place, (row, column + 1 if self.to is None else self.to)


class Requirements(Section):
    """What the design must keep for `ohmskin verify` to pass it; the defaults are the project's own."""

    crosstalk_percent: Positive = 2.0
    """largest change of an untouched cell's reading, in % of that reading"""
    reading_error_percent: Positive = 5.0
    """largest error of a resistance that equation (10) makes of an uncalibrated reading"""
    pressure_rmse_percent: Positive = 5.0
    """largest RMS error of the pressure estimate, in % of full scale"""


class Cells(Spreadable):
    """The resistances that the cells take, for the verification; a CELL.toml says more."""

    PARTS: ClassVar[tuple[str, ...]] = ("rest_resistance",)

    rest_resistance: Positive
    """ohm of an untouched cell; its spread is that of the whole cell, pressed or not"""
    full_scale_resistance: Positive
    """ohm under full-scale pressure"""
    full_scale_kpa: Positive | None = None
    """kPa; None: quantities in kPa are not known"""

    @model_validator(mode="after")
    def _changes(self) -> Self:
        if self.rest_resistance == self.full_scale_resistance:
            raise ValueError("full_scale_resistance equals rest_resistance: such a cell measures nothing")
        return self


class Operation(Section):
    """How the board is run; the verification judges the design under these conditions."""

    frame_rate: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """Hz: frames of all rows"""
    baudrate: Annotated[float, Field(gt=0, le=1e12)] | None = None
    """bit/s of the link to the host, start and stop bits included"""
    temperature_range: Annotated[tuple[NotNegative, NotNegative], Field(strict=False)] | None = None
    """K, lowest and highest ambient temperature; None: 298.15 K only"""
    readings_per_calibration: Annotated[int, Field(ge=1)] = 20
    """frames of the untouched skin that the driver averages when it is tared"""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.temperature_range is not None and not self.temperature_range[0] <= self.temperature_range[1]:
            raise ValueError(f"temperature_range must be [lowest, highest] in K, got {list(self.temperature_range)}")
        return self


class Design(Section):
    """A complete readout design. ``Design.load("design.toml")``."""

    array: Array
    drive: Drive
    readout: Readout
    adc: Adc | None = None
    """None: the column outputs are taken as they are"""
    sheet: Sheet = Sheet()
    """geometry of the material, if array.sheet is "continuous"; a sliced one needs none"""
    fault: Annotated[tuple[Fault, ...], Field(strict=False)] = ()
    requirements: Requirements = Requirements()
    requirement: Annotated[tuple[Requirement, ...], Field(strict=False, exclude=True)] = ()
    """of the verification only; a board does not send them"""
    cells: Cells | None = None
    """None: as a CELL.toml says, or the shipped example cell"""
    operation: Operation = Operation()

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

    @classmethod
    def load(cls, path: str | Path) -> Design:
        """Read DESIGN.toml; InputError with one located message if it is not a valid design."""
        design = load(path, cls)
        model = design.readout.amplifier_model
        if model is None:
            return design
        return design.replace(readout={"amplifier_model": model.read(Path(path).parent)})

    @property
    def spreads(self) -> dict[str, Spread]:
        """How far each part may lie from its nominal value, by section and key: ``"readout.offset_voltage"``."""
        found: dict[str, Spread] = {}
        for name in ("array", "drive", "readout", "adc", "cells"):
            section = getattr(self, name)
            if section is not None:
                found |= {f"{name}.{key}": spread for key, spread in section.spread.items()}
        return found

    def with_circuit(self, circuit: str) -> Design:
        """The same array and parts read by another circuit."""
        return self.replace(readout={"circuit": circuit})

    @cached_property
    def board(self) -> Board:
        """The design expanded into arrays, once."""
        return Board.of(self, CIRCUITS[self.readout.circuit])

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
