"""A design to a netlist that KiCad reads, whose import gives the same design, and to its list of parts.

The netlist draws lines, drivers, loads or amplifiers, feedback and pull-downs as ordinary parts. What a drawing cannot
say (tolerances, the converter, line resistances) stands in fields ``Ohmskin.TABLE.KEY`` of the connector of the rows.
Which keys these are is not listed here: the parts are imported again, and every key that comes back otherwise gets a
field.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, get_args

from ..circuits import Design
from ..common.config import parse, toml_value
from ._board import value_of
from ._import import KEY, import_design, plain, stated
from ._lines import ROLE
from ._netlist import Netlist, Part, Pin

LEFT_OUT = ("fault", "requirement")
"""tables that are no part of the circuit"""
_CHANNELS, _COMMON = ("9", "8", "7", "6", "5", "4", "3", "2", "23", "22", "21", "20", "19", "18", "17", "16"), "1"
"""pins of a CD74HC4067"""


class _Drawing:
    """Parts and nets as they are placed."""

    def __init__(self) -> None:
        self.parts: dict[str, Part] = {}
        self._counts: dict[str, int] = {}

    def add(self, letter: str, kind: str, value: str, nets: Mapping[str, str], **fields: str) -> Part:
        """Place a part; ``nets`` by number of pin. Fields' names have ``Ohmskin.`` ahead."""
        self._counts[letter] = self._counts.get(letter, 0) + 1
        ref = f"{letter}{self._counts[letter]}"
        pins = {number: Pin(net) for number, net in nets.items()}
        part = Part(ref, value, kind, {f"{KEY}{name}": text for name, text in fields.items()}, pins)
        self.parts[ref] = part
        return part

    def netlist(self) -> Netlist:
        nets: dict[str, list[tuple[str, str]]] = {}
        for part in self.parts.values():
            for number, pin in part.pins.items():
                nets.setdefault(pin.net, []).append((part.ref, number))
        return Netlist(self.parts, nets)


def drawn(tables: Mapping[str, Any]) -> Netlist:
    """The parts of a design, given by the tables of its file, with fields for what they do not say.

    Raises:
        InputError: the tables are no valid design.

    """
    wanted = {name: table for name, table in tables.items() if name not in LEFT_OUT}
    wanted["readout"] = {key: item for key, item in wanted.get("readout", {}).items() if key != "amplifier_model"}
    if not wanted["readout"]:
        del wanted["readout"]
    design = parse(wanted, Design, source="the design")
    drawing = _Drawing()
    rows = _connector(drawing, "ROW", design.array.rows, "rows")
    _connector(drawing, "COL", design.array.columns, "columns")
    if "column_end" not in wanted:
        _columns(drawing, design, wanted["readout"])
    if "row_end" not in wanted:
        _drivers(drawing, design)
    fields = dict(rows.fields)
    came_back, meant = import_design(drawing.netlist()), stated(design)
    for (table, key), value in meant.items():
        stated_there = came_back.tables.get(table, {}).get(key, _default(table, key))
        if value is not None and (plain(stated_there) != plain(value) or (table, key) in came_back.questions):
            fields[f"{KEY}{table}.{key}"] = toml_value(value)
    absent = [table for table in came_back.tables if not any(name == table for name, _ in meant)]
    if absent:
        fields[f"{KEY}without"] = " ".join(absent)
    drawing.parts[rows.ref] = replace(rows, fields=fields)
    return drawing.netlist()


def _default(table: str, key: str) -> Any:
    """The value of a key that is left out; None: it has none."""
    annotation = Design.model_fields[table].annotation
    for model in (annotation, *get_args(annotation)):
        found = getattr(model, "model_fields", {}).get(key)
        if found is not None and not found.is_required():
            return found.get_default(call_default_factory=True)
    return None


def _connector(drawing: _Drawing, stem: str, count: int, role: str) -> Part:
    nets = {str(k + 1): f"{stem}{k}" for k in range(count)}
    return drawing.add("J", f"Conn_01x{count:02d}", stem, nets, **{ROLE.removeprefix(KEY): role})


def _columns(drawing: _Drawing, design: Design, readout: Mapping[str, Any]) -> None:
    given = readout["reference_resistance"]
    nominal = given["nominal"] if isinstance(given, Mapping) else given
    spread = {key: item for key, item in given.items() if key != "nominal"} if isinstance(given, Mapping) else {}
    fields = {"spread": ", ".join(f"{key} = {toml_value(item)}" for key, item in spread.items())} if spread else {}
    lines = range(design.array.rows if design.readout.circuit == "row-amplifier" else design.array.columns)
    stem = "ROW" if design.readout.circuit == "row-amplifier" else "COL"
    multiplexed = design.readout.columns == "multiplexed"
    ends = range(1) if multiplexed else lines
    for first in range(0, len(lines), len(_CHANNELS)) if multiplexed else ():
        own = zip(_CHANNELS, lines[first:], strict=False)
        pins = {number: f"{stem}{k}" for number, k in own} | {_COMMON: "SENSE", "24": "VCC", "12": "GND"}
        drawing.add("U", "Multiplexer", "CD74HC4067", pins)
    amplified = design.board.circuit.has_amplifiers
    for k in ends:
        net = "SENSE" if multiplexed else f"{stem}{k}"
        ohm = nominal[k] if isinstance(nominal, list) else nominal
        if amplified:
            drawing.add("R", "R", _shown(ohm), {"1": net, "2": f"OUT{k}"}, **fields)
            pins = {"1": f"OUT{k}", "2": net, "3": "REF", "4": "GND", "8": "VCC"}
            drawing.add("U", "Amplifier", "OPAMP", pins)
            if design.readout.feedback_capacitance:
                drawing.add("C", "C", _shown(design.readout.feedback_capacitance), {"1": net, "2": f"OUT{k}"})
        else:
            level = design.readout.reference_voltage
            far = "GND" if not level else f"+{level:g}V" if level > 0 else "REF"
            drawing.add("R", "R", _shown(ohm), {"1": net, "2": far}, **fields)
        if design.readout.column_capacitance:
            drawing.add("C", "C", _shown(design.readout.column_capacitance), {"1": net, "2": "GND"})


def _drivers(drawing: _Drawing, design: Design) -> None:
    if design.drive.idle_rows == "pull":
        for k in range(design.array.rows):
            drawing.add("R", "R", _shown(design.drive.idle_row_resistance), {"1": f"ROW{k}", "2": "GND"})


def _shown(value: float) -> str:
    """A value as it is written in a drawing; as a plain number where a prefix would round it."""
    for prefix, scale in (("M", 1e6), ("k", 1e3), ("", 1.0), ("m", 1e-3), ("u", 1e-6), ("n", 1e-9), ("p", 1e-12)):
        if value >= scale:
            text = f"{value / scale:.6g}{prefix}"
            return text if value_of(text) == value else repr(float(value))
    return repr(float(value))


def to_netlist(tables: Mapping[str, Any]) -> str:
    """A design's tables as a netlist of KiCad (s-expression), with the fields by which it is imported again."""
    netlist = drawn(tables)
    quoted = json.dumps
    lines = ['(export (version "E")', '  (design (tool "ohmskin"))', "  (components"]
    for part in netlist.parts.values():
        lines.append(f"    (comp (ref {quoted(part.ref)}) (value {quoted(part.value)})")
        if part.fields:
            fields = " ".join(f"(field (name {quoted(name)}) {quoted(text)})" for name, text in part.fields.items())
            lines.append(f"      (fields {fields})")
        lines.append(f'      (libsource (lib "ohmskin") (part {quoted(part.kind)}) (description "")))')
    lines += ["  )", "  (nets"]
    for code, (name, nodes) in enumerate(netlist.nets.items(), start=1):
        lines.append(f'    (net (code "{code}") (name {quoted(name)})')
        lines += [f"      (node (ref {quoted(ref)}) (pin {quoted(number)}))" for ref, number in nodes]
        lines.append("    )")
    return "\n".join([*lines, "  )", ")"]) + "\n"


def parts_list(tables: Mapping[str, Any]) -> str:
    """The parts of a design as CSV: references, quantity, kind, value, tolerance."""
    groups: dict[tuple[str, str, str], list[str]] = {}
    for part in drawn(tables).parts.values():
        groups.setdefault((part.kind, part.value, part.fields.get(f"{KEY}spread", "")), []).append(part.ref)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["references", "quantity", "kind", "value", "spread"])
    for (kind, value, spread), refs in groups.items():
        writer.writerow([" ".join(refs), len(refs), kind, value, spread])
    return out.getvalue()
