"""Strict JSON (RFC 8259) of what commands print: null where a number is not finite."""

from __future__ import annotations

import json
import math
from typing import Any


def json_text(value: Any, *, indent: int | None = None) -> str:
    """``value`` as JSON; NaN and infinite numbers in its lists and dictionaries become null, for JSON has neither.

    Raises:
        TypeError: it contains something else than dictionaries, lists, tuples, text, numbers, truth values and None.

    """
    return json.dumps(_null_where_not_finite(value), indent=indent, allow_nan=False)


def _null_where_not_finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _null_where_not_finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_null_where_not_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
