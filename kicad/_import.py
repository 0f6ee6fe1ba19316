"""A board's circuit to a DESIGN.toml: each value with the part it comes from, and a question for what is not told."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan
from typing import Any

from pydantic import BaseModel

from ..circuits import Design
from ..common.config import parse, parse_toml, toml_value
from ..common.text import one_line
from ..errors import InputError
from ._board import Board, Branch, spread_of
from ._lines import ROLE, ColumnEnd, Level, RowEnd, column_end, find_lines, row_end
from ._netlist import Netlist

KEY = "Ohmskin."
"""head of the fields that state a key of DESIGN.toml: ``Ohmskin.adc.bits``, with its value as TOML"""
USUAL_VOLTS, USUAL_BITS = 5.0, 10
"""of a supply whose name tells none, and of a converter that is not known: what a question begins with"""
SAME_VOLTS = 1e-3
"""V, up to which two potentials are the same"""
LEAST_OHM = 1e-3
"""of a resistor in a described end"""


@dataclass
class Imported:
    """A design read from a netlist."""

    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    """of DESIGN.toml"""
    notes: dict[tuple[str, str], str] = field(default_factory=dict)
    """(table, key) -> where its value comes from"""
    questions: dict[tuple[str, str], str] = field(default_factory=dict)
    """(table, key) -> what a netlist cannot tell of it; the value there is a usual one"""

    def put(self, table: str, key: str, value: Any, note: str) -> None:
        """State a key."""
        self.tables.setdefault(table, {})[key] = value
        self.notes[table, key] = note

    def ask(self, table: str, key: str, question: str) -> None:
        """Doubt a key."""
        self.questions.setdefault((table, key), question)

    def design(self) -> Design:
        """The design; InputError if the values do not fit each other."""
        return parse(self.tables, Design, source="the netlist")

    def toml(self) -> str:
        """DESIGN.toml: a comment for each value, and the questions where they belong."""
        lines = ["# From a netlist. # ? asks for what a netlist cannot tell; the value below it is a usual one."]
        for table, keys in self.tables.items():
            lines += ["", f"[{table}]"]
            for key, value in keys.items():
                if (table, key) in self.questions:
                    lines.append(f"# ? {one_line(self.questions[table, key])}")
                lines.append(f"{key} = {toml_value(value)}  # {one_line(self.notes[table, key])}")
        return "\n".join(lines) + "\n"


def import_design(netlist: Netlist) -> Imported:
    """Find the array of a board and what its lines end in, and state the design.

    Raises:
        InputError: no array is found, its lines end in different kinds of circuits, or a field is not valid.

    """
    lines = find_lines(Board(netlist))
    board, sensed, driven = lines.board, lines.columns, lines.rows
    found = Imported()
    found.put("array", "rows", len(driven), f"by {lines.by}")
    found.put("array", "columns", len(sensed), "likewise")
    ends = [column_end(board, net, sensed=True) for net in sensed]
    transposed = not any(ends) and all(column_end(board, net) for net in driven)
    if transposed:
        sensed, driven = driven, sensed
        ends = [column_end(board, net) for net in sensed]
    reference = _columns(found, board, sensed, ends)
    if transposed:
        found.put("readout", "circuit", "row-amplifier", _why(next(end for end in ends if end is not None)))
    _rows(found, [row_end(board, net) for net in driven], driven, reference)
    _converter(found, board, ends)
    _stated(found, netlist)
    order = ("array", "drive", "row_end", "readout", "adc")
    found.tables = {name: found.tables[name] for name in (*order, *found.tables) if name in found.tables}
    return found


def differences(found: Design, wanted: Design) -> list[str]:
    """Values of two designs that differ, a line each."""
    ours, theirs = stated(found), stated(wanted)
    return [
        f"{table}.{key}: {_shown(ours.get((table, key)))} in the netlist, {_shown(theirs[table, key])} in the design"
        for table, key in theirs
        if plain(ours.get((table, key))) != plain(theirs[table, key])
    ]


def _shown(value: Any) -> str:
    return "nothing" if value is None else toml_value(value)


def plain(value: Any) -> Any:
    """A value in a form that compares: numbers as floats, sequences as lists."""
    match value:
        case bool() | str() | None:
            return value
        case int() | float():
            return float(value)
        case Mapping():
            return {key: plain(item) for key, item in value.items()}
        case Sequence():
            return [plain(item) for item in value]
    return value


def stated(design: Design) -> dict[tuple[str, str], Any]:
    """All values of a design, defaults too, by table and key; parts with a spread as tables of DESIGN.toml."""
    values: dict[tuple[str, str], Any] = {}
    for table in type(design).model_fields:
        section = getattr(design, table)
        for key, value in section.model_dump(exclude={"spread"}).items() if isinstance(section, BaseModel) else ():
            spread = design.spreads.get(f"{table}.{key}")
            own = {} if spread is None else spread.model_dump(exclude_unset=True)
            values[table, key] = {"nominal": value, **own} if own else value
    return values


# -- the sensed lines ---


def _columns(found: Imported, board: Board, nets: Sequence[str], ends: Sequence[ColumnEnd | None]) -> float:
    """State ``[readout]`` and ``column_lead``; returns the volts of the reference."""
    kinds = Counter("nothing" if end is None else end.kind for end in ends)
    if len(kinds) > 1:
        usual = kinds.most_common(1)[0][0]
        odd = next(
            net for net, end in zip(nets, ends, strict=True) if ("nothing" if end is None else end.kind) != usual
        )
        raise InputError(f"columns end in {', '.join(f'{n} x {kind}' for kind, n in kinds.items())}; see net {odd}")
    known = [end for end in ends if end is not None]
    if not known:
        found.put("readout", "circuit", "voltage-divider", f"no load is drawn at {nets[0]}")
        found.put("readout", "reference_resistance", 10e3, "not drawn")
        found.ask("readout", "reference_resistance", "what loads a column? (ohm; no resistor to a supply was found)")
        found.put("readout", "reference_voltage", 0.0, "ground")
        return 0.0
    first = known[0]
    is_amplifier = first.kind == "amplifier"
    found.put("readout", "circuit", "inverting-amplifier" if is_amplifier else "voltage-divider", _why(first))
    _resistances(found, "readout", "reference_resistance", [end.reference for end in known if end.reference])
    volts = _reference(found, first)
    shared = {end.switch[0].ref for end in known if end.switch is not None}
    if shared:
        part, ohm = first.switch or known[0].switch or (None, 0.0)
        found.put("readout", "columns", "multiplexed", f"behind {', '.join(sorted(shared))}")
        found.put("readout", "idle_columns", "float", "open channels of the multiplexer")
        if part is not None:
            found.put("array", "column_lead", ohm, f"{part.ref} {part.value}, typical on-resistance")
        ends_apart = {end.reference.part.ref for end in known if end.reference}
        if len(ends_apart) > 1:
            found.ask(
                "readout",
                "columns",
                f"{len(ends_apart)} multiplexers have an end each: see [column_end] with shared_by; here all share one",
            )
    series = [sum(branch.value for branch in end.series) for end in known]
    if any(series):
        refs = [branch.part.ref for end in known for branch in end.series]
        found.put("array", "column_lead", _one(series), f"{refs[0]} and so on")
    if first.ground is not None:
        _put_capacitor(found, "column_capacitance", [end.ground for end in known])
    if is_amplifier:
        _amplifier(found, board, first)
        if first.feedback is not None:
            _put_capacitor(found, "feedback_capacitance", [end.feedback for end in known])
    return volts


def _why(end: ColumnEnd) -> str:
    if end.amplifier is not None and end.reference is not None:
        return f"{end.amplifier.part.ref} {end.amplifier.part.value} with {end.reference.part.ref} from output to input"
    assert end.reference is not None
    return f"{end.reference.part.ref} from the column to {end.reference.other}"


def _resistances(found: Imported, table: str, key: str, branches: Sequence[Branch]) -> None:
    """State resistors of the lines: one value or a list, with the tolerance that their parts name."""
    value: Any = _one([branch.value for branch in branches])
    spreads = [spread_of(branch.part) for branch in branches]
    if spreads[0] and all(spread == spreads[0] for spread in spreads):
        value = {"nominal": value, **spreads[0]}
    refs = list(dict.fromkeys(branch.part.ref for branch in branches))
    shown = refs[0] if len(refs) == 1 else f"{refs[0]} to {refs[-1]}"
    found.put(table, key, value, f"{shown} {branches[0].part.value}")


def _put_capacitor(found: Imported, key: str, branches: Sequence[Branch | None]) -> None:
    values = {branch.value for branch in branches if branch is not None}
    first = next(branch for branch in branches if branch is not None)
    found.put("readout", key, max(values), f"{first.part.ref} {first.part.value}, F")
    if len(values) > 1 or None in branches:
        found.ask(
            "readout", key, "the lines have different capacitors, and a design one value; the largest one stands here"
        )


def _one(values: Sequence[float]) -> float | list[float]:
    return values[0] if len(set(values)) == 1 else list(values)


def _reference(found: Imported, end: ColumnEnd) -> float:
    level = end.level
    if level is None:
        found.put("readout", "reference_voltage", 0.0, "not found in the netlist")
        found.ask("readout", "reference_voltage", "which volts are at the other input of the amplifiers?")
        return 0.0
    volts = _volts(found, level, "readout", "reference_voltage")
    held = f" by {' and '.join(level.parts)}" if level.parts else ""
    found.put("readout", "reference_voltage", volts, f"V of {level.net}{held}")
    return volts


def _volts(found: Imported, level: Level, table: str, key: str) -> float:
    if not isnan(level.volts):
        return level.volts
    found.ask(table, key, f"how many volts has {level.net or 'the supply'}?")
    return USUAL_VOLTS


def _amplifier(found: Imported, board: Board, end: ColumnEnd) -> None:
    assert end.amplifier is not None
    part = end.amplifier.part
    known = board.described("amplifier", part) or {}
    names = {
        "open_loop_gain": "gain",
        "gain_bandwidth": "gain_bandwidth",
        "offset_voltage": "offset_voltage",
        "bias_current": "bias_current",
        "voltage_noise": "voltage_noise",
    }
    for key, name in names.items():
        if name in known:
            found.put("readout", key, known[name], f"{part.value}, data sheet")
    levels = [board.supply_volts(net) if not board.is_ground(net) else 0.0 for net in end.amplifier.supplies]
    if None in levels:
        return
    low, high = (USUAL_VOLTS if volts is None or isnan(volts) else volts for volts in levels)
    if any(volts is not None and isnan(volts) for volts in levels):
        found.ask("readout", "supply", f"how many volts has {end.amplifier.supplies[1]}?")
    margin = float(known.get("from_rails", 0.0))
    swing = [low + margin, high - float(known.get("below_rail", margin))]
    found.put(
        "readout", "supply", swing, f"V between {' and '.join(end.amplifier.supplies)}, less {part.value}'s margin"
    )


# -- the driven lines ---


def _rows(found: Imported, ends: Sequence[RowEnd | None], nets: Sequence[str], reference: float) -> None:
    known = [end for end in ends if end is not None]
    if not known:
        found.put("drive", "voltage", _other_rail(reference), "no driver is drawn")
        found.ask("drive", "voltage", f"what drives {nets[0]}, and with how many volts against the reference?")
        return
    first = known[0]
    selected = first.selected or Level(float("nan"))
    volts = _volts(found, selected, "drive", "voltage")
    low = first.idle is not None and first.idle.volts == 0.0 and not first.idle.net  # a push-pull output: either level
    high_reference = low and reference != 0.0 and abs(volts - reference) < SAME_VOLTS
    if high_reference:  # loads to the supply: the selected row is pulled low, and idle rows stand high
        volts = 0.0
    ohms = [end.on_ohm + sum(branch.value for branch in end.series) for end in known]
    described = first.diode is not None or (first.idle is not None and not _stays(first, reference, high_reference))
    if first.is_controller:
        table, key = ("row_end", "idle") if described else ("drive", "idle_rows")
        found.ask(table, key, "are pins of idle rows driven to the other level (ground), or open (float)?")
    if described:
        _described(found, first, volts, max(ohms[0], LEAST_OHM))
        return
    found.put("drive", "voltage", volts - reference, f"V against the reference, by {first.driver}")
    _idle(found, first, reference)
    series = f" with {first.series[0].part.ref} {first.series[0].part.value}" if first.series else ""
    found.put("array", "row_lead", _one(ohms), f"{first.driver}, typical on-resistance{series}")


def _stays(end: RowEnd, reference: float, high_reference: bool) -> bool:
    """Whether idle rows stand at the reference."""
    return high_reference or (end.idle is not None and abs(end.idle.volts - reference) < SAME_VOLTS)


def _described(found: Imported, end: RowEnd, volts: float, ohm: float) -> None:
    """State rows whose idle level is not the reference, or that have a diode, by the parts of their ends."""
    drive = [f"V1 drive 0 {volts:g}"]
    if end.diode is not None:
        found.put("row_end", "selected", [*drive, "D1 drive node", f"R1 node line {ohm:g}"], end.driver)
        found.put("row_end", "idle", [], f"{end.diode.part.ref} {end.diode.part.value} blocks")
        return
    assert end.idle is not None
    found.put("row_end", "selected", [*drive, f"R1 drive line {ohm:g}"], f"{end.driver}, typical on-resistance")
    idle = [f"V1 hold 0 {end.idle.volts:g}", f"R1 hold line {ohm + end.idle.ohm:g}"]
    found.put("row_end", "idle", idle, f"{end.driver}, whose idle level is not the reference")


def _idle(found: Imported, end: RowEnd, reference: float) -> None:
    if end.idle is not None:
        found.put("drive", "idle_rows", "ground", f"{end.driver} holds idle rows at the reference")
        return
    if end.pull is not None:
        branch, level = end.pull
        if abs(level.volts - reference) < SAME_VOLTS:
            found.put("drive", "idle_rows", "pull", f"{end.driver} leaves idle rows open, {branch.part.ref} pulls")
            found.put("drive", "idle_row_resistance", branch.value, f"{branch.part.ref} {branch.part.value}")
            return
    found.put("drive", "idle_rows", "float", f"{end.driver} leaves idle rows open")


def _other_rail(reference: float) -> float:
    return USUAL_VOLTS if reference == 0.0 else -reference


# -- the converter, and what fields state ---


def _converter(found: Imported, board: Board, ends: Sequence[ColumnEnd | None]) -> None:
    part = board.controller
    known = {} if part is None else board.described("converter", part) or board.described("controller", part) or {}
    if part is None:
        found.put("adc", "bits", USUAL_BITS, "no converter is drawn")
        found.ask("adc", "bits", "how many bits has the converter?")
    else:
        found.put("adc", "bits", known["bits"], f"{part.ref} {part.value}")
    volts = float(known.get("volts", USUAL_VOLTS))
    found.put("adc", "range", [0.0, volts], "V" if part is None else f"V, the usual supply of {part.value}")
    found.ask("adc", "range", "which volts does the converter read as 0 and as full scale?")
    behind = next((end.behind for end in ends if end is not None and end.behind is not None), None)
    if behind is not None:
        found.put("adc", "switch_resistance", behind[1], f"{behind[0].ref} {behind[0].value}, typical on-resistance")


def _stated(found: Imported, netlist: Netlist) -> None:
    """Fields ``Ohmskin.TABLE.KEY`` of any symbol, which state what the drawing cannot."""
    for part in netlist.parts.values():
        for name, text in part.fields.items():
            table, _, key = name.removeprefix(KEY).partition(".")
            if name == f"{KEY}without":
                for absent in text.split():
                    found.tables.pop(absent, None)
                    found.questions = {at: asked for at, asked in found.questions.items() if at[0] != absent}
            if not name.startswith(KEY) or not key or name == ROLE:
                continue
            value = parse_toml(f"value = {text}", f"{part.ref}: field {name}")["value"]
            found.put(table, key, value, f"field {name} of {part.ref}")
            found.questions.pop((table, key), None)
