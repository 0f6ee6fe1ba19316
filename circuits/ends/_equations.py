"""Modified nodal analysis of a line's end (Ho, Ruehli and Brennan 1975), and its exact reduction to one port.

The unknowns are the potentials of the nodes and the currents of voltage sources, inductors, wires of 0 ohm and
amplifier outputs. Nothing moves: capacitors are open, and inductors are wires (:mod:`..timing._events` has their
states).

A linear end is, seen from its line, one straight line between voltage and current, and what the converter samples is
affine in them (:class:`EndLaw`). We find both by Gauss-Jordan elimination in rational numbers: cards are doubles, and
doubles are rational, so that an amplifier of gain 1e12 or a difference of nearly equal sources costs no digits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from functools import lru_cache
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ...errors import InputError
from ._cards import GROUND, Card

LINE, OUT, ROW, CELL = "line", "out", "row", "cell"


class EndLaw(NamedTuple):
    """A linear end, exactly: ``volts = source + resistance * current`` at the line, current into the end."""

    resistance: Fraction | None
    """ohm; None: the end fixes its current, not the voltage"""
    source: Fraction
    """V; with a fixed current that current in A"""
    output: Fraction
    """V that the converter samples at zero current; with a fixed current at 0 V on the line"""
    slope: Fraction
    """V/A of the output by the current; with a fixed current V/V by the line's voltage"""


class Equations(NamedTuple):
    """Equations ``static x = source`` of one end in double precision."""

    nodes: tuple[str, ...]
    """the first unknowns; the currents of branches follow"""
    static: FloatArray
    """(U, U) S, and dimensionless coefficients of branches"""
    source: FloatArray
    """(U,) A and V"""
    branches: tuple[str, ...]
    """names of the cards with a current among the unknowns"""

    @classmethod
    def of(cls, cards: Iterable[Card], ports: Iterable[str] = ()) -> Equations:
        """Stamp the cards; ``ports`` are nodes that come first, whether a card uses them or not. Diodes have no stamp:
        :mod:`.._nodal` has their law.
        """
        system = _Stamps(cards, ports, float)
        size = system.size
        static, source = np.zeros((size, size)), np.zeros(size)
        for row, column, value in system.static:
            static[row, column] += value
        for row, value in system.source:
            source[row] += value
        return cls(tuple(system.nodes), static, source, tuple(system.branches))


class _Stamps:
    """Entries of the equations, in the number type of ``number``."""

    def __init__(self, cards: Iterable[Card], ports: Iterable[str], number: Callable[[Any], Any]) -> None:
        cards = tuple(cards)
        named = (node for card in cards for node in card.nodes)
        self.nodes = list(dict.fromkeys(node for node in (*ports, *named) if node != GROUND))
        self.branches = [card.name for card in cards if card.kind in "vlehx" or (card.kind == "r" and card.value == 0)]
        self.static: list[tuple[int, int, Any]] = []
        self.source: list[tuple[int, Any]] = []
        self._at = {node: place for place, node in enumerate(self.nodes)}
        self._at |= {name: len(self.nodes) + place for place, name in enumerate(self.branches)}
        for card in cards:
            self._stamp(card, number(1), number)

    @property
    def size(self) -> int:
        return len(self._at)

    def _stamp(self, card: Card, one: Any, number: Callable[[Any], Any]) -> None:
        nodes, kind = card.nodes, card.kind
        value = number(card.value)
        if card.name in self.branches:
            self._add(nodes[2] if kind == "x" else nodes[0], card.name, one)
            if kind != "x":
                self._add(nodes[1], card.name, -one)
                self._add(card.name, nodes[0], one)
                self._add(card.name, nodes[1], -one)
        match kind:
            case "r" if card.value:
                self._conductor(nodes, one / value)
            case "v":
                self.source.append((self._at[card.name], value))
            case "i":
                self._inject(nodes, value)
            case "e" | "g":
                for sign, node in ((value, nodes[2]), (-value, nodes[3])):
                    if kind == "e":
                        self._add(card.name, node, -sign)
                    else:
                        self._add(nodes[0], node, sign)
                        self._add(nodes[1], node, -sign)
            case "f":
                self._controller(card)
                self._add(nodes[0], card.control, value)
                self._add(nodes[1], card.control, -value)
            case "h":
                self._controller(card)
                self._add(card.name, card.control, -value)
            case "x":
                plus, minus, out = nodes
                self._add(card.name, plus, one)
                self._add(card.name, minus, -one)
                if isfinite(card["open_loop_gain"]):
                    self._add(card.name, out, -one / number(card["open_loop_gain"]))
                self.source.append((self._at[card.name], -number(card["offset_voltage"])))
                self._inject((minus, GROUND), number(card["bias_current"]))

    def _controller(self, card: Card) -> None:
        if card.control not in self.branches:
            raise InputError(f"{card.name} is controlled by {card.control}; expected a voltage source of this end")

    def _add(self, equation: str, unknown: str, value: Any) -> None:
        if GROUND not in (equation, unknown):
            self.static.append((self._at[equation], self._at[unknown], value))

    def _inject(self, nodes: tuple[str, ...], amperes: Any) -> None:
        """A current that leaves the first node for the second one by way of the part."""
        for node, sign in zip(nodes, (-1, 1), strict=True):
            if node != GROUND:
                self.source.append((self._at[node], sign * amperes))

    def _conductor(self, nodes: tuple[str, ...], value: Any) -> None:
        for a, b in (nodes, nodes[::-1]):
            self._add(a, a, value)
            self._add(a, b, -value)


@lru_cache(maxsize=4096)
def end_law(cards: tuple[Card, ...], where: str, out: str = LINE) -> EndLaw:
    """The law of a linear end at its line, exactly.

    Args:
        cards: without diodes.
        where: name of the end in messages.
        out: the node that the converter samples.

    Raises:
        InputError: the parts contradict each other, or leave the sampled voltage undetermined.

    """
    system = _Stamps(cards, (LINE,), Fraction)
    size, line = system.size, system.nodes.index(LINE)
    if out not in system.nodes:
        raise InputError(f"{where}: no part is at the node '{out}'")
    sampled = system.nodes.index(out)
    inner = [place for place in range(size) if place not in (line, sampled)]
    order = [*inner, *dict.fromkeys((sampled, line))]
    column = {place: number for number, place in enumerate(order)}
    rows = [[Fraction(0)] * (size + 2) for _ in range(size)]
    for row, unknown, value in system.static:
        rows[row][column[unknown]] += value
    for row, value in system.source:
        rows[row][size + 1] += value
    rows[line][size] -= 1  # the current into the end enters at the line
    solved = _reduced(rows, size + 1, where)
    free = [number for number in range(size + 1) if number not in solved]
    law = {
        number: (row[size + 1], {other: -row[other] for other in free if row[other]}) for number, row in solved.items()
    }
    volts, amperes = column[line], size

    def affine(number: int, by: int) -> tuple[Fraction, Fraction]:
        constant, others = law.get(number, (Fraction(0), {number: Fraction(1)}))
        if others.keys() - {by}:
            raise InputError(f"{where}: no path for direct current determines the voltage at '{out}'")
        return constant, others.get(by, Fraction(0))

    if volts in solved:
        source, resistance = affine(volts, amperes)
        output, slope = affine(column[sampled], amperes)
        return EndLaw(resistance, source, output, slope)
    current, _ = affine(amperes, volts)
    output, slope = affine(column[sampled], volts)
    return EndLaw(None, current, output, slope)


def _reduced(rows: list[list[Fraction]], unknowns: int, where: str) -> dict[int, list[Fraction]]:
    """Reduced row echelon form: the row of each unknown that has a pivot."""
    pending, solved = list(rows), dict[int, list[Fraction]]()
    for number in range(unknowns):
        pivot = next((row for row in pending if row[number]), None)
        if pivot is None:
            continue
        pending.remove(pivot)
        factor = pivot[number]
        pivot[:] = [value / factor for value in pivot]
        for row in (*pending, *solved.values()):
            if factor := row[number]:
                row[:] = [value - factor * own if own else value for value, own in zip(row, pivot, strict=True)]
        solved[number] = pivot
    if any(row[-1] for row in pending):
        raise InputError(f"{where}: sources without a resistance between them contradict each other")
    return solved


def float_of(value: Fraction) -> float:
    """The nearest double; inf beyond all doubles."""
    try:
        return float(value)
    except OverflowError:
        return inf if value > 0 else -inf
