"""The ends of all lines of a board as cards, and as the numbers that the solvers of linear boards take.

Row i ends in ``selected[i]`` or ``idle[i]``, column j in ``read[j]`` or ``unread[j]``. Where every end is
linear and conducts like a resistance, its line law (:class:`._equations.EndLaw`) is all that the other lines can feel.
The board then has the numbers of :class:`Rows` and :class:`Columns`. All other boards, with diodes, limited amplifiers,
current sources or a reference that the ends share, are solved node by node (:mod:`..readouts._nodal`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._tuning import HELD
from ..solvers import IDEAL_WIRE
from ._cards import GROUND, OPAMP, Card
from ._equations import LINE, OUT, EndLaw, end_law, float_of

REF = "ref"
"""the node of the reference voltage"""
OPEN_OHM = IDEAL_WIRE
"""stands for an end that takes no current: solvers of positive arithmetic lose no digits by it"""
Network = tuple[Card, ...]


class Rows(NamedTuple):
    """The ends of rows as a driver behind a lead, and a pull-down resistor."""

    lead: FloatArray
    """(N,) ohm between driver and pull-down"""
    pull: float
    """ohm to the potential of idle rows; inf: none"""
    floating: bool
    """whether idle rows have no driver"""
    drive: float
    """V of the driver above the potential of idle rows"""
    datum: Fraction
    """V, the potential of idle rows"""


class Columns(NamedTuple):
    """The ends of columns as Thevenin equivalents: (M,) each, sources in V above the potential of idle rows."""

    resistance: FloatArray
    source: FloatArray
    output: FloatArray
    """V that the converter samples at zero current"""
    slope: FloatArray
    """V/A of it"""
    idle_resistance: FloatArray
    idle_source: FloatArray


@dataclass(frozen=True, eq=False)
class LineEnds:
    """Cards of every end."""

    selected: tuple[Network, ...]
    idle: tuple[Network, ...]
    read: tuple[Network, ...]
    """at each column while it has its turn"""
    unread: tuple[Network, ...]
    shared_by: int
    """neighbouring columns that take turns at one end"""
    reference: Network
    """what holds the node ``ref``; empty: a stiff source of ``level``"""
    level: float
    """V; 0: ``ref`` is a node like any other"""
    crosspoint: Network = ()
    """between each row and its cells, from the node ``row`` to ``cell``; empty: nothing"""

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.selected), len(self.unread)

    @cached_property
    def out(self) -> str:
        """The node that the converter samples."""
        nodes = {node for card in self.read[0] for node in card.nodes}
        return OUT if OUT in nodes else LINE

    @cached_property
    def is_linear(self) -> bool:
        """Whether no part has a bend."""
        every = (*self.selected, *self.idle, *self.read, *self.unread, self.reference, self.crosspoint)
        return not any(is_bent(card) for network in every for card in network)

    @cached_property
    def is_apart(self) -> bool:
        """Whether lines feel each other by way of the grid only."""
        return self.is_linear and not (self.reference or self.crosspoint)

    @cached_property
    def swing(self) -> tuple[float, float]:
        """V between which the converter's node stays, by the limits of any amplifier at the ends of columns.

        Where the node is not an amplifier's own output, it is affine in that output, as both are in the line's current;
        ends with diodes besides state no limits. Of ends that differ, the narrowest swing.
        """
        low, high = -inf, inf
        for network in dict.fromkeys(self.read):
            for card in network:
                if card.kind == "x" and is_bent(card):
                    least, most = self._at_limits(network, card)
                    low, high = max(low, least), min(high, most)
        return low, high

    def _at_limits(self, network: Network, amplifier: Card) -> tuple[float, float]:
        """V of the converter's node where an amplifier's output is at its limits, in ascending order."""
        limits, node = (amplifier["low"], amplifier["high"]), amplifier.nodes[2]
        if node != self.out:
            if any(card.kind == "d" for card in network):
                return -inf, inf
            smooth = self._smooth(network)
            own, sampled = (end_law(smooth, "column_end", where) for where in (node, self.out))
            if not own.slope or not sampled.slope:  # it does not take part, or the converter's node does not move
                return -inf, inf
            ratio = float_of(sampled.slope / own.slope)
            start = float_of(sampled.output - sampled.slope / own.slope * own.output)
            limits = (start + ratio * limits[0], start + ratio * limits[1])
        return min(limits), max(limits)

    def _smooth(self, network: Network) -> Network:
        """The network with conducting diodes, amplifiers without limits, and a stiff reference."""
        smooth = _unbent(network)
        if any(REF in card.nodes for card in smooth) and (self.level or self.reference):
            smooth += (Card("V.REF", (REF, GROUND), self.level),)
        return smooth

    def held(self, network: Network) -> Network:
        """The network with a stiff source at its reference node, if it has one that no network holds."""
        if self.level and not self.reference and any(REF in card.nodes for card in network):
            return (*network, Card("V.REF", (REF, GROUND), self.level))
        return network

    def of_step(self, row: int, read: BoolArray) -> Iterator[tuple[str, int, Network]]:
        """What all lines end in while a row is selected and the columns ``read`` (M,) have their turn.

        Yields:
            A name, the number of the line (rows first; N + M is the shared reference), and the network.

        """
        rows, columns = self.shape
        for i in range(rows):
            yield f"r{i}", i, self.held(self.selected[i] if i == row else self.idle[i])
        for j in range(columns):
            name, network = (f"c{j // self.shared_by}", self.read[j]) if read[j] else (f"idle{j}", self.unread[j])
            yield name, rows + j, self.held(network)
        if self.reference:
            yield "ref", rows + columns, self.reference

    def rows(self, datum: Fraction) -> Rows | None:
        """The rows' ends as numbers; None where they are not of this kind.

        Args:
            datum: V, potential of idle rows that are open.

        """
        laws = [
            (end_law(self.held(on), "row_end.selected"), end_law(self.held(off), "row_end.idle"))
            for on, off in zip(self.selected, self.idle, strict=True)
        ]
        found = [_driver(on, off, datum) for on, off in laws]
        known = [row for row in found if row is not None]
        if len(known) < len(found) or any(row[1:] != known[0][1:] for row in known):
            return None
        return known[0]._replace(lead=np.array([row.lead[0] for row in known]))

    def columns(self, datum: Fraction) -> Columns | None:
        """The columns' ends as numbers, sources above ``datum`` in V; None where they are not of this kind."""
        read = [end_law(self.held(end), "column_end", self.out) for end in self.read]
        unread = [end_law(self.held(end), "column_end.idle") for end in self.unread]
        found = [_thevenin(law, datum) for law in (*read, *unread)]
        known = np.array([end for end in found if end is not None])
        if len(known) < len(found):
            return None
        resistance, source, output, slope = known[: len(read)].T
        idle_resistance, idle_source = known[len(read) :, :2].T
        idle_resistance = np.where(idle_resistance >= OPEN_OHM, inf, idle_resistance)
        return Columns(resistance, source, output, slope, idle_resistance, idle_source)

    def ambiguity(self) -> str:
        """Why readings do not tell the cells apart; empty: this says nothing against it.

        A row that conducts better while it is idle lets several sets of cells have the same readings. Conducting diodes
        count as wires here.
        """
        if self.crosspoint:
            return "parts at each cell are not modelled in recovery"
        ends = [end_law(self._smooth(end), "column_end", self.out) for end in self.read]
        if all(law.resistance is None for law in ends):
            return "nothing loads the columns, so that readings tell ratios of a column's cells only; expected a load"
        if all(law.resistance is not None and abs(law.resistance) < HELD * abs(law.slope) for law in ends):
            return ""  # amplifiers hold the columns, and each reading is a current
        for i, pair in enumerate(zip(self.selected, self.idle, strict=True)):
            on, off = (end_law(self._smooth(network), "row_end").resistance for network in pair)
            if off is not None and (on is None or abs(off) < abs(on)):
                selected = "a current source" if on is None else f"{float_of(on):g} ohm"
                return (
                    f"row {i} ends in {float_of(off):g} ohm while it is idle and in {selected} while it is selected, "
                    "so that several sets of cells can have the same readings; expected an idle end that conducts less"
                )
        return ""

    def rest(self) -> Fraction:
        """V of the first column's end without current; 0 where it takes none."""
        law = end_law(self.held(self.read[0]), "column_end", self.out)
        return law.source if law.resistance is not None else Fraction(0)


def is_bent(card: Card) -> bool:
    """Whether the law of a part has a bend: diodes, and amplifiers with limits."""
    return card.kind == "d" or (card.kind == "x" and (isfinite(card["low"]) or isfinite(card["high"])))


def _unbent(network: Network) -> Network:
    """The network with its diodes conducting, and its amplifiers without limits."""
    parts = []
    for card in network:
        if card.kind == "d":
            parts.append(Card(f"R.{card.name}", card.nodes, card["rs"]))
        elif card.kind == "x":
            unlimited = tuple((key, value) for key, value in card.parameters if key not in {"low", "high"})
            parts.append(replace(card, parameters=(*unlimited, ("low", -inf), ("high", inf))))
        else:
            parts.append(card)
    return tuple(parts)


def _driver(on: EndLaw, off: EndLaw, datum: Fraction) -> Rows | None:
    """A row's ends as driver, lead and pull-down. The pull-down stays while the row is selected."""
    if on.resistance is None or on.resistance < 0 or (off.resistance is None and off.source):
        return None
    lead, pull, floating = on.resistance, inf, off.resistance != on.resistance
    if off.resistance is None:
        volts = on.source - datum
    else:
        volts, datum = on.source - off.source, off.source
        if floating:
            if on.resistance > off.resistance:
                return None
            lead = on.resistance * off.resistance / (off.resistance - on.resistance)
            pull, volts = float_of(off.resistance), volts * (1 + lead / off.resistance)
    return Rows(np.array([float_of(lead)]), pull, floating, float_of(volts), datum) if volts else None


def _thevenin(law: EndLaw, datum: Fraction) -> tuple[float, float, float, float] | None:
    """Resistance, source, output and slope; None for an end that is no resistance."""
    if law.resistance is None:
        if law.source:
            return None
        return OPEN_OHM, 0.0, float_of(law.output + law.slope * datum), float_of(law.slope) * OPEN_OHM
    if law.resistance < 0:
        return None
    parts = law.resistance, law.source - datum, law.output, law.slope
    resistance, source, output, slope = map(float_of, parts)
    return resistance, source, output, slope


def amplifier(plus: str, minus: str, out: str, **keys: float) -> Card:
    """The card of an amplifier."""
    return Card("X1", (plus, minus, out), parameters=tuple((OPAMP | keys).items()))
