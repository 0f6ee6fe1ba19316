"""Cramer-Rao bound of a frame: how well any unbiased method can know the cells from one frame of readings.

    python -m ohmskin.bench.knowable

With J the certified derivatives of all readings by the logarithms of all cells (:func:`ohmskin.circuits.sensitivity`)
and s the standard deviation of a reading, the covariance of any unbiased estimate is at least s^2 (J'J)^-1 (Rao,
"Information and the accuracy attainable in the estimation of statistical parameters", 1945). The error of an ADC step
counts as noise of step/sqrt(12), as far as the readings' own noise makes it random.

A cell is valid in the driver where 50 % cover its error. A board whose bound exceeds 50 % at three standard deviations
therefore has no valid cell, whatever the method. The table has that bound beside what the driver finds.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, sqrt

import click
import numpy as np

from ..circuits import Design, adc_codes, scan, sensitivity
from ..common.arrays import FloatArray
from ..driver import CountReader
from ._driver import NOISE_STEPS, design, pressed

READOUTS = (
    ("voltage-divider", "float", 8),
    ("voltage-divider", "float", 10),
    ("voltage-divider", "float", 12),
    ("voltage-divider", "ground", 10),
    ("inverting-amplifier", "float", 12),
)
"""circuit, idle rows, ADC bits"""
SIZES = 8, 16, 32
SIGMAS = 3.0
FRAMES = 20
"""with the same cells and other noise, until the driver's reading is looked at: by then it knows the noise"""


def bound(board: Design, cells: FloatArray, noise_steps: float = NOISE_STEPS) -> FloatArray:
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


def row(circuit: str, idle_rows: str, bits: int, size: int) -> str:
    """One board, as a line of text."""
    board = design(size, circuit, idle_rows, bits)
    assert board.adc is not None
    _, frames = pressed(board.array.shape, FRAMES)
    cells = frames[-1]
    least = bound(board, cells)
    read, random, volts = CountReader(board), np.random.default_rng(0), scan(board, cells).volts
    for _ in range(FRAMES):
        noisy = volts + random.normal(scale=NOISE_STEPS * board.adc.step, size=volts.shape)
        reading = read(adc_codes(board, noisy).astype(np.uint16))
    possible = 100.0 * float((SIGMAS * least <= 0.5).mean())
    percent = "".join(f"{100 * value:>9.1f}" for value in (least.min(), float(np.median(least)), least.max()))
    valid = 100.0 * float(reading.valid.mean())
    return f"{circuit + ', ' + idle_rows:28}{bits:>5}{size:>5} x {size:<4}{percent}{possible:>17.0f}{valid:>13.0f}"


def table() -> Iterator[str]:
    """All boards as lines of text, as they come."""
    yield f"least standard deviation of a cell in % by one frame, with {NOISE_STEPS:g} ADC steps of noise"
    figures = f"{'best':>9}{'median':>9}{'worst':>9}{'can be valid %':>17}{'are valid %':>13}"
    yield f"{'board':28}{'bits':>5}{'array':>12}{figures}"
    for circuit, idle_rows, bits in READOUTS:
        for size in SIZES:
            yield row(circuit, idle_rows, bits, size)


@click.command()
def main() -> None:
    """Print what one frame can tell of the cells of boards on which readings depend on many cells."""
    for line in table():
        click.echo(line)


if __name__ == "__main__":
    main()
