"""``[document]`` and ``[parts]`` of DESIGN.toml: what a verification is filed under, and the parts list with ratings.

Nothing is read or computed by them; the verification holds stresses to the ratings, and its report prints the rest.
"""

from __future__ import annotations

import datetime
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from ..common.config import Positive, Section


def _as_date(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    try:
        return datetime.date.fromisoformat(value)
    except ValueError as error:
        raise ValueError("expected a date as 2026-05-31") from error


Line = Annotated[str, Field(max_length=120, pattern=r"^[^\n\r]*$")]
"""one line of text for the report"""


class Document(Section):
    """What the report of a verification is filed under."""

    number: Line = ""
    revision: Line = ""
    author: Line = ""
    date: Annotated[datetime.date | None, BeforeValidator(_as_date)] = None


class Part(Section):
    """A part as it is bought: its number, and what its data sheet rates it at. Subclasses have the ratings."""

    number: Line = ""
    """the maker's part number"""
    derating: Annotated[float, Field(gt=0, le=1)] = 1.0
    """share of each rating that may be used"""

    @property
    def ratings(self) -> dict[str, float]:
        """SI values by kind of stress, of those that are given."""
        kinds = (kind for kind in ("voltage", "current", "power") if getattr(self, kind, None) is not None)
        return {kind: getattr(self, kind) for kind in kinds}


class CellPart(Part):
    """The material at one crosspoint."""

    voltage: Positive | None = None
    """V"""
    power: Positive | None = None
    """W"""


class DriverPart(Part):
    """Switch and lead of a driven line."""

    current: Positive | None = None
    """A"""
    power: Positive | None = None
    """W"""


class AmplifierPart(Part):
    """The amplifier at a sensed line."""

    current: Positive | None = None
    """A that its output delivers"""


class ResistorPart(Part):
    """``readout.reference_resistance``: the resistor across an amplifier, or the load of a divider."""

    voltage: Positive | None = None
    """V"""
    power: Positive | None = None
    """W"""


class BoughtParts(Section):
    """Parts of the board, by what they are in the circuit."""

    cell: CellPart | None = None
    driver: DriverPart | None = None
    amplifier: AmplifierPart | None = None
    reference_resistor: ResistorPart | None = None
    converter: Part | None = None
