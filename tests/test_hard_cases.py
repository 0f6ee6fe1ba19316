"""The solver on circuits that break others, cell by cell against the exact nodal reference."""

from __future__ import annotations

from itertools import product
from math import inf

import numpy as np
import pytest

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import Array, Design, Drive, Readout, scan

SHAPE = (3, 4)


def _cells(kind: str, random: np.random.Generator) -> np.ndarray:
    cells = 10 ** random.uniform(3, 6, SHAPE)
    match kind:
        case "1 ohm to 1 Tohm":
            cells = 10 ** random.uniform(0, 12, SHAPE)
        case "open lines":
            cells[1] = cells[:, 2] = inf
        case "a short":
            cells[0, 0] = 0.0
        case "nearly shorts":
            cells[0, 0], cells[2, 3] = 1e-3, 1e-9
        case "all open":
            cells[:] = inf
    return cells


@pytest.mark.parametrize("kind", ["1 ohm to 1 Tohm", "open lines", "a short", "nearly shorts", "all open"])
@pytest.mark.parametrize("gain", [1.0, 1e5, 1e12, inf, None])
@pytest.mark.parametrize("idle_rows", ["ground", "float"])
def test_hard_cases_keep_eleven_digits(kind: str, gain: float | None, idle_rows: str) -> None:
    """``gain`` None: the divider. An error counts relative to the cell's own signal, however small that is."""
    random = np.random.default_rng(3)
    # A short between an ideal driver and an ideal amplifier is read as inf (test_ideal_parts).
    leads = [1e-6, 70.0] if kind == "a short" and gain == inf else [0.0, 1e-6, 70.0]
    for lead, row_segment, column_segment in product(leads, [0.0, 1.0, 1e6], [0.0, 1e-6]):
        design = Design(
            array=Array(
                rows=SHAPE[0],
                columns=SHAPE[1],
                row_lead=lead,
                column_lead=lead,
                row_segment=row_segment,
                column_segment=column_segment,
            ),
            drive=Drive.model_validate({"voltage": -1.0, "idle_rows": idle_rows}),
            readout=Readout(
                circuit="inverting-amplifier" if gain else "voltage-divider",
                reference_resistance=1000.0,
                open_loop_gain=gain or inf,
                offset_voltage=1e-3 if gain == 1e5 else 0.0,
                bias_current=1e-9 if gain == 1e5 else 0.0,
            ),
        )
        cells = _cells(kind, random)
        expected = reference_volts(design, cells)
        np.testing.assert_allclose(scan(design, cells).volts, expected, rtol=1e-11, atol=1e-18)
