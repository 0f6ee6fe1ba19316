"""Faults that come and go: cells that open, short or make bad contact, lines that break or touch, a supply that sags.

Events of cells change the cells' resistance, and so the truth. Events of lines and of the supply change the circuit.
The board knows of none of them: it describes itself to the host as it was built.
"""

from __future__ import annotations

from math import inf
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..circuits import Design, Fault
from ..common.arrays import BoolArray, FloatArray
from ..common.config import NotNegative, Section

EventKind = Literal[
    "open-cell",
    "shorted-cell",
    "sparking-cell",
    "broken-row",
    "broken-column",
    "bridged-rows",
    "bridged-columns",
    "supply-sag",
]
_SPARKING, _SAG = frozenset({"sparking-cell"}), frozenset({"supply-sag"})
_BRIDGES = frozenset({"bridged-rows", "bridged-columns"})
_CELL_KINDS = _SPARKING | {"open-cell", "shorted-cell"}
_PLACED = _CELL_KINDS | _BRIDGES | {"broken-row", "broken-column"}
_KEYS: dict[str, frozenset[str]] = {
    "place": _PLACED,
    "resistance": _PLACED - _SPARKING,
    "to": _BRIDGES,
    "rate_hz": _SPARKING,
    "seed": _SPARKING,
    "share": _SAG,
}
"""Which kinds take which key"""
_SPARKS = 1 << 16
"""after so many states the pattern of a sparking cell begins anew"""


class Event(Section):
    """Something that happens at ``at_s`` and lasts until ``until_s``.

    ==================  ==================================================================================
    open-cell           ``resistance`` (default inf) in series with the cell at ``place``
    shorted-cell        ``resistance`` (default 0) across the cell
    sparking-cell       the cell is open or as it was, at random, anew ``rate_hz`` times a second
    broken-row          ``resistance`` (default inf) in series with the row line, ahead of ``place``
    broken-column       the same in the column line
    bridged-rows        ``resistance`` (default 0) from the row of ``place`` to row ``to`` (default: the next)
    bridged-columns     the same between column lines
    supply-sag          drive voltage and the upper limit of the outputs fall to ``share`` of what they are
    ==================  ==================================================================================
    """

    at_s: NotNegative
    until_s: Annotated[float, Field(gt=0)] = inf
    """left out: for ever"""
    kind: EventKind
    place: Annotated[tuple[int, int] | None, Field(strict=False)] = None
    """[row, column]"""
    resistance: Annotated[float | None, Field(ge=0)] = None
    """ohm"""
    to: Annotated[int | None, Field(ge=0)] = None
    """bridges only: the other line"""
    rate_hz: Annotated[float | None, Field(ge=1e-3, le=1e6)] = None
    """sparking cells only: new states per second; left out: 100"""
    seed: Annotated[int | None, Field(ge=0)] = None
    """sparking cells only: of the pattern; left out: 0"""
    share: Annotated[float | None, Field(gt=0, lt=1)] = None
    """supply-sag only"""

    @model_validator(mode="after")
    def _keys_fit(self) -> Self:
        for key, kinds in _KEYS.items():
            if getattr(self, key) is not None and self.kind not in kinds:
                raise ValueError(f"an event of kind '{self.kind}' has no key '{key}'")
        if self.place is None and self.kind in _PLACED:
            raise ValueError(f"an event of kind '{self.kind}' needs a place = [row, column]")
        if self.share is None and self.kind == "supply-sag":
            raise ValueError("an event of kind 'supply-sag' needs a share between 0 and 1")
        if not self.until_s > self.at_s:
            raise ValueError(f"until_s = {self.until_s} is not after at_s = {self.at_s}")
        return self

    @property
    def changes_cells(self) -> bool:
        """Whether the event happens to a cell, and not to the circuit."""
        return self.kind in _CELL_KINDS

    def happening(self, time_s: FloatArray) -> BoolArray:
        """(frames,) whether the event is on at each of ``time_s``."""
        near = 1e-9 * np.maximum(time_s, 1.0)  # a frame that falls on the beginning but for rounding has it
        return (time_s >= self.at_s - near) & (time_s < self.until_s - near)

    def changed_cells(self, time_s: FloatArray, resistance: FloatArray) -> FloatArray:
        """Resistance of the event's cell (frames,) in ohm, given what it would be without."""
        on = self.happening(time_s)
        match self.kind:
            case "open-cell":
                changed = resistance + (inf if self.resistance is None else self.resistance)
            case "shorted-cell":
                across = self.resistance or 0.0
                with np.errstate(divide="ignore"):
                    changed = 1.0 / (1.0 / resistance + np.divide(1.0, across))
            case _:
                states = np.random.default_rng(self.seed or 0).random(_SPARKS) < 0.5
                number = np.floor((time_s - self.at_s) * (self.rate_hz or 100.0) + 1e-9).astype(np.int64)
                changed = np.where(states[number % _SPARKS], inf, resistance)
        return np.where(on, changed, resistance)

    def changed_design(self, design: Design) -> Design:
        """The design while the event lasts. Raises InputError if its place lies outside the array."""
        if self.kind == "supply-sag":
            assert self.share is not None
            low, high = design.readout.supply
            sagging = max(high * self.share, design.readout.reference_voltage) if high > 0 else high
            return design.replace(
                drive={"voltage": design.drive.voltage * self.share}, readout={"supply": (low, sagging)}
            )
        keys = {"kind": self.kind, "place": self.place, "resistance": self.resistance, "to": self.to}
        fault = Fault.model_validate({key: value for key, value in keys.items() if value is not None})
        return design.replace(fault=(*design.fault, fault))


def check_events(events: list[Event], design: Design) -> None:
    """Raises InputError for places that the array does not have."""
    rows, columns = design.array.shape
    for number, event in enumerate(events):
        if event.place is not None and not (0 <= event.place[0] < rows and 0 <= event.place[1] < columns):
            place = list(event.place)
            raise ValueError(f"event[{number}].place: {place} lies outside the {rows} x {columns} array")
        if not event.changes_cells:
            try:
                event.changed_design(design)
            except ValueError as error:
                raise ValueError(f"event[{number}]: {error}") from error
