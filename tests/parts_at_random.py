"""Seeded designs that use everything a design file can say: unequal parts, faults, every circuit, both rails."""

from __future__ import annotations

from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ohmskin.circuits import Design

SENSING_COLUMNS = ("inverting-amplifier", "voltage-divider", "voltage-feedback")
"""circuits to choose from where none is named: laws that tell rows from columns hold for these"""


def real_design(
    seed: int,
    *,
    circuit: str | None = None,
    faults: int = 0,
    smallest: int = 2,
    largest: int = 4,
    idle_lines: bool = False,
    **readout: Any,
) -> tuple[Design, NDArray[np.float64]]:
    """A design with one number per line for every part, and cells from 100 ohm to 1 Mohm.

    ``idle_lines``: rows on pull-downs and multiplexed columns occur as well.
    """
    rng = np.random.default_rng(seed)
    rows, columns = (int(n) for n in rng.integers(smallest, largest + 1, 2))
    cells = 10 ** rng.uniform(2, 6, (rows, columns))

    circuit = circuit or str(rng.choice(SENSING_COLUMNS))
    sensed = rows if circuit == "row-amplifier" else columns

    def ohms(low: float, high: float, count: int) -> list[float] | float:
        return (10 ** rng.uniform(low, high, count)).tolist() if rng.random() < 0.7 else float(10**low)

    tables: dict[str, Any] = {
        "array": {
            "rows": rows,
            "columns": columns,
            "row_segment": ohms(-2, 2, rows),
            "column_segment": ohms(-2, 2, columns),
            "row_lead": ohms(-1, 2, rows),
            "column_lead": ohms(-1, 2, columns),
        },
        "drive": {"voltage": float(rng.choice([-1.0, 0.5, 3.3])), "idle_rows": str(rng.choice(["ground", "float"]))},
        "readout": {
            "circuit": circuit,
            "reference_resistance": (10 ** rng.uniform(2, 5, sensed)).tolist(),
            "reference_voltage": float(rng.choice([0.0, 1.65])),
            "open_loop_gain": rng.choice([inf, 1e9, 1e5, 1e3, 10.0], sensed).tolist(),
            "offset_voltage": rng.uniform(-2e-3, 2e-3, sensed).tolist(),
            "bias_current": rng.uniform(-1e-7, 1e-7, sensed).tolist(),
            "idle_columns": str(rng.choice(["float", "load"])),
        }
        | readout,
        "fault": [_fault(rng, rows, columns) for _ in range(faults)],
    }
    if circuit == "voltage-feedback":
        tables["drive"]["idle_rows"] = "ground"
    if circuit != "voltage-divider":
        del tables["readout"]["idle_columns"]
    if idle_lines:
        _choose_idle_lines(np.random.default_rng([seed, 1]), tables)
    return Design.model_validate(tables), cells


def _choose_idle_lines(rng: np.random.Generator, tables: dict[str, Any]) -> None:
    """Idle lines of any kind that the circuit can have."""
    drive, readout = tables["drive"], tables["readout"]
    if readout["circuit"] == "voltage-feedback":
        return
    drive["idle_rows"] = str(rng.choice(["ground", "float", "pull"]))
    if drive["idle_rows"] == "pull":
        drive["idle_row_resistance"] = float(10 ** rng.uniform(2, 5))
    if rng.random() < 0.6:
        readout |= {"columns": "multiplexed", "idle_columns": str(rng.choice(["float", "ground", "load"]))}
        for key in ("reference_resistance", "open_loop_gain", "offset_voltage", "bias_current"):
            value = readout[key]
            readout[key] = value[0] if isinstance(value, list) else value


def _fault(rng: np.random.Generator, rows: int, columns: int) -> dict[str, Any]:
    kind = str(
        rng.choice(["open-cell", "shorted-cell", "broken-row", "broken-column", "bridged-rows", "bridged-columns"])
    )
    row, column = int(rng.integers(rows)), int(rng.integers(columns))
    fault: dict[str, Any] = {"kind": kind, "place": [row, column]}
    if rng.random() < 0.5:
        fault["resistance"] = float(10 ** rng.uniform(0, 5))
    if kind == "bridged-rows":
        fault["to"] = (row + 1) % rows
    if kind == "bridged-columns":
        fault["to"] = (column + 1) % columns
    return fault
