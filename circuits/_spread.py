"""Component tolerances: how far a part of a built board may lie from its nominal value.

A part of DESIGN.toml is a number, or a table with its spread::

    reference_resistance = { nominal = 20e3, tolerance = 0.01, matching = 0.001, package = 8 }

The nominal value takes the place of the table, and the spread moves to the section's ``spread``. All code that reads
a design therefore sees numbers; only the verification asks for spreads.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from ..common.config import Finite, NotNegative, Section


class Spread(Section):
    """How the values of one kind of part scatter from line to line and from board to board."""

    tolerance: Annotated[float, Field(ge=0)] = 0.0
    """largest deviation, relative to the nominal value"""
    deviation: NotNegative = 0.0
    """largest deviation in the unit of the part, in addition to ``tolerance``"""
    end_of_life: Annotated[float, Field(ge=0)] | None = None
    """largest relative deviation at the end of the part's life, the initial one included; None: it does not age"""
    end_of_life_deviation: NotNegative | None = None
    """the same in the unit of the part, the initial ``deviation`` included"""
    matching: NotNegative | None = None
    """largest deviation of lines of one package from their common value, relative to the nominal value; None: each line
    deviates on its own by the whole tolerance"""
    package: Annotated[int, Field(ge=1)] | None = None
    """lines that share one package; None: all of them. Only with ``matching``"""
    distribution: Literal["uniform", "normal", "two-point"] = "uniform"
    """within the tolerance; "normal": the tolerance is three standard deviations, parts beyond it are sorted out;
    "two-point": always at one end or the other"""
    temperature_coefficient: Finite = 0.0
    """1/K, relative to the nominal value, which holds at 298.15 K; of offsets, bias currents and converter errors, in
    their own unit per kelvin (V/K, A/K), and on each line of either sign"""
    tied_to: Literal["drive.voltage", "readout.reference_voltage"] | None = None
    """the part that this one follows: its value is multiplied by the other's over the other's nominal value, in
    addition to what its own tolerance does. A converter's gain follows inversely: its reference is the other part"""

    @property
    def ageing(self) -> tuple[float, float]:
        """By how much the largest deviation grows over the part's life: relative, and in the unit of the part."""
        relative = 0.0 if self.end_of_life is None else self.end_of_life - self.tolerance
        return relative, 0.0 if self.end_of_life_deviation is None else self.end_of_life_deviation - self.deviation

    @field_validator("tolerance", "matching", "end_of_life")
    @classmethod
    def _fraction(cls, value: float | None) -> float | None:
        if value is not None and value >= 1:
            raise ValueError(f"expected a fraction below 1 of the nominal value: {value:g} % is {value / 100:g}")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.matching is not None and self.matching > self.tolerance:
            raise ValueError(f"matching {self.matching} exceeds tolerance {self.tolerance}")
        for key, initial in (("end_of_life", "tolerance"), ("end_of_life_deviation", "deviation")):
            if (aged := getattr(self, key)) is not None and aged < getattr(self, initial):
                raise ValueError(f"{key} {aged} is less than the initial {initial} {getattr(self, initial)}")
        if self.package is not None and self.matching is None:
            raise ValueError("package is given without matching; expected how well the lines of one package agree")
        return self


class Spreadable(Section):
    """A section some of whose parts may be tables ``{nominal = ..., tolerance = ...}``."""

    PARTS: ClassVar[tuple[str, ...]] = ()
    """the keys that may have a spread"""

    spread: dict[str, Spread] = Field(default_factory=dict)
    """by key; filled from the tables of the keys themselves"""

    @model_validator(mode="before")
    @classmethod
    def _take_out_spreads(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        tables = dict(given)
        spread = dict(tables.get("spread") or {})
        for key in cls.PARTS:
            part = tables.get(key)
            if not isinstance(part, Mapping):
                continue
            if "nominal" not in part:
                raise ValueError(f"{key}: expected a number, or a table with the key 'nominal'")
            tables[key] = part["nominal"]
            spread[key] = {name: value for name, value in part.items() if name != "nominal"}
        if spread:
            tables["spread"] = spread
        return tables

    @model_validator(mode="after")
    def _known_parts(self) -> Self:
        for key in self.spread:
            if key not in self.PARTS:
                raise ValueError(f"spread.{key}: no such part; expected one of {', '.join(self.PARTS)}")
        return self
