"""Laws of neighbours as prior of cells whose readings are missing or not believed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from ohmskin.bench.harness import interval_score
from ohmskin.cell import Cell
from ohmskin.cell.estimation import _neighbours as neighbours
from ohmskin.common.arrays import BoolArray, FloatArray, IntArray
from ohmskin.common.geometry import Geometry

CELL = Cell.example()
FULL_KPA = CELL.full_scale_kpa
DT_S = 0.01
SPOT = (2, 3)
"""the cell whose contact fails"""


def moving(shape: tuple[int, int], seconds: float = 8.0, width: float = 1.1) -> FloatArray:
    """Loads (n, *shape) of a finger that moves to and fro along the rows, in full scales."""
    time = DT_S * np.arange(round(seconds / DT_S))[:, None, None]
    rows, columns = np.indices(shape)
    along = -1.5 + (shape[1] + 2) * (0.5 - 0.5 * np.cos(2.0 * np.pi * time / 5.0))
    load = 0.7 * np.exp(-((rows - (shape[0] - 1) / 2 - 0.3) ** 2 + (columns - along) ** 2) / (2.0 * width**2))
    return np.where(load < 0.01, 0.0, load)


def readings(load: FloatArray, seed: int, noise: float = 5e-4) -> FloatArray:
    shape = load.shape[1:]
    ohm = CELL.forward(shape).run(np.full(len(load), DT_S), load * FULL_KPA)
    return ohm * (1.0 + noise * np.random.default_rng(seed).standard_normal(ohm.shape))


def failing(frames: int, seed: int, every_s: float, lasts_s: float) -> BoolArray:
    """(frames,) when a contact is bad: a Markov chain."""
    random, bad = np.random.default_rng(seed), np.zeros(frames, dtype=np.bool_)
    for n in range(100, frames):
        ends = random.random() < -np.expm1(-DT_S / (lasts_s if bad[n - 1] else every_s))
        bad[n] = bad[n - 1] != ends
    return bad


def estimated(ohm: FloatArray, *, alone: bool = False, beside: IntArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Loads and deviations in full scales; ``alone``: of cells that know of no others."""
    shape = (ohm[0].size,) if alone else ohm.shape[1:]
    estimator = CELL.estimator(shape, beside=beside)
    frames = [(estimator.step(DT_S, frame.reshape(shape)), estimator.std_kpa) for frame in ohm]
    load, std = np.moveaxis(np.array(frames), 1, 0).reshape(2, *ohm.shape) / FULL_KPA
    return load, std


@pytest.mark.parametrize(
    ("reads", "every_s", "lasts_s", "most"),
    [(2.5, 0.3, 0.06, 0.7), (1.4, 0.3, 0.06, 0.7), (np.nan, 0.7, 0.3, 0.7), (np.nan, 1.5, 1.5, 0.6)],
)
def test_a_cell_whose_contact_is_intermittent_is_known_better_by_its_neighbours(
    reads: float, every_s: float, lasts_s: float, most: float
) -> None:
    """While a finger moves over it: interval score and error, beside those of a cell that knows of no others."""
    found = []
    for seed in range(3):
        load = moving((5, 7))
        ohm, bad = readings(load, seed), failing(len(load), seed, every_s, lasts_s)
        ohm[(bad, *SPOT)] *= reads
        truth = load[(slice(50, None), *SPOT)]
        of_both = []
        for alone in (False, True):
            shown, std = (each[(slice(50, None), *SPOT)] for each in estimated(ohm, alone=alone))
            of_both.append((interval_score(shown - truth, std), np.mean((shown - truth) ** 2)))
        found.append(of_both)
    beside, alone = np.mean(found, axis=0)
    assert beside[0] < most * alone[0]
    assert beside[1] < alone[1]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=5, deadline=None)
def test_neighbours_tell_nothing_of_a_cell_that_reads_well(seed: int) -> None:
    """Bit for bit, whatever becomes of one of them; and a lost one is lost to itself alone."""
    load = moving((3, 5), 3.0)
    ohm = readings(load, seed)
    ohm[failing(len(ohm), seed, 0.4, 0.2), 1, 2] = np.nan
    others = np.ones((3, 5), dtype=np.bool_)
    others[1, 2] = False
    sure = estimated(ohm, alone=True)
    shown = estimated(ohm)
    believed = (shown[0] == sure[0]).all(axis=0)
    # Jumps may be bad contacts, of which neighbours tell; all else is equal.
    assert np.mean(np.abs(shown[0] - sure[0])[:, others] > 0.03) < 0.01
    assert (shown[0] == sure[0])[:, others].mean() > 0.98
    assert believed.any()


def test_a_load_that_is_lifted_while_its_cell_is_not_read_is_gone() -> None:
    """Its neighbours have come to rest; a lone cell, whose neighbours had never been pressed, keeps its load."""
    time = DT_S * np.arange(500)[:, None, None]
    rows, columns = np.indices((5, 5))
    finger = 0.7 * np.exp(-((rows - 2) ** 2 + (columns - 2) ** 2) / 2.4)
    held, lone = np.interp(time, [1.0, 1.1, 2.5, 2.6], [0, 1, 1, 0]), np.interp(time, [1.0, 1.1], [0, 1])
    for load, gone in ((held * finger, True), (lone * 0.6 * ((rows == 2) & (columns == 2)), False)):
        ohm = readings(load, 1)
        ohm[200:450, 2, 2] = np.nan
        shown, std = (each[:, 2, 2] for each in estimated(ohm))
        truth = load[:, 2, 2]
        assert abs(shown[440] - truth[440]) < (0.1 if gone else 0.02)
        assert (np.abs(shown - truth) <= 2.0 * std)[230:].mean() > 0.8
        if gone:
            assert abs(shown[230] - truth[230]) < 0.1  # while it is held


@pytest.mark.parametrize("factor", [1.1, 1.4, 2.5])
@pytest.mark.parametrize("frames", [1, 6])
def test_a_jump_of_a_lone_cell_is_shown_at_once_and_doubted_more_than_that_of_neighbours(
    factor: float, frames: int
) -> None:
    """It may be a spark, or a pin: the deviation covers both."""
    ohm = readings(np.zeros((200, 5, 5)), 2, 2e-4)
    spark, press = ohm.copy(), ohm.copy()
    spark[120 : 120 + frames, 2, 2] *= factor
    press[120:, 1:4, 1:4] *= min(factor, 1.6)
    (lone, lone_std), (shown, std) = estimated(spark), estimated(press)
    assert (np.abs(lone) <= 2.0 * lone_std + 0.02).all()  # of none
    assert np.abs(np.delete(lone.reshape(200, 25), 12, axis=1)).max() < 0.02
    assert (shown[121, 1:4, 1:4] > 0.05).all()
    assert std[120, 2, 2] / shown[120, 2, 2] < 0.7 * lone_std[120, 2, 2] / lone[120, 2, 2]
    pin = ohm.copy()
    pin[120:, 2, 2] *= min(factor, 1.6)
    pressed, its_std = (each[120:, 2, 2] for each in estimated(pin))
    assert pressed.min() > 0.05
    assert its_std[-1] < 0.2 * its_std[0]


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1)])
def test_boards_of_one_row_and_of_one_cell(shape: tuple[int, int]) -> None:
    """A lone cell has no neighbours; a row has those along it."""
    load = moving((1, 7), 4.0)[:, :, : shape[0] * shape[1]].reshape(-1, *shape)
    ohm = readings(load, 3)
    cell = np.unravel_index(load[0].size // 2, shape)
    ohm[(slice(130, 230), *cell)] = np.nan
    beside, alone = estimated(ohm), estimated(ohm, alone=True)
    if load[0].size == 1:
        np.testing.assert_array_equal(beside, alone)
        return
    truth = load[(slice(None), *cell)]
    scores = []
    for shown, std in (beside, alone):
        off, own = shown[(slice(None), *cell)] - truth, std[(slice(None), *cell)]
        scores.append(interval_score(off, own))
    assert scores[0] < scores[1]


def test_cells_are_beside_each_other_as_the_geometry_says() -> None:
    """Those of a rectangle, also when they are given; and none across a gap."""
    square = Geometry.rectangle((4, 5), 0.005).neighbours.beside
    for own, given_ones in zip(neighbours.beside_in((4, 5)), square, strict=True):
        assert set(own) == set(given_ones)
    load = moving((4, 5), 3.0)
    ohm = readings(load, 4)
    ohm[150:260, 2, 2] = np.nan
    np.testing.assert_allclose(estimated(ohm), estimated(ohm, beside=square), rtol=1e-12)
    apart = np.full_like(square, 20)
    np.testing.assert_array_equal(estimated(ohm, beside=apart), estimated(ohm, alone=True))


def test_a_saved_state_remembers_what_was_like_its_neighbours() -> None:
    load = moving((3, 4), 4.0)
    ohm = readings(load, 5)
    ohm[150:330, 1, 2] = np.nan
    one, other = CELL.estimator((3, 4)), CELL.estimator((3, 4))
    for frame in ohm[:240]:
        one.step(DT_S, frame)
    other.restore(one.state())
    for frame in ohm[240:]:
        np.testing.assert_array_equal(one.step(DT_S, frame), other.step(DT_S, frame))
        np.testing.assert_array_equal(one.std_kpa, other.std_kpa)


# -- Bayes' rule --


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 0.1), st.booleans()), min_size=4, max_size=4))
def test_the_prior_has_the_moments_of_the_believed_neighbours(cells: list[tuple[float, float, bool]]) -> None:
    told = np.array([[0.3, 0.1, 1.0], *cells], dtype=np.float64).T.copy()
    mean, variance = neighbours.prior(0, np.array([[1, 2, 3, 4, 5]]), told)
    load, var = (told[row, 1:][told[neighbours.BELIEVED, 1:] > 0.0] for row in range(2))
    if not load.size:
        assert variance < 0.0
        return
    assert mean == pytest.approx(load.mean())
    assert variance == pytest.approx(load.var() + var.mean() + load.mean() ** 2, abs=1e-12)


@given(st.floats(0.0, 1.0), st.floats(0.01, 0.3), st.floats(0.0, 1.0), st.floats(0.01, 0.3), st.floats(0.0, 1.0))
def test_a_fused_load_has_the_moments_of_the_mixture(
    load: float, std: float, mean: float, spread: float, like: float
) -> None:
    """Of what its past says, and of the product of that with what the neighbours tell."""
    x = np.linspace(-2.5, 3.5, 20001)
    of_both = norm.logpdf(x, load, std) + norm.logpdf(x, mean, spread)
    past, both = norm.pdf(x, load, std), np.exp(of_both - of_both.max())
    density = like * both / both.sum() + (1.0 - like) * past / past.sum()
    expected = density @ x
    found, var = neighbours.fuse(load, std**2, mean, spread**2, like)
    assert found == pytest.approx(expected, abs=1e-6)
    assert var == pytest.approx(density @ (x - expected) ** 2, abs=1e-6)


@given(st.floats(0.0, 1.0), st.floats(0.01, 0.3), st.floats(0.0, 1.0), st.floats(0.01, 0.3))
def test_a_load_is_like_its_neighbours_by_bayes_rule(load: float, std: float, mean: float, spread: float) -> None:
    """Against a load that is anywhere up to full scale; in any unit."""
    density = 0.9 * norm.pdf(load, mean, np.hypot(std, spread))
    expected = density / (density + 0.1)
    assert neighbours.alike(load, std**2, mean, spread**2, 1.0, 0.1) == pytest.approx(expected)
    assert neighbours.alike(7 * load, 49 * std**2, 7 * mean, 49 * spread**2, 7.0, 0.1) == pytest.approx(expected)
