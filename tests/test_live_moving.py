"""A law of the live path: loads that move and swing are followed, as of fingertips that wander over the skin.

Each cell's load turns a hundred times, smoothly, and is hardly ever none for long. Rules for loads that are held, for
taps and for rest must not take it for one of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ohmskin.cell import Cell
from ohmskin.circuits import Design, adc_codes, scan_batch
from ohmskin.driver import CountReader
from ohmskin.driver._estimate import Estimate
from ohmskin.driver._rest import Rest

CELL = Cell.example()
PROTOTYPE = Design.load(Path(__file__).parents[1] / "verification" / "prototype.toml")
DIVIDER = Design.model_validate(
    {
        "array": {"rows": 4, "columns": 3, "row_segment": 1.0, "column_segment": 1.0, "row_lead": 40.0},
        "drive": {"voltage": 3.3, "idle_rows": "ground"},
        "readout": {"circuit": "voltage-divider", "reference_resistance": 10e3},
        "adc": {"bits": 8, "range": [0.0, 3.3]},
    }
)
FINE_DIVIDER = DIVIDER.model_copy(update={"adc": DIVIDER.adc.model_copy(update={"bits": 12})})
SUBSTEPS, SEEDS = 4, (7, 8)
SIGMA_CELLS, MEAN_KPA, SWING_KPA, BEGIN_S, PLACE_S = 0.8, 6.0, 5.0, 3.0, 2.5
FREQUENCIES_HZ = (0.37, 0.53)
PRESSED_KPA, REST_KPA = 0.5, 0.05
AT_REST_KPA = 0.25
"""root mean square of what cells show that have just been left by a finger"""


@dataclass(frozen=True)
class Found:
    """What wandering fingers read as, over all frames, cells and seeds."""

    load: np.ndarray
    pressure: np.ndarray
    std: np.ndarray

    @property
    def rmse_kpa(self) -> float:
        """Where a cell is pressed."""
        pressed = self.load > PRESSED_KPA
        return float(np.sqrt(np.mean((self.pressure - self.load)[pressed] ** 2)))

    def within(self, deviations: float, cells: np.ndarray) -> float:
        """Share of the errors of some frames and ``cells`` within stated ``deviations``."""
        return float(np.mean((np.abs(self.pressure - self.load) <= deviations * self.std)[cells]))


def fingers(shape: tuple[int, ...], time_s: np.ndarray, seed: int) -> np.ndarray:
    """Loads (n, *shape) in kPa of two fingertips, as of ``examples/calibration.py``."""
    draw = np.random.default_rng(seed)
    cells = np.moveaxis(np.indices(shape), 0, -1)
    load = np.zeros((len(time_s), *shape))
    for frequency_hz in FREQUENCIES_HZ:
        places = draw.uniform(0.0, np.array(shape) - 1.0, (16, 2))
        place_s = BEGIN_S + PLACE_S * np.arange(len(places))
        at = np.stack([np.interp(time_s, place_s, along) for along in places.T], axis=-1)
        peak = MEAN_KPA + SWING_KPA * np.sin(2 * np.pi * frequency_hz * (time_s - BEGIN_S))
        apart = ((cells - at[:, None, None]) ** 2).sum(axis=-1)
        load += (peak * (time_s > BEGIN_S))[:, None, None] * np.exp(-apart / (2 * SIGMA_CELLS**2))
    return load


def followed(board: Design, noise_v: float, rate_hz: float, seconds: float) -> Found:
    """What a skin shows and states of the emulated ``board``, by the default estimator."""
    shape, dt = (board.array.rows, board.array.columns), 1.0 / rate_hz
    time_s = dt / SUBSTEPS * np.arange(1.0, round(seconds * rate_hz) * SUBSTEPS + 1)
    plays = []
    for seed in SEEDS:
        load = fingers(shape, time_s, seed)
        ohm = CELL.forward(shape).run(np.full(len(time_s), dt / SUBSTEPS), load)[SUBSTEPS - 1 :: SUBSTEPS]
        volts = scan_batch(board, ohm).volts
        codes = adc_codes(board, volts + noise_v * np.random.default_rng(seed).standard_normal(volts.shape))
        read = CountReader(board)
        estimate = Estimate(CELL, shape, None, Rest(CELL, None), None)
        pressure, std = np.empty((2, *ohm.shape))
        for n, frame in enumerate(codes):
            pressure[n], std[n] = estimate.take([dt], [read(frame)])
            judged = slice(round(BEGIN_S * rate_hz), None)
        plays.append((load[SUBSTEPS - 1 :: SUBSTEPS][judged], pressure[judged], std[judged]))
    return Found(*(np.concatenate(parts) for parts in zip(*plays, strict=True)))


@pytest.mark.parametrize(
    ("board", "noise_v", "rate_hz", "seconds", "most_kpa"),
    [
        pytest.param(PROTOTYPE, 5e-4, 20.0, 40.0, 0.235, id="prototype"),
        pytest.param(FINE_DIVIDER, 1e-3, 20.0, 25.0, 0.46, id="divider of 12 bits"),
        pytest.param(DIVIDER, 4e-3, 20.0, 25.0, 0.75, id="divider of 8 bits"),
        pytest.param(DIVIDER, 4e-3, 100.0, 12.0, 0.54, id="fast divider of 8 bits"),
    ],
)
def test_wandering_fingers_are_followed(
    board: Design, noise_v: float, rate_hz: float, seconds: float, most_kpa: float
) -> None:
    """Errors are no larger than turns that are told late make them, and are stated; cells that rest show it.

    Near a turn the load is among several explanations, so that errors have longer tails than a normal distribution.
    """
    found = followed(board, noise_v, rate_hz, seconds)
    pressed, rests = found.load > PRESSED_KPA, found.load < REST_KPA
    print(f"{found.rmse_kpa:.2f} kPa rms, {100 * found.within(2.0, pressed):.1f} % within 2 sd")
    assert found.rmse_kpa < most_kpa
    assert found.within(2.0, pressed) > 0.87
    assert found.within(3.0, pressed) > 0.96
    assert np.sqrt(np.mean((found.pressure - found.load)[rests] ** 2)) < AT_REST_KPA


def test_a_load_that_rises_again_is_not_hidden() -> None:
    """Whether a load has turned is in doubt for some frames. That it was there before is not."""
    found = followed(PROTOTYPE, 5e-4, 20.0, 20.0)
    rises = (np.diff(found.load, axis=0) > 0) & (found.load[:-1] > 1.0)
    assert np.diff(found.pressure, axis=0)[rises].min() > -0.5
