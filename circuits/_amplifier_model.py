"""SPICE macro-models of amplifiers (``.SUBCKT``), as makers publish them: read, checked, and safe to include.

A model file is a program of somebody else. ngspice would run a ``.control`` block or a line that begins with ``*#``
inside the file, shell commands included, and read any file that ``.include`` or a code model names. This module
therefore accepts only lines that describe a circuit. It has lists of the allowed cards, devices and model types; every
other line is an error that names file and line. Subcircuits that the model does not call are left out of the netlist,
whatever they contain: libraries have hundreds.

Two things of makers' files that ngspice does not understand are translated: the end-of-file byte of DOS, and resistors
without noise. PSpice marks such resistors by a model of temperature zero (``T_ABS=-273.15``), which ngspice drops
without a word; its own mark is ``noisy=0``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, PrivateAttr, model_validator

from ..common.config import Finite, LocalFile, Section
from ..common.files import read_bytes
from ..common.text import one_line, shortened
from ..errors import InputError
from .ends import Statement, statements

Pin = Literal["in+", "in-", "v+", "v-", "out", "ground", "open"]
PINS: tuple[Pin, ...] = ("in+", "in-", "v+", "v-", "out")
"""default: the order that most makers use"""
MOST_MODEL_BYTES = 4 * 2**20
MOST_STATEMENTS = 20_000
"""of a model whose calls are expanded; makers' amplifiers have hundreds"""
MOST_NESTED = 16
"""definitions within each other; makers' models have none or one"""
CARDS = (".subckt", ".ends", ".model", ".param", ".params", ".func", ".if", ".elseif", ".else", ".endif")
DEVICES = "bcdefghijklmqrstvwxz"
"""First letters of devices; among the others are code models ("a"), which can read files."""
MODEL_TYPES = (
    *("r", "c", "l", "d", "npn", "pnp", "njf", "pjf", "nmf", "pmf", "nmos", "pmos", "vdmos", "sw", "csw"),
    *("res", "cap", "ind", "vswitch", "iswitch", "ltra"),
)
LTSPICE_ONLY = re.compile(r"^[bcdefghilrv].*\s(noiseless\b|(?:rpar|cpar|rser|lser|rlshunt)\s*=)", re.IGNORECASE)
"""Words of LTspice on devices, which ngspice refuses."""
_ENCRYPTED = re.compile(r"\$CDNENC|\* Begin:.*Encrypt|^\*?\s*LTspice Encrypted", flags=re.IGNORECASE | re.MULTILINE)
_ABSOLUTE = re.compile(r"\bt_abs\s*=\s*([-+]?[\d.]+(?:e[-+]?\d+)?)", re.IGNORECASE)
_NOISELESS_CELSIUS = -273.0
"""A resistor that is at most this warm is meant to have no thermal noise."""


class AmplifierModel(Section):
    """The maker's macro-model of the column amplifiers, in place of the one-pole amplifier of SPICE netlists.

    The file is read when the table is: errors are no such file, no such subcircuit, another number of pins, or a line
    that is not allowed.
    """

    file: LocalFile
    """the model file, relative to the design"""
    subcircuit: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.\-+/]+$")]
    """name of the .SUBCKT in the file"""
    pins: Annotated[tuple[Pin, ...], Field(strict=False)] = PINS
    """function of each pin, in the order of the .SUBCKT line; "ground" is tied to 0 V, "open" to nothing"""
    rails: Annotated[tuple[Finite, Finite] | None, Field(strict=False)] = None
    """V at "v-" and "v+"; None: as readout.supply"""
    _text: str = PrivateAttr(default="")

    @model_validator(mode="after")
    def _connected(self) -> Self:
        for pin in ("in+", "in-", "out"):
            if self.pins.count(pin) != 1:
                raise ValueError(f"pins must name '{pin}' once, got {list(self.pins)}")
        if self.rails is not None and not self.rails[0] < self.rails[1]:
            raise ValueError(f"rails must be [voltage at v-, voltage at v+] in V, got {list(self.rails)}")
        self._text = self._read(self.file)
        return self

    @property
    def text(self) -> str:
        """The checked cards of the file, one per line."""
        return self._text

    def _read(self, path: Path) -> str:
        # Makers use various code pages; only comments may contain more than ASCII.
        content = read_bytes(path, most_bytes=MOST_MODEL_BYTES).decode("latin-1")
        if _ENCRYPTED.search(content):
            raise InputError(f"{path}: the model is encrypted; expected plain text")
        used = self._used(list(_within(statements(content, str(path)), str(path))), str(path))
        for placed in used:
            _check_card(placed.card, str(path))
        return "\n".join(_without_thermal_noise(used))

    def _used(self, every: list[_Placed], path: str) -> list[_Placed]:
        """The statements of the subcircuit, of those that it calls, and outside of all; libraries have many others."""
        pins: dict[str, list[str]] = {}
        bodies: dict[str, list[Statement]] = {}
        for card, around in every:
            words = card.words
            if not around:
                _check_card(card, path)
                if not words[0].startswith("."):
                    raise InputError(
                        f"{path}: line {card.line}: '{shortened(one_line(card.text))}' stands outside a .SUBCKT"
                    )
            elif words[0] == ".subckt" and len(around) == 1:
                pins.setdefault(words[1], _before_parameters(words[2:]))
            elif words[0] not in (".subckt", ".ends"):
                for name in {around[0].name, around[-1].name}:
                    bodies.setdefault(name, []).append(card)  # of definitions with one name, all count
        name = self.subcircuit.lower()
        if name not in pins:
            known = ", ".join(sorted(pins)) or "none"
            raise InputError(f"{path}: no .SUBCKT {self.subcircuit}; the file has {shortened(one_line(known), 100)}")
        if len(pins[name]) != len(self.pins):
            raise InputError(
                f"{path}: .SUBCKT {self.subcircuit} has {len(pins[name])} pins "
                f"({shortened(one_line(' '.join(pins[name])))}), but readout.amplifier_model.pins names "
                f"{len(self.pins)}"
            )
        reached = _reached(name, bodies, path)
        return [placed for placed in every if not placed.around or placed.around[0].name in reached]


class _Scope(NamedTuple):
    """One .SUBCKT."""

    line: int
    name: str


class _Placed(NamedTuple):
    """A statement, and the .SUBCKTs around it from the outermost one on; its own .SUBCKT and .ENDS lines are within."""

    card: Statement
    around: tuple[_Scope, ...]


def _within(cards: Iterable[Statement], path: str) -> Iterator[_Placed]:
    around: tuple[_Scope, ...] = ()
    for card in cards:
        words = card.words
        if words[0] == ".subckt":
            if len(words) < 2:
                raise InputError(f"{path}: line {card.line}: a .SUBCKT without a name")
            if len(around) == MOST_NESTED:
                raise InputError(
                    f"{path}: line {card.line}: .SUBCKTs within each other; expected at most {MOST_NESTED}"
                )
            around = (*around, _Scope(card.line, words[1]))
        if words[0] == ".ends" and not around:
            raise InputError(f"{path}: line {card.line}: .ENDS without .SUBCKT")
        if words[0] != ".end":
            yield _Placed(card, around)
        around = around[:-1] if words[0] == ".ends" else around
    if around:
        raise InputError(f"{path}: .SUBCKT {one_line(around[-1].name)} has no .ENDS")


def _check_card(card: Statement, path: str) -> None:
    """Raise InputError for a statement of a kind that is not allowed."""
    first = card.words[0]
    where = f"{path}: line {card.line}"
    shown = shortened(one_line(card.text))
    if not card.text.isascii() or not card.text.isprintable() or "`" in card.text:
        raise InputError(f"{where}: expected plain ASCII text outside comments, got '{shown}'")
    if first.startswith("."):
        if first not in CARDS or first != card.text.split()[0].lower():
            raise InputError(f"{where}: '{shown}' is not part of a model; expected only {', '.join(CARDS)}")
        if first == ".model":
            _check_model_type(card, where, shown)
    elif first[0] == "a":
        raise InputError(f"{where}: '{shown}' is a device of LTspice, or a code model, which are not supported")
    elif dialect := LTSPICE_ONLY.search(card.text):
        word = dialect[1].rstrip("= ")
        raise InputError(f"{where}: '{shown}': '{word}' is LTspice's own, and ngspice does not read it")
    elif first[0] not in DEVICES:
        raise InputError(f"{where}: '{shown}' is no device of a model; expected one of {DEVICES.upper()}")
    if re.search(r"\bfile\s*=", card.text, flags=re.IGNORECASE):
        raise InputError(f"{where}: '{shown}' would read a file")


def _check_model_type(card: Statement, where: str, shown: str) -> None:
    words = card.text.lower().replace("(", " ").split()
    kind = words[2] if len(words) > 2 else ""
    kind = kind.split(":")[-1] if kind.startswith("ako:") and len(words) > 3 else kind
    if kind.startswith("ako:") or kind not in MODEL_TYPES:
        raise InputError(f"{where}: '{shown}': unknown type of model; expected one of {', '.join(MODEL_TYPES)}")


def _without_thermal_noise(every: list[_Placed]) -> Iterator[str]:
    """The statements, with ``noisy=0`` on resistors whose model has a temperature of zero kelvin."""
    noiseless: dict[tuple[tuple[_Scope, ...], str], bool] = {}
    for card, around in every:
        words = card.text.lower().replace("(", " ").split()
        if words[0] == ".model" and words[2] in ("r", "res"):
            noiseless[around, words[1]] = _is_noiseless(card.text)
    for card, around in every:
        text = card.text
        if card.words[0] == ".model" and _is_noiseless(text):
            text = _ABSOLUTE.sub("", text, count=1)
        elif card.words[0].startswith("r"):
            # The nearest model of that name counts, as in ngspice.
            places = [(around[:depth], word) for word in card.words[3:5] for depth in reversed(range(len(around) + 1))]
            if next((noiseless[place] for place in places if place in noiseless), False):
                text = f"{text} noisy=0"
        yield text


def _is_noiseless(model: str) -> bool:
    found = _ABSOLUTE.search(model)
    return found is not None and float(found[1]) <= _NOISELESS_CELSIUS


def _before_parameters(words: list[str]) -> list[str]:
    """Words before any parameter: the nodes of a .SUBCKT line, or the nodes and the subcircuit of a call."""
    found = []
    for position, word in enumerate(words):
        if word in ("params:", "optional:") or words[position + 1 : position + 2] == ["="]:
            break
        found.append(word)
    return found


def _reached(name: str, bodies: Mapping[str, list[Statement]], path: str) -> set[str]:
    """The subcircuit and all that it calls.

    The calls are followed as ngspice expands them.

    Raises:
        InputError: a subcircuit that contains itself, or one that expands to more than :data:`MOST_STATEMENTS`.

    """
    reached, count = {name}, 0
    above = {name: iter(bodies.get(name, ()))}
    while above:
        current, pending = next(reversed(above.items()))
        card = next(pending, None)
        if card is None:
            del above[current]
            continue
        count += 1
        if count > MOST_STATEMENTS:
            what = f"{path}: .SUBCKT {one_line(name)} with all that it calls"
            raise InputError(f"{what} has too many statements; expected at most {MOST_STATEMENTS}")
        for callee in _before_parameters(card.words[1:])[-1:] if card.words[0].startswith("x") else ():
            if callee in above:
                raise InputError(f"{path}: .SUBCKT {one_line(callee)} contains itself")
            reached.add(callee)
            above[callee] = iter(bodies.get(callee, ()))
    return reached
