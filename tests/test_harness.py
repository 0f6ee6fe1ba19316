"""Tables of measurements say what the fields of their rows say."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ohmskin.bench.harness import column, table


@dataclass(frozen=True)
class Row:
    size: int = field(metadata=column("cells", "{0} x {0}"))
    name: str = field(metadata=column("name", "{}", width=6))
    seconds: float = field(metadata=column("ms", "{:.1f}", unit=1e-3))
    found: dict[str, float] = field(metadata=column("{}, %", "{:.0f}", unit=0.01))
    hidden: float = 1.0
    default: bool = field(default=True, metadata=column("default"))


def test_columns_are_aligned_and_other_fields_are_left_out() -> None:
    rows = Row(4, "a", 0.0123, {"taps": 0.5, "rubs": math.nan}), Row(16, "second", 1.5, {"taps": 1.0, "rubs": 0.25})
    assert list(table(rows, "what it is")) == [
        "what it is",
        "cells  name      ms  taps, %  rubs, %  default",
        "4 x 4  a       12.3       50        -      yes",
        "16 x 16  second  1500.0      100       25      yes",
    ]


def test_without_rows_there_is_only_the_head() -> None:
    assert list(table([], "what it is")) == ["what it is"]
    assert list(table([])) == []
