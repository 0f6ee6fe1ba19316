"""The noise of readings, measured while a skin is pressed; and which cells are valid on boards that people build."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from designs import digitised
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray, median
from ohmskin.common.noise import NoiseEstimate, constant_part
from ohmskin.driver import CountReader

STEP = 1e-3


@cache
def amplified(rows: int, columns: int) -> Design:
    """A board of steps of 1 mV, made once for the many readers of a test."""
    adc = {"range": [0.0, 65536 * STEP]}
    return digitised("grounded", rows, columns, 16, readout={"reference_resistance": 1e3}, adc=adc)


def measured(readings: np.ndarray) -> list[float]:
    """Standard deviations in ADC steps after each frame of (frames, rows, columns) V."""
    read, seen = CountReader(amplified(*readings.shape[1:])), []
    for volts in readings:
        read(np.clip(np.round(volts / STEP) + 20000, 1, 65000).astype(np.int64))
        seen.append(read.noise_volts / STEP)
    return seen


@pytest.mark.parametrize("cells", [(2, 2), (8, 8), (16, 24)])
@pytest.mark.parametrize("steps", [0.6, 3.0, 40.0])
def test_noise_is_known_after_a_few_frames(cells: tuple[int, int], steps: float) -> None:
    """From the fourth frame on; with four cells, and far above a step, a little later."""
    noise = np.random.default_rng(1).normal(scale=steps * STEP, size=(200, *cells))
    seen = np.array(measured(noise))[3 if steps < 10 and cells != (2, 2) else 8 :] / steps
    assert seen.min() > (0.8 if cells != (2, 2) else 0.4)
    assert np.median(seen) < (1.3 if cells != (2, 2) else 2.2)


def test_noise_that_grows_is_noticed_and_noise_that_ends_is_forgotten() -> None:
    rng = np.random.default_rng(2)
    scale = np.repeat([1.0, 10.0, 1.0], [20, 20, 80])[:, None, None]
    seen = measured(scale * STEP * rng.normal(size=(120, 6, 6)))
    assert seen[22] > 8  # the third frame of it
    assert seen[60] > 1
    assert seen[-1] < 1.8


@pytest.mark.parametrize("steps", [0.6, 3.0, 20.0])
@pytest.mark.parametrize("cells", [(1, 1), (1, 2), (2, 2), (3, 5)])
def test_few_readings_rarely_show_less_noise_than_there_is(cells: tuple[int, int], steps: float) -> None:
    """Of the frames from the fifth on; noise far beyond the limit of the first two is believed later."""
    rng, low = np.random.default_rng(7), []
    for _ in range(300):
        seen = measured(rng.normal(scale=steps * STEP, size=(6, *cells)))[1:]
        low.append(np.array(seen) / steps < 0.9)
    assert np.mean(low, axis=0)[3:].max() < 0.12


def test_noise_that_begins_on_few_cells_is_known_in_its_third_frame() -> None:
    scale, missed = np.repeat([0.5, 20.0], [20, 3])[:, None, None], 0
    for seed in range(100):
        seen = measured(STEP * scale * np.random.default_rng(seed).normal(size=(23, 5, 3)))
        missed += seen[-1] < 12.0
    assert missed < 10


@pytest.mark.parametrize("cells", [(1, 1), (1, 2), (3, 1), (2, 2)])
def test_an_edge_of_few_cells_that_goes_one_way_is_no_noise(cells: tuple[int, int]) -> None:
    """Presses and releases of 2 to 6 frames, of up to 20,000 steps, of some of the cells or all."""
    worst = []
    for seed in range(60):
        draw = np.random.default_rng(seed)
        edge = np.r_[0.0, np.cumsum(draw.dirichlet(np.full(draw.integers(2, 7), 3.0)))]
        course = np.concatenate([np.zeros(15), edge, np.ones(15), 1.0 - edge, np.zeros(5)])
        gain = draw.uniform(0.1, 1.0, cells) * (draw.random(cells) < 0.7)
        press = course[:, None, None] * gain * np.exp(draw.uniform(np.log(50.0), np.log(2e4)))
        seen = measured(STEP * (press + draw.normal(scale=0.4, size=press.shape)))
        worst.append(max(seen[15:]))
    assert max(worst) < 15.0


@pytest.mark.parametrize("cells", [(1, 1), (2, 1)])
def test_noise_that_begins_on_a_cell_or_two_is_known_after_five_frames(cells: tuple[int, int]) -> None:
    scale, missed = np.repeat([0.5, 20.0], [20, 5])[:, None, None], 0
    for seed in range(100):
        seen = measured(STEP * scale * np.random.default_rng(seed).normal(size=(25, *cells)))
        missed += seen[-1] < 10.0
    assert missed < 15


def pressing(shape: tuple[int, int], frames: int, peak: float) -> np.ndarray:
    """(frames, rows, columns) V of a press of all cells that grows and goes on; cells answer differently."""
    course = 0.5 - 0.5 * np.cos(np.arange(frames) / 25.0)
    gain = np.random.default_rng(5).uniform(0.3, 1.0, shape)
    return peak * STEP * gain * course[:, None, None]


@pytest.mark.parametrize("cells", [(3, 5), (12, 12)])
@pytest.mark.parametrize("begins", [20, 50])
def test_noise_that_begins_while_all_cells_move_is_known_in_its_third_frame(
    cells: tuple[int, int], begins: int
) -> None:
    """Wherever the press is: before, at and after its steepest frame. Afterwards it is known all the time."""
    scale = np.where(np.arange(90) < begins, 0.5, 20.0)[:, None, None]
    missed, later = 0, []
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(size=(90, *cells))
        seen = measured(pressing(cells, 90, 3000.0) + STEP * scale * noise)
        missed += seen[begins + 2] < 12.0
        later += seen[begins + 6 :]
    assert missed <= 1
    assert np.mean(np.array(later) < 14.0) < 0.05
    assert np.median(later) < 30.0


@pytest.mark.parametrize("cells", [(3, 5), (8, 8), (16, 16)])
def test_a_press_of_all_cells_is_no_noise_whatever_its_course(cells: tuple[int, int]) -> None:
    """Up to 120 steps per frame, with accelerations of 5; three in four frames state less than twice the noise."""
    noise = np.random.default_rng(6).normal(scale=0.7, size=(160, *cells))
    seen = np.array(measured(pressing(cells, 160, 6000.0) + STEP * noise)) / 0.7
    assert np.quantile(seen[5:], 0.75) < 2.0
    assert seen[5:].min() > 0.7


def test_a_jump_of_all_cells_there_and_back_is_forgotten_at_once() -> None:
    """Such a tap lasts two frames. What has been taken for noise in one frame is not assumed for a second."""
    for cells in ((2, 2), (4, 4), (8, 8)):
        rng = np.random.default_rng(7)
        volts = rng.normal(scale=0.5 * STEP, size=(40, *cells))
        volts[20:22] += 2000.0 * STEP * rng.uniform(0.3, 1.0, (2, *cells))
        assert max(measured(volts)[26:]) < 8.0


def test_a_noise_that_quiet_frames_contradict_is_gone_after_twenty_of_them() -> None:
    """Nobody can tell motion of many patterns from noise; once all is at rest, readings show that there is none."""
    rng = np.random.default_rng(11)
    scale = np.repeat([1000.0, 0.3], [40, 30])[:, None, None]
    seen = measured(scale * STEP * rng.normal(size=(70, 4, 6)))
    assert seen[45] > 500.0
    assert seen[62] < 10.0


@pytest.mark.parametrize("pause", [4, 9, 15])
def test_a_noise_that_has_paused_is_known_in_the_frame_in_which_it_returns(pause: int) -> None:
    for seed in range(10):
        noise = np.random.default_rng(seed).normal(scale=3.0 * STEP, size=(12 + pause, 8, 8))
        noise[6 : 6 + pause] = 0.0
        seen = measured(noise)
        assert seen[5 + pause] < 3.0
        assert min(seen[6 + pause :]) > 1.2


def test_five_readings_that_move_each_by_itself_do_not_hide_a_noise() -> None:
    known = []
    for seed in range(60):
        draw = np.random.default_rng(seed)
        moving = np.cumsum(draw.normal(scale=400.0, size=(10, 1, 5)), axis=0)
        moving[:6] = moving[6]
        moving[6:] += draw.normal(scale=50.0, size=(4, 1, 5))
        known.append(min(measured(moving * STEP)[8:10]))
    assert np.mean(np.array(known) > 25.0) > 0.85


def test_noise_on_a_few_readings_of_which_most_come_and_go_at_a_limit_is_not_multiplied() -> None:
    """Readings near a limit count as limited, but move and show the noise as any others do."""
    readout = {"reference_resistance": 1e3, "supply": [-0.1, 3.4]}
    design = digitised("grounded", 4, 1, 8, readout=readout, adc={"range": [-0.1, 3.3]})
    read, rng = CountReader(design), np.random.default_rng(12)
    volts = scan(design, np.array([[200.0], [400.0], [800.0], [500.0]])).volts
    step = 3.4 / 256
    for _ in range(40):
        read(adc_codes(design, volts + rng.normal(scale=20.0 * step, size=(4, 1))))
    assert 10.0 < read.noise_volts / step < 80.0


def divider(bits: int, reference_ohm: float, idle_rows: str) -> Design:
    sections = {"drive": {"idle_rows": idle_rows}, "readout": {"reference_resistance": reference_ohm}}
    return digitised("divider", 8, 8, bits, array={"row_lead": 25.0}, **sections)


@pytest.mark.parametrize(
    ("bits", "reference_ohm", "idle_rows"),
    [
        (8, 1e3, "ground"),
        (8, 4.7e3, "ground"),
        (8, 1e3, "float"),
        (10, 1e3, "float"),
        (10, 4.7e3, "float"),
        (12, 1e3, "float"),
    ],
)
def test_cells_of_usual_dividers_are_valid_at_rest_and_pressed(bits: int, reference_ohm: float, idle_rows: str) -> None:
    """Cells of 10 kohm, a finger that presses one of them to a tenth, noise of 1 mV; none is off by a factor of two."""
    design, rng = divider(bits, reference_ohm, idle_rows), np.random.default_rng(5)
    read, rest = CountReader(design), 1e4 * np.exp(rng.normal(0, 0.1, (8, 8)))
    row, column = np.indices((8, 8))
    finger = np.exp(-((row - 2.3) ** 2 + (column - 5.1) ** 2) / 1.3)
    valid, within, worst = [], [], 0.0
    for load in np.r_[np.zeros(10), np.linspace(0.0, 1.0, 10), np.ones(8)]:
        cells = rest / (1.0 + 9.0 * load * finger)
        reading = read(adc_codes(design, scan(design, cells).volts + rng.normal(scale=1e-3, size=(8, 8))))
        found = reading.valid
        off = np.abs(reading.resistance / cells - 1.0)[found]
        worst = max(worst, float(off.max(initial=0.0)))
        within += (off / reading.uncertainty[found]).tolist()
        valid.append(found)
    assert np.mean(valid[2:10]) == 1.0
    assert np.mean(valid[-8:]) == 1.0
    assert max(within) < 5.0 / 3.0
    assert np.sqrt(np.mean(np.square(within))) > 0.05  # an uncertainty that tells something
    assert worst < 0.5


def test_cells_that_are_known_to_a_factor_of_two_are_not_valid() -> None:
    """A reference resistor a hundredth of the cells: one step of eight bits is a third of the signal and more."""
    design = divider(8, 1e3, "ground")
    read = CountReader(design)
    for _ in range(3):
        reading = read(adc_codes(design, scan(design, np.full((8, 8), 4e5)).volts))
    assert not reading.valid.any()


def test_readings_that_stand_still_become_valid_again_after_noise() -> None:
    """The noise of a second ago is forgotten, though the same counts come again and again."""
    design, rng = divider(10, 1e3, "float"), np.random.default_rng(6)
    read, volts = CountReader(design), scan(design, np.full((8, 8), 1e4)).volts
    for _ in range(10):
        noisy = read(adc_codes(design, volts + rng.normal(scale=0.015, size=(8, 8))))
    quiet = [read(adc_codes(design, volts)) for _ in range(120)]
    assert not noisy.valid.all()
    assert quiet[-1].valid.all()
    assert quiet[-1].uncertainty.max() < 0.3 * noisy.uncertainty.min()


@pytest.mark.parametrize("count", [1, 4, 16, 256])
@pytest.mark.parametrize("press", [0.0, 1000.0])
def test_the_noise_of_each_reading_is_learned_while_a_finger_taps(count: int, press: float) -> None:
    """To a third of a reading's own noise after 600 frames; presses of a thousand times the noise do not count."""
    ratios, frames = [], np.arange(600)
    for seed in range(1 if count > 100 else 6):
        draw = np.random.default_rng(seed)
        true = np.geomspace(0.7, 1.4, count) if count > 1 else np.ones(1)
        course = press * ((frames % 100 < 20) + 0.5 - 0.5 * np.cos(frames / 40.0))
        estimate = NoiseEstimate(count, quantum=1e-6)
        for load in course[:, None] + true * draw.normal(size=(600, count)):
            estimate.update(load)
        ratios.append(estimate.each / true)
    assert np.median(ratios) == pytest.approx(1.0, abs=0.1)
    assert np.quantile(ratios, [0.05, 0.95]) == pytest.approx([1.0, 1.0], abs=0.3)


@pytest.mark.parametrize("sigma", [0.08, 0.2, 0.5, 2.0])
def test_of_quantised_readings_noise_and_constant_part_make_up_the_whole_error(sigma: float) -> None:
    """Mean squares over many readings: what changes from frame to frame, and what stays of a step of uniform error."""
    draw = np.random.default_rng(3)
    true, estimate = draw.uniform(0.0, 100.0, 400), NoiseEstimate(400, quantum=1.0, assumed=0.5)
    errors = []
    for _ in range(60):
        codes = np.round(true + sigma * draw.normal(size=400))
        estimate.update(codes)
        errors.append(np.mean((codes - true) ** 2))
    stated = estimate.usual**2 + constant_part(estimate.usual) ** 2 / 12.0
    assert stated == pytest.approx(np.mean(errors), rel=0.1)


def test_readings_that_are_missing_or_sent_twice_change_no_noise() -> None:
    draw = np.random.default_rng(5)
    frames = draw.normal(size=(300, 12))
    plain, doubled, gappy = (NoiseEstimate(12, quantum=1e-6) for _ in range(3))
    upper: tuple[list[float], ...] = [], [], []
    for frame in frames:
        missing = draw.random(12) < 0.1
        upper[0].append(plain.update(frame))
        gappy.run(np.where(missing, np.nan, frame)[None])
        upper[1].append(gappy.std)
        upper[2].append([doubled.update(frame), doubled.update(frame)][1])
    assert [doubled.usual, gappy.usual] == pytest.approx([plain.usual] * 2, rel=0.15)
    assert np.median(upper, axis=1) == pytest.approx(np.median(upper[0]), rel=0.3)


def test_a_restored_estimate_goes_on_as_the_saved_one() -> None:
    draw = np.random.default_rng(6)
    one, other = (NoiseEstimate(9, quantum=1e-3, expected=2.0) for _ in range(2))
    for frame in draw.normal(size=(50, 9)):
        one.update(frame)
    other.restore({name: np.array(value) for name, value in one.state().items()})
    for frame in draw.normal(size=(50, 9)):
        assert one.update(frame) == other.update(frame)
    np.testing.assert_array_equal(one.each, other.each)


# The median of a small array


@given(arrays(np.float64, array_shapes(max_dims=2, max_side=20), elements=st.floats(-1e150, 1e150)))
def test_the_median_is_numpy_s_and_leaves_the_values_alone(values: FloatArray) -> None:
    before = values.copy()
    assert median(values) == float(np.median(values))
    assert median(values[::-1]) == median(values)
    np.testing.assert_array_equal(values, before)
