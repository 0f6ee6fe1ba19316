"""``[row_end]``, ``[column_end]``, ``[reference]``, ``[crosspoint]`` and ``[scan]`` of DESIGN.toml: small networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Self

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from ...common.config import Finite, LocalFile, Section
from .._spread import Spread
from ._cards import Card, parse_cards, read_subcircuit

MOST_EVENTS = 32
LONGEST_CARD = 500


class CardFile(Section):
    """A subcircuit of a SPICE file. Its cards take its place where the design is read."""

    file: LocalFile
    """path, relative to the design"""
    subcircuit: Annotated[str, Field(min_length=1, max_length=100)]


def _cards(*ports: str) -> BeforeValidator:
    """A list of cards, or a file with a subcircuit of these ports; as a list of cards that are written anew."""

    def check(value: object, info: ValidationInfo) -> tuple[str, ...]:
        if isinstance(value, Mapping):
            source = CardFile.model_validate(value, context=info.context)
            cards = read_subcircuit(source.file, source.subcircuit, ports)
        elif not isinstance(value, (list, tuple)) or not all(isinstance(line, str) for line in value):
            raise ValueError('expected a list of cards such as ["R1 line 0 10k"], or { file = ..., subcircuit = ... }')
        elif any(len(line) > LONGEST_CARD for line in value):
            raise ValueError(f"a card of more than {LONGEST_CARD} characters")
        else:
            cards = parse_cards(value)
        return tuple(card.line() for card in cards)

    return BeforeValidator(check)


OfLine = Annotated[tuple[str, ...], _cards("line")]
OfOutput = Annotated[tuple[str, ...], _cards("line", "out")]
OfCrosspoint = Annotated[tuple[str, ...], _cards("row", "cell")]
OfReference = Annotated[tuple[str, ...], _cards("ref")]
Fractions = Annotated[dict[str, Annotated[float, Field(ge=0, lt=1)]], Field(max_length=256)]
Values = Annotated[dict[str, Annotated[tuple[Finite, ...], Field(strict=False)]], Field(max_length=256)]


class _End(Section):
    """What the ends of rows and of columns have in common: spreads of their parts, by the parts' names."""

    NETWORKS: ClassVar[tuple[str, ...]] = ()
    """the keys that hold cards"""

    tolerance: Fractions = Field(default_factory=dict)
    """largest deviation of a part, relative to its value"""
    end_of_life: Fractions = Field(default_factory=dict)
    """largest deviation of a part at the end of its life, the tolerance included"""
    temperature_coefficient: Annotated[dict[str, Finite], Field(max_length=256)] = Field(default_factory=dict)
    """1/K of a part, relative to its value at 298.15 K"""
    values: Values = Field(default_factory=dict)
    """one value per end of a part, in place of that of its card"""

    @property
    def networks(self) -> dict[str, tuple[Card, ...]]:
        """The cards by key; none of keys that are not given."""
        lists = ((key, getattr(self, key)) for key in self.NETWORKS)
        return {key: parse_cards(lines) for key, lines in lists if lines is not None}

    @property
    def nominal(self) -> dict[str, float]:
        """Values of all parts that are one number, by name; ``idle.R1`` where another list has another R1."""
        found: dict[str, dict[str, Card]] = {}
        for key, cards in self.networks.items():
            for card in cards:
                if card.has_value:
                    found.setdefault(card.name, {})[key] = card
        return {
            name if len(set(places.values())) == 1 else f"{key}.{name}": card.value
            for name, places in found.items()
            for key, card in places.items()
        }

    @property
    def spreads(self) -> dict[str, Spread]:
        """Spreads of the parts that have one, by the names of :attr:`nominal`."""

        def of(table: Mapping[str, float], name: str) -> float:
            return table.get(name, table.get(name.rpartition(".")[2], 0.0))

        found = {}
        for name in self.nominal:
            tolerance, drift = of(self.tolerance, name), of(self.temperature_coefficient, name)
            aged = of(self.end_of_life, name) or None
            if tolerance or drift or aged:
                found[name] = Spread(tolerance=tolerance, temperature_coefficient=drift, end_of_life=aged)
        return found

    def lines(self, key: str, count: int) -> tuple[tuple[Card, ...], ...]:
        """The network of each of ``count`` lines, with the line's own values of some parts."""
        network, nominal = self.networks[key], self.nominal
        own = {}
        for card in network:
            name = card.name if card.name in nominal else f"{key}.{card.name}"
            if name in self.values:
                own[card.name] = self.values[name]
        return tuple(
            tuple(replace(card, value=own[card.name][line]) if card.name in own else card for card in network)
            for line in range(count)
        )

    @model_validator(mode="after")
    def _known_parts(self) -> Self:
        exact = self.nominal
        loose = exact | {name.rpartition(".")[2]: 0.0 for name in exact}
        for key in ("tolerance", "end_of_life", "temperature_coefficient", "values"):
            known = exact if key == "values" else loose
            for name in getattr(self, key):
                if name not in known:
                    raise ValueError(f"{key}.{name}: no such part; expected one of {', '.join(known) or 'none'}")
        _ = self.spreads  # which checks that no part ages to less than its tolerance
        return self


class RowEnd(_End):
    """What drives a row, and what a row ends in that is not selected. The node ``line`` is the row's lead."""

    NETWORKS = ("selected", "idle")

    selected: OfLine | None = None
    """None: as ``[drive]`` says"""
    idle: OfLine | None = None
    """no cards: the row is open; None: as ``[drive]`` says"""


class ColumnEnd(_End):
    """What a column ends in behind its lead, from the node ``line`` to the node ``out``."""

    NETWORKS = ("parts", "idle")

    parts: OfOutput
    """The converter samples the node ``out``, or ``line`` if no part is at ``out``."""
    shared_by: Annotated[int, Field(ge=1, le=1024)] = 1
    """so many neighbouring columns take turns at one end, in the order of their numbers"""
    idle: OfLine = ()
    """at a column that does not have the shared end"""

    @model_validator(mode="after")
    def _has_turns(self) -> Self:
        if self.idle != () and self.shared_by == 1:
            raise ValueError("idle has no effect with shared_by = 1: every column has its end at all times")
        return self


class Reference(_End):
    """The source of the reference voltage, if it is not stiff: one node ``ref`` that all ends share."""

    NETWORKS = ("parts",)

    parts: OfReference


class Crosspoint(_End):
    """What lies between a row's line (the node ``row``) and each of its cells (``cell``), as a diode does."""

    NETWORKS = ("parts",)

    parts: OfCrosspoint


Seconds = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]


class Event(Section):
    """One event of a scan; exactly one key."""

    wait: Seconds | None = None
    """s"""
    discharge: Seconds | None = None
    """s for which the sampled node is tied to ground"""
    discard: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """conversions whose results are thrown away"""
    read: Annotated[int, Field(ge=1, le=10_000)] | None = None
    """conversions whose mean is the reading"""

    @model_validator(mode="after")
    def _one(self) -> Self:
        if sum(getattr(self, key) is not None for key in type(self).model_fields) != 1:
            raise ValueError("an event has one of the keys wait, discharge, discard and read")
        return self


class Scan(Section):
    """The events of a frame. A row is selected, then ``row`` happens; then each column in turn has ``column``."""

    row: Annotated[tuple[Event, ...], Field(strict=False, max_length=MOST_EVENTS)] = ()
    column: Annotated[tuple[Event, ...], Field(strict=False, max_length=MOST_EVENTS)] = (Event(read=1),)
    conversion_time: Annotated[float, Field(ge=0, le=1)] | None = None
    """s of one conversion; None: ``adc.acquisition_time``"""

    @model_validator(mode="after")
    def _reads(self) -> Self:
        for event in self.row:
            if event.read is not None or event.discard is not None:
                raise ValueError("row: conversions belong to the events of a column")
        if sum(event.read is not None for event in self.column) != 1:
            raise ValueError("column: expected one event { read = n }")
        return self

    @property
    def averages(self) -> int:
        """Conversions whose mean is a reading."""
        return next(event.read for event in self.column if event.read is not None)
