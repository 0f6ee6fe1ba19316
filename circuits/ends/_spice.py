"""Networks as SPICE cards, written from their values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from math import isfinite
from typing import TYPE_CHECKING

from ._cards import GROUND, Card

if TYPE_CHECKING:
    from scipy.cluster.hierarchy import DisjointSet


LARGEST_GAIN = 1e8
"""of a voltage-controlled source: a larger one would multiply ngspice's rounding errors"""


def spice_cards(network: Iterable[Card], node: Callable[[str], str], suffix: str) -> Iterator[str]:
    """Cards of a network for ngspice.

    An amplifier of finite gain is a voltage-controlled source. With a gain above :data:`LARGEST_GAIN` or infinite, or
    with a supply that limits its output, it is the equation ``out = out + (v+ - v- + Vos - out / A)``, limited: exact
    for any gain, and for none. No card has a large number that stands for an ideal part.

    Args:
        network: the parts.
        node: name of a node of the network in the whole circuit.
        suffix: for the names of the parts.

    """
    for card in network:
        name, nodes = f"{card.name}{suffix}", tuple(map(node, card.nodes))
        at = " ".join(nodes)
        match card.kind:
            case "c" if card.value == 0:
                continue
            case "r" if card.value == 0:
                yield f"V{name} {at} DC 0"
            case "v" | "i":
                yield f"{name} {at} DC {card.value!r}"
            case "f" | "h":
                yield f"{name} {at} {card.control}{suffix} {card.value!r}"
            case "d":
                model = f"diode_{name}".lower()
                yield f"{name} {at} {model}"
                yield f".model {model} D(IS={card['is']!r} N={card['n']!r} RS={card['rs']!r})"
            case "x":
                plus, minus, out = (f"v({each})" for each in nodes)
                limited = isfinite(card["low"]) or isfinite(card["high"])
                if card["bias_current"] and nodes[1] != GROUND:
                    yield f"I{name} {nodes[1]} {GROUND} DC {card['bias_current']!r}"
                if not limited and card["open_loop_gain"] <= LARGEST_GAIN:
                    yield f"V{name} plus_{name} {nodes[0]} DC {card['offset_voltage']!r}"
                    yield f"E{name} {nodes[2]} {GROUND} plus_{name} {nodes[1]} {card['open_loop_gain']!r}"
                    continue
                law = f"{out}+({plus}-{minus}+{card['offset_voltage']!r}"
                law += f"-{out}/{card['open_loop_gain']!r})" if isfinite(card["open_loop_gain"]) else ")"
                law = f"min({law},{card['high']!r})" if isfinite(card["high"]) else law
                law = f"max({law},{card['low']!r})" if isfinite(card["low"]) else law
                yield f"B{name} {nodes[2]} {GROUND} V = {law.replace(f'v({GROUND})', '0')}"
            case _:
                yield f"{name} {at} {card.value!r}"


def join(islands: DisjointSet, network: Iterable[Card], node: Callable[[str], str]) -> None:
    """Merge the nodes between which a network has a path for direct current."""
    for card in network:
        nodes = [node(each) for each in card.nodes]
        for each in nodes:
            islands.add(each)
        if card.kind == "x":
            islands.merge(nodes[2], GROUND)
        elif card.kind in "rlvehd":
            islands.merge(nodes[0], nodes[1])
