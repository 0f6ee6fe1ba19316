"""Noise that the cells of a column share: what is taken out, what must not be, and what it does for light taps."""

from __future__ import annotations

import numpy as np
import pytest
from needs import need

from ohmskin.bench.boards import design
from ohmskin.cell import Cell, Estimator
from ohmskin.cell.estimation._noise import NoiseMeter
from ohmskin.cell.estimation._shared_noise import LEAST_CELLS, LOOPS, SharedNoise
from ohmskin.circuits import adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.common.compiled import load as load_loops
from ohmskin.driver import CountReader

CELL = Cell.example()
DT_S = 0.01
OWN, SHARED = 0.012, 0.035
"""standard deviations of r, as 4 mV make of it on a divider of eight rows"""


def noise(frames: int, rows: int, columns: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """(frames, rows, columns) relative errors of cells, and (frames, 1, columns) those of whole columns."""
    random = np.random.default_rng(seed)
    own = OWN * random.standard_normal((frames, rows, columns))
    return own, SHARED * random.standard_normal((frames, 1, columns))


def told(estimator: Estimator) -> Estimator:
    """Of the noise, as the driver tells of steps."""
    own = np.full(estimator.shape, OWN)
    rest = np.full(estimator.shape, CELL.rest_resistance_ohm)
    estimator.resolve(0.01 * own, rest, 0.01 * own * np.hypot(1.0, SHARED / OWN))
    return estimator


def stepped(estimator: Estimator, ohms: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pressures and their standard deviations in kPa."""
    estimator.compile()
    pressure, std = np.empty((2, *ohms.shape))
    for n, ohm in enumerate(ohms):
        pressure[n] = estimator.step(DT_S, ohm)
        std[n] = estimator.std_kpa
    return pressure, std


def loaded(kpa: FloatArray) -> FloatArray:
    """Ohm of cells of the example under a load (frames, rows, columns)."""
    return CELL.forward(kpa.shape[1:]).run(np.full(len(kpa), DT_S), kpa)


@pytest.mark.parametrize("pressed", [0.0, 1.5])
@pytest.mark.parametrize("asleep", [0, 2, 3, 7])
def test_what_is_left_is_what_the_sleeping_cells_cannot_tell(asleep: int, pressed: float) -> None:
    """Own noise, and of the shared one what the mean of k cells does not know: ratio / (1 + k ratio) of own."""
    frames, rows, columns = 4000, 8, 6
    own, shared = noise(frames, rows, columns)
    r = pressed * (np.arange(rows) == 7)[:, None]
    readings = r + (1.0 + r) ** 2 * own + (1.0 + r) * shared
    meter = NoiseMeter(rows * columns)
    found = SharedNoise((rows, columns), meter)
    found.suppose(1.0, float(np.hypot(1.0, SHARED / OWN)))
    meter.own = OWN
    awake = np.zeros((rows, columns), dtype=np.bool_)
    for first in sum(noise(40, rows, columns, seed=1)):  # all cells sleep, and tell that they do share noise
        found.subtract(DT_S, first.ravel(), None, awake.ravel())
    awake[asleep:] = True
    without = np.array([found.subtract(DT_S, x.ravel(), None, awake.ravel())[0] for x in readings])
    error = (without.reshape(readings.shape) - r)[:, 7]
    ratio = (SHARED / OWN) ** 2
    left = ratio / (1.0 + asleep * ratio) if asleep >= LEAST_CELLS else ratio
    scale = 1.0 + pressed
    assert error.std() == pytest.approx(OWN * scale * np.sqrt(scale**2 + left), rel=0.05)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_load_that_may_have_been_taken_for_noise_is_in_doubt(compiled: bool) -> None:
    """By 1.5 deviations of the mean of seven sleeping cells. The eighth one, which is pressed, doubts it."""
    need("needs numba" if compiled and not load_loops(*LOOPS) else None)
    rows, columns, pressed, load = 8, 400, 0.5, 1.5 * SHARED
    own, shared = noise(44, rows, columns)
    meter = NoiseMeter(rows * columns)
    found = SharedNoise((rows, columns), meter)
    found.suppose(1.0, float(np.hypot(1.0, SHARED / OWN)))
    found.compiled, meter.own = compiled, OWN
    awake = np.zeros((rows, columns), dtype=np.bool_)
    for reading in (own + shared)[:40]:
        found.subtract(DT_S, reading.ravel(), None, awake.ravel())
    awake[7] = True
    r = pressed * awake
    quiet, doubts = np.zeros(rows * columns), []
    for n in range(40, 44):
        reading = r + load * (1.0 - awake) + (1.0 + r) * (own[n] + shared[n])
        without, _, _ = found.subtract(DT_S, reading.ravel(), None, awake.ravel())
        doubt = quiet.copy()
        told = found.doubt(without, awake.ravel())
        assert told is not None
        doubt[told[0]] = told[1]
        doubts.append(doubt.reshape(rows, columns))
    assert not np.any(np.array(doubts)[:, :7])
    last = doubts[-1][7][doubts[-1][7] > 0.0] / (1.0 + pressed)
    assert last.size > columns / 3
    assert 0.7 * load < np.median(last) < 1.3 * load


@pytest.mark.parametrize("kpa", [3.0, 9.0])
@pytest.mark.parametrize("columns", [1, 8])
def test_a_load_on_whole_columns_is_no_noise(columns: int, kpa: float) -> None:
    """A plate moves all cells of a column alike, as shared noise does."""
    frames = 400
    own, shared = noise(frames, 8, 8)
    plate = np.zeros((8, 8))
    plate[:, :columns] = kpa
    time_s = DT_S * np.arange(frames)
    load = np.interp(time_s, [2.0, 2.2], [0.0, 1.0])[:, None, None] * plate
    pressure, std = stepped(told(CELL.estimator((8, 8))), loaded(load) * (1.0 + own + shared))
    off = np.abs(pressure - load)[:, :, :columns]
    assert np.mean(off[250:] < 0.1 * kpa + 3.0 * 0.1) > 0.93
    assert np.mean(off[200:] < 2.0 * std[200:, :, :columns]) > 0.98


def test_noise_of_columns_is_no_tremor_of_a_plate() -> None:
    """Neighbours tell tremors below a reading's noise: under a plate at rest they have none to tell, for long."""
    load = 9.0 * np.interp(DT_S * np.arange(700), [0.5, 0.7], [0.0, 1.0])[:, None, None] * np.ones((6, 8))
    own, shared = noise(len(load), 6, 8, seed=3)
    pressure, std = stepped(told(CELL.estimator((6, 8))), loaded(load) * (1.0 + own + shared))
    off = np.abs(pressure - load)[100:]
    print(f"error {np.sqrt(np.mean(off[300:] ** 2)):.2f} kPa, {100 * np.mean(off < 2.0 * std[100:]):.1f} % within 2 sd")
    assert np.sqrt(np.mean(off[300:] ** 2)) < 1.5
    assert np.mean(off < 2.0 * std[100:]) > 0.98


def test_columns_that_share_no_noise_are_left_alone() -> None:
    """As on a divider with floating rows, whose readings depend on one another in other ways."""
    own, _ = noise(300, 8, 8)
    estimator = told(CELL.estimator((8, 8)))
    for error in own * np.hypot(1.0, SHARED / OWN):
        estimator.step(DT_S, CELL.rest_resistance_ohm * (1.0 + error))
    assert estimator._shared_noise.ratio == 0.0
    assert np.median(estimator._noise.at_rest) == pytest.approx(np.hypot(OWN, SHARED), rel=0.1)


def test_a_saved_state_goes_on() -> None:
    own, shared = noise(200, 8, 8)
    load = np.zeros((200, 8, 8))
    load[120:, 2:4, 3] = 5.0
    ohms = loaded(load) * (1.0 + own + shared)
    first, second = told(CELL.estimator((8, 8))), CELL.estimator((8, 8))
    stepped(first, ohms[:150])
    second.restore(first.state())
    np.testing.assert_array_equal(stepped(first, ohms[150:])[0], stepped(second, ohms[150:])[0])


def on_divider(
    load: FloatArray, bits: int, noise_v: float, seed: int, *, compiled: bool = False
) -> tuple[FloatArray, FloatArray]:
    """(frames, 8, 8) pressure and deviation under a load (frames, 8, 8), on a divider whose idle rows are driven."""
    board, random = design("voltage-divider", "ground", "float", bits, 10e3), np.random.default_rng(seed)
    rest = CELL.rest_resistance_ohm * np.exp(random.normal(0.0, 0.1, (8, 8)))
    ohms = loaded(load) * rest / CELL.rest_resistance_ohm
    read, estimator = CountReader(board), CELL.estimator((8, 8), rest_resistance_ohm=rest)
    if compiled:
        need(None if estimator.compile() else "needs numba")
    pressure, std = np.empty((2, *load.shape))
    for n, ohm in enumerate(ohms):
        volts = scan(board, ohm).volts
        reading = read(adc_codes(board, volts + noise_v * random.standard_normal((8, 8))))
        if n == 5:
            estimator.resolve(*reading.resolution)
        pressure[n] = estimator.step(DT_S, reading.for_estimation)
        std[n] = estimator.std_kpa
    return pressure, std


def beside_a_hold(kpa: float, *, compiled: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(frames, 8) load, pressure and deviation of a column: one cell is held at 9 kPa, then the others get ``kpa``."""
    time_s = DT_S * np.arange(320)
    load = np.zeros((time_s.size, 8, 8))
    load[:, :, 3] = kpa * np.interp(time_s, [2.0, 2.3], [0.0, 1.0])[:, None]
    load[:, 2, 3] = 9.0 * np.interp(time_s, [1.0, 1.1], [0.0, 1.0])
    pressure, std = on_divider(load, 12, 1e-3, seed=0, compiled=compiled)
    return load[:, :, 3], pressure[:, :, 3], std[:, :, 3]


@pytest.mark.parametrize("kpa", [3.0, 9.0])
def test_a_load_beside_a_held_one_is_no_noise(kpa: float) -> None:
    """Taken for noise, it would seem to release the held cell, and would itself come late."""
    load, pressure, std = beside_a_hold(kpa, compiled=False)
    off = np.abs(pressure - load)
    assert off[150:, 2].max() < 0.6
    assert np.mean(off[190:] < 2.0 * std[190:]) > 0.98
    assert (off[190:] / std[190:]).max() < 4.5


def test_machine_code_tells_loads_from_noise_as_array_operations_do() -> None:
    for one, other in zip(beside_a_hold(3.0, compiled=True), beside_a_hold(3.0, compiled=False), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)


def fringe(bits: int, noise_v: float, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(frames, 8, 8) load, pressure and deviation of taps of 9 kPa at 2 Hz, on a divider whose idle rows are driven.

    Gaussian in space: the cells beside the finger get 3.3 kPa, and those at the corners 1.2.
    """
    time_s = DT_S * np.arange(600)
    phase_s = time_s % 0.5
    tap = np.where((time_s > 1.0) & (phase_s < 0.15), np.sin(np.pi * phase_s / 0.15), 0.0)
    row, column = np.indices((8, 8))
    finger = 9.0 * np.exp(-((row - 2.0) ** 2 + (column - 5.0) ** 2))
    load = tap[:, None, None] * np.where(finger > 0.1, finger, 0.0)
    return load, *on_divider(load, bits, noise_v, seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bits", "noise_v", "left_kpa", "within"), [(12, 4e-3, 1.5, 0.9), (10, 1e-3, 0.8, 0.92), (12, 3e-4, 0.15, 0.95)]
)
def test_light_taps_beside_strong_ones_leave_little(bits: int, noise_v: float, left_kpa: float, within: float) -> None:
    """Cells of 0.5 to 3.5 kPa, between the taps (root mean square) and at all times. Before, 4 mV left 4 to 7 kPa."""
    left, share = [], []
    for seed in range(2):
        load, pressure, std = fringe(bits, noise_v, seed)
        light = (load.max(axis=0) > 0.5) & (load.max(axis=0) < 3.5)
        off = (pressure - load)[100:, light]
        left.append(np.mean(off[load[100:, light] == 0.0] ** 2))
        share.append(np.mean(np.abs(off) < 2.0 * std[100:, light]))
    assert np.sqrt(np.mean(left)) < left_kpa
    assert np.mean(share) > within
