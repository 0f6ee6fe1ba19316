"""Boards that people build: how many of their cells are valid, how honest uncertainties are, and how small they can be.

    python -m ohmskin.bench.boards

Skins of 8 x 8 cells, 10 to 100 kohm at rest, on dividers and amplifiers of 8, 10 and 12 bits, with 0.3 and 3 mV of
noise. A finger presses to a tenth of the resistance within eight frames and stays (:func:`built`).

The second table (:func:`knowable`) has the Cramer-Rao bound of a frame: how well any unbiased method can know the cells
from one frame of readings. With J the certified derivatives of all readings by the logarithms of all cells
(:func:`ohmskin.circuits.sensitivity`) and s the standard deviation of a reading, the covariance of any unbiased
estimate is at least s^2 (J'J)^-1 (Rao, "Information and the accuracy attainable in the estimation of statistical
parameters", 1945). The error of an ADC step counts as noise of step/sqrt(12), as far as the readings' own noise makes
it random. A cell is valid in the driver where 50 % cover its error. A board whose bound exceeds 50 % at three standard
deviations therefore has no valid cell, whatever the method.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, product
from math import hypot, sqrt

import click
import numpy as np

from ..circuits import Design, sensitivity
from ..common.arrays import FloatArray
from ..driver import CountReader
from . import _driver
from .harness import column, table

READOUTS: dict[str, tuple[str, str, str, tuple[tuple[float, float], ...]]] = {
    "divider, rows grounded": ("voltage-divider", "ground", "float", ((10e3, 1e3), (30e3, 10e3), (100e3, 10e3))),
    "divider, rows floating": ("voltage-divider", "float", "float", ((10e3, 1e3), (30e3, 10e3), (100e3, 10e3))),
    "divider, all loaded": ("voltage-divider", "float", "load", ((10e3, 1e3), (30e3, 4.7e3), (100e3, 10e3))),
    "inverting amplifier": ("inverting-amplifier", "ground", "float", ((10e3, 1e3), (10e3, 3e3), (100e3, 3e3))),
}
"""circuit, idle rows, idle columns; ohm of a cell at rest and of the reference resistor"""
BITS, NOISE_V = (8, 10, 12), (0.3e-3, 3e-3)
AT_REST, PRESSING, HELD = 10, 8, 12
"""frames"""
FROM = 3
"""first frame that counts: before it the noise is hardly known"""
HARD = 10.0
"""conductance under the finger over that at rest"""
DENSE = (
    ("voltage-divider", "float", 8),
    ("voltage-divider", "float", 10),
    ("voltage-divider", "float", 12),
    ("voltage-divider", "ground", 10),
    ("inverting-amplifier", "float", 12),
)
"""circuit, idle rows and ADC bits of boards for the bound"""
SIZES = 8, 16, 32
SIGMAS = 3.0
FRAMES = 20
"""with the same cells and other noise, until the driver's reading is looked at: by then it knows the noise"""


def design(circuit: str, idle_rows: str, idle_columns: str, bits: int, reference_ohm: float) -> Design:
    """A board of 8 x 8 cells with leads of 25 ohm."""
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


@dataclass(frozen=True)
class Built:
    """A board that people build, at rest and under a finger."""

    readout: str = field(metadata=column("readout", "{}", width=22))
    bits: int = field(metadata=column("bits", "{}"))
    rest_ohm: float = field(metadata=column("rest kohm", "{:g}", unit=1e3))
    reference_ohm: float = field(metadata=column("reference", "{:g}", unit=1e3))
    noise_v: float = field(metadata=column("noise mV", "{:g}", unit=1e-3))
    valid: dict[str, float] = field(metadata=column("valid, %: {}", "{:.0f}", unit=0.01))
    """share of the cells"""
    known: dict[str, float] = field(metadata=column("known to, %: {}", "{:.1f}", unit=0.01))
    """median stated uncertainty"""
    rms: float = field(metadata=column("error: rms", "{:.2f}"))
    """root mean square of error over uncertainty"""
    worst: float = field(metadata=column("worst", "{:.2f}"))


def built() -> Iterator[Built]:
    """Measure all boards of :data:`READOUTS`."""
    for (name, (circuit, idle_rows, idle_columns, resistances)), bits in product(READOUTS.items(), BITS):
        for (rest_ohm, reference_ohm), noise_v in product(resistances, NOISE_V):
            board = design(circuit, idle_rows, idle_columns, bits, reference_ohm)
            yield Built(name, bits, rest_ohm, reference_ohm, noise_v, *_read(board, rest_ohm, noise_v))


def _read(board: Design, rest_ohm: float, noise_v: float) -> tuple[dict[str, float], dict[str, float], float, float]:
    draw, read = np.random.default_rng(1), CountReader(board)
    rest = rest_ohm * np.exp(draw.normal(0.0, 0.1, (8, 8)))
    row, column = np.indices((8, 8))
    finger = np.exp(-((row - 2.3) ** 2 + (column - 5.1) ** 2) / 1.3)
    loads = np.r_[np.zeros(AT_REST), np.linspace(0.0, 1.0, PRESSING), np.ones(HELD)][:, None, None] * finger
    frames = []
    cells = rest / (1.0 + loads * (HARD - 1.0))
    for counts, true, share in zip(_driver.quantised(board, cells, noise_v, draw), cells, loads, strict=True):
        reading = read(counts)
        frames.append((reading.valid, reading.uncertainty, reading.resistance / true - 1.0, share))
    valid, stated, off, load = (np.array(each[FROM:]) for each in zip(*frames, strict=True))
    found = valid.astype(bool)
    parts = {"rest": load < 0.02, "pressed": load > 0.5}
    medians = {
        name: float(np.median(stated[part & found])) if (part & found).any() else np.nan for name, part in parts.items()
    }
    used = np.abs(off[found]) / stated[found]
    shares = {name: float(found[part].mean()) for name, part in parts.items()}
    return shares, medians, float(np.sqrt(np.mean(used**2))), float(used.max(initial=0.0))


def bound(board: Design, cells: FloatArray, noise_steps: float = _driver.NOISE_STEPS) -> FloatArray:
    """(rows, columns) least standard deviation of the logarithm of each cell's resistance, from one frame.

    Args:
        board: with a converter.
        cells: (rows, columns) ohm.
        noise_steps: standard deviation of the readings' noise in ADC steps.

    """
    assert board.adc is not None
    noise_volts = board.adc.step * hypot(noise_steps, 1.0 / sqrt(12.0))
    per_log = (sensitivity(board, cells).cells * cells).reshape(cells.size, cells.size)
    _, information, directions = np.linalg.svd(per_log / noise_volts)
    variance = np.sum((directions / information[:, None]) ** 2, axis=0)
    std: FloatArray = np.sqrt(variance).reshape(cells.shape)
    return std


HEAD = f"least standard deviation of a cell in % by one frame, with {_driver.NOISE_STEPS:g} ADC steps of noise"


@dataclass(frozen=True)
class Knowable(_driver.OnBoard):
    """A board on which readings depend on many cells."""

    least: dict[str, float] = field(metadata=column("{}", "{:.1f}", width=6, unit=0.01))
    """bound of the best, the median and the worst cell"""
    possible: float = field(metadata=column("can be valid, %", "{:.0f}", unit=0.01))
    """share of the cells whose bound is within 50 % at :data:`SIGMAS`"""
    valid: float = field(metadata=column("are valid, %", "{:.0f}", unit=0.01))
    """share that the driver calls valid"""


def knowable() -> Iterator[Knowable]:
    """What one frame can tell of the cells of boards of :data:`DENSE`, and what the driver finds."""
    for (circuit, idle_rows, bits), size in product(DENSE, SIZES):
        board = _driver.design(size, circuit, idle_rows, bits)
        _, frames = _driver.pressed(board.array.shape, FRAMES)
        cells = frames[-1]
        least, read = bound(board, cells), CountReader(board)
        for counts in _driver.counts_of(board, np.repeat(cells[None], FRAMES, axis=0)):
            reading = read(counts)
        quantiles = {"best": float(least.min()), "median": float(np.median(least)), "worst": float(least.max())}
        possible = float((SIGMAS * least <= 0.5).mean())
        yield Knowable(*_driver.described(board), quantiles, possible, float(reading.valid.mean()))


@click.command()
def main() -> None:
    """Print both tables."""
    for line in chain(table(built()), [""], table(knowable(), HEAD)):
        click.echo(line)


if __name__ == "__main__":
    main()
