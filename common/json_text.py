"""Strict JSON (RFC 8259), and nested tables with other values in place of those that JSON lacks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any


def json_text(value: Any, *, indent: int | None = None) -> str:
    """``value`` as JSON; NaN and infinite numbers in its lists and dictionaries become null, for JSON has neither.

    Raises:
        TypeError: it contains something else than dictionaries, lists, tuples, text, numbers, truth values and None.

    """
    return json.dumps(replaced(value, _null_where_not_finite), indent=indent, allow_nan=False)


def replaced(value: Any, item: Callable[[Any], Any]) -> Any:
    """Nested dictionaries, lists and tuples with ``item(x)`` in place of each value x in them."""
    if isinstance(value, Mapping):
        return {key: replaced(inner, item) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [replaced(inner, item) for inner in value]
    return item(value)


def finite_or_text(value: Any) -> Any:
    """NaN and infinite numbers as text, for :func:`replaced`."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _null_where_not_finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
