"""Which nets of a board are the rows and the columns of its array, and what each of them ends in."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field
from math import isnan, nan

from ..errors import InputError
from ._board import Amplifier, Board, Branch, Output
from ._netlist import LONGEST_TEXT, Part

ROLE = "Ohmskin.role"
"""field of a symbol: "rows" or "columns" of a connector, "cell" of a part between a row and a column"""
_CONNECTORS = re.compile(r"^(?:J|P|CN|CON|X|H|JP)\d")
FEW = 2
"""lines of a kind that an array has at least, if its lines are to be found without roles"""


@dataclass
class Level:
    """The potential of a net: volts behind ohms."""

    volts: float
    """NaN: a supply whose name tells no volts"""
    ohm: float = 0.0
    parts: list[str] = field(default_factory=list)
    net: str = ""


@dataclass
class ColumnEnd:
    """What one sensed line ends in."""

    kind: str
    """"amplifier", "load" or "open" """
    reference: Branch | None = None
    """feedback resistor or load"""
    level: Level | None = None
    """of the amplifier's other input, or of the load's far end"""
    amplifier: Amplifier | None = None
    feedback: Branch | None = None
    """capacitor across the feedback resistor"""
    ground: Branch | None = None
    """capacitor from the line to ground"""
    series: list[Branch] = field(default_factory=list)
    """between the line and its end"""
    switch: tuple[Part, float] | None = None
    """multiplexer ahead of the amplifier or the load, and its resistance"""
    behind: tuple[Part, float] | None = None
    """multiplexer between the end and the converter"""


@dataclass
class RowEnd:
    """What drives one line."""

    selected: Level | None = None
    """None: driven, to volts that are not told"""
    idle: Level | None = None
    """None: open while idle"""
    on_ohm: float = 0.0
    driver: str = ""
    """the part that drives, and its kind"""
    series: list[Branch] = field(default_factory=list)
    pull: tuple[Branch, Level] | None = None
    diode: Branch | None = None
    is_controller: bool = False


def potential(board: Board, net: str, *, depth: int = 3) -> Level | None:
    """The potential that holds a net: ground, a supply, a divider between such, or a follower of one; else None."""
    if board.is_ground(net):
        return Level(0.0, net=net)
    volts = board.supply_volts(net)
    if volts is not None:
        return Level(volts, net=net)
    if depth == 0:
        return None
    for amplifier in board.amplifiers:
        if amplifier.output == net and amplifier.inverting == net:
            held = potential(board, amplifier.other, depth=depth - 1)
            return None if held is None else Level(held.volts, 0.0, [*held.parts, amplifier.part.ref], net)
    ends = [(b, potential(board, b.other, depth=depth - 1)) for b in board.resistors.get(net, ())]
    held_by = [(branch, level) for branch, level in ends if level is not None and not level.ohm]
    if len(held_by) < 2:
        return None
    conductance = sum(1.0 / branch.value for branch, _ in held_by if branch.value)
    if not conductance:
        return None
    volts = sum(level.volts / branch.value for branch, level in held_by) / conductance
    return Level(volts, 1.0 / conductance, [branch.part.ref for branch, _ in held_by], net)


def column_end(board: Board, net: str, *, sensed: bool = False) -> ColumnEnd | None:
    """What a net ends in, if it is a sensed line; None: it is not.

    ``sensed`` says that it is one; else a load counts only where the net goes to a converter.
    """
    here = _direct_end(board, net, sensed)
    if here is not None:
        here.behind = _multiplexer(board, here.amplifier.output if here.amplifier is not None else net)
        return here
    for switch in board.switches.get(net, ()):
        end = _direct_end(board, switch.nets[0], sensed) if len(switch.nets) == 1 else None
        if end is not None:
            end.switch = switch.part, switch.on_resistance
            return end
    for branch in board.resistors.get(net, ()):
        if potential(board, branch.other) is None:
            end = _direct_end(board, branch.other, sensed)
            if end is not None and end.kind == "amplifier":
                end.series.append(branch)
                return end
    return None


def _direct_end(board: Board, net: str, sensed: bool) -> ColumnEnd | None:
    ground = next((b for b in board.capacitors.get(net, ()) if board.is_ground(b.other)), None)
    for amplifier in board.amplifiers:
        if amplifier.inverting == net and amplifier.output != net:
            back = [b for b in board.resistors.get(net, ()) if b.other == amplifier.output]
            if back:
                across = next((b for b in board.capacitors.get(net, ()) if b.other == amplifier.output), None)
                level = potential(board, amplifier.other)
                return ColumnEnd("amplifier", back[0], level, amplifier, across, ground)
    if sensed or _reaches_converter(board, net):
        for branch in board.resistors.get(net, ()):
            level = potential(board, branch.other)
            if level is not None:
                return ColumnEnd("load", branch, level, ground=ground)
    return None


def _reaches_converter(board: Board, net: str) -> bool:
    """Whether a net goes to a converter: at once, or by a resistor, a buffer or a multiplexer whose line is open."""
    nets = {net} | {branch.other for branch in board.resistors.get(net, ()) if potential(board, branch.other) is None}
    nets |= {amplifier.output for amplifier in board.amplifiers if amplifier.other in nets}
    nets |= {common for one in set(nets) for switch in board.switches.get(one, ()) for common in switch.nets}
    return any(board.converter_at(one) is not None for one in nets if potential(board, one) is None)


def _multiplexer(board: Board, net: str) -> tuple[Part, float] | None:
    """The multiplexer through which an output goes to the converter."""
    for switch in board.switches.get(net, ()):
        if len(switch.nets) == 1 and potential(board, switch.nets[0]) is None:
            return switch.part, switch.on_resistance
    return None


def row_end(board: Board, net: str) -> RowEnd | None:
    """What drives a net, if it is a driven line; None: nothing does."""
    pull = next(
        ((b, level) for b in board.resistors.get(net, ()) if (level := potential(board, b.other)) is not None), None
    )
    steps: list[tuple[str, list[Branch], Branch | None]] = [(net, [], None)]
    steps += [(b.other, [b], None) for b in board.resistors.get(net, ()) if potential(board, b.other) is None]
    steps += [(b.other, [], b) for b in board.diodes.get(net, ())]
    for at, series, diode in steps:
        found = _driver_at(board, at)
        if found is not None:
            found.series, found.diode, found.pull = series, diode, pull
            return found
    return None


def _driver_at(board: Board, net: str) -> RowEnd | None:
    for switch in board.switches.get(net, ()):
        if len(switch.nets) == 2:
            levels = [potential(board, one) for one in switch.nets]
            if all(level is not None for level in levels):
                return RowEnd(levels[1], levels[0], switch.on_resistance, f"{switch.part.ref} {switch.part.value}")
        else:
            common = switch.nets[0]
            level = potential(board, common)
            if level is not None or board.output_at(common) is not None:
                selected = level if level is not None else _high(board, board.output_at(common))
                return RowEnd(selected, None, switch.on_resistance, f"{switch.part.ref} {switch.part.value}")
    output = board.output_at(net)
    if output is None:
        return None
    return RowEnd(
        _high(board, output),
        Level(0.0),
        output.on_resistance,
        f"{output.part.ref} {output.part.value}",
        is_controller=output.is_controller,
    )


def _high(board: Board, output: Output | None) -> Level:
    """The high level of an output: its supply, else the usual volts of such a controller."""
    if output is None:
        return Level(nan)
    if output.supply is not None:
        found = potential(board, output.supply)
        if found is not None and not isnan(found.volts):
            return found
    known = board.described("controller", output.part)
    return Level(nan if known is None else float(known["volts"]), parts=[output.part.ref], net=output.supply or "")


@dataclass
class Lines:
    """The nets of the array, in order."""

    rows: list[str]
    columns: list[str]
    by: str
    """how they were found"""
    board: Board
    """the board without what stands between rows and columns"""


def find_lines(board: Board) -> Lines:
    """Rows and columns: by roles of symbols, by parts that stand at every crosspoint, else by what connectors lead to.

    Raises:
        InputError: there are none, with what was found and how a field of a symbol says it.

    """
    for found in (_by_role(board), _by_cells(board)):
        if found is not None:
            return found
    candidates = _candidates(board)
    columns = [net for net in candidates if column_end(board, net) is not None]
    rows = [net for net in candidates if net not in columns and row_end(board, net) is not None]
    if len(rows) < FEW or len(columns) < FEW:
        raise InputError(
            f"{len(rows)} rows and {len(columns)} columns found at connectors; give the array's connectors a field "
            f"{ROLE} = rows or columns"
        )
    return Lines(rows, columns, "what the pins of connectors lead to", board)


def _by_role(board: Board) -> Lines | None:
    lines: dict[str, list[str]] = {"rows": [], "columns": []}
    cells = []
    for part in sorted(board.netlist.parts.values(), key=lambda part: _natural(part.ref)):
        role = part.fields.get(ROLE, "").strip().lower()
        if role in lines:
            lines[role] += [part.pins[number].net for number in sorted(part.pins, key=_natural)]
        elif role == "cell":
            cells.append(part)
        elif role:
            raise InputError(f"{part.ref}: {ROLE} is '{role}'; expected rows, columns or cell")
    if lines["rows"] and lines["columns"]:
        return Lines(lines["rows"], lines["columns"], f"fields {ROLE}", board)
    if cells:
        found = _bipartite(board, cells)
        if found is None:
            raise InputError(f"the {len(cells)} parts with {ROLE} = cell do not stand at every crosspoint of an array")
        return found
    return None


def _by_cells(board: Board) -> Lines | None:
    """Lines between which equal parts of two pins stand at every crosspoint: the cells, drawn one by one."""
    groups: dict[tuple[str, str], list[Part]] = defaultdict(list)
    for part in board.netlist.parts.values():
        if len(part.pins) == 2:
            groups[part.kind, part.value].append(part)
    for cells in sorted(groups.values(), key=len, reverse=True):
        if len(cells) >= FEW * FEW and (found := _bipartite(board, cells)) is not None:
            return found
    return None


def _bipartite(board: Board, cells: list[Part]) -> Lines | None:
    """Rows and columns, if the parts join each net of one kind with each of another once."""
    pairs = [tuple(pin.net for pin in part.pins.values()) for part in cells]
    beside: dict[str, set[str]] = defaultdict(set)
    for one, other in pairs:
        beside[one].add(other)
        beside[other].add(one)
    first = pairs[0][0]
    others = sorted(beside[first], key=_natural)
    ones = sorted(beside[others[0]], key=_natural)
    complete = all(beside[net] == set(others) for net in ones) and all(beside[net] == set(ones) for net in others)
    if not complete or set(ones) & set(others) or min(len(ones), len(others)) < FEW:
        return None
    if len(pairs) != len(ones) * len(others) or len(beside) != len(ones) + len(others):
        return None
    bare = board.without(cells)
    sensed = [sum(column_end(bare, net) is not None for net in nets) for nets in (ones, others)]
    rows, columns = (others, ones) if sensed[0] > sensed[1] else (ones, others)
    return Lines(rows, columns, f"the {len(pairs)} cells drawn, {cells[0].ref} and so on", bare)


def _candidates(board: Board) -> list[str]:
    """Nets at connectors that no potential holds, in the order of names that count, else of pins."""
    nets = []
    for part in sorted(board.netlist.parts.values(), key=lambda part: _natural(part.ref)):
        if _CONNECTORS.match(part.ref) or part.kind.startswith("Conn"):
            nets += [part.pins[number].net for number in sorted(part.pins, key=_natural)]
    if not nets:
        nets = sorted(board.netlist.nets, key=_natural)
    free = [net for net in dict.fromkeys(nets) if potential(board, net) is None]
    stems = defaultdict(list)
    for net in free:
        stems[net.rstrip("0123456789")].append(net)
    counted = all(net[-1:].isdigit() and not net.startswith("Net-(") for net in free)
    return [net for group in stems.values() for net in sorted(group, key=_natural)] if counted else free


def _natural(text: str) -> list[tuple[int, str]]:
    """A key that sorts ROW2 before ROW10: numbers by their length first, and before words."""
    parts = [part for part in re.split(r"(\d+)", text) if part]
    return [(len(part.lstrip("0")), part.lstrip("0")) if part.isdecimal() else (LONGEST_TEXT, part) for part in parts]
