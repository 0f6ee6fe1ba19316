"""DESIGN.toml: the array, its drive, its readout and its ADC. Everything not named is ideal."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from ..config import Section, load
from ..errors import InputError

Ohm = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
FloatArray = NDArray[np.float64]

Circuit = Literal["inverting-amplifier", "voltage-divider"]
CIRCUITS: tuple[str, ...] = get_args(Circuit)


class Array(Section):
    """The passive grid. Column j's line starts at row 0 and its amplifier follows row N-1;
    row i is driven at column 0.
    """

    rows: Annotated[int, Field(ge=1, le=1024)]
    columns: Annotated[int, Field(ge=1, le=1024)]
    row_segment: Ohm = 0.0
    """ohm between neighbouring crosspoints of a row line"""
    column_segment: Ohm = 0.0
    row_lead: Ohm = 0.0
    """ohm in series with each row line: driver, switch, lead up to its first crosspoint"""
    column_lead: Ohm = 0.0
    """ohm between the last crosspoint of a column line and the amplifier"""
    sheet: Literal["sliced", "continuous"] = "sliced"

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns


class Drive(Section):
    """What the rows are driven with."""

    voltage: Finite
    """V, selected row against the reference"""
    idle_rows: Literal["ground", "float"] = "ground"

    @model_validator(mode="after")
    def _drives(self) -> Self:
        if self.voltage == 0:
            raise ValueError("voltage must not be 0: nothing would be read")
        return self


class Readout(Section):
    """What each column ends in."""

    circuit: Circuit
    reference_resistance: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    """ohm: Rref, or the divider's load"""
    reference_voltage: Finite = 0.0
    """V: non-inverting input and idle rows (single-supply boards)"""
    open_loop_gain: Annotated[float, Field(ge=1)] = inf
    gain_bandwidth: Annotated[float, Field(gt=0)] = inf
    """Hz"""
    offset_voltage: Finite = 0.0
    """V, added to the non-inverting input"""
    bias_current: Finite = 0.0
    """A, into the inverting input"""
    supply: Annotated[tuple[float, float], Field(strict=False)] = (-inf, inf)
    """V, output swing"""
    idle_columns: Literal["float", "load"] = "float"
    """divider only: what the columns that are not being read end in"""
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

    @model_validator(mode="after")
    def _swing(self) -> Self:
        low, high = self.supply
        if not low < high:
            raise ValueError(f"supply must be [lowest, highest] output in V, got [{low}, {high}]")
        if not low <= self.reference_voltage <= high:
            raise ValueError(f"reference_voltage {self.reference_voltage} V lies outside supply [{low}, {high}] V")
        return self


class Adc(Section):
    """The converter behind the column outputs."""

    bits: Annotated[int, Field(ge=1, le=32)]
    range: Annotated[tuple[Finite, Finite], Field(strict=False)]
    """V at code 0 and at full scale"""
    sampling_capacitance: NotNegative = 0.0
    """F"""
    switch_resistance: NotNegative = 0.0
    """ohm, between an output and the sampling capacitor"""
    acquisition_time: NotNegative = 0.0
    """s that one sampling capacitor spends on each column in turn; 0: each column has its own, always connected"""

    @model_validator(mode="after")
    def _span(self) -> Self:
        if not self.range[0] < self.range[1]:
            raise ValueError(f"range must be [lowest, highest] input in V, got {list(self.range)}")
        return self

    @property
    def step(self) -> float:
        """V of one code."""
        return (self.range[1] - self.range[0]) / 2.0**self.bits


class Requirements(Section):
    """What the design must keep for `ohmskin verify` to pass it; the defaults are the project's own."""

    crosstalk_percent: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    """largest change of an untouched cell's reading, in % of that reading"""
    reading_error_percent: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 5.0
    """largest error of a resistance that equation (10) makes of an uncalibrated reading"""
    pressure_rmse_percent: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 5.0
    """largest RMS error of the pressure estimate, in % of full scale"""


class Design(Section):
    """A complete readout design. ``Design.load("design.toml")``."""

    array: Array
    drive: Drive
    readout: Readout
    adc: Adc | None = None
    """None: the column outputs are taken as they are"""
    requirements: Requirements = Requirements()

    @classmethod
    def load(cls, path: str | Path) -> Design:
        """Read DESIGN.toml; InputError with one located message if it is not a valid design."""
        return load(path, cls)

    def with_circuit(self, circuit: str) -> Design:
        """The same array and parts read by another circuit."""
        readout = self.readout.model_dump() | {"circuit": circuit}
        return self.model_copy(update={"readout": Readout.model_validate(readout)})

    def resistance(self, cells: ArrayLike) -> FloatArray:
        """``cells`` as a checked (rows, columns) array in ohm; inf is an open cell, 0 a short.

        Raises:
            InputError: wrong shape, NaN or negative entries.

        """
        try:
            resistance = np.asarray(cells, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"cell resistances are not numbers: {error}") from error
        if resistance.shape != self.array.shape:
            raise InputError(
                f"cell resistances have shape {resistance.shape}, expected {self.array.shape} (rows, columns)"
            )
        bad = ~(resistance >= 0)
        if bad.any():
            row, column = np.argwhere(bad)[0]
            raise InputError(
                f"cell resistance at row {row}, column {column} is {resistance[row, column]}; "
                "expected ohm >= 0 (inf = open, 0 = short)"
            )
        return resistance
