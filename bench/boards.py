"""Boards that people build: how many of their cells are valid, and how honest the stated uncertainties are.

    python -m ohmskin.bench.boards

Skins of 8 x 8 cells, 10 to 100 kohm at rest, on dividers and amplifiers of 8, 10 and 12 bits, with 0.3 and 3 mV of
noise. A finger presses to a tenth of the resistance within eight frames and stays. For each board the table has the
share of valid cells at rest and under the finger, the stated uncertainty (median), the root mean square of error over
uncertainty, and the worst one.
"""

from __future__ import annotations

from collections.abc import Iterator

import click
import numpy as np

from ..circuits import Design, adc_codes, scan
from ..common.arrays import FloatArray
from ..driver import CountReader

READOUTS: dict[str, tuple[str, str, str, tuple[tuple[float, float], ...]]] = {
    "divider, rows grounded": ("voltage-divider", "ground", "float", ((10e3, 1e3), (30e3, 10e3), (100e3, 10e3))),
    "divider, rows floating": ("voltage-divider", "float", "float", ((10e3, 1e3), (30e3, 10e3), (100e3, 10e3))),
    "divider, all loaded": ("voltage-divider", "float", "load", ((10e3, 1e3), (30e3, 4.7e3), (100e3, 10e3))),
    "inverting amplifier": ("inverting-amplifier", "ground", "float", ((10e3, 1e3), (10e3, 3e3), (100e3, 3e3))),
}
"""circuit, idle rows, idle columns; ohm of a cell at rest and of the reference resistor"""
NOISE_V = 0.3e-3, 3e-3
AT_REST, PRESSING, HELD = 10, 8, 12
"""frames"""
FROM = 3
"""first frame that counts: before it the noise is hardly known"""
HARD = 10.0
"""conductance under the finger over that at rest"""


def design(circuit: str, idle_rows: str, idle_columns: str, bits: int, reference_ohm: float) -> Design:
    """A board with leads of 25 ohm."""
    amplified = circuit == "inverting-amplifier"
    lead = {"row_lead": 25.0, "column_lead": 25.0 if amplified else 0.0}
    return Design.model_validate(
        {
            "array": {"rows": 8, "columns": 8} | lead,
            "drive": {"voltage": -1.0 if amplified else 3.3, "idle_rows": idle_rows},
            "readout": {"circuit": circuit, "reference_resistance": reference_ohm, "idle_columns": idle_columns},
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


def pressed(rest_ohm: float, draw: np.random.Generator) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Cells (8, 8) in ohm of each frame, and the load on them from 0 to 1."""
    rest = rest_ohm * np.exp(draw.normal(0.0, 0.1, (8, 8)))
    row, column = np.indices((8, 8))
    finger = np.exp(-((row - 2.3) ** 2 + (column - 5.1) ** 2) / 1.3)
    for share in np.r_[np.zeros(AT_REST), np.linspace(0.0, 1.0, PRESSING), np.ones(HELD)]:
        yield rest / (1.0 + share * finger * (HARD - 1.0)), share * finger


def row(board: Design, rest_ohm: float, noise_v: float) -> tuple[float, ...]:
    """Valid share at rest and pressed, median uncertainty of both, rms and largest error over uncertainty."""
    draw, read = np.random.default_rng(1), CountReader(board)
    valid, stated, used, load = [], [], [], []
    for cells, share in pressed(rest_ohm, draw):
        reading = read(adc_codes(board, scan(board, cells).volts + draw.normal(scale=noise_v, size=cells.shape)))
        valid.append(reading.valid)
        stated.append(np.where(reading.valid, reading.uncertainty, np.nan))
        used.append(np.abs(reading.resistance / cells - 1.0) / reading.uncertainty)
        load.append(share)
    found, bound, off, loads = (np.array(each[FROM:]) for each in (valid, stated, used, load))
    rest, press = loads < 0.02, loads > 0.5
    off = off[found]
    shares = float(found[rest].mean()), float(found[press].mean())
    medians = tuple(float(np.nanmedian(bound[part])) if found[part].any() else np.nan for part in (rest, press))
    return *shares, *medians, float(np.sqrt(np.mean(off**2))), float(off.max(initial=0.0))


@click.command()
def main() -> None:
    """Print the table."""
    click.echo(
        f"{'readout':24} bits  rest/ref kohm  noise mV  valid %: rest pressed  known to %: rest pressed  error: rms max"
    )
    for name, (circuit, idle_rows, idle_columns, resistances) in READOUTS.items():
        for bits in (8, 10, 12):
            for rest_ohm, reference_ohm in resistances:
                for noise_v in NOISE_V:
                    board = design(circuit, idle_rows, idle_columns, bits, reference_ohm)
                    at_rest, under, rest, press, rms, most = row(board, rest_ohm, noise_v)
                    click.echo(
                        f"{name:24} {bits:4}  {rest_ohm / 1e3:6g}/{reference_ohm / 1e3:<6g} {1e3 * noise_v:9g} "
                        f"{100 * at_rest:14.0f} {100 * under:7.0f}  {100 * rest:16.1f} {100 * press:7.1f}  "
                        f"{rms:10.2f} {most:4.2f}"
                    )


if __name__ == "__main__":
    main()
