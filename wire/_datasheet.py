"""The description of a board as JSON (RFC 8259), within limits that a host can rely on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, NoReturn

from ..common.json_text import replaced
from ..errors import InputError, ProtocolError
from ._codec import MAX_DESCRIPTION

MAX_DEPTH = 32
"""tables and lists within one another; a design has four levels"""
MAX_INTEGER = 2**63
"""no quantity of a design or cell is larger, and larger integers overflow floating point"""


def write_description(design: Mapping[str, Any] | None, cell: Mapping[str, Any] | None) -> bytes:
    """The JSON text of a description.

    Args:
        design: tables of DESIGN.toml; None: left out.
        cell: tables of CELL.toml; None: left out.

    Raises:
        InputError: a value that JSON cannot carry, or a text that is too long.

    """
    given = {"design": design, "cell": cell}
    try:
        tables = {key: replaced(value, _without_infinity) for key, value in given.items() if value is not None}
        text = json.dumps(tables, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode()
    except (TypeError, ValueError) as error:
        raise InputError(f"a description that is not JSON: {error}") from error
    if len(text) > MAX_DESCRIPTION:
        raise InputError(f"a description of {len(text)} bytes; at most {MAX_DESCRIPTION} fit")
    return text


def read_description(text: bytes) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
    """The tables of design and cell, each None where the description has none. Other keys are left unread.

    Raises:
        ProtocolError: the text is no JSON object of that kind, or is beyond the limits.

    """
    try:
        tables = json.loads(text.decode(), parse_constant=_refuse_constant, parse_float=_finite, parse_int=_moderate)
        if not isinstance(tables, dict):
            raise ProtocolError("a description is not a JSON object")
        return _table(tables, "design"), _table(tables, "cell")
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"a description is not JSON: {error}") from error


def _table(tables: dict[str, Any], key: str) -> Mapping[str, Any] | None:
    value = tables.get(key)
    if value is None:
        return None
    if not isinstance(value, dict):
        raise ProtocolError(f"a description whose '{key}' is no object")
    found: Mapping[str, Any] = _with_infinity(value, MAX_DEPTH)
    return found


# Ideal parts have infinite values. JSON has none, therefore they travel as text.
_INFINITIES = {math.inf: "Infinity", -math.inf: "-Infinity"}
_TEXTS = {text: value for value, text in _INFINITIES.items()}


def _without_infinity(value: Any) -> Any:
    if isinstance(value, str) and value in _TEXTS:
        raise ValueError(f"the text {value!r} stands for a number")
    return _INFINITIES.get(value, value) if isinstance(value, float) else value


def _with_infinity(value: Any, depth: int) -> Any:
    if depth == 0:
        raise ProtocolError(f"a description with more than {MAX_DEPTH} levels")
    match value:
        case dict():
            return {key: _with_infinity(item, depth - 1) for key, item in value.items()}
        case list():
            return [_with_infinity(item, depth - 1) for item in value]
        case str():
            return _TEXTS.get(value, value)
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


def _finite(digits: str) -> float:
    value = float(digits)
    if math.isinf(value):
        raise ValueError(f"a number is too large: {digits[:20]}")
    return value


def _moderate(digits: str) -> int:
    value = int(digits)
    if abs(value) >= MAX_INTEGER:
        raise ValueError(f"an integer is too large: {digits[:20]}...")
    return value
