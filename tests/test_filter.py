"""Laws of the switching filter: its dynamics are the cell's, its updates are Bayes' rule, its errors are as stated."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm, truncnorm

from ohmskin.bench import scenes
from ohmskin.cell import Cell, PaperModel
from ohmskin.cell.estimation import Material
from ohmskin.cell.estimation import _filter as filters
from ohmskin.cell.estimation import _modes as modes
from ohmskin.cell.estimation._columns import RARE, WHITE, share_each
from ohmskin.common.arrays import FloatArray
from ohmskin.common.compiled import Records, zeros

CELL = Cell.example()
FULL_KPA = CELL.full_scale_kpa
assert isinstance(CELL.model, PaperModel)
MATERIAL = Material.of(CELL.model, FULL_KPA)
TUNING = modes.TUNING
MOMENTS = ("s", "r", "v"), (("ss", "sr", "sv"), ("sr", "rr", "rv"), ("sv", "rv", "vv"))


def step_of(dt_s: float) -> modes.Step:
    return modes.discretise(MATERIAL, dt_s)


def steps_of(dt_s: float) -> np.ndarray:
    made = zeros(modes.Step, 1)
    made[0] = step_of(dt_s)
    return made


def gaussian(record: object, place: int) -> tuple[FloatArray, FloatArray]:
    means, covariances = MOMENTS
    get = lambda name: getattr(record, name)[place]  # noqa: E731
    return np.array([get(n) for n in means]), np.array([[get(n) for n in row] for row in covariances])


def written(record: object, place: int, mean: FloatArray, covariance: FloatArray) -> None:
    means, names = MOMENTS
    for i, name in enumerate(means):
        getattr(record, name)[place] = mean[i]
        for j in range(3):
            getattr(record, names[i][j])[place] = covariance[i, j]


def drawn(seed: int) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(seed)
    root = 0.1 * random.standard_normal((3, 3))
    return random.uniform([0.2, 0.1, -0.3], [0.8, 0.9, 0.3]), root @ root.T + 1e-4 * np.eye(3)


# -- dynamics and modes --


@given(st.floats(1e-3, 0.3), st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_each_phase_steps_as_the_cell_does(dt_s: float, seed: int) -> None:
    """From the states of a cell that rises, or falls, to its next r and x3, exactly."""
    random, t, g3, t3 = np.random.default_rng(seed), step_of(dt_s), MATERIAL.g3, MATERIAL.t3_s
    for mode, way in ((modes.HOLD_UP, np.cumsum(random.uniform(0.0, 0.2, 12))), (modes.HOLD_DOWN, None)):
        load = way if way is not None else np.r_[0.9, 0.9 - np.cumsum(random.uniform(1e-3, 0.08, 11))]
        r = CELL.forward(()).run(np.full(12, dt_s), load * FULL_KPA) / CELL.rest_resistance_ohm - 1.0
        x3 = 0.0
        for n in range(12):
            before, change = (load[n - 1], load[n] - load[n - 1]) if n else (0.0, load[0])
            if n > 1:
                by = t.by_s[mode] * before + t.by_r[mode] * r[n - 1] + t.by_x3[mode] * x3
                assert by + t.by_move[mode] * change == pytest.approx(r[n], abs=1e-9)
            ways = t.x3_by_v[modes.LINE_UP] / t.way_s[modes.LINE_UP]
            after = t.x3_kept * x3 + t.x3_by_s[mode] * before + ways * change
            slow = np.exp(-dt_s / t3)
            assert after == pytest.approx(
                slow * x3 + g3 * (before * (1 - slow) + change * (1 - (1 - slow) * t3 / dt_s)), abs=1e-9
            )
            x3 = after


@given(st.integers(0, 2**32 - 1), st.sampled_from([modes.REST, modes.HOLD_UP, modes.MOVE_DOWN, modes.EDGE_UP]))
def test_a_prediction_is_the_linear_step_of_its_phase(seed: int, mode: int) -> None:
    """Mean of load, r and slow branch, and the covariance that the step makes of the one before."""
    random, t = np.random.default_rng(seed), step_of(0.02)
    mean, covariance = drawn(seed)
    x3 = random.uniform(0.0, 0.05)
    c, places = zeros(filters.Candidates, 1)[0], (mode, modes.MODES + mode)
    for place in places:
        written(c, place, mean, covariance)
        c.x3[place] = x3
    filters.predict(c, t)
    # Of the change of the load; at rest what was left of it goes within the step.
    of_load = np.array([-1.0, 0.0, 0.0]) if mode == modes.REST else np.array([0.0, 0.0, t.way_s[mode]])
    phase = modes.HOLD_UP if modes.PHASES[mode] == modes.UP else modes.HOLD_DOWN
    by = np.array([t.by_s[phase], t.by_r[phase], 0.0]) + t.by_move[phase] * of_load
    matrix = np.stack([np.array([1.0, 0.0, 0.0]) + of_load, by, [0.0, 0.0, t.kept[mode]]])
    noise = np.array([1.0, t.by_move[phase], 0.0])
    expected = matrix @ covariance @ matrix.T + t.noise_ss[mode] * np.outer(noise, noise)
    expected[1, 1] += TUNING.drift**2 * 0.02
    expected[2, 2] += t.noise_vv[mode]
    expected[:2, 2] += t.noise_sv[mode] * noise[:2]
    expected[2, :2] = expected[:2, 2]
    slow = t.x3_by_v[modes.LINE_UP] / t.way_s[modes.LINE_UP]
    for place in places:
        found, left = gaussian(c, place)
        np.testing.assert_allclose(found, matrix @ mean + [0.0, t.by_x3[phase] * x3, 0.0], atol=1e-12)
        assert c.x3[place] == pytest.approx(t.x3_kept * x3 + t.x3_by_s[phase] * mean[0] + slow * (of_load @ mean))
        np.testing.assert_allclose(left, expected, atol=1e-12)


@given(st.floats(2e-3, 0.2), st.floats(0.05, 1.0), st.floats(0.0, 0.03))
def test_what_was_left_of_a_load_goes_within_the_step_that_comes_to_rest(dt_s: float, load: float, x3: float) -> None:
    """r and the slow branch are those of the recovery phase under a load that falls to zero in a line."""
    m, t, c, steps = MATERIAL, step_of(dt_s), zeros(filters.Candidates, 1)[0], 4000
    r = x3 + m.g1 * load + 0.1
    c.s[modes.REST], c.r[modes.REST], c.x3[modes.REST] = load, r, x3
    filters.predict(c, t)
    for n in range(steps):  # midpoints, of equation (8)
        s = load * (1.0 - (n + 0.5) / steps)
        x2 = r - m.g1 * load * (1.0 - n / steps) - x3
        slow = (m.g3 * s - x3) / m.t3_s
        r += (-m.g1 * load / dt_s + (m.g2 * s - x2) / m.t2_s + slow) * dt_s / steps
        x3 += slow * dt_s / steps
    assert c.s[modes.REST] == 0.0
    assert c.x3[modes.REST] == pytest.approx(x3, abs=1e-8)
    assert c.r[modes.REST] == pytest.approx(r, abs=1e-6)


PAIRS = {
    "hold": (modes.HOLD_UP, modes.HOLD_DOWN, 0.0, math.inf),
    "creep": (modes.CREEP_UP, modes.CREEP_DOWN, TUNING.creep_per_s, TUNING.creep_s),
    "line": (modes.LINE_UP, modes.LINE_DOWN, TUNING.line_per_s, TUNING.line_s),
    "move": (modes.MOVE_UP, modes.MOVE_DOWN, TUNING.move_per_s, TUNING.move_s),
    "edge": (modes.EDGE_UP, modes.EDGE_DOWN, 0.0, math.inf),
}
"""motions: modes of the two phases, their usual speed in FS/s, and for how long it lasts"""


@pytest.mark.parametrize("motion", PAIRS)
def test_both_phases_are_equally_noisy_in_r(motion: str) -> None:
    """Otherwise the quieter phase would win where readings cannot tell them apart."""
    up, down, *_ = PAIRS[motion]
    t = step_of(1e-4)  # in which no memory fades
    noise = t.noise_rr - TUNING.drift**2 * t.dt_s
    assert noise[up] > 0.0
    assert noise[up] == pytest.approx(noise[down], rel=1e-3)
    assert t.noise_sr[up] / t.noise_ss[up] == pytest.approx(MATERIAL.gu, rel=1e-3)
    assert t.noise_sr[down] / t.noise_ss[down] == pytest.approx(MATERIAL.g1, rel=1e-3)


@pytest.mark.parametrize("motion", ["creep", "line", "move"])
@given(st.floats(1e-3, 0.2))
def test_the_speed_of_a_motion_is_an_ornstein_uhlenbeck_process(motion: str, dt_s: float) -> None:
    """It is forgotten in the time that the motion lasts, and its stationary deviation is the usual speed.

    That speed changes r by as much as the tuned one does at the mean gain of the phases.
    """
    up, down, per_s, lasts_s = PAIRS[motion]
    t, mean_gain = step_of(dt_s), 0.5 * (MATERIAL.gu + MATERIAL.g1)
    for mode, gain in ((up, MATERIAL.gu), (down, MATERIAL.g1)):
        assert t.kept[mode] == pytest.approx(np.exp(-dt_s / lasts_s))
        assert t.noise_vv[mode] / (1.0 - t.kept[mode] ** 2) == pytest.approx(t.speed[mode] ** 2)
        assert gain * t.speed[mode] == pytest.approx(mean_gain * per_s)


@given(st.floats(1e-3, 0.2))
def test_modes_follow_a_markov_chain_in_time(dt_s: float) -> None:
    """Shares of what follows add up to one, and hazards are per second: two steps are one of twice the time."""
    t, twice = step_of(dt_s), step_of(2.0 * dt_s)
    for after in (t.after_down, t.after_up, t.after_rest, t.after_shake):
        assert after.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(1.0 - twice.leaves, (1.0 - t.leaves) ** 2)
    slow = (t.kept > 0.0) & (t.kept < 1.0)
    np.testing.assert_allclose(twice.kept[slow], t.kept[slow] ** 2, atol=1e-12)
    np.testing.assert_allclose(twice.noise_vv[slow], (t.noise_vv * (1.0 + t.kept**2))[slow], rtol=1e-6)
    assert t.usual.sum() == pytest.approx(1.0)
    assert (t.usual > 0.0).all()


@pytest.mark.parametrize("falls", [False, True])
def test_a_way_that_a_turn_hides_raises_r_whichever_way_it_goes(falls: bool) -> None:
    """The cell answers rises by more than falls, so that the mean way before the turn adds to r, with a variance."""
    t, p, c = step_of(0.01), zeros(filters.Pools, 1)[0], zeros(filters.Candidates, 1)[0]
    k, on, back = filters.AFTER_DOWN if falls else filters.AFTER_UP, modes.LINE_UP, modes.LINE_DOWN
    on, back = (back, on) if falls else (on, back)
    p.s[k], p.r[k], p.v[k] = 0.5, 0.4, -2.0 if falls else 2.0
    (c.from_down if falls else c.from_up)[[on, back]] = 1.0
    filters.comes(c, p, t)
    assert t.bend == pytest.approx(MATERIAL.gu - MATERIAL.g1)
    assert c.r[modes.MODES + back] == pytest.approx(0.4 + t.unseen * t.bend * 0.01 * 2.0)
    assert c.rr[modes.MODES + back] == pytest.approx((t.unseen_std * t.bend * 0.01 * 2.0) ** 2)
    assert c.r[modes.MODES + on] == 0.4


@given(st.floats(0.0, 0.9), st.floats(0.005, 0.3), st.floats(-3.0, 0.0))
def test_a_fall_ends_at_a_mass_at_zero_or_at_a_density_of_plateaus(s: float, std: float, v: float) -> None:
    """Bayes' rule for a load that is normal, and has still to come down to zero within the frame."""
    t, p = step_of(0.01), zeros(filters.Pools, 1)[0]
    k = filters.AFTER_DOWN
    p.w[k], p.s[k], p.ss[k], p.v[k], p.r[k] = 1.0, s, std**2, v, 0.3
    spread = np.sqrt(std**2 + (0.01 * v) ** 2 + (t.memory * 0.3 / t.by_move[modes.DOWN]) ** 2 + t.floor**2)
    at_zero = t.release * (t.mistake + (1.0 - t.mistake) * norm.pdf(0.0, s, spread))
    assert filters.released(p, t) == pytest.approx(at_zero / (at_zero + 1.0 - t.release))


@given(st.integers(0, 2**32 - 1))
def test_mixing_keeps_the_probability(seed: int) -> None:
    """All that leaves a mode comes to another one, but for what begins to shake and stays counted where it was."""
    e, c, p = zeros(filters.Estimates, 1)[0], zeros(filters.Candidates, 1)[0], zeros(filters.Pools, 1)[0]
    random, t = np.random.default_rng(seed), step_of(0.02)
    for j in range(modes.MODES):
        written(e, j, *drawn(seed + j))
    e.w[:] = random.dirichlet(np.ones(modes.MODES))
    filters.mix(e, c, p, t)
    assert c.w.sum() == pytest.approx(1.0 + t.shakes * (1.0 - e.w[modes.SHAKE]), abs=1e-6)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.95), st.booleans())
def test_what_comes_to_a_mode_keeps_the_moments_of_the_mixture(seed: int, share: float, turns: bool) -> None:
    """Of two pools, each of two modes; a way that a turn hides is unknown, as is the speed that it was gone with."""
    e, p, c = zeros(filters.Estimates, 1)[0], zeros(filters.Pools, 1)[0], zeros(filters.Candidates, 1)[0]
    random, t = np.random.default_rng(seed), step_of(0.05)
    weights, slow, x3 = np.array([1.0 - share, share]), random.uniform(0.0, 0.1, 4), []
    means, covariances, place = [], [], modes.LINE_UP if turns else modes.LINE_DOWN
    for k, rows in enumerate((c.from_down, c.from_rest)):
        parts = [drawn(seed + 2 * k), drawn(seed + 2 * k + 1)]
        for j, part in zip((modes.LINE_DOWN, modes.MOVE_DOWN), parts, strict=True):
            written(e, j, *part)
            e.w[j], e.x3[j] = 0.5 / t.leaves[j], slow[2 * k + (j == modes.MOVE_DOWN)]
        filters.pool(p, 2 * k, e, modes.LINE_DOWN, modes.MOVE_DOWN + 1, t)
        x3.append(slow[2 * k : 2 * k + 2].mean())
        mean = np.mean([m for m, _ in parts], axis=0)
        covariance = np.mean([cov + np.outer(m - mean, m - mean) for m, cov in parts], axis=0)
        if turns and k == filters.AFTER_DOWN:
            gain = (MATERIAL.gu - MATERIAL.g1) * 0.05
            covariance[1, 1] += (gain * t.unseen_std) ** 2 * (covariance[2, 2] + mean[2] ** 2)
            mean[1] += gain * t.unseen * abs(mean[2])
        means.append(mean[:2])
        covariances.append(covariance[:2, :2])
        rows[place] = weights[k]
    filters.comes(c, p, t)
    mean = weights @ np.array(means)
    parted = zip(weights, means, covariances, strict=True)
    expected = sum(w * (cov + np.outer(m - mean, m - mean)) for w, m, cov in parted)
    found, left = gaussian(c, modes.MODES + place)
    np.testing.assert_allclose(found[:2], mean)
    np.testing.assert_allclose(left[:2, :2], expected, atol=1e-12)
    assert c.x3[modes.MODES + place] == pytest.approx(weights @ x3)


@given(st.sampled_from([(modes.LINE_UP, modes.LINE_DOWN), (modes.LINE_DOWN, modes.LINE_UP)]), st.floats(0.1, 3.0))
def test_only_a_change_of_phase_hides_a_way(ways: tuple[int, int], speed: float) -> None:
    """A motion that goes on the way it went has the r that it had; one that turns has more."""
    e, c, p = zeros(filters.Estimates, 1)[0], zeros(filters.Candidates, 1)[0], zeros(filters.Pools, 1)[0]
    on, back = ways
    e.w[on], e.s[on], e.r[on], e.v[on] = 1.0, 0.5, 0.4, speed if on == modes.LINE_UP else -speed
    filters.mix(e, c, p, step_of(0.01))
    assert c.r[modes.MODES + on] == pytest.approx(0.4, abs=1e-12)
    assert c.r[modes.MODES + back] > 0.4 + 1e-6


@given(st.floats(0.1, 0.8), st.floats(5.0, 50.0))
@settings(max_examples=20)
def test_a_load_that_shakes_within_a_step_raises_r_as_the_cell_does(load: float, speed: float) -> None:
    """r of a cell whose load goes to and fro within a step, beyond that of one whose load is held."""
    dt_s, swings, t = 1e-4, 20, step_of(1e-4)
    size = speed * dt_s / (2 * swings)  # up and down again makes the path
    to_and_fro = load + size * np.tile([1.0, 0.0], swings)
    times, r = np.r_[1.0, np.full(2 * swings, dt_s / (2 * swings))], []
    for after in (to_and_fro, np.full(2 * swings, load)):
        run = CELL.forward(()).run(times, np.r_[load, after] * FULL_KPA)
        r.append(run[-1] / CELL.rest_resistance_ohm)
    c = zeros(filters.Candidates, 1)[0]
    still, moved = modes.SHAKE, modes.MODES + modes.SHAKE
    c.s[[still, moved]], c.v[moved] = load, speed
    filters.predict(c, t)
    assert c.r[moved] - c.r[still] == pytest.approx(r[0] - r[1], rel=0.02)
    for by in (t.by_s, t.by_r, t.by_x3, t.by_move):  # half of the way is that of each phase
        assert by[still] == pytest.approx(0.5 * (by[modes.HOLD_UP] + by[modes.HOLD_DOWN]), rel=1e-12)


# -- Bayes' rule --

PLACE = modes.HOLD_UP


def conditioned(
    take: Callable[..., None], mean: FloatArray, covariance: FloatArray, ends: tuple[float, float], var: float
) -> tuple[FloatArray, FloatArray, float]:
    """Moments after a reading between ``ends`` with noise ``var``, and the logarithm of its density."""
    c = zeros(filters.Candidates, 1)[0]
    written(c, PLACE, mean, covariance)
    c.likelihood[PLACE] = 1.0
    take(c, *ends, var, step_of(0.01))
    return *gaussian(c, PLACE), np.log(c.likelihood[PLACE]) - c.distance[PLACE]


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 5.0), st.floats(1e-4, 0.05), st.floats(-0.2, 0.2))
@pytest.mark.parametrize("take", [filters.take_exact, filters.take_interval])
def test_a_narrow_reading_is_a_kalman_update(
    take: Callable[..., None], seed: int, speed: float, std: float, off: float
) -> None:
    """A load that shakes is read somewhere in its swing: ``swing_s`` times its speed is noise, at the mean gain."""
    mean, covariance = drawn(seed)
    mean[2] = speed
    gain = 0.5 * (MATERIAL.gu + MATERIAL.g1)
    swing = (gain * TUNING.swing_s) ** 2 * (speed**2 + covariance[2, 2])
    c, at = zeros(filters.Candidates, 1)[0], mean[1] + off
    for place, noise in ((modes.SHAKE, swing), (modes.MODES + modes.SHAKE, swing), (modes.LINE_UP, 0.0)):
        written(c, place, mean, covariance)
        c.likelihood[place] = 1.0
        take(c, at, at, std**2, step_of(0.01))
        var = covariance[1, 1] + std**2 + noise
        found, left = gaussian(c, place)
        np.testing.assert_allclose(found, mean + covariance[:, 1] / var * off, atol=1e-12)
        np.testing.assert_allclose(left, covariance - np.outer(covariance[1], covariance[1]) / var, atol=1e-12)
        assert np.log(c.likelihood[place]) - c.distance[place] == pytest.approx(norm.logpdf(off, scale=var**0.5))


@given(st.integers(0, 2**32 - 1), st.floats(-2.5, 1.5), st.floats(1.0, 1e6))
def test_an_interval_is_what_lies_within_it(seed: int, low: float, width: float) -> None:
    """Mean, variance and probability of a normal reading that is cut at both ends."""
    mean, covariance = drawn(seed)
    std = covariance[1, 1] ** 0.5
    ends = mean[1] + std * low, mean[1] + std * (low + width)
    found, left, density = conditioned(filters.take_interval, mean, covariance, ends, 0.0)
    cut = truncnorm(low, low + width, loc=mean[1], scale=std)
    assert found[1] == pytest.approx(cut.mean(), abs=1e-6)
    assert left[1, 1] == pytest.approx(cut.var(), rel=1e-4, abs=1e-9)
    inside = norm.cdf(low + width) - norm.cdf(low)
    assert np.exp(density) == pytest.approx(inside / min(ends[1] - ends[0], 1.0), rel=1e-6)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, -1.0]), st.floats(-3.0, 3.0), st.booleans())
def test_a_bound_truncates_and_takes_the_others_along(seed: int, side: float, z: float, of_speed: bool) -> None:
    """No load, or a speed against the sign of its mode."""
    mean, covariance = drawn(seed)
    c, k = zeros(filters.Candidates, 1)[0], 2 if of_speed else 0
    place = modes.LINE_UP if side > 0.0 or not of_speed else modes.LINE_DOWN
    side = side if of_speed else 1.0
    std = covariance[k, k] ** 0.5
    mean[k] = side * z * std
    written(c, place, mean, covariance)
    c.likelihood[place] = 1.0
    (filters.bound_speed if of_speed else filters.bound_load)(c, step_of(0.01))
    cut = truncnorm(*((-z, np.inf) if side > 0 else (-np.inf, z)), loc=mean[k], scale=std)
    found, left = gaussian(c, place)
    assert c.likelihood[place] == pytest.approx(norm.cdf(z), rel=3e-9)
    assert found[k] == pytest.approx(cut.mean(), abs=1e-6 + 0.01 * std)
    assert left[k, k] == pytest.approx(max(cut.var(), 0.02 * std**2), rel=1e-3)
    assert np.linalg.eigvalsh(left).min() > -1e-12
    shift = (found - mean)[[i for i in range(3) if i != k]]
    along = (covariance[k] / covariance[k, k] * (found - mean)[k])[[i for i in range(3) if i != k]]
    np.testing.assert_allclose(shift, along, atol=1e-9)


@given(st.sampled_from([filters.bound_speed, filters.bound_load]), st.integers(0, 2**32 - 1), st.floats(9.0, 100.0))
def test_what_is_beyond_a_bound_for_sure_comes_to_lie_on_it(bound: Callable[..., None], seed: int, z: float) -> None:
    """Along the regression of the others; and the bound has no say in a mode that does not know it."""
    mean, covariance = drawn(seed)
    k = 2 if bound is filters.bound_speed else 0
    mean[k] = -z * covariance[k, k] ** 0.5
    free = modes.HOLD_UP if k else modes.REST
    c = zeros(filters.Candidates, 1)[0]
    for place in (modes.LINE_UP, free):
        written(c, place, mean, covariance)
    bound(c, step_of(0.01))
    found, left = gaussian(c, modes.LINE_UP)
    np.testing.assert_allclose(found, mean - covariance[k] * mean[k] / covariance[k, k], atol=1e-9)
    assert found[k] == left[k, k] == 0.0
    np.testing.assert_array_equal(gaussian(c, free)[0], mean)


@given(st.floats(-4.0, 3.0), st.floats(1e-4, 0.5))
def test_loads_beyond_a_soft_bound_are_rare(z: float, rare: float) -> None:
    """Weight, mean and variance of a normal load whose density is ``rare`` times as much beyond the bound."""
    inside, shift, less = filters.truncated(z, rare)
    x = np.linspace(-9.0, 9.0, 200_001)
    density = norm.pdf(x) * np.where(x > -z, 1.0, rare)
    weight = np.trapezoid(density, x)
    expected = np.trapezoid(x * density, x) / weight
    assert inside == pytest.approx(weight, rel=1e-3)
    assert shift == pytest.approx(expected, abs=2e-3)
    assert 1.0 - less == pytest.approx(max(np.trapezoid((x - expected) ** 2 * density, x) / weight, 0.02), rel=0.01)


@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_a_load_beyond_the_heaviest_usual_one_is_rare(seed: int, z: float) -> None:
    """Its density is cut down there; the others go along by their regression."""
    t, c, (mean, covariance) = step_of(0.01), zeros(filters.Candidates, 1)[0], drawn(seed)
    std = covariance[0, 0] ** 0.5
    mean[0] = t.overload - z * std
    written(c, modes.LINE_UP, mean, covariance)
    c.w[modes.LINE_UP] = c.likelihood[modes.LINE_UP] = 1.0
    filters.bound_overload(c, t)
    x = np.linspace(-9.0, 9.0, 200_001)
    density = norm.pdf(x) * np.where(x < z, 1.0, filters.OVERLOADS)
    density /= np.trapezoid(density, x)
    shift = np.trapezoid(x * density, x)
    found, left = gaussian(c, modes.LINE_UP)
    assert found[0] == pytest.approx(mean[0] + std * shift, abs=3e-3 * std)
    less = np.trapezoid((x - shift) ** 2 * density, x)
    assert left[0, 0] == pytest.approx(max(less, 0.02) * std**2, rel=0.01)
    np.testing.assert_allclose(found - mean, covariance[0] / covariance[0, 0] * (found - mean)[0], atol=1e-9)


@given(st.floats(-700.0, 0.0))
def test_the_exponential_of_candidates_is_one(x: float) -> None:
    assert filters.decay(x) == pytest.approx(np.exp(x), rel=1e-12 if x > -40.0 else 1e-2)


@given(st.floats(-8.0, 8.0))
def test_the_normal_distribution_of_candidates_is_one(z: float) -> None:
    assert filters.mass(z, math.exp(-0.5 * z * z)) == pytest.approx(norm.cdf(z), rel=2e-9)


@given(st.floats(-3.0, 3.0), st.floats(0.02, 0.5))
def test_a_bound_counts_once_however_often_it_is_felt(z: float, load: float) -> None:
    """What is expected within the bounds is all that there is: without a reading the likelihood is one."""
    t, c = step_of(0.01), zeros(filters.Candidates, 1)[0]
    written(c, modes.LINE_UP, np.array([load, 0.4, 0.1 * z]), np.diag([0.01, 1e-3, 0.01]))
    filters.expect(c, t)
    filters.bound_speed(c, t)
    filters.bound_load(c, t)
    filters.bound_overload(c, t)
    assert c.likelihood[modes.LINE_UP] == pytest.approx(1.0)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.99))
def test_pools_keep_the_moments_of_the_mixture(seed: int, share: float) -> None:
    e, p = zeros(filters.Estimates, 1)[0], zeros(filters.Pools, 1)[0]
    parts, t = [drawn(seed), drawn(seed + 1)], step_of(0.01)
    for j, w, part in zip((modes.HOLD_UP, modes.LINE_UP), (1.0 - share, share), parts, strict=True):
        written(e, j, *part)
        e.w[j] = w / t.leaves[j]
    filters.pool(p, 0, e, modes.HOLD_UP, modes.LINE_UP + 1, t)
    mean = (1.0 - share) * parts[0][0] + share * parts[1][0]
    second = sum(
        w * (cov + np.outer(m, m)) for w, (m, cov) in zip((1.0 - share, share), parts, strict=True)
    ) - np.outer(mean, mean)
    found, covariance = gaussian(p, 0)
    np.testing.assert_allclose(found, mean)
    np.testing.assert_allclose(covariance, second, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.99))
def test_two_candidates_of_a_mode_are_merged_by_their_moments(seed: int, share: float) -> None:
    e, c, t = zeros(filters.Estimates, 1)[0], zeros(filters.Candidates, 1)[0], step_of(0.01)
    own, come = drawn(seed), drawn(seed + 1)
    places = modes.HOLD_UP, modes.MODES + modes.HOLD_UP
    for place, part, w, x3 in zip(places, (own, come), (1.0 - share, share), (0.01, 0.03), strict=True):
        written(c, place, *part)
        c.w[place], c.x3[place] = w, x3
    filters.merge(e, c, 1.0, t, 1.0)
    mean = (1.0 - share) * own[0] + share * come[0]
    second = sum(w * (cov + np.outer(m, m)) for w, (m, cov) in zip((1.0 - share, share), (own, come), strict=True))
    found, covariance = gaussian(e, modes.HOLD_UP)
    np.testing.assert_allclose(found, mean)
    np.testing.assert_allclose(covariance, second - np.outer(mean, mean), atol=1e-12)
    assert e.x3[modes.HOLD_UP] == pytest.approx(0.01 + 0.02 * share)
    assert e.w[modes.HOLD_UP] == pytest.approx(1.0)


@given(st.integers(0, 2**32 - 1), st.sampled_from([modes.LINE_UP, modes.MOVE_DOWN, modes.CREEP_UP]))
def test_what_is_expected_of_the_next_reading_is_the_second_moment_of_its_prediction(seed: int, mode: int) -> None:
    """About the present r, of two modes, in a step so short that only the load's way counts."""
    t, watch = step_of(1e-4), zeros(filters.Watch, 1)[0]
    e, c = zeros(filters.Estimates, 1)[0], zeros(filters.Candidates, 1)[0]
    mean, _ = drawn(seed)
    mean[2] *= 1e3  # a way that is seen in so short a step
    for j, w in ((mode, 0.7), (modes.HOLD_UP, 0.3)):
        for record in (e, c):
            written(record, j, mean, np.diag([0.0, 1e-4, 2e4]))
        e.w[j] = w
    filters.predict(c, t)
    found, variance = filters.expects(e, watch, t)
    moments = [c.rr[j] + (c.r[j] - mean[1]) ** 2 for j in (mode, modes.HOLD_UP)]
    assert found == pytest.approx(mean[1])
    assert variance == pytest.approx(0.7 * moments[0] + 0.3 * moments[1], rel=0.02)


@pytest.mark.parametrize("off", [5.5, 7.0, 9.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_interval_far_away_is_judged_by_its_near_end(off: float, side: float) -> None:
    """Within the quarter by which a normal tail is known from its density alone."""
    width = 3.0
    ends = sorted((side * off, side * (off + width)))
    *_, density = conditioned(filters.take_interval, np.zeros(3), np.diag([1e-4, 1e-6, 1e-4]), ends, 1.0)
    expected = norm.logsf(off) + np.log1p(-np.exp(norm.logsf(off + width) - norm.logsf(off))) - np.log(width)
    assert density == pytest.approx(expected, abs=0.25)


@given(st.integers(0, 2**32 - 1), st.floats(5.01, 30.0), st.floats(1.0, 1e3), st.sampled_from([1.0, -1.0]))
def test_an_interval_far_away_moves_an_estimate_to_its_near_end(seed: int, z: float, width: float, side: float) -> None:
    """The moments of a normal tail: a fifth of a deviation beyond the end at most, and next to no variance."""
    mean, covariance = drawn(seed)
    std = covariance[1, 1] ** 0.5
    low, high = sorted((mean[1] + side * z * std, mean[1] + side * (z + width) * std))
    found, left, _ = conditioned(filters.take_interval, mean, covariance, (low, high), 0.0)
    cut = truncnorm(z, z + width)
    assert side * (found[1] - mean[1]) / std == pytest.approx(cut.mean(), abs=0.2)
    assert 0.0 < left[1, 1] / std**2 < 0.05


def test_the_density_of_a_reading_is_that_of_the_mixture() -> None:
    """Of a cell in one mode, whose estimate is far from every bound: the predicted normal density."""
    e, c, p = zeros(filters.Estimates, 1)[0], zeros(filters.Candidates, 1)[0], zeros(filters.Pools, 1)[0]
    t = step_of(1e-6)  # nothing else can have happened
    e.w[1], e.s[1], e.r[1], e.ss[1], e.rr[1] = 1.0, 0.5, 0.5, 1e-4, 1e-4
    density = filters.advance(e, c, p, t, True, 0.51, 0.51, 3e-4, 1.0)
    assert density == pytest.approx(multivariate_normal.logpdf(0.51, 0.5, 4e-4), abs=1e-3)
    assert e.w.sum() == pytest.approx(1.0)


# -- columns --


def readings_of(r: FloatArray, variance: FloatArray, shared: FloatArray, held: float) -> Records[filters.Reading]:
    made = zeros(filters.Reading, r.size)
    made["known"], made["low"], made["high"], made["variance"] = 1.0, r, r, variance
    made["shared"], made["held"] = shared, held
    return made


def test_a_cell_takes_no_part_in_what_its_column_shares_for_it() -> None:
    """Its own reading changes the corrections of the others, and none of its own; alone in a column it has none."""
    t, cells, watches = steps_of(0.01), zeros(filters.Estimates, 5), zeros(filters.Watch, 5)
    for each in cells:
        filters.begin(each, 0.0, MATERIAL.geq, MATERIAL.gu, MATERIAL.g3)
    watches["asleep"] = 1.0

    def corrected(reading: FloatArray) -> FloatArray:
        readings = readings_of(reading, np.full(5, 1e-6), np.full(5, 4e-3), 0.0)
        share_each(cells, watches, t, np.zeros(2), readings)  # cells 0, 2, 4 in a column, 1 and 3 in another
        return reading - readings["low"]

    calm, off = corrected(np.zeros(5)), np.zeros(5)
    np.testing.assert_allclose(calm, 0.0, atol=1e-12)
    off[0] = 3e-3
    moved = corrected(off)
    assert moved[0] == pytest.approx(0.0, abs=4e-4)  # but for the recent mean
    assert (np.abs(moved[[2, 4]]) > 1e-3).all()
    assert moved[[1, 3]] == pytest.approx(0.0, abs=1e-12)
    off[0] = 1.0  # no more than a few deviations of one reading count
    assert (corrected(off)[[2, 4]] < 0.01).all()
    alike = corrected(np.full(5, 3e-3))
    assert (alike > 0.8 * 3e-3).all()  # what all show is taken out


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_what_a_column_shares_is_the_posterior_of_the_other_cells(seed: int, outlier: bool) -> None:
    """Its mean and variance by the joint normal law of the column; a reading counts up to 3 deviations (Huber)."""
    random, t = np.random.default_rng(seed), steps_of(0.01)
    cells, watches = zeros(filters.Estimates, 6), zeros(filters.Watch, 6)
    watches["asleep"], watches["offset"] = 1.0, random.normal(0.0, 0.1, 6)
    shared, noise = random.choice([-1.0, 1.0], 6) * random.uniform(1e-3, 4e-3, 6), random.uniform(1e-6, 1e-5, 6)
    off = 0.5 * random.uniform(-1.0, 1.0, 6) * np.sqrt(noise)
    total = np.sqrt(noise + shared**2)
    if outlier:
        off[0] = 3.0 * total[0] * random.uniform(1.5, 4.0) * random.choice([-1.0, 1.0])
    readings = readings_of(watches["offset"] + off, noise, shared, 1.0)
    share_each(cells, watches, t, np.zeros(1), readings)
    low, high, var = readings["low"], readings["high"], readings["variance"]
    counted = np.clip(off, -3.0 * total, 3.0 * total)
    averaged = sum((WHITE * (1.0 - WHITE) ** n) ** 2 for n in range(1000))  # variance of the recent mean of white z
    inverse = np.linalg.inv(np.outer(shared, shared) + np.diag(noise))
    if abs(shared @ inverse @ counted) > RARE:  # a load on the whole column
        np.testing.assert_allclose(low, watches["offset"] + off)
        np.testing.assert_allclose(var, noise + shared**2)
        return
    for i in range(6):
        others = np.arange(6) != i
        joint = np.outer(shared[others], shared[others]) + np.diag(noise[others])
        gain = np.linalg.solve(joint, shared[others])
        expected = watches["offset"][i] + off[i] - shared[i] * (gain @ counted[others])
        assert low[i] == high[i] == pytest.approx(expected, abs=1e-12)
        left = 1.0 - gain @ shared[others]
        assert var[i] == pytest.approx(noise[i] + shared[i] ** 2 * (left + averaged))


# -- the whole filter --


def errors(load: FloatArray, dt_s: float, noise: float, cell: Cell = CELL, seed: int = 0) -> tuple[FloatArray, ...]:
    """Errors and deviations (frames, cells) over full scale, under shares of full scale."""
    ohm = cell.forward(load.shape[1:]).run(np.full(len(load), dt_s), load * cell.full_scale_kpa)
    ohm = ohm * (1.0 + noise * np.random.default_rng(seed).standard_normal(ohm.shape))
    estimator, found, std = cell.estimator(load.shape[1:]), np.empty_like(load), np.empty_like(load)
    for n, frame in enumerate(ohm):
        found[n], std[n] = estimator.step(dt_s, frame), estimator.std_kpa
    return found / cell.full_scale_kpa - load, std / cell.full_scale_kpa


def presses(seed: int, frames: int, cells: int, dt_s: float) -> FloatArray:
    """Rises, holds and falls at random: of 0.1 to 1 s, from rest to full scale."""
    random, load = np.random.default_rng(seed), np.zeros((frames, cells))
    for i in range(cells):
        corners = np.cumsum(random.uniform(0.1, 1.0, 200))
        levels = np.repeat(random.choice([0.0, 0.0, 0.3, 0.6, 0.9], 100), 2)
        load[:, i] = np.interp(dt_s * np.arange(frames), corners, levels, left=0.0)
    return load


@pytest.mark.parametrize(("dt_s", "noise"), [(0.005, 1e-4), (0.01, 1e-3), (0.02, 5e-3)])
def test_errors_are_consistent_with_the_stated_deviations(dt_s: float, noise: float) -> None:
    """Normalised squared errors (NEES) of loads near one, and nine errors in ten within two deviations."""
    load = presses(1, 1200, 12, dt_s)
    error, std = errors(load, dt_s, noise)
    late = slice(100, None)
    assert 0.1 < np.mean((error / std)[late] ** 2, where=load[late] > 0.01) < 1.0  # cells at rest err by 0
    assert np.mean(np.abs(error) <= 2.0 * std, where=np.arange(1200)[:, None] > 100) > 0.9
    assert np.sqrt(np.mean(error[late] ** 2)) < 0.03


@pytest.mark.parametrize("dt_s", [0.005, 0.02, 0.1])
def test_with_little_noise_the_cell_is_inverted(dt_s: float) -> None:
    """Presses that are held: what is left are turns within frames."""
    time = dt_s * np.arange(int(20.0 / dt_s))
    load = np.interp(time, [2, 2.5, 6, 6.5, 9, 10, 14, 14.5], [0, 0.8, 0.8, 0.3, 0.3, 0.6, 0.6, 0])[:, None]
    error, std = errors(load * np.array([1.0, 0.4]), dt_s, 1e-4)
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert np.abs(error[time > 16.0]).max() < 0.005
    assert np.mean(np.abs(error) <= 2.0 * std) > 0.95


@given(st.floats(0.1, 10.0), st.floats(0.1, 100.0))
@settings(max_examples=5, deadline=None)
def test_units_do_not_matter(pressures: float, ohms: float) -> None:
    """Full scale and moduli in another unit, and R0 another one: the same shares of full scale."""
    model = CELL.model
    scaled = {
        name: value * pressures
        for name, value in model.model_dump(exclude_none=True).items()
        if name not in ("kind", "derivative_s")
    }
    other = CELL.replace(
        model=model.replace(**scaled),
        full_scale_kpa=FULL_KPA * pressures,
        rest_resistance_ohm=CELL.rest_resistance_ohm * ohms,
    )
    load = presses(3, 200, 2, 0.02)
    for one, two in zip(errors(load, 0.02, 1e-3), errors(load, 0.02, 1e-3, other), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-6)


@pytest.mark.parametrize("cell", [CELL, scenes.cells()["paper"]], ids=["example", "paper"])
def test_a_held_load_does_not_fade(cell: Cell) -> None:
    """Five minutes at 0.6: within the deviation, which stays small."""
    load = 0.6 * np.interp(0.1 * np.arange(3000), [2, 3], [0, 1])[:, None]
    error, std = errors(load, 0.1, 5e-4, cell)
    assert np.abs(error[100:]).max() < 0.02
    assert (np.abs(error) <= 2.0 * std)[100:].mean() > 0.97
    assert np.median(std) < 0.02


@pytest.mark.parametrize("again", [0.04, 0.3])
def test_a_cell_at_rest_sleeps_while_it_still_remembers_and_wakes_under_a_touch(again: float) -> None:
    """What is left of the load fades as the model says: it is neither shown as a load, nor does it hide one."""
    dt_s, time = 0.01, 0.01 * np.arange(1000)
    touched = time >= 8.0
    load = np.interp(time, [1, 1.2, 3, 3.2, 8, 8.05], [0, 0.7, 0.7, 0, 0, again])[:, None]
    ohm = CELL.forward((1,)).run(np.full(time.size, dt_s), load * FULL_KPA)
    noise = 5e-5
    noisy = ohm * (1.0 + noise * np.random.default_rng(0).standard_normal(ohm.shape))
    estimator, found, asleep = CELL.estimator((1,)), np.empty_like(load), np.empty(time.size, bool)
    for n, frame in enumerate(noisy):
        found[n], asleep[n] = estimator.step(dt_s, frame), estimator._watches["asleep"][0] > 0.0
    remembered = ohm[:, 0] / CELL.rest_resistance_ohm - 1.0
    late = (time > 5.0) & ~touched
    assert asleep[late].mean() > 0.8
    assert (remembered[late & asleep] > 10.0 * noise).any()
    assert (found[asleep] == 0.0).all()
    assert np.abs(found / FULL_KPA - load)[time > 8.15].max() < 0.02


@given(st.floats(2e-3, 0.1))
@settings(max_examples=10)
def test_a_sleeping_cell_follows_what_drifts_in_seconds_whatever_the_rate(dt_s: float) -> None:
    """A lag of first order; a rest that wandered with a load would hide the load."""
    watch, t = zeros(filters.Watch, 1)[0], step_of(dt_s)
    for _ in range(round(filters.DRIFTS_S / dt_s)):
        assert filters.rests(watch, t, 4e-4, 4e-4, 1e-6)
    assert watch.offset == pytest.approx(4e-4 * (1.0 - math.exp(-1.0)), rel=0.05)


def test_departures_that_add_up_wake_a_sleeping_cell() -> None:
    """Page's cumulative sum (1954): one standard deviation does after 2 WAKES frames, its negative never."""
    t, frames = step_of(1e-3), {}
    for r in (1e-3, -1e-3):
        watch = zeros(filters.Watch, 1)[0]
        frames[r] = next((n for n in range(1, 100) if not filters.rests(watch, t, r, r, 1e-6)), None)
    assert frames == {1e-3: pytest.approx(2.0 * filters.WAKES, abs=1), -1e-3: None}


def test_a_gap_widens_the_deviation_until_readings_come_back() -> None:
    load = 0.5 * np.interp(0.02 * np.arange(500), [1, 1.1], [0, 1])[:, None]
    ohm = CELL.forward((1,)).run(np.full(500, 0.02), load * FULL_KPA)
    ohm *= 1.0 + 2e-4 * np.random.default_rng(0).standard_normal(ohm.shape)
    ohm[200:300] = np.nan
    estimator, found, std = CELL.estimator((1,)), [], []
    for frame in ohm:
        found.append(float(estimator.step(0.02, frame)[0]))
        std.append(float(estimator.std_kpa[0]))
    assert (np.array(found)[200:300] == found[199]).all()
    assert (np.diff(std[200:240]) >= 0.0).all()
    assert std[299] > 10.0 * std[199]
    assert abs(found[-1] - 0.5 * FULL_KPA) < 2.0 * std[-1] + 0.01 * FULL_KPA


def test_what_the_load_may_have_become_in_a_gap_counts_as_doubt() -> None:
    """The last load is kept, and its deviation covers what the filter expects: that a ramp has gone on."""
    load = 0.3 * (0.02 * np.arange(120))[:, None]
    ohm = CELL.forward((1,)).run(np.full(120, 0.02), load * FULL_KPA)
    ohm *= 1.0 + 2e-4 * np.random.default_rng(0).standard_normal(ohm.shape)
    ohm[100:] = np.nan
    estimator, off = CELL.estimator((1,)), 0.0
    for n, frame in enumerate(ohm):
        shown = float(estimator.step(0.02, frame)[0]) / FULL_KPA
        if n >= 100:
            reading = estimator._readings[0]
            off = reading.load - shown
            assert (estimator.std_kpa[0] / FULL_KPA) ** 2 == pytest.approx(reading.load_variance + off**2)
    assert off > 0.05


@pytest.mark.parametrize("at_rest", [False, True])
def test_a_bad_contact_that_is_over_has_been_a_gap(at_rest: bool) -> None:
    """Estimates from before it go on without readings, and the first that returns to them is taken by them."""
    time = 0.01 * np.arange(160)
    load = np.interp(time, [0.5, 0.6, 1.1, 1.6], [0, 0.5, 0.5, 0.6])[:, None] * (0.0 if at_rest else 1.0)
    ohm = CELL.forward((1,)).run(np.full(160, 0.01), load * FULL_KPA)
    ohm *= 1.0 + 3e-4 * np.random.default_rng(1).standard_normal(ohm.shape)
    bad, missing = CELL.estimator((1,)), CELL.estimator((1,))
    for n, frame in enumerate(ohm):
        lost = 120 <= n < 129
        # Both measure their noise by the same readings.
        shown = [
            bad.step(0.01, frame * (3.5 if lost else 1.0))[0],
            missing.step(0.01, frame * (np.nan if lost else 1.0))[0],
        ]
        if n in (129, 130):
            assert bad._watches["since_s"][0] == 0.0
            assert shown[0] / FULL_KPA == pytest.approx(shown[1] / FULL_KPA, abs=1e-3)
            assert bad.std_kpa[0] == pytest.approx(missing.std_kpa[0], rel=0.1)
            ones, others = bad._cells[0], missing._cells[0]
            heavy = others.w > 0.05
            np.testing.assert_allclose(ones.s[heavy], others.s[heavy], atol=2e-3)


@pytest.mark.parametrize("factor", [0.5, 2.5, 4.0])
def test_a_bad_contact_is_over_when_it_is_over(factor: float) -> None:
    """For 60 ms, of cells at rest and pressed ones: ten frames later the error is that of before."""
    load = np.interp(0.01 * np.arange(400), [0.5, 0.6], [0, 1])[:, None] * np.array([0.0, 0.5])
    ohm = CELL.forward((2,)).run(np.full(400, 0.01), load * FULL_KPA)
    ohm *= 1.0 + 5e-4 * np.random.default_rng(1).standard_normal(ohm.shape)
    ohm[200:206] *= factor
    estimator = CELL.estimator((2,))
    found = np.array([estimator.step(0.01, frame) for frame in ohm]) / FULL_KPA
    assert np.abs(found - load)[215:].max() < 0.03


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 100.0])
def test_a_press_within_a_frame_is_shown_at_once_and_doubted(rate_hz: float) -> None:
    """It may be a bad contact: the deviation says so until it has lasted."""
    frames, level = round(6.0 * rate_hz), np.array([0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
    begins = frames // 2
    load = np.where(np.arange(frames)[:, None] < begins, 0.0, level)
    error, std = errors(load, 1.0 / rate_hz, 3e-4)
    assert np.abs(error[begins:]).max() < 0.02
    assert (std[begins] > 0.03 * level).all()
    assert (std[begins + round(0.4 * rate_hz)] < 0.03).all()


@pytest.mark.parametrize("factor", [1.6, 2.5])
def test_a_contact_may_get_bad_right_after_a_touch(factor: float) -> None:
    """0.1 s after a press was seen: what the cell read before the press has no part in it."""
    load = np.interp(0.01 * np.arange(200), [0.5, 0.53], [0, 1])[:, None] * np.array([0.3, 0.5, 0.8])
    ohm = CELL.forward((3,)).run(np.full(200, 0.01), load * FULL_KPA)
    ohm *= 1.0 + 2e-4 * np.random.default_rng(2).standard_normal(ohm.shape)
    ohm[63:69] *= factor
    estimator = CELL.estimator((3,))
    found = np.array([estimator.step(0.01, frame) for frame in ohm]) / FULL_KPA
    assert np.abs(found - load)[75:].max() < 0.03
    assert (np.abs(found - load)[63:69] <= 0.03).mean() > 0.6


@pytest.mark.parametrize("noise", [2e-4, 2e-3])
@pytest.mark.parametrize("rise_s", [0.02, 0.3, 2.0])
def test_an_overload_is_shown_with_a_deviation_that_grows(noise: float, rise_s: float) -> None:
    """Up to 1.25 of full scale; no load is left after it."""
    levels = np.array([1.0, 1.1, 1.15, 1.2, 1.25])
    time = 0.01 * np.arange(700)
    load = np.interp(time, [1.0, 1.0 + rise_s, 4.0, 4.2], [0, 1, 1, 0])[:, None] * levels
    error, std = errors(load, 0.01, noise)
    held = (time > 1.5 + rise_s) & (time < 4.0)
    assert (np.abs(error) <= 2.0 * std)[held].mean() > 0.95
    assert np.abs(error[held]).max() < 0.06
    assert (np.diff(np.median(std[held], axis=0)) > 0.0).all()
    assert np.abs(error[time > 5.2]).max() < 0.02


@pytest.mark.parametrize("since_s", [0.3, 1.0, 3.0])
def test_a_recording_joined_under_a_press_shows_it_within_its_deviation(since_s: float) -> None:
    """A press whose beginning nobody saw: the filter knows neither its age nor what was before."""
    time = 0.01 * np.arange(1400)
    load = np.interp(time, [1.0, 1.2, 8.0, 8.2], [0, 1, 1, 0])[:, None] * np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    ohm = CELL.forward((5,)).run(np.full(1400, 0.01), load * FULL_KPA)
    ohm *= 1.0 + 5e-4 * np.random.default_rng(3).standard_normal(ohm.shape)
    first, estimator = round((1.2 + since_s) / 0.01), CELL.estimator((5,))
    frames = [(estimator.step(0.01, frame), estimator.std_kpa) for frame in ohm[first:]]
    found, std = np.moveaxis(np.array(frames) / FULL_KPA, 1, 0)
    error = np.abs(found - load[first:])
    assert error[0].max() < 0.15
    assert (error <= 2.0 * std)[: round(3.0 / 0.01)].mean() > 0.9
    assert error[time[first:] > 9.2].max() < 0.06


def test_no_load_is_shown_a_second_after_vibration() -> None:
    """A finger that vibrates at 12 Hz, and is lifted."""
    time = 0.01 * np.arange(1200)
    held = np.interp(time, [1.0, 1.2, 8.0, 8.1], [0, 1, 1, 0])
    load = (0.35 * held + 0.1 * np.sin(2 * np.pi * 12.0 * time) * np.interp(time, [1.5, 2, 7.5, 8], [0, 1, 1, 0]))[
        :, None
    ]
    error, _ = errors(load, 0.01, 2e-4)
    assert np.abs(error[time > 9.1]).max() < 0.1
