"""Checkpoint file of a calibration, for interruption and resumption: JSON, replaced atomically after each press."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ..common.arrays import FloatArray
from ..common.config import Finite, NotNegative, Positive, Section, parse
from ..common.files import read_bytes, whole_file
from ..errors import InputError
from ._plan import Plan
from ._presses import Press, Rest

FORMAT = 1
MOST_BYTES = 256 * 2**20
MOST = 1_000_000
"""largest length of a list"""

_Text = Annotated[str, Field(max_length=1000)]
_Ohm = Positive | None
_Numbers = Annotated[list[Finite], Field(max_length=MOST)]
_Ohms = Annotated[list[_Ohm], Field(max_length=MOST)]


_ARRAYS = "resistance_ohm", "std_ohm", "change"
"""fields of :class:`Rest` that are arrays of all cells; they are flat in the file"""


class _Rest(Section):
    time_s: Finite
    resistance_ohm: _Ohms
    std_ohm: Annotated[list[NotNegative | None], Field(max_length=MOST)]
    change: Annotated[list[Finite | None], Field(max_length=MOST)]
    frames: Annotated[int, Field(ge=1)]


class _Press(Section):
    cells: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1, max_length=MOST)]
    time_s: _Numbers
    load_kpa: _Numbers
    window_s: _Numbers
    resistance_ohm: Annotated[list[_Ohms], Field(min_length=1, max_length=100)]
    std_ohm: Annotated[list[NotNegative], Field(max_length=MOST)]
    frames: Annotated[int, Field(ge=1)]
    step: Annotated[int, Field(ge=0)]
    felt_kpa: NotNegative
    fault: _Text


class _File(Section):
    format: Annotated[int, Field(ge=FORMAT, le=FORMAT)]
    setup: dict[str, Any]
    rest: _Rest
    presses: list[_Press]
    trace: list[tuple[Finite, Finite]]


@dataclass(frozen=True)
class Progress:
    """The measurements so far, and the settings of the calibration."""

    setup: dict[str, Any]
    """settings (texts and numbers) that must be the same when the calibration is resumed"""
    rest: Rest
    presses: tuple[Press, ...]
    trace: tuple[tuple[float, float], ...]
    """times in s and largest loads in kPa; empty if no reference sensor is used"""

    @property
    def last_s(self) -> float:
        """Time of the last measurement."""
        ends = [float(press.time_s[-1]) for press in self.presses]
        return max([self.rest.time_s, *ends, *(time for time, _ in self.trace[-1:])])

    def save(self, path: Path) -> None:
        """Replace the file. Raises InputError if writing fails."""
        content = {
            "format": FORMAT,
            "setup": self.setup,
            "rest": {name: _plain(np.ravel(value) if name in _ARRAYS else value) for name, value in _named(self.rest)},
            "presses": [{name: _plain(value) for name, value in _named(press)} for press in self.presses],
            "trace": self.trace,
        }
        with whole_file(path) as file:
            file.write(json.dumps(content, allow_nan=False).encode())

    @classmethod
    def load(cls, path: Path, setup: dict[str, Any], plan: Plan) -> Progress:
        """Read a file written by :meth:`save`.

        Args:
            path: path of the file.
            setup: settings of the calibration that is to be resumed.
            plan: plan of that calibration.

        Raises:
            InputError: the file cannot be read, is invalid, or belongs to another calibration.

        """
        try:
            content = json.loads(read_bytes(path, most_bytes=MOST_BYTES))
        except (ValueError, RecursionError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: is no progress of a calibration: {error}") from error
        if not isinstance(content, dict):
            raise InputError(f"{path}: is no progress of a calibration: expected a JSON object")
        if isinstance(content.get("trace"), list):
            content["trace"] = [tuple(pair) if isinstance(pair, list) else pair for pair in content["trace"]]
        file = parse(content, _File, source=str(path))
        for key, value in setup.items():
            if file.setup.get(key) != value:
                raise InputError(
                    f"{path}: is the progress of another calibration: its {key} is {file.setup.get(key)!r}, "
                    f"this one's {value!r}; leave out --resume to begin anew"
                )
        rows, columns = plan.shape
        rest = file.rest
        arrays = {name: _array(getattr(rest, name)) for name in _ARRAYS}
        if any(len(values) != rows * columns for values in arrays.values()):
            raise InputError(f"{path}: rest: expected {rows * columns} values")
        ohm, std, change = (values.reshape(plan.shape) for values in arrays.values())
        presses = tuple(_press(press, plan, f"{path}: presses[{number}]") for number, press in enumerate(file.presses))
        if any(later.time_s[0] < earlier.time_s[0] for earlier, later in pairwise(presses)):
            raise InputError(f"{path}: presses: expected them in the order of time")
        return cls(setup, Rest(rest.time_s, ohm, std, change, rest.frames), presses, tuple(file.trace))


def _press(file: _Press, plan: Plan, source: str) -> Press:
    cells, windows = len(file.cells), len(file.window_s)
    press = Press(
        cells=np.array(file.cells, dtype=np.intp),
        time_s=np.array(file.time_s),
        load_kpa=np.array(file.load_kpa),
        window_s=np.array(file.window_s),
        resistance_ohm=_array([ohm for line in file.resistance_ohm for ohm in line]),
        std_ohm=np.array(file.std_ohm),
        frames=file.frames,
        step=file.step,
        felt_kpa=file.felt_kpa,
        fault=file.fault,
    )
    sound = (
        len(press.time_s) == len(press.load_kpa) >= 2
        and bool((np.diff(press.time_s) > 0).all())
        and bool((press.load_kpa >= 0).all())
        and bool((np.diff(press.cells) > 0).all())
        and press.cells[-1] < plan.shape[0] * plan.shape[1]
        and all(len(line) == cells for line in file.resistance_ohm)
        and len(file.resistance_ohm) == windows
        and len(press.std_ohm) == cells
        and press.step < len(plan.loads_kpa)
    )
    if not sound:
        raise InputError(f"{source}: its values do not fit each other, or not this skin")
    return replace(press, resistance_ohm=press.resistance_ohm.reshape(windows, cells))


def _named(measured: Rest | Press) -> Iterator[tuple[str, Any]]:
    return ((item.name, getattr(measured, item.name)) for item in fields(measured))


def _plain(value: Any) -> Any:
    """Arrays as lists, with None in place of NaN."""
    if isinstance(value, (np.ndarray, list)):
        return [_plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _array(values: list[float] | list[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
