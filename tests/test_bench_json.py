"""What ``ohmskin bench --json`` prints is JSON (RFC 8259) whatever was measured: it has no NaN and no infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any, get_type_hints

import pytest

from ohmskin import bench
from ohmskin.bench import (
    _driver,
    _emulator,
    _estimators,
    _fingers,
    _freshness,
    _measurement,
    _taps,
    _view,
    _worst_frames,
)
from ohmskin.cli import run
from ohmskin.cli._json import json_text


def unknown(row: type, number: float) -> Any:
    """A measurement of this dataclass, every result of which is ``number``."""
    hints = get_type_hints(row)
    kinds: dict[Any, Any] = {str: "", bool: False, int: 0}
    kinds |= {dict[str, int]: {"": 0}, dict[str, float]: {"": number}, dict[float, float]: {1.0: number}}
    asked = {"size": 4, "segment": 1.0}
    return row(**{item.name: asked.get(item.name, kinds.get(hints[item.name], number)) for item in fields(row)})


def no_number(text: str) -> None:
    raise AssertionError(f"{text} is not JSON")


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("option", "measured"),
    [
        ([], [(bench, "measure", _measurement.Row)]),
        (["--estimators"], [(_estimators, "estimators", _estimators.Row)]),
        (["--emulator"], [(_emulator, "emulator", _emulator.Row)]),
        (
            ["--driver"],
            [
                (_driver, "driver", _driver.Row),
                (_worst_frames, "worst_frames", _worst_frames.WorstFrames),
                (_driver, "live_estimators", _driver.Row),
                (_freshness, "freshness", _freshness.Freshness),
            ],
        ),
        (["--contacts"], [(_taps, "taps_and_faults", _taps.Taps), (_fingers, "fingers", _fingers.Fingers)]),
        (["--view"], [(_view, "view", _view.Row)]),
    ],
    ids=lambda value: value[0] if value and isinstance(value[0], str) else None,
)
def test_numbers_that_are_not_finite_are_null(
    option: list[str],
    measured: list[tuple[Any, str, type]],
    number: float,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def rows_of(row: type) -> Callable[..., list[Any]]:
        return lambda *_, **__: [unknown(row, number)]

    for module, name, row in measured:
        monkeypatch.setattr(module, name, rows_of(row))
    assert run(["bench", *option, "--size", "4", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out, parse_constant=no_number)
    assert len(rows) == len(measured)
    for row, (_, _, kind) in zip(rows, measured, strict=True):
        assert set(row) == {item.name for item in fields(kind)}
        assert None in row.values()


def test_what_is_finite_stays_as_it_is() -> None:
    value = {"a": [1, 2.5, "NaN", None, True], "b": {"c": (0.1, math.nan)}}
    assert json.loads(json_text(value)) == {"a": [1, 2.5, "NaN", None, True], "b": {"c": [0.1, None]}}
