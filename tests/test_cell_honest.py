"""Stated standard deviations against errors: loads, faults, noise, frame rates, and cells of several kinds."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import astuple, dataclass, replace

import numpy as np
import pytest
from cells import EXAMPLE

from ohmskin.bench import judges, scenes
from ohmskin.cell import Cell, PaperModel
from ohmskin.cell._cell import Calibrated
from ohmskin.cell.inversions._learned import Limits, StaticCurve

LOADS = ["hold", "edge", "press", "slow ramp", "fast ramp", "sine", "taps", "finger"]


@dataclass(frozen=True)
class Shape:
    """What a cell of the paper's kind does, whatever its units: the parameters of `PaperModel` follow."""

    gain: float
    """r at full scale, at equilibrium"""
    at_once: float
    """share of it that the cell answers at once"""
    slow: float
    """share of it that takes ``slow_s``; the rest takes ``fast_s``"""
    fast_s: float
    slow_s: float
    overshoot: float
    """what a rise adds to r, over r at equilibrium"""
    fading_s: float
    """time in which the overshoot fades"""

    def cell(self, full_kpa: float, rest_ohm: float) -> Cell:
        gain = self.gain / full_kpa
        e2, e3, etau2 = 1 / (gain * (1 - self.at_once - self.slow)), 1 / (gain * self.slow), 1 / (gain * self.overshoot)
        model = PaperModel(
            eu1_kpa=1 / gain,
            etau2_kpa=etau2,
            eu2_kpa_per_s=etau2 / self.fading_s,
            e1_kpa=1 / (gain * self.at_once),
            e2_kpa=e2,
            e3_kpa=e3,
            eta2_kpa_s=self.fast_s * e2,
            eta3_kpa_s=self.slow_s * e3,
        )
        return Cell(rest_resistance_ohm=rest_ohm, full_scale_kpa=full_kpa, model=model)


LEAST = Shape(gain=0.3, at_once=0.5, slow=0.02, fast_s=3.0, slow_s=50.0, overshoot=0.1, fading_s=2.0)
MOST = Shape(gain=1.2, at_once=0.8, slow=0.06, fast_s=15.0, slow_s=200.0, overshoot=0.4, fading_s=10.0)
# Where deviations were least honest: half of the answer is late, and the overshoot fades at once.
CORNERS = [
    replace(LEAST, gain=gain, overshoot=overshoot, fast_s=15.0) for gain in (0.3, 1.2) for overshoot in (0.1, 0.4)
]
BOARDS = list(itertools.product((60.0, 100.0, 250.0), (0.1, 1.0, 10.0)))
"""frames per second, noise in mV"""


def drawn(random: np.random.Generator) -> Cell:
    """A cell between the two extremes."""
    shape = Shape(*random.uniform(astuple(LEAST), astuple(MOST)).tolist())
    return shape.cell(full_kpa=random.uniform(5.0, 200.0), rest_ohm=random.uniform(500.0, 5e4))


def judged_by_load(skins: Iterable[tuple[Cell, tuple[float, float]]]) -> dict[str, list[judges.Figures]]:
    """Each cell on its board, under each of eight loads. ``pytest -rP`` shows what was found."""
    found: dict[str, list[judges.Figures]] = {load: [] for load in LOADS}
    for number, (cell, (rate_hz, noise_mv)) in enumerate(skins):
        for load in LOADS:
            played = scenes.play(scenes.Scene(load, f"drawn {number}", rate_hz, 12, noise_mv), cell)
            pressure, std, _ = judges.estimated(played, cell.estimator((scenes.CELLS,)))
            found[load].append(judges.figures(played, pressure, std, cell.full_scale_kpa))
    for load, several in found.items():
        least, rmse = min(one.within for one in several), max(one.rmse for one in several)
        print(f"{load:10} within two {within_two(several):.1f} %, least {least:.1f} %, rmse up to {rmse:.1f} %")
    return found


def within_two(several: Iterable[judges.Figures]) -> float:
    return float(np.mean([one.within for one in several]))


@pytest.mark.slow
def test_errors_of_drawn_paper_cells_are_within_the_stated_deviations() -> None:
    """Always the same twelve cells, so that no estimator is made for those of the judges' table alone."""
    random = np.random.default_rng(1)
    found = judged_by_load((drawn(random), BOARDS[n % len(BOARDS)]) for n in range(12))
    assert within_two(itertools.chain(*found.values())) > 97.0
    for several in found.values():
        assert within_two(several) > 95.0


@pytest.mark.slow
def test_paper_cells_that_answer_late_are_as_honest() -> None:
    """What turns leave adds up under loads without a rest."""
    found = judged_by_load((shape.cell(full_kpa=20.0, rest_ohm=1e4), (60.0, 0.1)) for shape in CORNERS)
    for several in found.values():
        assert within_two(several) > 95.0


@pytest.mark.parametrize("step", [0.035, 0.07])
def test_flips_between_two_codes_are_no_load_and_leave_little_doubt(step: float) -> None:
    """Cells at rest whose readings are one of two neighbouring codes, from frame to frame by chance."""
    cells, rest_ohm = 64, EXAMPLE.rest_resistance_ohm
    draw = np.random.default_rng(0)
    flips = draw.random((800, cells)) < draw.uniform(0.02, 0.5, cells)
    estimator = EXAMPLE.estimator((cells,))
    estimator.resolve(np.full(cells, step / np.sqrt(12)), np.full(cells, rest_ohm))
    largest = 0.0
    for frame in flips:
        estimator.step(0.01, rest_ohm * (1.0 + step * frame))
        largest = max(largest, float(estimator.std_kpa.max()))
    assert isinstance(EXAMPLE.model, PaperModel)
    kpa_of_step = step * EXAMPLE.model.e1_kpa
    assert largest < 1.5 * kpa_of_step


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_a_calibrated_cell_is_judged_with_what_calibration_left_unexplained(factor: float) -> None:
    """A calibration that is off by 3 % and says that it was off by 1.5 % of full scale on readings it had not seen."""
    model = EXAMPLE.model
    assert isinstance(model, PaperModel)
    off = model.replace(eta2_kpa_s=model.eta2_kpa_s * factor, eu2_kpa_per_s=model.eu2_kpa_per_s / factor)
    static = StaticCurve(coefficients=(0.0, 1.0), limits=Limits(lowest=0.0, highest=1.0), std_kpa=1.0)
    calibrated = Calibrated(default="inverse", reason="", held_out_percent={"inverse": 1.5}, static=static)
    believed = EXAMPLE.replace(model=off, estimators=calibrated)
    played = scenes.play(scenes.Scene("press", "example"))
    pressure, std, _ = judges.estimated(played, believed.estimator((scenes.CELLS,)))
    error = np.abs(pressure - played.pressure_kpa)
    assert np.mean(error[50:] < 2 * std[50:]) > 0.95


def test_a_cell_at_rest_shows_no_load_whatever_its_curve_says() -> None:
    """A cubic fitted to presses misses rest by 8 % of full scale: a cell that sleeps shows none."""
    static = StaticCurve(coefficients=(0.08, 1.0), limits=Limits(lowest=0.0, highest=1.0), std_kpa=0.5)
    calibrated = Calibrated(default="static", reason="", held_out_percent={"static": 5.0}, static=static)
    cell = EXAMPLE.replace(estimators=calibrated)
    played = scenes.read(EXAMPLE, np.zeros((200 * scenes.SUBSTEPS, 8)), 0.01, 1.0, np.random.default_rng(0))
    pressure, std, _ = judges.estimated(played, cell.estimator((8,)))
    assert not pressure[-1].any()
    assert (std[-1] > 0.08 * EXAMPLE.full_scale_kpa).all()


@pytest.mark.parametrize("kpa", [3.0, 9.0, 14.0])
@pytest.mark.parametrize("after_s", [0.05, 0.2, 1.5])
def test_a_first_reading_under_load_is_no_long_hold_without_a_doubt(kpa: float, after_s: float) -> None:
    """The skin is opened after a press has begun; it lasts for two seconds, and two more follow."""
    cell, dt = Cell.example(), 0.02
    time = np.arange(0.0, 10.0, dt)
    load = kpa * np.interp(time, [0.1, 0.15, 2.1, 2.15, 4.0, 4.05, 5.0, 5.05, 7.0, 7.05, 8.0, 8.05], [0, 1, 1, 0] * 3)
    board, estimator = cell.forward((4,)), cell.estimator((4,))
    estimator.compile()
    noise = np.random.default_rng(0).normal(scale=1e-3, size=(len(time), 4))
    ratios = []
    for now, true, scatter in zip(time, load, noise, strict=True):
        ohm = board.step(dt, np.full(4, true)) * (1.0 + scatter)
        if now > 0.1 + after_s:
            pressure = estimator.step(dt, ohm)
            ratios.append(np.abs(pressure - true) / estimator.std_kpa)
    assert np.mean(np.array(ratios) > 2.0) < 0.05
    assert np.mean(np.array(ratios) > 3.0) < 0.02


@pytest.mark.parametrize("factor", [0.6, 0.75, 2.5, 4.0])
@pytest.mark.parametrize("kind", ["paper", "asymmetric"])
def test_a_bad_contact_of_a_released_cell_leaves_no_trace(kind: str, factor: float) -> None:
    """60 ms in which an unloaded cell, which still remembers a press, reads more or less than it has."""
    cell, dt = scenes.cells()[kind], 0.01
    time = dt / scenes.SUBSTEPS * np.arange(600 * scenes.SUBSTEPS)
    share = np.interp(time, [0.5, 0.6, 2.5, 2.6], [0.0, 1.0, 1.0, 0.0])[:, None] * np.linspace(0.5, 0.9, 4)
    played = scenes.read(cell, share, dt, 0.3, np.random.default_rng(0))
    played.siemens[280:286] /= factor
    pressure, _, _ = judges.estimated(played, cell.estimator((4,)))
    assert np.abs(pressure[300:]).max() < 0.03 * cell.full_scale_kpa


@pytest.mark.parametrize("machine_code", [False, True])
def test_no_pressure_beyond_the_usual_is_shown_in_doubt(machine_code: bool) -> None:
    """Loads that turn within frames, in noise: what is shown beyond full scale is in the deviation, and not doubt."""
    random, cell = np.random.default_rng(0), Cell.example()
    estimator, forward = cell.estimator((4, 4)), cell.forward((4, 4))
    if machine_code and not estimator.compile():
        pytest.skip("the extra 'fast' is not in use")
    full_kpa, beyond, doubted = cell.full_scale_kpa, 0, 0
    for frame in range(800):
        load = full_kpa * random.random((4, 4)) * (random.random((4, 4)) < 0.5) * (frame > 50)
        for part in (random.random(), 1.0, 1.0):
            ohm = forward.step(0.02 / 3.0, part * load)
        shown = estimator.step(0.02, ohm * (1.0 + 0.01 * random.standard_normal((4, 4))))
        doubt_kpa2 = estimator.variance_of_last_step()() - np.maximum(shown - full_kpa, 0.0) ** 2
        unusual = shown > 1.1 * full_kpa * (1.0 + 1e-9)
        beyond += np.count_nonzero(unusual)
        doubted += np.count_nonzero(unusual & (doubt_kpa2 > (0.1001 * full_kpa) ** 2))
    assert doubted == 0
    assert beyond < 20
