"""The tables of DESIGN.toml except ``[readout]``: each part with its unit, limits and default.

Parts that a file does not name are ideal. :mod:`._readout` has the table ``[readout]``, and :mod:`._design` the whole
file.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, PlainValidator, model_validator

from ..common.config import LEAST_SI, MOST_SI, Finite, NotNegative, Positive, Section
from ..common.constants import ZERO_CELSIUS
from ._spread import Spreadable

LEAST_DRIVE_V, MOST_V, LEAST_REFERENCE_OHM = 1e-6, 1e4, 1e-6
"""Limits far beyond any board. Within these limits an offset is at most 1e16 times the signal of a cell of 1 ohm, so
that the solvers can distinguish a finite output from that of a short."""

COLDEST_K = 150.0
"""The project's own limit, below every skin and above every temperature that may be meant in degrees Celsius."""

FaultKind = Literal["open-cell", "shorted-cell", "broken-row", "broken-column", "bridged-rows", "bridged-columns"]


def _per_line(expected: str, allowed: Callable[[float], bool]) -> PlainValidator:
    """A number for all lines, or a list of one per line; its length is checked by :class:`Design`."""

    def check(value: object) -> float | tuple[float, ...]:
        for number in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(number, bool) or not isinstance(number, (int, float)) or not allowed(number):
                raise ValueError(f"must be {expected}, or a list of one such number per line")
        return tuple(map(float, value)) if isinstance(value, (list, tuple)) else float(value)  # type: ignore[arg-type]  # checked above

    return PlainValidator(check)


def in_kelvin(value: float) -> float:
    """The value, unless it is so low that it must be in another unit. Raises ValueError."""
    if value < COLDEST_K:
        raise ValueError(f"expected K, from {COLDEST_K:g} K up: {value:g} °C is {value + ZERO_CELSIUS:g} K")
    return value


Kelvin = Annotated[float, Field(le=MOST_SI, allow_inf_nan=False), AfterValidator(in_kelvin)]
Volts = Annotated[float, Field(ge=-MOST_V, le=MOST_V, allow_inf_nan=False)]
PerLine = float | tuple[float, ...]
Ohms = Annotated[
    PerLine, _per_line(f"a number of ohm, 0 or at least {LEAST_SI:g}", lambda x: x == 0 or LEAST_SI <= x <= MOST_SI)
]
PositiveOhms = Annotated[
    PerLine,
    _per_line(f"a number of ohm > 0, at least {LEAST_REFERENCE_OHM:g}", lambda x: LEAST_REFERENCE_OHM <= x <= MOST_SI),
]
Gains = Annotated[PerLine, _per_line("a number >= 1 (or inf)", lambda x: 1 <= x <= MOST_SI or x == inf)]
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
    """Geometry and discretisation of the continuous sheet (:mod:`._sheet`). The defaults are the project's own: cells
    on a 1 inch pitch, 1/8 inch thick, under strips of 3/4 inch.
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
            usual = "" if "electrode_width" in self.model_fields_set else " (left out; name it as well)"
            raise ValueError(f"electrode_width {self.electrode_width} m{usual} exceeds the pitch {self.pitch} m")
        return self


class Drive(Spreadable):
    """Drive of the selected line, and state of the idle driven lines."""

    PARTS: ClassVar[tuple[str, ...]] = ("voltage",)

    voltage: Volts
    """V, selected row against the reference"""
    idle_rows: Literal["ground", "float", "pull"] = "ground"
    """driven lines that are not selected: at the reference, open, or open with pull-down resistors;
    "voltage-feedback" drives them itself"""
    idle_row_resistance: Annotated[float, Field(ge=LEAST_REFERENCE_OHM)] = inf
    """ohm, idle_rows = "pull" only: from each driven line, where its lead ends, to the reference. The resistor stays
    there while its line is selected"""
    idle_leakage: NotNegative = 0.0
    """A that the switches of an idle line leak into it at most, of either sign; for the verification only"""

    @model_validator(mode="after")
    def _drives(self) -> Self:
        if (self.idle_rows == "pull") != (self.idle_row_resistance < inf):
            raise ValueError(
                'idle_rows = "pull" needs idle_row_resistance in ohm'
                if self.idle_rows == "pull"
                else f'idle_row_resistance has no effect with idle_rows = "{self.idle_rows}"; expected "pull"'
            )
        if abs(self.voltage) < LEAST_DRIVE_V:
            raise ValueError(f"voltage must be at least {LEAST_DRIVE_V:g} V, up or down: nothing would be read")
        return self


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
    gain_error: Annotated[float, Field(gt=-1, le=MOST_SI, allow_inf_nan=False)] = 0.0
    """relative excess of the converter's slope, about the lower end of the range"""
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
    """A known fault at the crosspoint ``place = [row, column]``.

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
        """The two crosspoints that a bridge connects."""
        row, column = self.place
        if self.kind == "bridged-rows":
            return self.place, (row + 1 if self.to is None else self.to, column)
        return self.place, (row, column + 1 if self.to is None else self.to)


class Requirements(Section):
    """Limits that the design must keep to pass `ohmskin verify`; the defaults are the project's own."""

    crosstalk_percent: Positive = 2.0
    """largest change of an untouched cell's reading, in % of that reading"""
    reading_error_percent: Positive = 5.0
    """largest error, in %, of a resistance by equation (10) from an uncalibrated reading"""
    pressure_rmse_percent: Positive = 5.0
    """largest RMS error of the pressure estimate, in % of full scale"""
    output_current: Positive = 5e-3
    """A that an amplifier's output delivers at most"""
    driver_current: Positive = 10e-3
    """A that the driver of a selected line delivers at most"""


class Cells(Spreadable):
    """Range of the cells' resistances, for the verification; a CELL.toml describes the cells in full."""

    PARTS: ClassVar[tuple[str, ...]] = ("rest_resistance",)

    rest_resistance: Positive
    """ohm of an untouched cell; its spread is that of the whole cell, pressed or not"""
    full_scale_resistance: Positive
    """ohm under full-scale pressure"""
    full_scale_kpa: Positive | None = None
    """kPa; None: quantities in kPa cannot be computed"""

    @model_validator(mode="after")
    def _changes(self) -> Self:
        if self.rest_resistance == self.full_scale_resistance:
            raise ValueError("full_scale_resistance equals rest_resistance: such a cell measures nothing")
        return self


class Operation(Section):
    """Operating conditions under which the verification judges the design."""

    frame_rate: Annotated[float, Field(gt=0, le=1e6)] | None = None
    """Hz: frames of all rows"""
    baudrate: Annotated[float, Field(gt=0, le=1e12)] | None = None
    """bit/s of the link to the host, start and stop bits included"""
    temperature_range: Annotated[tuple[Kelvin, Kelvin], Field(strict=False)] | None = None
    """K, lowest and highest ambient temperature; None: 298.15 K only"""
    readings_per_calibration: Annotated[int, Field(ge=1)] = 20
    """frames of the untouched skin that the driver averages when it is tared"""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.temperature_range is not None and not self.temperature_range[0] <= self.temperature_range[1]:
            raise ValueError(f"temperature_range must be [lowest, highest] in K, got {list(self.temperature_range)}")
        return self
