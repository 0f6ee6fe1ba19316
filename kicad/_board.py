"""A netlist as a circuit: resistors, capacitors and diodes between nets, amplifiers, multiplexers, drivers, potentials.

``parts.toml`` says what a netlist does not: pins by number, and values from data sheets.
"""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ..common.config import parse_toml
from ._netlist import Netlist, Part

_VALUE = re.compile(
    r"^\s*(?P<whole>\d*[.,]?\d+(?:[eE][-+]?\d+)?)\s*(?P<unit>[pnuµμmkKMGR]|ohms?|Ω)?(?P<rest>\d*)", re.ASCII
)
_PERCENT = re.compile(r"(\d*\.?\d+)\s*%")
_FIRST = 40
"""characters of a value in which its tolerance stands"""
_PREFIX = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
_GROUND = re.compile(r"^(?:[ADPS]?GND[ADPS]?|GNDREF|VSS[A]?|0|0V|EARTH)$", re.IGNORECASE)
_SUPPLY = re.compile(r"^\+?(?P<whole>\d+)(?:V(?P<part>\d*)|\.(?P<point>\d+)V)\w*$", re.IGNORECASE)
_NAMED_SUPPLY = re.compile(r"^\+?(?:A|D)?V(?:CC|DD|IN|REF|BUS|AA|S)\w*$|^\+?BATT?\w*$", re.IGNORECASE)
_CONTROLLER_PINS = 8
"""a part of more pins that nothing else is known of counts as a controller only if its name is listed"""


def value_of(text: str) -> float | None:
    """The value of a resistor or capacitor as drawn: ``10k``, ``4k7``, ``0R1``, ``2.2uF``; None: it is none."""
    found = _VALUE.match(text)
    if found is None:
        return None
    whole, unit, rest = found["whole"].replace(",", "."), found["unit"] or "", found["rest"]
    if rest and "." not in whole:
        whole = f"{whole}.{rest}"
    return float(whole) * _PREFIX.get(unit, 1.0)


def spread_of(part: Part) -> dict[str, Any]:
    """The tolerance of a part: of its field ``Ohmskin.spread`` (keys of DESIGN.toml), ``Tolerance``, or its value."""
    own = part.fields.get("Ohmskin.spread", "")
    if own:
        return dict(parse_toml(f"spread = {{ {own} }}", f"{part.ref}: field Ohmskin.spread")["spread"])
    for text in (part.fields.get("Tolerance", ""), part.fields.get("tolerance", ""), part.value):
        found = _PERCENT.search(text[:_FIRST])
        if found:
            return {"tolerance": float(found[1]) / 100.0}
    return {}


class Branch(NamedTuple):
    """A two-terminal part, seen from one of its nets."""

    part: Part
    value: float
    other: str
    """the net at its other end"""
    forward: bool = True
    """diodes: whether this net is the anode"""


class Amplifier(NamedTuple):
    """One unit of an operational amplifier; its nets."""

    part: Part
    inverting: str
    other: str
    output: str
    supplies: tuple[str, str]


class Switch(NamedTuple):
    """A multiplexer as one of its channels sees it, or a change-over switch as its pole sees it."""

    part: Part
    nets: tuple[str, ...]
    """the common net; of a change-over switch both throws"""
    on_resistance: float


class Output(NamedTuple):
    """A push-pull output: of a shift register, a decoder, or a controller."""

    part: Part
    supply: str | None
    """net of its supply; None: not told"""
    on_resistance: float
    is_controller: bool


@dataclass
class Board:
    """The circuit of a netlist."""

    netlist: Netlist

    def without(self, parts: Iterable[Part]) -> Board:
        """The same board without some parts."""
        gone = {part.ref for part in parts}
        nets = {name: [node for node in nodes if node[0] not in gone] for name, nodes in self.netlist.nets.items()}
        return Board(Netlist({ref: part for ref, part in self.netlist.parts.items() if ref not in gone}, nets))

    @cached_property
    def resistors(self) -> dict[str, list[Branch]]:
        """Net -> the resistors at it."""
        return self._branches("R", r"^R(?:\d|_|$|es)")

    @cached_property
    def capacitors(self) -> dict[str, list[Branch]]:
        """Net -> the capacitors at it."""
        return self._branches("C", r"^C(?:\d|_|$|ap)")

    @cached_property
    def diodes(self) -> dict[str, list[Branch]]:
        """Net -> the diodes at it."""
        found: dict[str, list[Branch]] = defaultdict(list)
        for part in self.netlist.parts.values():
            if part.ref.rstrip("0123456789?") == "D" and len(part.pins) == 2 and "LED" not in part.kind.upper():
                anode = next((n for n, pin in part.pins.items() if pin.function.upper() in ("A", "ANODE")), "2")
                if anode in part.pins:
                    plus = part.pins[anode].net
                    minus = next(pin.net for number, pin in part.pins.items() if number != anode)
                    found[plus].append(Branch(part, 0.0, minus))
                    found[minus].append(Branch(part, 0.0, plus, forward=False))
        return found

    def _branches(self, letter: str, kinds: str) -> dict[str, list[Branch]]:
        found: dict[str, list[Branch]] = defaultdict(list)
        for part in self.netlist.parts.values():
            stem = part.ref.rstrip("0123456789?")
            if stem not in (letter, f"{letter}N", f"{letter}A") and not re.match(kinds, part.kind):
                continue
            value = value_of(part.value)
            if value is None or part.fields.get("dnp", "") not in ("", "0", "no") or "DNP" in part.value.upper():
                continue
            for one, other in _pairs(part):
                found[one].append(Branch(part, value, other))
                found[other].append(Branch(part, value, one))
        return found

    @cached_property
    def amplifiers(self) -> list[Amplifier]:
        """All units of all operational amplifiers that are connected."""
        found = []
        for part in self.netlist.parts.values():
            if self.described("amplifier", part) is None or self._is_switch(part):
                continue
            package = _package(part)
            if package is None:
                continue
            pins = {number: pin.net for number, pin in part.pins.items()}
            plus, minus = (pins.get(number, "") for number in package["supplies"])
            for inverting, other, output in package["units"]:
                if {inverting, other, output} <= pins.keys():
                    found.append(Amplifier(part, pins[inverting], pins[other], pins[output], (minus, plus)))
        return found

    @cached_property
    def switches(self) -> dict[str, list[Switch]]:
        """Net -> the switches that it is a channel or a pole of."""
        found: dict[str, list[Switch]] = defaultdict(list)
        for part in self.netlist.parts.values():
            if (known := self.described("mux", part)) is not None:
                for common, channels in _multiplexers(part, known):
                    switch = Switch(part, (common,), float(known["on_resistance"]))
                    for number in channels:
                        if number in part.pins:
                            found[part.pins[number].net].append(switch)
            elif (known := self.described("changeover", part)) is not None:
                for pole, *throws in known["poles"]:
                    if all(number in part.pins for number in (pole, *throws)):
                        nets = tuple(part.pins[number].net for number in throws)
                        found[part.pins[pole].net].append(Switch(part, nets, float(known["on_resistance"])))
        return found

    def _is_switch(self, part: Part) -> bool:
        return any(self.described(kind, part) is not None for kind in ("mux", "changeover", "driver", "converter"))

    def output_at(self, net: str) -> Output | None:
        """The push-pull output that drives a net; None: there is none."""
        for ref, number in self.netlist.nets.get(net, ()):
            part = self.netlist.parts[ref]
            if (known := self.described("driver", part)) is not None and number in known["outputs"]:
                supply = part.pins.get(known["supply_pin"])
                return Output(part, None if supply is None else supply.net, float(known["on_resistance"]), False)
            if (known := self.described("controller", part)) is not None and len(part.pins) > _CONTROLLER_PINS:
                return Output(part, None, float(known["on_resistance"]), True)
        return None

    def converter_at(self, net: str) -> Part | None:
        """The controller or converter that a net goes to; None: there is none."""
        for ref, _ in self.netlist.nets.get(net, ()):
            part = self.netlist.parts[ref]
            if any(self.described(kind, part) is not None for kind in ("converter", "controller")):
                return part
        return None

    @cached_property
    def controller(self) -> Part | None:
        """The converter of the board, or its controller; None: neither is known."""
        for kind in ("converter", "controller"):
            for part in self.netlist.parts.values():
                if self.described(kind, part) is not None:
                    return part
        return None

    def described(self, kind: str, part: Part) -> dict[str, Any] | None:
        """The entry of parts.toml for a part, if it is of that kind."""
        for entry in _catalogue()[kind]:
            if part.named(entry["pattern"]):
                return dict(entry)
        return None

    def is_ground(self, net: str) -> bool:
        """Whether a net is ground, by its name."""
        return _GROUND.match(_short(net)) is not None

    def supply_volts(self, net: str) -> float | None:
        """The volts of a supply by its name; NaN where the name tells none; None: it is no supply."""
        name = _short(net)
        found = _SUPPLY.match(name)
        if found is not None:
            return float(f"{found['whole']}.{found['part'] or found['point'] or 0}")
        return float("nan") if _NAMED_SUPPLY.match(name) else None


def _short(net: str) -> str:
    return net.rsplit("/", 1)[-1]


def _pairs(part: Part) -> list[tuple[str, str]]:
    """The nets of each resistor or capacitor of a part: one, a pack of several, or a network with a common pin."""
    pins = part.pins
    if len(pins) == 2:
        one, other = (pin.net for pin in pins.values())
        return [(one, other)]
    units: dict[str, list[str]] = defaultdict(list)
    common = next((pin.net for pin in pins.values() if pin.function.lower() in ("common", "com")), None)
    for pin in pins.values():
        found = re.match(r"R(\d+)(?:\.\d)?$", pin.function)
        if found:
            units[found[1]].append(pin.net)
    if common is not None:
        return [(common, nets[0]) for nets in units.values()]
    if units:
        return [(nets[0], nets[1]) for nets in units.values() if len(nets) == 2]
    count = len(pins)
    if re.search(r"pack", part.kind, re.IGNORECASE) and count % 2 == 0:
        return [(pins[str(k + 1)].net, pins[str(count - k)].net) for k in range(count // 2) if str(count - k) in pins]
    return []


def _multiplexers(part: Part, known: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """(net of the common pin, numbers of the channels' pins) of a part: by number, else by the pins' names."""
    common, channels = known.get("common"), known.get("channels", [])
    second = known.get("second")
    by_name = {number: pin.function.upper().strip("~{}") for number, pin in part.pins.items()}
    named = [n for n, name in by_name.items() if re.fullmatch(r"(?:I|C|CH|Y|X|S|A|IN|IO)?\d+", name) and n != common]
    commons = [n for n, name in by_name.items() if re.fullmatch(r"SIG|COM|COMMON|Z|D|X|A|COM\w*", name)]
    is_breakout = any(name in ("SIG", "COMMON") for name in by_name.values())
    if common in part.pins and not is_breakout:
        found = [(part.pins[common].net, list(channels))]
        if second is not None and second["common"] in part.pins:
            found.append((part.pins[second["common"]].net, list(second["channels"])))
        return found
    if not commons:
        return []
    selects = {n for n in named if re.fullmatch(r"[SA]\d", by_name[n]) and len(named) > 8}
    return [(part.pins[commons[0]].net, [n for n in named if n not in selects])]


def _package(part: Part) -> dict[str, Any] | None:
    packages = _catalogue()["packages"]
    highest = max((int(number) for number in part.pins if re.fullmatch(r"[0-9]{1,4}", number)), default=0)
    if highest <= 5:
        return dict(packages["5"])
    if highest <= 8:
        single = part.pins.get("6") is not None and part.pins.get("1") is None and part.pins.get("7") is not None
        return dict(packages["single" if single else "8"])
    return dict(packages["14"]) if highest <= 14 else None


@cache
def _catalogue() -> dict[str, Any]:
    tables = tomllib.loads((Path(__file__).parent / "parts.toml").read_text(encoding="utf-8"))
    for kind, entries in tables.items():
        if kind != "packages":
            for entry in entries:
                entry["pattern"] = re.compile(entry["match"], re.IGNORECASE)
    return tables
