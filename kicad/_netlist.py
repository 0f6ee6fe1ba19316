"""Netlists as KiCad 5 to 10 export them: s-expressions (``.net``) or XML, to parts with pins and fields.

Both formats have the same content: components with reference, value, library part and fields; and nets, each a list of
nodes (reference, pin number, name of the pin).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ..common.files import read_text
from ..errors import InputError

MOST_PARTS = 20_000
"""of a netlist; a board of 1024 lines has about 5,000"""
LONGEST_TEXT = 16_384
"""characters of a name, value or field: a list with a number for each of 1024 lines"""

_TOKEN = re.compile(r'(?P<open>\()|(?P<close>\))|"(?P<quoted>(?:[^"\\]|\\.)*)"|(?P<word>[^\s()"]+)', re.DOTALL)
_ESCAPED = re.compile(r"\\(.)", re.DOTALL)

Tree = list[Any]
"""an s-expression: the name of the list, then its items, texts or further lists"""


@dataclass(frozen=True)
class Pin:
    """One pin of a part."""

    net: str
    function: str = ""
    """name of the pin in the symbol; empty: not told"""


@dataclass(frozen=True)
class Part:
    """A component of the board."""

    ref: str
    value: str
    kind: str
    """name of the symbol in its library"""
    fields: dict[str, str] = field(default_factory=dict)
    pins: dict[str, Pin] = field(default_factory=dict)
    """number of a pin -> the pin; pins without a net are left out"""

    def named(self, pattern: re.Pattern[str]) -> bool:
        """Whether the value or the symbol's name matches."""
        return any(pattern.search(text) for text in (self.value, self.kind))


@dataclass(frozen=True)
class Netlist:
    """Parts by reference, and the pins of each net."""

    parts: dict[str, Part]
    nets: dict[str, list[tuple[str, str]]]
    """name of a net -> its nodes (reference, number of the pin)"""


def read_netlist(path: str | Path) -> Netlist:
    """Read a netlist that KiCad exported, as s-expressions or XML.

    Raises:
        InputError: the file cannot be read, or is no such netlist.

    """
    return parse_netlist(read_text(path), path)


def parse_netlist(text: str, path: str | Path) -> Netlist:
    """As :func:`read_netlist`, of a text that ``path`` names in messages."""
    try:
        tree = _from_xml(text) if text.lstrip()[:1] == "<" else parse_expression(text)
        return _netlist(tree)
    except RecursionError as error:
        raise InputError(f"{path}: is nested too deeply for a netlist") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def parse_expression(text: str) -> Tree:
    """The first list of a text; without recursion, since an untrusted text may nest as deeply as it likes."""
    stack: list[Tree] = [[]]
    for found in _TOKEN.finditer(text):
        if found["open"]:
            stack.append([])
        elif found["close"]:
            if len(stack) == 1:
                raise InputError("is no s-expression: a bracket closes that was not opened")
            inner = stack.pop()
            stack[-1].append(inner)
        elif found["word"] is not None:
            stack[-1].append(found["word"])
        else:
            stack[-1].append(_ESCAPED.sub(r"\1", found["quoted"]))
    if len(stack) > 1:
        raise InputError(f"is no s-expression: {len(stack) - 1} brackets are not closed")
    return next((item for item in stack[0] if isinstance(item, list)), [])


def _from_xml(text: str) -> Tree:
    try:
        return _element(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise InputError(f"is no XML: {error}") from error


def _element(element: ElementTree.Element) -> Tree:
    tree: Tree = [element.tag, *([name, value] for name, value in element.attrib.items())]
    if (element.text or "").strip():
        tree.append((element.text or "").strip())
    return tree + [_element(child) for child in element]


def _netlist(tree: Tree) -> Netlist:
    if not isinstance(tree, list) or tree[:1] != ["export"]:
        raise InputError("is no netlist of KiCad; expected (export ... or <export ..., from File > Export > Netlist")
    found = [_part(one) for section in sections(tree, "components") for one in sections(section, "comp")]
    if len(found) > MOST_PARTS:
        raise InputError(f"has {len(found)} components; expected at most {MOST_PARTS}")
    parts = {part.ref: part for part in found}
    nets: dict[str, list[tuple[str, str]]] = {}
    for section in sections(tree, "nets"):
        for net in sections(section, "net"):
            name = text_of(net, "name")
            for node in sections(net, "node"):
                ref, number = text_of(node, "ref"), text_of(node, "pin")
                if ref in parts:
                    nets.setdefault(name, []).append((ref, number))
                    parts[ref].pins[number] = Pin(name, text_of(node, "pinfunction"))
    if not parts or not nets:
        raise InputError("has no components or no nets; expected the netlist of a whole schematic")
    return Netlist(parts, nets)


def _part(tree: Tree) -> Part:
    fields: dict[str, str] = {}
    for section in sections(tree, "fields"):
        fields |= {text_of(one, "name"): _body(one) for one in sections(section, "field")}
    fields |= {text_of(one, "name"): text_of(one, "value") for one in sections(tree, "property")}
    source = next(sections(tree, "libsource"), [])
    return Part(text_of(tree, "ref"), text_of(tree, "value"), text_of(source, "part"), fields)


def sections(tree: Sequence[Any], name: str) -> Iterator[Tree]:
    return (item for item in tree if isinstance(item, list) and item[:1] == [name])


def text_of(tree: Sequence[Any], name: str) -> str:
    return _body(next(sections(tree, name), []))


def _body(tree: Sequence[Any]) -> str:
    text = next((item for item in reversed(tree[1:]) if isinstance(item, str)), "")
    if len(text) > LONGEST_TEXT:
        raise InputError(f"has a text of {len(text)} characters; expected at most {LONGEST_TEXT}")
    return text
