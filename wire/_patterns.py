"""What a line of text looks like: fixed text, fields in braces, and the numbers of the cells.

``line = "R{row}: {cells}"`` of BOARD.toml; the other keys of ``[frame]`` (prefix, skip, numbered_rows, suffix) describe
usual lines in words of their own and become the same :class:`LinePattern`.

============================  ======================================================================================
``{cells}``                   the cells' numbers, with ``separator`` between two
``{row}``, ``{column}``       of the line's cell or cells, both from 0 or both from 1 on
``{index}``                   number of the line within the frame, likewise
``{number}``                  of the frame
``{time_s}`` ``_ms`` ``_us``  the board's time
``{skip}``                    a number that is not read
``{text}``                    characters other than white space that are not read, such as a checksum
============================  ======================================================================================
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

PLACES = ("index", "row", "column")
TIMES_US = {"time_s": 1e6, "time_ms": 1e3, "time_us": 1.0}
"""us of a unit"""
FIELDS = (*PLACES, "number", *TIMES_US, "skip", "text", "cells")
_FIELD = re.compile(r"\{([^{}]*)\}")
_NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)"


@dataclass(frozen=True)
class LinePattern:
    """The parts of a line: fixed texts, and names of fields, by turns."""

    parts: tuple[str, ...]
    """texts at even places, fields at odd ones; of a text that is :data:`GAP` any separator stands for itself"""

    @classmethod
    def parse(cls, text: str) -> LinePattern:
        """Raises ValueError that says what was expected."""
        made = cls(tuple(_FIELD.split(text)))
        fields = made.fields
        wrong = next((name for name in fields if name not in FIELDS), None)
        if wrong is not None:
            raise ValueError(f"'{{{wrong}}}' is no field; expected {', '.join(f'{{{name}}}' for name in FIELDS)}")
        if "{" in "".join(made.parts[::2]) or "}" in "".join(made.parts[::2]):
            raise ValueError(f"{text!r}: a brace that encloses no field")
        repeated = [name for name in set(fields) - {"skip", "text"} if fields.count(name) > 1]
        if fields.count("cells") != 1 or repeated or sum(name in TIMES_US for name in fields) > 1:
            raise ValueError(f"{text!r}: expected {{cells}} once, and each other field at most once")
        if made.places not in ([], ["row"], ["row", "column"], ["index"]):
            raise ValueError(f"{text!r}: expected {{row}}, {{row}} and {{column}}, or {{index}}")
        if any(not between for between in made.parts[2:-1:2]):
            raise ValueError(f"{text!r}: nothing stands between two fields; expected a separator")
        return made

    @property
    def fields(self) -> list[str]:
        """Names of the fields, in the order sent."""
        return list(self.parts[1::2])

    @property
    def places(self) -> list[str]:
        """Names of the fields that place a line."""
        return [name for name in PLACES if name in self.fields]

    @property
    def time(self) -> str | None:
        """Name of the field of the board's time."""
        return next((name for name in self.fields if name in TIMES_US), None)

    @cached_property
    def _expression(self) -> re.Pattern[str]:
        found = ""
        for k, part in enumerate(self.parts):
            if k % 2 == 0:
                found += _flexible(part)
            else:
                found += r"(.*)" if part == "cells" else r"\S*?" if part == "text" else rf"\s*({_NUMBER})"
        return re.compile(found, re.DOTALL)

    def read(self, line: str) -> tuple[str, dict[str, float]] | None:
        """The text of the cells and the other fields' numbers; None: the line is none of these."""
        found = self._expression.fullmatch(line)
        if found is None:
            return None
        values: dict[str, float] = {}
        cells = ""
        for name, value in zip([one for one in self.fields if one != "text"], found.groups(), strict=True):
            if name == "cells":
                cells = value
            else:
                values[name] = float(value)
        return cells, values

    def write(self, cells: str, values: Mapping[str, str]) -> str:
        """A line; fields without a value are zeros."""
        return "".join(
            part if k % 2 == 0 else cells if part == "cells" else values.get(part, "0")
            for k, part in enumerate(self.parts)
        )


def _flexible(text: str) -> str:
    """An expression for fixed text, in which white space may be any."""
    return "".join(r"\s+" if one.isspace() else rf"\s*{re.escape(one)}" for one in re.split(r"(\s+)", text) if one)
