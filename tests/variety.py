"""Seeded designs of every kind with cells to match: each seed is another circuit, the same on every machine."""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray

from ohmskin.circuits import Array, Design, Drive, Readout


def any_design(seed: int, largest: int = 5) -> tuple[Design, NDArray[np.float64]]:
    """A design with a random choice of real parts, and cells from 100 ohm to 1 Mohm, some open, some shorted.

    Where ideal parts would contradict each other (a shorted cell between an ideal driver and an ideal
    amplifier), the rows get a lead and the columns get one too.
    """
    rng = np.random.default_rng(seed)
    rows, columns = (int(n) for n in rng.integers(1, largest + 1, 2))
    cells = 10 ** rng.uniform(2, 6, (rows, columns))
    if rng.random() < 0.4:
        cells[rng.random(cells.shape) < 0.2] = inf
    shorted = rng.random() < 0.3
    if shorted:
        cells[rng.random(cells.shape) < 0.1] = 0.0

    def sometimes(low: float, high: float, *, always: bool = False) -> float:
        return float(10 ** rng.uniform(low, high)) if always or rng.random() < 0.5 else 0.0

    array = Array(
        rows=rows,
        columns=columns,
        row_segment=sometimes(-2, 2),
        column_segment=sometimes(-2, 2),
        row_lead=sometimes(-1, 2, always=shorted),
        column_lead=sometimes(-1, 2, always=shorted),
    )
    drive = Drive.model_validate(
        {"voltage": float(rng.choice([-1.0, 0.5, 3.3])), "idle_rows": str(rng.choice(["ground", "float"]))}
    )
    limited = rng.random() < 0.4
    circuit = str(rng.choice(["inverting-amplifier", "voltage-divider"], p=[0.7, 0.3]))
    readout = Readout.model_validate(
        {
            "circuit": circuit,
            "reference_resistance": float(10 ** rng.uniform(2, 5)),
            "reference_voltage": float(rng.choice([0.0, 1.65])),
            "open_loop_gain": float(rng.choice([inf, 1e9, 1e5, 1e3, 10.0])),
            "offset_voltage": float(rng.choice([0.0, 1e-3, -2e-3])),
            "bias_current": float(rng.choice([0.0, 1e-8])),
            "supply": (-0.2, 3.3) if limited else (-inf, inf),
            "idle_columns": str(rng.choice(["float", "load"])) if circuit == "voltage-divider" else "float",
        }
    )
    return Design(array=array, drive=drive, readout=readout), cells
