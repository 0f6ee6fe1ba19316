"""Readings without their noise: the alpha-beta filter against least squares done the long way."""

import numpy as np
import pytest

from ohmskin.cell.estimation import _smoothing as smoothing
from ohmskin.cell.estimation._noise import NoiseMeter, average, std_at_rest
from ohmskin.cell.materials._simulate import step_noise, white_noise
from ohmskin.common import compiled

NOISE = 0.005


def smoothed(dt: float, r: np.ndarray, noise: float = NOISE, window: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    line, found, std = smoothing.begin(r[0]), [r[0]], [np.full_like(r[0], noise)]
    for reading in r[1:]:
        smooth = smoothing.advance(
            line, dt, smoothing.gains_for(window, dt), reading, noise * (1 + line[smoothing.LEVEL])
        )
        found.append(smooth.level.copy())
        std.append(smooth.std)
    return np.array(found), np.array(std)


def readings(truth: np.ndarray, cells: int = 200) -> np.ndarray:
    noise = np.random.default_rng(1).standard_normal((len(truth), cells))
    return truth[:, None] + NOISE * (1 + truth[:, None]) * noise


def test_it_is_least_squares_with_forgotten_readings() -> None:
    """The end of a line through all readings, weights exp(-age/window); the first line's slope has a prior."""
    rng = np.random.default_rng(2)
    dt, window = 0.05, 1.0
    r = 0.3 + 0.01 * dt * np.arange(40)[:, None] + 0.1 * NOISE * rng.standard_normal((40, 1))
    found, std = smoothed(dt, r, window=window)
    steps = 1.1 ** round(np.log(window / dt) / np.log(1.1))  # windows come in steps of 10 %
    prior = (smoothing.STEEPEST / steps) ** -2
    for n in (1, 2, 10, 39):
        age = np.arange(n, -1.0, -1.0)
        line = np.column_stack([np.ones_like(age), -age])
        weight = np.exp(-age / steps)
        # The prior is on the slope at the first reading, and is forgotten with it.
        normal = line.T @ (weight[:, None] * line) + np.diag([0.0, prior * np.exp(-n / steps)])
        end = np.linalg.solve(normal, line.T @ (weight * r[: n + 1, 0]))
        assert found[n, 0] == pytest.approx(end[0], abs=1e-12)
        assert std[n, 0] == pytest.approx(NOISE * (1 + found[n - 1, 0]) * np.sqrt(np.linalg.inv(normal)[0, 0]))


def test_the_noise_of_readings_is_measured() -> None:
    """At rest, under a press that comes and goes, and in conductance as a board has it."""
    rng = np.random.default_rng(3)
    truth = 0.4 * (1 - np.cos(2 * np.pi * 0.5 * 0.01 * np.arange(1500)))
    for level, cells in ((np.zeros(1500), 64), (truth, 64), (truth, 1)):
        meter = NoiseMeter(cells)
        for n, r in enumerate(level[:, None] + NOISE * (1 + level[:, None]) ** 2 * rng.standard_normal((1500, cells))):
            meter.update(r, None)
            if n > 300 and n % 100 == 0:
                now = np.full(cells, level[n])
                assert np.median(meter.std(now)) == pytest.approx(NOISE * (1 + level[n]) ** 2, rel=0.35)


@pytest.mark.parametrize("cells", [64, 400])
def test_no_cell_is_taken_for_free_of_noise_at_the_beginning(cells: int) -> None:
    """The differences of a cell's first readings are near zero now and then; the array knows better from the start."""
    rng = np.random.default_rng(8)
    meter = NoiseMeter(cells)
    for n in range(60):
        meter.update(NOISE * rng.standard_normal(cells), None)
        if n:
            std = meter.std(np.zeros(cells))
            assert std.min() > 0.5 * NOISE
            assert std.max() < 2.5 * NOISE


def test_a_press_on_one_cell_is_not_the_noise_of_the_others() -> None:
    rng = np.random.default_rng(4)
    meter = NoiseMeter(25)
    for n in range(600):
        r = 1e-4 * rng.standard_normal(25)
        r[7] += 0.3 * (n // 3 % 2)
        meter.update(r, None)
    std = meter.std(np.zeros(25))
    assert np.delete(std, 7) == pytest.approx(1e-4, rel=0.4)
    assert std[7] < 4e-4


@pytest.mark.parametrize("machine_code", [False, True])
@pytest.mark.parametrize("cells", [2, 64])
def test_the_noise_of_a_cell_stays_what_it_was_while_the_cell_is_not_read(cells: int, machine_code: bool) -> None:
    rng = np.random.default_rng(5)
    meter = meter_of(cells, machine_code)
    for _ in range(600):
        meter.update(NOISE * rng.standard_normal(cells), None)
    known = np.arange(cells) > 0
    before = meter.at_rest.copy()
    for _ in range(3000):
        meter.update(np.where(known, NOISE * rng.standard_normal(cells), 0.0), known)
    assert meter.at_rest[0] == pytest.approx(before[0], rel=1e-12)
    assert meter.at_rest[1] != pytest.approx(before[1], rel=1e-6)


@pytest.mark.parametrize("machine_code", [False, True])
@pytest.mark.parametrize(("cells", "readings"), [(1, 1500), (64, 600)])
def test_noise_that_has_risen_is_no_crowd_of_edges(cells: int, readings: int, machine_code: bool) -> None:
    """All differences are then outliers of the old noise, which are passed over only as long as they are few."""
    rng = np.random.default_rng(6)
    meter = meter_of(cells, machine_code)
    for _ in range(600):
        meter.update(NOISE * rng.standard_normal(cells), None)
    for _ in range(readings):
        meter.update(10.0 * NOISE * rng.standard_normal(cells), None)
    assert np.median(meter.at_rest) == pytest.approx(10.0 * NOISE, rel=0.25)


@pytest.mark.parametrize("machine_code", [False, True])
def test_readings_beside_edges_do_not_count_as_noise(machine_code: bool) -> None:
    """Taps of eight deviations, whose edges the smoothing has noticed; without its word 20 % more noise is found."""
    rng = np.random.default_rng(7)
    meter = meter_of(8, machine_code)
    for n in range(1500):
        meter.on_line[:] = 1.0 + n % 20
        meter.update(8.0 * NOISE * (n // 20 % 2) + NOISE * rng.standard_normal(8), None)
    assert meter.at_rest.mean() == pytest.approx(NOISE, rel=0.12)


@pytest.mark.parametrize("machine_code", [False, True])
@pytest.mark.parametrize("cells", [5, 30])
@pytest.mark.parametrize("power", [1, 2])
def test_noise_of_pressed_cells_follows_the_law_that_their_readings_show(
    power: int, cells: int, machine_code: bool
) -> None:
    """Noise of a conductance is constant, or scales with it: in r it is proportional to (1 + r)^2 or to 1 + r."""
    rng = np.random.default_rng(8)
    meter = meter_of(cells, machine_code)
    for n in range(1800):
        r = np.full(cells, 0.75 - 0.75 * np.cos(0.01 * max(n - 600, 0)))
        meter.update(r + NOISE * (1.0 + r) ** power * rng.standard_normal(cells), None)
    assert (meter.multiplicative > 0.0) == (power == 1)
    assert meter.std(np.zeros(cells))[:3] == pytest.approx(NOISE, rel=0.35)
    pressed = np.full(cells, 1.5)
    for _ in range(200):
        meter.update(pressed + NOISE * 2.5**power * rng.standard_normal(cells), None)
    assert np.median(meter.std(pressed)) == pytest.approx(NOISE * 2.5**power, rel=0.2)
    again = NoiseMeter(cells)
    again.restore(meter.state())
    assert again.std(pressed) == pytest.approx(meter.std(pressed), rel=1e-12)


@pytest.mark.parametrize("machine_code", [False, True])
def test_a_pressed_cell_that_stays_at_one_code_tells_nothing_of_the_law_of_noise(machine_code: bool) -> None:
    rng = np.random.default_rng(9)
    meter, step = meter_of(30, machine_code), 2.0 * NOISE
    meter.resolve(np.full(30, step / 12**0.5), 0.0)
    for n in range(1500):
        noise = NOISE * rng.standard_normal(30) * (n < 600)
        conductance = np.round((1.0 / (1.0 + 1.5 * (n >= 600)) + noise) / step) * step
        meter.update(1.0 / conductance - 1.0, None)
    assert meter.multiplicative == 0.0


def meter_of(cells: int, machine_code: bool) -> NoiseMeter:
    meter = NoiseMeter(cells)
    meter.compiled = machine_code
    if machine_code and not compiled.load(average, std_at_rest):
        pytest.skip("the extra 'fast' is not in use")
    return meter


@pytest.mark.parametrize("dt", [0.01, 0.1])
@pytest.mark.parametrize("slope", [0.0, 0.01, 0.1])
def test_ramps_pass_without_lag_and_with_the_stated_noise(dt: float, slope: float) -> None:
    time = np.arange(0, 6, dt)
    truth = slope * time
    found, std = smoothed(dt, readings(truth))
    late = time > 3
    error = (found - truth[:, None])[late]
    assert abs(error.mean()) < 0.2 * NOISE
    assert np.sqrt(np.mean(error**2)) < 0.85 * NOISE
    assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(std[late] ** 2)) < 1.3


def test_a_jump_is_seen_in_its_own_sample() -> None:
    time = np.arange(0, 10, 0.05)
    truth = np.where(time < 5, 0.0, 0.4)
    found, _ = smoothed(0.05, readings(truth))
    assert np.abs(found - truth[:, None]).max() < 6 * NOISE * 1.4
    quiet = np.std((found - truth[:, None])[time > 8])
    assert quiet < 0.5 * NOISE * 1.4


def test_readings_coarser_than_their_noise_have_that_of_their_steps() -> None:
    fine = 10e3 + 3e3 * np.sin(np.linspace(0, 20, 5000))
    coarse = 200.0 * np.round(fine / 200.0)
    assert white_noise(coarse) == 0
    assert step_noise(coarse) == pytest.approx(np.std(coarse - fine), rel=0.05)
    assert step_noise(np.full(10, 3.0)) == 0


@pytest.mark.parametrize("steps", [1.1**k for k in (-3, 0, 4, 20, 45, 80)])
def test_the_table_of_gains_is_that_of_the_kalman_filter(steps: float) -> None:
    """Level and slope, predicted and corrected reading by reading; what was known before counts e^(1/steps) less."""
    moves = np.array([[1.0, 1.0], [0.0, 1.0]])
    known = np.diag([1.0, min(smoothing.STEEPEST / steps, 1.0) ** 2])
    table = smoothing.gains(steps)
    assert (table.level[0], table.slope[0]) == (1.0, 0.0)
    for n in range(1, table.level.size):
        known = np.exp(1 / steps) * moves @ known @ moves.T
        gain = known[:, 0] / (known[0, 0] + 1.0)
        known = known - np.outer(gain, known[0])
        assert (table.level[n], table.slope[n]) == pytest.approx(gain, rel=1e-9)
        assert table.std[n] == pytest.approx(np.sqrt(known[0, 0]), rel=1e-9)


@pytest.mark.parametrize("cells", [1, 8, 64])
@pytest.mark.parametrize("expected", [0.1, 1.0, 10.0])
def test_the_noise_of_a_calibration_is_soon_forgotten(cells: int, expected: float) -> None:
    """It is only where the measurement begins: 150 readings later the board's own noise is known."""
    random = np.random.default_rng(3)
    found = []
    for _ in range(20):
        meter = NoiseMeter(cells, expected * NOISE)
        for _ in range(150):
            meter.update(NOISE * random.standard_normal(cells), None)
        found.append(meter.quiet)
    assert np.isfinite(found).all()
    assert np.median(found) == pytest.approx(NOISE, rel=0.2)
