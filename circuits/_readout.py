"""``[readout]`` of DESIGN.toml: the name of the circuit that reads the sensed lines, and its parts."""

from __future__ import annotations

from math import inf
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ..common.config import LEAST_SI, NotNegative
from ._amplifier_model import AmplifierModel
from ._sections import Gains, Numbers, PositiveOhms, Volts, in_kelvin
from ._spread import Spreadable
from .readouts import CIRCUITS


def _known_circuit(name: str) -> str:
    if name not in CIRCUITS:
        raise ValueError(f"unknown circuit; expected one of {', '.join(map(repr, CIRCUITS))}")
    return name


Circuit = Annotated[str, AfterValidator(_known_circuit)]


class Readout(Spreadable):
    """The circuit at the end of each sensed line. Keys with a value per line take one number, or a list with one each.

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
    gain_bandwidth: Annotated[float, Field(ge=LEAST_SI)] = inf
    """Hz"""
    offset_voltage: Numbers = 0.0
    """V, added to the non-inverting input"""
    bias_current: Numbers = 0.0
    """A, into the input that the column is tied to"""
    supply: Annotated[tuple[float, float], Field(strict=False)] = (-inf, inf)
    """V, output swing"""
    columns: Literal["parallel", "multiplexed"] = "parallel"
    """an amplifier or a load for each sensed line, or one for all of them behind a switch"""
    idle_columns: Literal["float", "ground", "load"] = "float"
    """sensed lines that are not read, of dividers and of multiplexed lines: open, at the reference, or connected to it
    by reference_resistance"""
    column_capacitance: NotNegative = 0.0
    """F, from each inverting input to ground: column line and amplifier"""
    feedback_capacitance: NotNegative = 0.0
    """F, across Rref"""
    voltage_noise: NotNegative = 0.0
    """V/sqrt(Hz), of each amplifier"""
    current_noise: NotNegative = 0.0
    """A/sqrt(Hz), at each inverting input"""
    temperature: Annotated[NotNegative, AfterValidator(lambda kelvin: kelvin and in_kelvin(kelvin))] = 0.0
    """K, of all resistors, for their thermal noise; 0: no thermal noise"""
    amplifier_model: Annotated[AmplifierModel | None, Field(exclude=True)] = None
    """the maker's macro-model, for transient SPICE netlists; boards do not send it"""

    @model_validator(mode="after")
    def _swing(self) -> Self:
        low, high = self.supply
        if not low < high:
            raise ValueError(f"supply must be [lowest, highest] output in V, got [{low}, {high}]")
        if not low <= self.reference_voltage <= high:
            raise ValueError(f"reference_voltage {self.reference_voltage} V lies outside supply [{low}, {high}] V")
        return self


PER_LINE = ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current")
"""keys that take one number, or a list of one per sensed line"""
