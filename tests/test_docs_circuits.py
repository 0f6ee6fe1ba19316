"""The examples in docs/circuits.md print what they say."""

from __future__ import annotations

import doctest
from pathlib import Path


def test_examples() -> None:
    page = Path(__file__).parent.parent / "docs" / "circuits.md"
    failed, attempted = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
    assert attempted > 15
    assert failed == 0
