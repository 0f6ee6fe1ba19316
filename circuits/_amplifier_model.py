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
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Literal, Self

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
        cards = [card for card in statements(content, str(path)) if card.words[0] != ".end"]
        used = self._used(cards, str(path))
        for card in used:
            _check_card(card, str(path))
        return "\n".join(_without_thermal_noise(used))

    def _used(self, cards: list[Statement], path: str) -> list[Statement]:
        """The cards of the subcircuit, of those that it calls, and outside of all; libraries have many others."""
        outside: dict[str, list[str]] = {}
        calls: dict[str, set[str]] = {}
        belongs: list[str | None] = []
        inside: list[str] = []
        for card in cards:
            words = card.words
            if words[0] == ".subckt":
                if len(words) < 2:
                    raise InputError(f"{path}: line {card.line}: a .SUBCKT without a name")
                if not inside:
                    outside.setdefault(words[1], _before_parameters(words[2:]))
                inside.append(words[1])
            belongs.append(inside[0] if inside else None)
            if words[0] == ".ends":
                if not inside:
                    raise InputError(f"{path}: line {card.line}: .ENDS without .SUBCKT")
                inside.pop()
            elif not inside:
                _check_card(card, path)
                if not words[0].startswith("."):
                    raise InputError(
                        f"{path}: line {card.line}: '{shortened(one_line(card.text))}' stands outside a .SUBCKT"
                    )
            elif words[0].startswith("x"):
                callee = _before_parameters(words[1:])[-1:]
                for caller in {inside[0], inside[-1]}:
                    calls.setdefault(caller, set()).update(callee)
        if inside:
            raise InputError(f"{path}: .SUBCKT {one_line(inside[-1])} has no .ENDS")
        name = self.subcircuit.lower()
        if name not in outside:
            known = ", ".join(sorted(outside)) or "none"
            raise InputError(f"{path}: no .SUBCKT {self.subcircuit}; the file has {shortened(one_line(known), 100)}")
        if len(outside[name]) != len(self.pins):
            raise InputError(
                f"{path}: .SUBCKT {self.subcircuit} has {len(outside[name])} pins "
                f"({shortened(one_line(' '.join(outside[name])))}), but readout.amplifier_model.pins names "
                f"{len(self.pins)}"
            )
        reached = _reached(name, calls, path)
        used = [card for card, owner in zip(cards, belongs, strict=True) if owner is None or owner in reached]
        if (whole := _expanded(used, reached)) > MOST_STATEMENTS:
            what = f"{path}: .SUBCKT {self.subcircuit} with all that it calls"
            raise InputError(f"{what} has {whole:.3g} statements; expected at most {MOST_STATEMENTS}")
        return used


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


def _without_thermal_noise(cards: list[Statement]) -> Iterator[str]:
    """The statements, with ``noisy=0`` on resistors whose model has a temperature of zero kelvin."""
    scopes = _resistor_models(cards)
    inside: list[int] = []
    for number, card in enumerate(cards):
        first, text = card.words[0], card.text
        if first == ".subckt":
            inside.append(number)
        elif first == ".ends":
            inside.pop()
        elif first == ".model" and (found := _ABSOLUTE.search(text)) and float(found[1]) <= _NOISELESS_CELSIUS:
            text = _ABSOLUTE.sub("", text, count=1)
        elif first[0] == "r":
            # The nearest model of that name counts, as in ngspice.
            known = (scopes.get(scope, {}).get(word) for word in card.words[3:5] for scope in (*reversed(inside), None))
            if next((noiseless for noiseless in known if noiseless is not None), False):
                text = f"{text} noisy=0"
        yield text


def _resistor_models(cards: list[Statement]) -> dict[int | None, dict[str, bool]]:
    """Whether models of resistors are without noise, by name, for each .SUBCKT by its place; None: outside of all."""
    scopes: dict[int | None, dict[str, bool]] = {}
    inside: list[int | None] = [None]
    for number, card in enumerate(cards):
        words = card.text.lower().replace("(", " ").split()
        if words[0] == ".subckt":
            inside.append(number)
        elif words[0] == ".ends":
            inside.pop()
        elif words[0] == ".model" and words[2] in ("r", "res"):
            found = _ABSOLUTE.search(card.text)
            noiseless = found is not None and float(found[1]) <= _NOISELESS_CELSIUS
            scopes.setdefault(inside[-1], {})[words[1]] = noiseless
    return scopes


def _before_parameters(words: list[str]) -> list[str]:
    """Words before any parameter: the nodes of a .SUBCKT line, or the nodes and the subcircuit of a call."""
    found = []
    for position, word in enumerate(words):
        if word in ("params:", "optional:") or words[position + 1 : position + 2] == ["="]:
            break
        found.append(word)
    return found


def _expanded(cards: list[Statement], reached: Iterable[str]) -> float:
    """Statements of the last of the subcircuits when all calls in it are replaced by what they call.

    Args:
        cards: of all of them. Of definitions with one name the largest counts.
        reached: names, each behind those that it calls.

    """
    definitions: dict[str, list[Counter[str | None]]] = {}
    inside: list[Counter[str | None]] = []
    for card in cards:
        words = card.words
        if words[0] == ".subckt":
            inside.append(Counter())
            definitions.setdefault(words[1], []).append(inside[-1])
        elif words[0] == ".ends":
            inside.pop()
        elif inside:
            called = _before_parameters(words[1:])[-1:] if words[0].startswith("x") else []
            inside[-1].update([None, *called])
    whole: dict[str | None, float] = {None: 1.0}
    for name in reached:
        whole[name] = max(
            (sum(count * whole.get(part, 0.0) for part, count in parts.items()) for parts in definitions.get(name, [])),
            default=0.0,
        )
    return list(whole.values())[-1]


def _reached(name: str, calls: dict[str, set[str]], path: str) -> dict[str, None]:
    """The subcircuit and all that it calls, which come before it. Raises InputError for one that contains itself, which
    ngspice would expand until memory ends.
    """
    finished: dict[str, None] = {}
    stack = [(name, iter(sorted(calls.get(name, ()))))]
    while stack:
        current, pending = stack[-1]
        callee = next(pending, None)
        if callee is None:
            finished[current] = None
            stack.pop()
        elif callee in [above for above, _ in stack]:
            raise InputError(f"{path}: .SUBCKT {one_line(callee)} contains itself")
        elif callee not in finished:
            stack.append((callee, iter(sorted(calls.get(callee, ())))))
    return finished
