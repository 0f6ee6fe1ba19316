"""The examples in docs/circuits.md and docs/your-circuit.md print what they say."""

from __future__ import annotations

import doctest
from pathlib import Path

import pytest


@pytest.mark.parametrize("name", ["circuits.md", "your-circuit.md"])
def test_examples(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).parent.parent
    monkeypatch.chdir(root)
    failed, attempted = doctest.testfile(str(root / "docs" / name), module_relative=False, encoding="utf-8")
    assert attempted > 12
    assert failed == 0
