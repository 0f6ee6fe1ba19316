"""Cards of a line's end: SPICE elements, parsed to values and written back from these values only.

The text may come from a file or from a board. It is never passed on to a simulator: each card becomes a :class:`Card`,
and :meth:`Card.text` writes the card anew from its numbers. What is not an element of :data:`NODES` (``.control``,
``.include``, expressions, code models) is an error that names the line.

========  ==========================================================================================
card      meaning
========  ==========================================================================================
R C L     ``R1 a b 10k``; capacitors are open and inductors are wires where nothing moves
V I       ``V1 a b 3.3`` or ``V1 a b DC 3.3``; a current source drives its current from a to b inside
E G       ``E1 out+ out- in+ in- gain``, voltage-controlled voltage and current sources
F H       ``F1 out+ out- V1 gain``, controlled by the current through a voltage source
D         ``D1 anode cathode IS=1e-14 N=1 RS=0``, or the name of a model: ``.model NAME D(IS=1e-14)``, or of
          :data:`DIODES`
X         ``X1 in+ in- out opamp open_loop_gain=1e5 ...``: an amplifier with the keys of ``[readout]``, or in a
          file a subcircuit of the same file
========  ==========================================================================================

Values are SPICE's: 10k, 3.3meg, 100n; letters behind them are units. ``M`` is milli, as in SPICE.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

from ...common.files import read_text
from ...common.text import one_line, shortened
from ...errors import InputError

GROUND = "0"
NODES = {"r": 2, "c": 2, "l": 2, "v": 2, "i": 2, "e": 4, "g": 4, "f": 2, "h": 2, "d": 2, "x": 3}
"""Nodes of each kind of element; ``x`` is the amplifier."""
MOST_CARDS = 64
MOST_BYTES = 1 << 18
SUFFIXES = {"t": 1e12, "g": 1e9, "meg": 1e6, "k": 1e3, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12, "f": 1e-15}
OPAMP = {
    "open_loop_gain": inf,
    "gain_bandwidth": inf,
    "offset_voltage": 0.0,
    "bias_current": 0.0,
    "voltage_noise": 0.0,
    "current_noise": 0.0,
    "low": -inf,
    "high": inf,
}
"""Keys of an amplifier with their ideal values; ``low`` and ``high`` are the limits of its output in V."""
DIODES: dict[str, dict[str, float]] = {
    "1n4148": {"is": 2.52e-9, "n": 1.752, "rs": 0.568},
    "bat54": {"is": 1e-7, "n": 1.0, "rs": 1.5},
    "1n5817": {"is": 3.19e-5, "n": 1.373, "rs": 0.051},
}
"""Saturation current (A), emission coefficient and series resistance (ohm) of usual diodes, as their makers' models
have them."""
_DIODE = {"is": 1e-14, "n": 1.0, "rs": 0.0}
_SILENT_DIODE = {"cjo", "cj0", "tt", "m", "vj", "eg", "xti", "fc", "bv", "ibv", "nbv", "kf", "af", "tnom"}
_SILENT_DIODE |= {"isr", "nr", "ikf", "iave", "vpk", "type", "mfg"}
"""Parameters of diode models that a forward-biased diode at 27 degrees Celsius does not have."""
_NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)(meg|[tgkmunpf])?[a-z]*$", re.IGNORECASE)
_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}$", re.IGNORECASE)
_NODE = re.compile(r"[a-z0-9_+\-.]{1,32}$", re.IGNORECASE)
_DEEPEST = 8
_DOS_END_OF_FILE = "\x1a"


class Statement(NamedTuple):
    """One statement of a netlist, its continuation lines joined and its comments removed."""

    line: int
    """number in the file, from 1"""
    text: str

    @property
    def words(self) -> list[str]:
        return self.text.lower().replace("=", " = ").split()


@dataclass(frozen=True)
class Card:
    """One element."""

    name: str
    """in capitals"""
    nodes: tuple[str, ...]
    value: float = 0.0
    """ohm, F, H, V, A or gain"""
    control: str = ""
    """name of the source whose current controls an F or H"""
    parameters: tuple[tuple[str, float], ...] = ()
    """of diodes and amplifiers"""

    @property
    def kind(self) -> str:
        return self.name[0].lower()

    @property
    def has_value(self) -> bool:
        """Whether the element is one number, which may have a tolerance."""
        return self.kind not in "dx"

    def __getitem__(self, key: str) -> float:
        return dict(self.parameters)[key]

    def renamed(self, node: Callable[[str], str], name: Callable[[str], str]) -> Card:
        """The card with other names of its nodes and of itself."""
        return replace(
            self,
            name=name(self.name),
            nodes=tuple(map(node, self.nodes)),
            control=name(self.control) if self.control else "",
        )

    def line(self) -> str:
        """The card as a design file has it."""
        words = [self.name, *self.nodes]
        if self.kind == "x":
            words.append("opamp")
        words += [self.control] if self.control else []
        words += [repr(self.value)] if self.has_value else []
        usual = OPAMP if self.kind == "x" else {}
        words += [f"{key}={value!r}" for key, value in self.parameters if value != usual.get(key)]
        return " ".join(words)


def number(text: str, where: str) -> float:
    """A SPICE value. Raises InputError."""
    match = _NUMBER.match(text)
    value = float(match[1]) * SUFFIXES.get((match[2] or "").lower(), 1.0) if match else inf
    if not isfinite(value) or abs(value) > 1e30:
        raise InputError(f"{where}: '{shortened(one_line(text), 40)}' is no value; expected one such as 10k or 3.3meg")
    return value


def parse_cards(lines: Iterable[str]) -> tuple[Card, ...]:
    """The cards of a list in a design file.

    Raises:
        InputError: a line that is no such card, two cards of one name, or too many.

    """
    return _of_list(tuple(lines))


@lru_cache(maxsize=256)
def _of_list(lines: tuple[str, ...]) -> tuple[Card, ...]:
    return _parsed(enumerate(lines), lambda index: f"card {index}", {})


def read_subcircuit(path: Path, name: str, ports: tuple[str, ...]) -> tuple[Card, ...]:
    """The cards of a subcircuit of a file, with ``ports`` as the names of its ports.

    Its ``.subckt`` line names these ports, or has as many ports in the same order.

    Raises:
        InputError: the file cannot be read, has other cards than those of this module, or lacks the subcircuit.

    """
    text = read_text(path)
    if len(text) > MOST_BYTES:
        raise InputError(f"{path}: {len(text)} characters; expected at most {MOST_BYTES}")
    bodies, models = _bodies(text, str(path))
    found = bodies.get(name.lower())
    if found is None:
        known = ", ".join(bodies) or "none"
        raise InputError(f"{path}: there is no .subckt {shortened(one_line(name), 40)}; the file has {known}")
    given, lines = found
    own = ports if set(given) >= set(ports) else ports[: len(given)]
    if len(given) < 1 or not (set(given) >= set(ports) or len(given) <= len(ports)):
        raise InputError(f"{path}: .subckt {name} has the ports {' '.join(given)}; expected {' '.join(ports)}")
    rename = {} if set(given) >= set(ports) else dict(zip(given, own, strict=True))
    cards = _expanded(lines, bodies, models, str(path), 0)
    return tuple(card.renamed(lambda node: rename.get(node, node), str) for card in cards)


def _bodies(
    text: str, path: str
) -> tuple[dict[str, tuple[tuple[str, ...], list[tuple[int, str]]]], dict[str, dict[str, float]]]:
    """Subcircuits of a file by name: ports, and numbered lines; and the diode models of the file."""
    bodies: dict[str, tuple[tuple[str, ...], list[tuple[int, str]]]] = {}
    models: dict[str, dict[str, float]] = {}
    inside: list[tuple[int, str]] | None = None
    for index, line in statements(text, path):
        words = line.lower().split()
        where = f"{path}: line {index}"
        if words[0] == ".subckt":
            if inside is not None or len(words) < 3:
                raise InputError(f"{where}: expected .subckt NAME PORT ..., outside of another one")
            inside = []
            bodies[words[1]] = tuple(word for word in words[2:] if "=" not in word), inside
        elif words[0] == ".ends":
            if inside == []:  # calls of such would be followed without end, as no part comes of them
                raise InputError(f"{where}: a .subckt without parts")
            inside = None
        elif words[0] == ".model":
            models.update(_model(line, where))
        elif words[0] == ".end":
            break
        elif inside is not None:
            inside.append((index, line))
        elif words[0][0] == ".":
            raise InputError(
                f"{where}: '{shortened(words[0], 40)}' is not read here; expected .subckt, .ends or .model"
            )
    return bodies, models


def statements(content: str, path: str) -> Iterator[Statement]:
    """Statements with their continuation lines; comments are dropped, and commands in comments refused."""
    start, parts = 0, []
    for number, raw in enumerate(re.split(r"\r\n|\r|\n", content.replace(_DOS_END_OF_FILE, "\n")), 1):
        line = raw.strip()
        if line.startswith("*#"):
            raise InputError(f"{path}: line {number}: '{shortened(one_line(line))}' is a command to ngspice")
        line = re.split(r";|\s\$\s|//", line, maxsplit=1)[0].strip()
        line = re.sub(r"^(\.ends\b[^*]*)\*.*", r"\1", line, flags=re.IGNORECASE)
        if not line or line.startswith(("*", "$")):
            continue
        if line.startswith("+"):
            parts.append(line[1:])
            continue
        if text := " ".join(" ".join(parts).split()):
            yield Statement(start, text)
        start, parts = number, [line]
    if text := " ".join(" ".join(parts).split()):
        yield Statement(start, text)


def _expanded(
    lines: list[tuple[int, str]],
    bodies: Mapping[str, tuple[tuple[str, ...], list[tuple[int, str]]]],
    models: Mapping[str, dict[str, float]],
    path: str,
    depth: int,
) -> list[Card]:
    cards: list[Card] = []
    if depth > _DEEPEST:
        raise InputError(f"{path}: subcircuits are nested too deeply; expected at most {_DEEPEST} levels")
    for index, line in lines:
        words, where = line.lower().split(), f"{path}: line {index}"
        calls = [place for place, word in enumerate(words) if place and word in bodies]
        if words[0][0] != "x" or not calls:
            cards += _parsed([(index, line)], lambda at: f"{path}: line {at}", models)
        else:
            ports, body = bodies[words[calls[-1]]]
            outer = words[1 : calls[-1]]
            if len(outer) != len(ports):
                raise InputError(f"{where}: {len(outer)} nodes, but .subckt {words[calls[-1]]} has {len(ports)} ports")
            at = {**dict(zip(ports, outer, strict=True)), GROUND: GROUND}
            call = words[0].upper()

            def node(inner: str, at: Mapping[str, str] = at, call: str = call) -> str:
                return at.get(inner, f"{call}.{inner}".lower())

            def name(inner: str, call: str = call) -> str:
                return f"{inner}_{call}"

            cards += [card.renamed(node, name) for card in _expanded(body, bodies, models, path, depth + 1)]
        if len(cards) > MOST_CARDS:
            raise InputError(f"{where}: more than {MOST_CARDS} parts in one end")
    return cards


def _parsed(
    lines: Iterable[tuple[int, str]], place: Callable[[int], str], models: Mapping[str, dict[str, float]]
) -> tuple[Card, ...]:
    cards: list[Card] = []
    known, pending = dict(models), []
    for index, line in lines:
        if line.lower().startswith(".model"):
            known.update(_model(line, place(index)))
        else:
            pending.append((index, line))
    for index, line in pending:
        card = _card(line, place(index), known)
        if any(card.name == other.name for other in cards):
            raise InputError(f"{place(index)}: there is a {card.name} already")
        cards.append(card)
        if len(cards) > MOST_CARDS:
            raise InputError(f"{place(index)}: more than {MOST_CARDS} parts in one end")
    for card in cards:
        if card.control and not any(card.control == other.name for other in cards):
            raise InputError(f"{card.name} is controlled by {card.control}, which is no part of this end")
    return tuple(cards)


def _card(line: str, where: str, models: Mapping[str, dict[str, float]]) -> Card:
    words = line.replace("(", " ").replace(")", " ").replace(",", " ").split()
    shown = shortened(one_line(line), 60)
    kind = words[0][0].lower() if words else ""
    if kind not in NODES or not _NAME.match(words[0]):
        raise InputError(f"{where}: '{shown}' is no part; expected R, C, L, V, I, E, G, F, H, D or X")
    words = " ".join(words).replace(" =", "=").replace("= ", "=").split()
    name, count = words[0].upper(), NODES[kind]
    nodes, rest = tuple(word.lower() for word in words[1 : 1 + count]), words[1 + count :]
    nodes = tuple(GROUND if node == "gnd" else node for node in nodes)
    if len(nodes) < count or not all(map(_NODE.match, nodes)):
        raise InputError(f"{where}: '{shown}' names {len(nodes)} nodes; expected {count}")
    keys = {key.lower(): number(value, where) for key, _, value in (w.partition("=") for w in rest if "=" in w)}
    plain = [word for word in rest if "=" not in word and word.lower() != "dc"]
    if kind == "d":
        return Card(name, nodes, parameters=_diode(plain, keys, models, where, shown))
    if kind == "x":
        if [word.lower() for word in plain] != ["opamp"] or not keys.keys() <= OPAMP.keys():
            raise InputError(f"{where}: '{shown}': expected NAME in+ in- out opamp, then {'=, '.join(OPAMP)}=")
        parameters = OPAMP | keys
        if not parameters["open_loop_gain"] >= 1 or not parameters["low"] < parameters["high"]:
            raise InputError(f"{where}: '{shown}': expected open_loop_gain >= 1, and low < high")
        return Card(name, nodes, parameters=tuple(parameters.items()))
    control = ""
    if kind in "fh" and plain:
        control, plain = plain[0].upper(), plain[1:]
    if len(plain) != 1 or keys:
        what = "the source that controls it and a gain" if kind in "fh" else "one value"
        raise InputError(f"{where}: '{shown}' has {' '.join(rest) or 'nothing'} behind its nodes; expected {what}")
    value = number(plain[0], where)
    if kind in "rcl" and value < 0:
        raise InputError(f"{where}: '{shown}': a value below 0")
    return Card(name, nodes, value, control)


def _model(line: str, where: str) -> dict[str, dict[str, float]]:
    words = line.replace("(", " ").replace(")", " ").replace(" =", "=").replace("= ", "=").split()
    if len(words) < 3 or words[2].lower() != "d":
        raise InputError(f"{where}: '{shortened(one_line(line), 60)}': expected .model NAME D(IS=... N=... RS=...)")
    values = (word.partition("=") for word in words[3:])
    parameters = {key.lower(): value for key, _, value in values if key.lower() not in _SILENT_DIODE}
    return {words[1].lower(): {key: number(value, where) for key, value in parameters.items()}}


def _diode(
    plain: list[str], keys: dict[str, float], models: Mapping[str, dict[str, float]], where: str, shown: str
) -> tuple[tuple[str, float], ...]:
    known = DIODES | dict(models)
    name = plain[0].lower() if plain else ""
    name = name if name in known else name.removeprefix("d")  # D1N4148 is 1N4148
    if len(plain) > 1 or (name and name not in known):
        raise InputError(
            f"{where}: '{shown}': no such diode; expected IS=, N= and RS= behind the nodes, a .model, or one of "
            f"{', '.join(DIODES)}"
        )
    given = known.get(name, {}) | keys
    if not given.keys() <= _DIODE.keys():
        raise InputError(f"{where}: '{shown}': a diode has IS, N and RS here")
    values = _DIODE | given
    if not values["is"] > 0 or not values["n"] > 0 or values["rs"] < 0:
        raise InputError(f"{where}: '{shown}': expected IS > 0, N > 0 and RS >= 0")
    return tuple(values.items())
