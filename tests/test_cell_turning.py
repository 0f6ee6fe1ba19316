"""The paper's cell inverted by where the pressure turns: what the sign of dr/dt misreads, noise, wrong parameters."""

import re

import numpy as np
import pytest
from cells import EXAMPLE, FULL, sense

from ohmskin.bench._independent import presses
from ohmskin.cell import PaperModel
from ohmskin.cell.estimation._conditions import Conditions
from ohmskin.cell.estimation._estimator import Estimator
from ohmskin.cell.estimation._inversion import Inversion
from ohmskin.cell.estimation._scale import Ratio
from ohmskin.cell.inversions import _doubts as doubts
from ohmskin.cell.inversions import _turning_rows as turning_rows
from ohmskin.cell.inversions._switched import SwitchedInversion
from ohmskin.cell.inversions._turning import TurningInversion
from ohmskin.cell.inversions._turning_rows import MemoryRows

MODEL = EXAMPLE.model
assert isinstance(MODEL, PaperModel)
REST = EXAMPLE.rest_resistance_ohm
NOISE = 0.005
BY_ARRAYS = 2000
"""readings up to which array operations estimate, and not machine code"""


BEHIND = (
    *("recent_extreme", "forgotten_kpa", "undithered", "released_kpa", "taken_before_kpa2"),
    *("highest_mean_kpa", "fallen"),
)


@pytest.mark.parametrize("name", BEHIND)
def test_rows_behind_those_of_a_room_are_where_their_numbers_say(name: str) -> None:
    """A row that is added before them moves them, and no type tells."""
    places = {re.sub("_kpa2?$", "", row): place for place, row in enumerate(TurningInversion.rows)}
    assert getattr(turning_rows, name.upper()) == places[re.sub("_kpa2?$", "", name)]


def rmse(inversion: Inversion, noise: float | None, read: np.ndarray, load: np.ndarray, dt: float) -> float:
    return float(np.sqrt(np.mean(errors(inversion, noise, read, load, dt) ** 2)))


def errors(inversion: Inversion, noise: float | None, read: np.ndarray, load: np.ndarray, dt: float) -> np.ndarray:
    """(n, *shape) over full scale, for readings (n, *shape) of cells under normalised loads (n, *shape)."""
    shape = read.shape[1:]
    rest = np.full(shape or 1, REST)
    estimator = Estimator(inversion, shape, rest, Ratio(rest), Conditions(noise=noise))
    if len(read) > BY_ARRAYS:
        estimator.compile()
    return np.array([estimator.step(dt, r) for r in read]) / FULL - load


def loads(kind: str, rng: np.random.Generator, dt: float) -> np.ndarray:
    time = np.arange(0, 120, dt)
    if kind == "steps":
        return np.asarray(sum(((time > a) & (time < a + 15)).astype(float) for a in (5, 35, 70)))
    if kind == "presses":
        return presses(rng, 120, dt, holds=False)
    corners = np.cumsum(rng.uniform(5, 25, 30))
    return np.interp(time, corners, np.r_[0, rng.uniform(0, 1, 29)])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["steps", "presses", "slow ramps"])
@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_any_load_is_found(kind: str, dt: float) -> None:
    """Without noise each of eight loads to 1.5 % of full scale, most of it until a turn is noticed; steps exactly."""
    load = np.stack([loads(kind, np.random.default_rng(seed), dt) for seed in range(8)], axis=1)
    read = EXAMPLE.forward((8,)).run(np.full(len(load), dt), FULL * load)
    error = errors(TurningInversion(MODEL, FULL, exact=True), 0.0, read, load, dt)
    assert np.sqrt(np.mean(error**2, axis=0)).max() < (1e-9 if kind == "steps" else 0.015)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["steps", "presses", "slow ramps"])
@pytest.mark.parametrize("dt", [0.02, 0.1])
def test_noise_costs_less_than_the_noise_inverted(kind: str, dt: float) -> None:
    """0.5 % of the reading is 1 % of full scale where E1 answers alone: the estimate is as good, the paper's twice
    as far off.
    """
    rng = np.random.default_rng(5)
    load = loads(kind, rng, dt)
    read = sense(EXAMPLE, load, dt) * (1 + NOISE * rng.standard_normal(len(load)))
    found = rmse(TurningInversion(MODEL, FULL, exact=False), NOISE, read, load, dt)
    assert found < 0.0165
    assert found < 0.5 * rmse(SwitchedInversion(MODEL, FULL), None, read, load, dt)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["steps", "presses", "slow ramps"])
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_wrong_time_constants_stay_bearable(kind: str, factor: float) -> None:
    """All off by 20 %: within 6 % of full scale, though a held load then seems to move."""
    wrong = MODEL.replace(
        eta2_kpa_s=MODEL.eta2_kpa_s * factor,
        eta3_kpa_s=MODEL.eta3_kpa_s * factor,
        eu2_kpa_per_s=MODEL.eu2_kpa_per_s / factor,
    )
    rng = np.random.default_rng(6)
    load = loads(kind, rng, 0.1)
    read = sense(EXAMPLE, load) * (1 + NOISE * rng.standard_normal(len(load)))
    assert rmse(TurningInversion(wrong, FULL, exact=False), NOISE, read, load, 0.1) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_a_smooth_load_turns_when_its_own_model_says_so(dt: float) -> None:
    """Half of this cell's answer takes 15 s, and its overshoot fades in 2 s.

    Its resistance therefore bends at a turn as if the load went on. Corners of a ramp are no smooth turns.
    """
    model = PaperModel(
        eu1_kpa=200 / 3,
        etau2_kpa=500 / 3,
        eu2_kpa_per_s=250 / 3,
        e1_kpa=400 / 3,
        e2_kpa=138.9,
        e3_kpa=3333.0,
        eta2_kpa_s=15 * 138.9,
        eta3_kpa_s=50 * 3333.0,
    )
    cell = EXAMPLE.replace(model=model)
    time = dt * np.arange(1.0, 12.0 / dt)
    sine = 0.5 - 0.4 * np.cos(1.4 * np.pi * time)
    ramps = np.interp(time, [1.0, 4.0, 6.0, 10.0], [0.0, 0.9, 0.9, 0.0])
    load = np.stack([sine, ramps], axis=1)
    read = cell.forward((2,)).run(np.full(len(load), dt), FULL * load)
    error = errors(TurningInversion(model, FULL, exact=True), 0.0, read, load, dt)
    assert (np.sqrt(np.mean(error**2, axis=0)) < [0.06, 0.005]).all()


def test_a_doubt_ends_at_full_scale() -> None:
    """Steps of a coarse converter look like turns, at rest too: their doubts must not add up without end."""
    inversion = TurningInversion(MODEL, FULL, exact=False)
    rows = MemoryRows(inversion.begin(np.zeros(1)))
    rows.unsure[:] = 0.0
    for _ in range(50):
        rows.variance[:] = FULL**2
        doubts._keep(rows, np.zeros(1), np.array([True]), inversion._numbers.each)
    assert np.sqrt(rows.doubt) == pytest.approx(FULL)
