"""One requirement on a design: a quantity with its limits, as a ``[[requirement]]`` table of DESIGN.toml."""

from __future__ import annotations

from math import isfinite
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from ..common.config import Positive, Section

Method = Literal["nominal", "worst-case", "monte-carlo", "spice", "hardware"]


class Conditions(Section):
    """Conditions under which a quantity is determined; defaults are those of the design."""

    frame_rate: Positive | None = None
    """Hz, in place of ``operation.frame_rate``"""
    yield_percent: Annotated[float, Field(gt=0, lt=100)] = 99.0
    """method "monte-carlo": percentage of boards that must keep the limits"""


class Requirement(Section):
    """A quantity of the design, its limits, and the method of verification."""

    id: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\s/\\]+$")]
    text: str = ""
    """the requirement in words"""
    source: str = ""
    """where the requirement comes from: a specification, a customer, a standard"""
    quantity: Annotated[str, Field(min_length=1)]
    """name in the catalogue (``ohmskin verify --quantities``), or ``FILE.py:FUNCTION`` for a quantity of one's own"""
    min: float | None = None
    max: float | None = None
    unit: str = ""
    """of min and max; left out: the unit of the catalogue"""
    method: Method | None = None
    """how the requirement is verified; left out: as the catalogue says"""
    conditions: Conditions = Conditions()

    @model_validator(mode="after")
    def _limits(self) -> Self:
        for key in ("min", "max"):
            limit = getattr(self, key)
            if limit is not None and not isfinite(limit):
                raise ValueError(f"{key} is {limit}; expected a finite limit, or none")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min} exceeds max {self.max}: no value could keep both")
        return self
