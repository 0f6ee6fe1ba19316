"""Places of cells from a layout of KiCad 6 to 10 (``.kicad_pcb``): footprints between a row's net and a column's."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..circuits import Shape
from ..common.config import parse
from ..common.files import read_text
from ..common.text import shortened, shown
from ..errors import InputError
from ._netlist import Tree, parse_expression, sections, text_of

ROWS, COLUMNS = r"(?:ROW|R)[_-]?(\d+)", r"(?:COLUMN|COL|C)[_-]?(\d+)"
"""names of nets, without the sheet ahead; the group is the number of the line"""
MOST_DIGITS = 9
"""of the number of a line"""


def shape_of_layout(path: str | Path, *, rows: str = ROWS, columns: str = COLUMNS) -> Shape:
    """The cells of a layout: every footprint whose pads lie on one row's net and on one column's.

    The place of a cell is the middle of its pads, and its area that of the rectangle around them, along the footprint's
    own axes. Lines are numbered from the least number on. Places are those of the drawing: x to the right, y down.

    Args:
        path: of the .kicad_pcb file.
        rows: regular expression of the nets of rows, with a group for the number.
        columns: likewise of columns.

    Raises:
        InputError: the file cannot be read, is no layout or has no cells; or two cells lie between the same lines.

    """
    try:
        tree = parse_expression(read_text(path))
        if tree[:1] != ["kicad_pcb"]:
            raise InputError("is no layout of KiCad 6 or newer; expected (kicad_pcb ...")
        patterns = [re.compile(rf"(?:.*/)?(?:{one})", re.IGNORECASE) for one in (rows, columns)]
        if any(pattern.groups != 1 for pattern in patterns):
            raise InputError(f"names of nets '{rows}', '{columns}'; expected one group each, of the line's number")
        cells = [cell for part in sections(tree, "footprint") if (cell := _cell(part, patterns)) is not None]
        if not cells:
            raise InputError(f"no footprint lies between nets {rows} and {columns}; expected the patterns of its nets")
        first = [min(lines) for lines in list(zip(*cells, strict=True))[:2]]
        numbered = [(row - first[0], column - first[1], *place) for row, column, *place in cells]
        lists = zip(*sorted(numbered), strict=True)
        names = ("row", "column", "x_mm", "y_mm", "area_mm2")
        return parse(dict(zip(names, map(list, lists), strict=True)), Shape, source="cells")
    except re.error as error:
        raise InputError(f"{path}: names of nets: no regular expression: {error}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _cell(part: Tree, patterns: Sequence[re.Pattern[str]]) -> tuple[int, int, float, float, float] | None:
    """Row, column, x, y and area of a cell; None for any other footprint."""
    pads = list(sections(part, "pad"))
    lines: list[set[int]] = [set(), set()]
    for pad in pads:
        net = text_of(pad, "net")
        for found, pattern in zip(lines, patterns, strict=True):
            match = pattern.fullmatch(net)
            if match:
                found.add(_line(match[1], net))
    if any(len(found) != 1 for found in lines):
        return None
    x, y, rotation = _at(part)
    corners = []
    for pad in pads:
        left, top, own = _at(pad)
        width, height = _numbers(pad, "size", range(2, 3))
        angle = math.radians(own - rotation)  # a pad's angle in the file is that on the board
        across = (abs(width * math.cos(angle)) + abs(height * math.sin(angle))) / 2
        down = (abs(width * math.sin(angle)) + abs(height * math.cos(angle))) / 2
        corners += [(left - across, top - down), (left + across, top + down)]
    (low, upper), (high, lower) = (tuple(map(of, *corners)) for of in (min, max))
    dx, dy, angle = (low + high) / 2, (upper + lower) / 2, math.radians(rotation)
    place = x + dx * math.cos(angle) + dy * math.sin(angle), y - dx * math.sin(angle) + dy * math.cos(angle)
    return lines[0].pop(), lines[1].pop(), *(round(one, 6) for one in place), round((high - low) * (lower - upper), 6)


def _at(tree: Sequence[Any]) -> tuple[float, float, float]:
    """Place in mm and angle in degrees."""
    x, y, *angle = _numbers(tree, "at", range(2, 4))
    return x, y, angle[0] if angle else 0.0


def _line(number: str | None, net: str) -> int:
    if number is None or not number.isdecimal() or len(number) > MOST_DIGITS:
        raise InputError(f"net {shown(net)} has no number of a line; expected up to {MOST_DIGITS} digits in the group")
    return int(number)


def _numbers(tree: Sequence[Any], name: str, count: range) -> list[float]:
    found = next(sections(tree, name), [])[1:]
    try:
        numbers = [float(item) for item in found]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) not in count or not all(map(math.isfinite, numbers)):
        wanted = " or ".join(map(str, count))
        raise InputError(f"({name} ...) of '{tree[0]}' is {shortened(str(found))}; expected {wanted} numbers")
    return numbers
