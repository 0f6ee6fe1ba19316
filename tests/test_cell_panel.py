"""Calibration with defaults on materials outside the fitted classes: nested models, the static floor, honest folds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cells
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ohmskin.bench import panel
from ohmskin.bench._materials import LOADS, MATERIALS
from ohmskin.cell import (
    AsymmetricModel,
    CalibrationResult,
    Cell,
    ContactModel,
    Recording,
    calibrate,
    checked_recording,
    estimate_recording,
)
from ohmskin.cell._cell import Calibrated, EstimatorName
from ohmskin.cell.identification import _training as training
from ohmskin.cell.identification._calibrate import _breaks, _judge, _seen
from ohmskin.cell.identification._choice import Evidence, choose
from ohmskin.cell.identification._fitted import Drift
from ohmskin.cell.identification._folds import Fold, Strokes, strokes
from ohmskin.cell.identification._identify import fits
from ohmskin.cell.identification._judged import MOVING, Judged, Regimes, best_share, mixed, standard_errors_better
from ohmskin.cell.identification._remarks import believed, remarks
from ohmskin.cell.inversions._features import Bank
from ohmskin.cell.inversions._learned import DRIFT, Learned
from ohmskin.errors import InputError


def _unused(rng: np.random.Generator, loads: np.ndarray, dt: float) -> np.ndarray:
    raise AssertionError("a static curve needs no simulation")


SUBSET = (("random", "relays", 1), ("new speeds", "maxwell", 0))


def shortened(scene: panel.Scene, seconds: float) -> panel.Scene:
    """The last part of the head and the first part of the rest, ``seconds`` each at most."""
    near = np.abs(scene.time_s - scene.head_s) <= seconds
    first = scene.time_s[near][0]
    return replace(
        scene,
        time_s=scene.time_s[near] - first,
        pressure_kpa=scene.pressure_kpa[near],
        resistance_ohm=scene.resistance_ohm[near],
        head_s=scene.head_s - first,
    )


@cache
def judged(load: str, material: str, seed: int) -> tuple[CalibrationResult, panel.Verdict]:
    scene = shortened(panel.scene(load, material, seed), 120)
    found = panel.calibrated(scene)
    return found, panel.judge(scene, found)


@pytest.mark.slow
@pytest.mark.parametrize("names", SUBSET, ids=lambda names: f"{names[0]}, {names[1]}")
def test_the_chosen_estimator_is_never_much_worse_than_the_static_curve(names: tuple[str, str, int]) -> None:
    """On presses that were not learned from; and the stated deviation holds there."""
    _, verdict = judged(*names)
    assert verdict.rmse_percent <= 1.1 * verdict.static_percent
    assert verdict.within_two_std >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("names", SUBSET, ids=lambda names: f"{names[0]}, {names[1]}")
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_the_deviation_covers_an_r0_that_is_given_wrong(names: tuple[str, str, int], factor: float) -> None:
    """It is as before for the R0 of the calibration, which the folds judged along with everything else."""
    found, own = judged(*names)
    scene = replace(shortened(panel.scene(*names), 120), rest_factor=factor)
    given = panel.judge(scene, found)
    assert given.within_two_std >= 0.9
    assert given.std_percent > own.std_percent
    rest = found.cell.rest_resistance_ohm
    known, plain = found.cell.estimator((), rest_resistance_ohm=rest, rest_error=0.0), found.cell.estimator(())
    for read in (rest, 1.2 * rest):
        assert known.step(0.1, read) == plain.step(0.1, read)
        assert known.std_kpa == plain.std_kpa


@pytest.mark.slow
@settings(max_examples=4)
@given(material=st.sampled_from(sorted(MATERIALS)), seed=st.integers(0, 1000))
def test_a_nested_model_never_fits_worse_than_one_it_contains(material: str, seed: int) -> None:
    """m10 contains asymmetric; it is started from where that one ended."""
    scene = shortened(panel.scene("random", material, seed), 80)
    head = scene.time_s < scene.head_s
    pressure = scene.pressure_kpa[head]
    assume(pressure.min() < 0.2 * pressure.max())  # a recording that is never released is refused
    recording = checked_recording(scene.time_s[head], pressure, scene.resistance_ohm[head])
    error = {fit.model.kind: fit.error for fit in fits(recording, panel.FULL_SCALE_KPA)}
    assert error["m10"] <= 1.01 * error["asymmetric"] + 1e-4


def folds_of(errors: list[np.ndarray], std: float = 0.05) -> list[Judged]:
    """Errors in shares of full scale, each array a fold whose load moves all the time."""
    return [
        Judged(
            Fold(n, n + 1.0),
            error,
            np.full(len(error), std),
            Regimes(np.full(len(error), MOVING), np.arange(float(len(error)))),
        )
        for n, error in enumerate(errors)
    ]


@given(
    sizes=st.lists(st.floats(0.001, 0.3), min_size=9, max_size=9),
    unexplained=st.floats(0, 0.1),
    presses=st.floats(0.5, 100),
    elsewhere=st.floats(0.1, 2.0),
    seed=st.integers(0, 9),
)
def test_the_choice_is_by_the_worst_fold_with_the_static_curve_as_the_floor(
    sizes: list[float], unexplained: float, presses: float, elsewhere: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    names: tuple[EstimatorName, ...] = ("static", "play", "distilled")
    judged = {
        name: folds_of([size * rng.standard_normal(80) for size in part])
        for name, part in zip(names, np.reshape(sizes, (3, 3)).tolist(), strict=True)
    }
    ratios: dict[EstimatorName, float] = {"static": 0.1, "play": 0.1 * elsewhere, "distilled": 0.1 * elsewhere}
    chosen, reason = choose(Evidence(judged, ratios, presses, ALIKE, unexplained, 1.0))
    worst = {name: max(100 * part.rms for part in folds) for name, folds in judged.items()}
    passed = [name for name in names[1:] if standard_errors_better(judged[name], judged["static"]) >= 1.28]
    if presses < 3 and elsewhere >= 1.1:
        passed = []
    assert chosen in (passed or ["static"])
    assert len(passed) < 2 or worst[chosen] <= 1.1 * min(worst["play"], worst["distilled"])
    assert f"{worst[chosen]:.1f} % of full scale on the worst of 3 folds, number" in reason


def _press_by_press(heights: np.ndarray, seconds: np.ndarray, noise: float = 0.0) -> Recording:
    """Triangular presses one after the other, of a cell without memory."""
    turns = np.concatenate([[0.0, 5.0], 5.0 + np.cumsum(np.repeat(seconds / 2, 2))])
    levels = np.concatenate([[0.0, 0.0], np.column_stack([heights, 0 * heights]).ravel()])
    time = np.arange(0, turns[-1], 0.1)
    load = np.interp(time, turns, levels)
    gauge = 10.0 * load + noise * np.random.default_rng(0).standard_normal(len(time))
    return Recording(time, gauge, 1e4 * (1 + 0.5 * load))


def test_presses_vary_that_differ_in_height_and_in_duration() -> None:
    even, heights = np.ones(12), np.linspace(0.3, 1.0, 12)
    durations = np.geomspace(2, 20, 12)[::-1]
    assert strokes(_press_by_press(heights, durations), 10.0).vary
    assert strokes(_press_by_press(heights, durations, noise=0.1), 10.0).vary
    assert not strokes(_press_by_press(even, 5 * even), 10.0).vary
    assert not strokes(_press_by_press(even, 5 * even, noise=0.1), 10.0).vary
    assert not strokes(_press_by_press(even, durations), 10.0).vary, "nothing is known of lower presses"
    cut_off = np.append(even[:-1], 0.3)
    assert not strokes(_press_by_press(cut_off, 5 * cut_off), 10.0).vary, "the last press alone says little"


def test_strokes_go_from_turn_to_turn() -> None:
    """A play swallows a tenth of full scale at each turn, and half of that at the first one."""
    heights, durations = np.array([0.8, 0.5, 1.0]), np.array([6.0, 8.0, 4.0])
    found = strokes(_press_by_press(heights, durations), 10.0)
    assert found.height == pytest.approx(np.repeat(heights, 2) - np.array([0.05, *[0.1] * 5]), abs=0.06)
    assert found.seconds[1:-1] == pytest.approx(np.repeat(durations / 2, 2)[1:-1], abs=0.8)


ALIKE = Strokes(np.ones(40), np.full(40, 5.0))
VARIED = Strokes(np.linspace(0.3, 1.0, 40), np.geomspace(1, 20, 40))


def test_loads_that_vary_are_not_alike_though_the_static_error_hardly_scatters() -> None:
    """As on a cell with little memory, whose static curve errs by the same everywhere."""
    static = folds_of([0.02 * np.sin(np.arange(400.0)) for _ in range(3)])
    for presses, of_load, expected in ((30.0, VARIED, True), (30.0, ALIKE, False), (2.0, VARIED, False)):
        evidence = Evidence({"static": static}, {"static": 0.1}, presses, of_load, 0.1, 1.0)
        assert evidence.varied == expected


@given(presses=st.floats(4, 40), begins=st.floats(0, 1), grows=st.sampled_from([0.0, 2.0]))
def test_few_presses_are_alike_wherever_in_a_press_the_folds_begin(presses: float, begins: float, grows: float) -> None:
    """The static curve errs by more in rises than in falls. Presses differ only if the error grows from some on."""
    path = 2 * np.arange(begins, begins + presses, 0.01)
    error = np.where(path % 2 < 1, 0.1, 0.02) * np.where(path > path.mean(), 1 + grows, 1)
    parts = np.array_split(np.arange(len(path)), [len(path) // 2, 3 * len(path) // 4])
    static = [
        Judged(Fold(n, n + 1.0), error[part], error[part], Regimes(np.full(len(part), MOVING), path[part]))
        for n, part in enumerate(parts)
    ]
    evidence = Evidence({"static": static}, {"static": 0.1}, 2 * presses, ALIKE, 0.1, 1.0)
    assert evidence.varied == bool(grows)


@given(gain=st.floats(0.3, 3), seed=st.integers(0, 100))
def test_a_mixture_with_the_static_curve_errs_less_than_either_on_the_folds(gain: float, seed: int) -> None:
    """The share is at most the best one; between none and the best one, the sum of squares falls."""
    rng = np.random.default_rng(seed)
    static = folds_of([0.1 * rng.standard_normal(100) for _ in range(3)])
    other = folds_of([0.1 * gain * rng.standard_normal(100) for _ in range(3)])
    share = best_share(other, static)
    assert 0 <= share <= 1
    both = mixed(other, static, share)
    total = [sum(part.rms**2 for part in folds) for folds in (both, static)]
    assert total[0] <= total[1] * (1 + 1e-9)
    assert best_share(static, folds_of([3 * part.error for part in static])) == 1.0
    assert best_share(folds_of([3 * part.error for part in static]), static) == 0.0


def test_a_learned_map_mixed_with_the_static_curve_answers_in_between() -> None:
    found, _ = judged(*SUBSET[0])
    estimators = found.cell.estimators
    assert estimators is not None
    assert estimators.distilled is not None
    rng = np.random.default_rng(3)
    limits = estimators.static.limits.replace(lowest=-1e6, highest=1e6)
    learned = estimators.distilled.replace(limits=limits)
    reached = estimators.static.reached
    assert reached is not None
    reading = rng.uniform(reached.lowest[0], reached.highest[0], 50)
    resistance = found.cell.rest_resistance_ohm * (1 + reading)

    def answers(map_: Learned) -> np.ndarray:
        cell = found.cell.replace(estimators=estimators.replace(distilled=map_))
        return cell.estimator((50,), "distilled", noise=0.0).step(1.0, resistance) / found.cell.full_scale_kpa

    curve = estimators.static.load(reading)
    alone = answers(learned.replace(static_share=0.0))
    assert np.allclose(answers(learned.replace(static_share=1.0)), curve, atol=1e-9)
    assert np.allclose(answers(learned.replace(static_share=0.5)), (alone + curve) / 2, atol=1e-9)
    assert not np.allclose(alone, curve, atol=0.01)


@given(seed=st.integers(0, 1000), glitch=st.floats(0.1, 10))
def test_the_first_feature_is_the_last_reading_and_a_glitch_does_not_enter_the_memories(
    seed: int, glitch: float
) -> None:
    """A press within one frame is answered at once. Banks of earlier versions see it a frame later, and smoothed."""
    rng = np.random.default_rng(seed)
    now, before = Bank(0.1, (0.5, 8.0), (0.05,)), Bank(0.1, (0.5, 8.0), (0.05,), smoothed=True)
    memory = now.begin(np.zeros(1))
    for r in rng.uniform(0, 1, 5):
        now.advance(memory, 0.1, np.array([r]))
    features, earlier = now.features(memory)[:, 0], before.features(memory)[:, 0]
    assert features[0] == r
    assert features[0] - features[1] == pytest.approx(earlier[0])
    assert features[0] - features[2:] == pytest.approx(earlier[0] - earlier[2:])
    calm, glitched = (now.begin(np.zeros(1)) for _ in range(2))
    for r in (0.0, glitch, 0.0, 0.0):
        now.advance(glitched, 0.1, np.array([r]))
        now.advance(calm, 0.1, np.zeros(1))
    assert np.array_equal(now.features(glitched), now.features(calm))


def test_paths_are_learned_from_where_chains_that_break_explain_the_recording() -> None:
    """Elsewhere they would let a map follow what little is told of other loads."""
    fitted, _ = judged("random", "relays", 1)
    whole, m10 = (next(fit for fit in fitted.fits if fit.label == label) for label in ("m10, k = 0", "m10"))
    for error, expected in ((0.4, True), (0.6, False)):
        found = (whole, replace(m10, error=error * whole.error))
        assert _breaks(found) == expected


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 1000), dt=st.floats(0.02, 0.5))
def test_a_path_is_the_faded_sum_of_what_the_reading_moved(seed: int, dt: float) -> None:
    """Written out for one cell. Motion narrower than the play adds nothing, and a reading that stays lets it fade."""
    rng = np.random.default_rng(seed)
    bank = Bank(0.1, (0.5,), (0.01, 0.05), paths_s=(2.0, 20.0))
    readings = np.cumsum(rng.normal(0, 0.05, 60))
    steps = np.full(60, dt)
    found = bank.run(steps, readings[:, None])[:, -2:, 0]
    middle = [readings[0]] * 2 + [sorted(readings[n - 2 : n + 1])[1] for n in range(2, 60)]
    smooth = follower = readings[0]
    paths = np.zeros(2)
    for n in range(1, 60):
        smooth += (middle[n] - smooth) * (1 - np.exp(-dt / 0.1))
        moved = float(np.clip(follower, smooth - 0.05, smooth + 0.05)) - follower
        follower += moved
        paths = paths * np.exp(-dt / np.array([2.0, 20.0])) + abs(moved)
        assert found[n] == pytest.approx(paths, abs=1e-12)
    narrow = bank.run(steps, 0.04 * rng.choice([-1.0, 1.0], (60, 1)) * np.minimum(np.arange(60), 1)[:, None])
    assert not narrow[:, -2:].any()


def test_a_recording_of_two_heights_has_a_static_curve_through_both() -> None:
    """They leave a cubic open; NumPy's warning of that, an error here, means nothing to who made the recording."""
    time, load = np.arange(400.0), np.tile([0.0, 1.0], 200)
    curve = training.static_curve(training.NormalisedRecording(time, 0.4 * load, load, 1e4, _unused, 0.0), 15.5)
    assert curve.load(0.4 * load) == pytest.approx(load, abs=1e-6)


def test_the_static_curve_is_judged_as_it_will_run() -> None:
    """A fold's error is that of the estimator with its smoothing, not that of the curve on single noisy readings."""
    rng = np.random.default_rng(5)
    time = np.arange(0, 120, 0.05)
    load = np.clip(1.2 * np.sin(2 * np.pi * time / 40), 0, 1)
    read = 1e4 * (1 + 0.3 * load) * (1 + 0.02 * rng.standard_normal(len(time)))
    recording = checked_recording(time, 15.5 * load, read)
    curve = training.static_curve(training.NormalisedRecording(time, read / 1e4 - 1, load, 1e4, _unused, 0.0), 15.5)
    model = AsymmetricModel(e1_kpa=60, e2_kpa=600, e3_kpa=600, eta2_kpa_s=3000, eta3_kpa_s=6e4)
    cell = Cell(rest_resistance_ohm=1e4, full_scale_kpa=15.5, model=model)
    trial = cell.replace(
        estimators=Calibrated(
            default="static", reason="", held_out_percent={}, seen=_seen(recording, 15.5), static=curve
        )
    )
    fold = _judge(trial, "static", recording, Regimes.of(recording, 15.5), Fold(60.0, 120.0))
    pressure, stated = estimate_recording(trial.estimator(()), time, read)
    later = time >= 60
    assert stated is not None
    assert np.array_equal(fold.error, (pressure - 15.5 * load)[later] / 15.5)
    assert np.array_equal(fold.std, stated[later] / 15.5)
    raw = (np.clip(curve.load(read / 1e4 - 1), 0, 1.2) - load)[later]
    assert np.std(fold.error) < 0.9 * np.std(raw)


@given(scale=st.floats(0.05, 20), seed=st.integers(0, 100))
def test_deviations_hold_on_the_folds_that_they_were_calibrated_on(scale: float, seed: int) -> None:
    """However wrong the deviations of the regression were, 95 % of held-out errors lie within two of them."""
    rng = np.random.default_rng(seed)
    std = 0.03 * np.exp(rng.standard_normal(3000))
    regime = rng.integers(0, 3, 3000)
    worse = scale * np.array([0.2, 1.0, 3.0])[regime]
    folds = [
        Judged(Fold(n, n + 1.0), worse * std * rng.standard_normal(3000), std, Regimes(regime, np.arange(3000.0)))
        for n in range(3)
    ]
    found, _ = judged(*SUBSET[0])
    assert found.cell.estimators is not None
    learned = found.cell.estimators.distilled
    assert learned is not None
    wide = training.calibrated(learned.replace(std_factor=1.0), folds, drift=0.0, elsewhere=0.0, most=np.inf)
    for fold in folds[1:]:
        final = np.maximum(std * wide.std_factor, wide.std_floor) / DRIFT
        for part in range(3):
            assert np.mean((np.abs(fold.error) <= 2 * final * (1 + 1e-9))[regime == part]) >= 0.95


def test_the_deviation_grows_beyond_what_was_learned_from() -> None:
    """A reading larger than any recorded one, and a change faster than any, are answered with more doubt."""
    found, _ = judged(*SUBSET[0])
    cell = found.cell
    highest = float(found.recording.resistance_ohm.max())
    for name in ("static", "play", "distilled"):
        estimator = cell.estimator((2,), name, noise=0.0)
        estimator.step(0.1, np.array([highest, highest + 1.5 * (highest - cell.rest_resistance_ohm)]))
        known, unknown = estimator.std_kpa
        assert unknown > known + 0.2 * cell.full_scale_kpa
    overload = cell.estimator((), "static", noise=0.0).step(0.1, highest + 1.5 * (highest - cell.rest_resistance_ohm))
    assert overload >= 0.99 * cell.full_scale_kpa
    lost = cell.estimator((), "static")
    lost.step(0.1, 1.1 * cell.rest_resistance_ohm)
    before = lost.std_kpa
    assert lost.step(0.1, 1e9) == lost.step(0.1, 1e9), "an open contact is a missing reading"
    assert lost.std_kpa > before


def falling() -> Cell:
    """A contact, of which presses to full scale were recorded."""
    cell = Cell(
        rest_resistance_ohm=1e5, full_scale_kpa=15.5, model=ContactModel(exponent=0.9, full_scale_resistance_ohm=5e3)
    )
    time = np.arange(0, 120, 0.1)
    load = 15.5 * np.sin(np.pi * time / 12) ** 2
    read = cell.forward(()).run(np.full(len(time), 0.1), load)
    noisy = read * (1 + 0.002 * np.random.default_rng(0).standard_normal(len(time)))
    return calibrate(checked_recording(time, load, noisy)).cell


RISING = {"m10": lambda: judged(*SUBSET[1])[0].cell, "paper": lambda: cells.paper().cell}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "name"),
    [(falling, "static"), *((RISING[kind], name) for kind in RISING for name in ("static", "play", "distilled"))],
    ids=["falling, static", *(f"{kind}, {name}" for kind in RISING for name in ("static", "play", "distilled"))],
)
def test_an_overload_never_reads_as_less(make: Callable[[], Cell], name: str) -> None:
    """Load that rises slowly to 2.5 times full scale: the pressure shown never falls.

    Where the reading leaves the range of the recording, the sd covers the error.

    This holds whatever share of the answer is the static curve's. Learned maps waver a little within their range.
    """
    cell = make()
    assert cell.estimators is not None
    if name == "static":
        _overload(cell, name)
        return
    for share in (0.0, 0.5):
        learned = getattr(cell.estimators, name).replace(static_share=share)
        _overload(cell.replace(estimators=cell.estimators.replace(**{name: learned})), name)


def _overload(cell: Cell, name: str) -> None:
    time = np.arange(0, 110, 0.1)
    load = np.interp(time, [0, 10, 110], [0, 0, 2.5]) * cell.full_scale_kpa
    read = cell.forward(()).run(np.full(len(time), 0.1), load)
    assert (np.diff(read[100:]) * (read[-1] - read[0]) > 0).all(), "the resistance goes on in the direction of a press"
    pressure, std = estimate_recording(cell.estimator((), name, noise=0.0), time, read)
    assert std is not None
    fall = (1e-9 if name == "static" else 0.02) * cell.full_scale_kpa
    assert (np.maximum.accumulate(pressure) - pressure).max() < fall
    assert pressure[-1] >= 0.99 * cell.full_scale_kpa
    assert cell.estimators is not None
    curve = cell.estimators.static
    assert curve.reached is not None
    reading = curve.reading(read / cell.rest_resistance_ohm - 1)
    beyond = curve.reached.excess(reading[None]) > 0.05 * (curve.reached.highest[0] - curve.reached.lowest[0])
    assert np.count_nonzero(beyond & (load > cell.full_scale_kpa)) > 100
    assert (np.abs(pressure - load)[beyond] < 2 * std[beyond]).all()


def test_a_spark_in_a_recording_is_not_learned_from() -> None:
    """Single readings that no load explains are passed over; fast presses and noise are kept."""
    scene = panel.scene("speeds", "maxwell", 0)
    recording = checked_recording(scene.time_s, scene.pressure_kpa, scene.resistance_ohm)
    assert len(recording.without_sparks.time_s) == len(recording.time_s)
    sparked = scene.resistance_ohm.copy()
    sparked[500::700] *= 1.4
    recording = checked_recording(scene.time_s, scene.pressure_kpa, sparked)
    kept = recording.without_sparks
    assert len(kept.time_s) == len(recording.time_s) - len(sparked[500::700])
    assert not np.isin(recording.time_s[500::700], kept.time_s).any()


@pytest.mark.parametrize("load", [*LOADS, *panel.DISTURBANCES])
def test_every_recording_of_the_panel_can_be_made_again(load: str) -> None:
    one, two = (panel.scene(load, "maxwell", 3) for _ in range(2))
    assert (one.resistance_ohm == two.resistance_ohm).all()
    assert 0 < one.head_s < one.time_s[-1]
    head = one.time_s < one.head_s
    checked_recording(one.time_s[head], one.pressure_kpa[head], one.resistance_ohm[head])
    other = panel.scene(load, "maxwell", 4)
    assert not np.array_equal(one.resistance_ohm, other.resistance_ohm)


def test_the_panel_takes_its_materials_in_turn() -> None:
    names = list(panel.scenes((0, 1, 2)))
    assert {material for _, material, _ in names} == set(MATERIALS)
    assert len(set(names)) == len(names)
    assert {load for load, _, _ in names} == {*LOADS, *panel.DISTURBANCES}


def test_a_load_cell_that_is_late_and_a_converter_that_clips_are_noticed() -> None:
    scene = panel.scene("random", "relays", 2)
    head = scene.time_s < 120
    time, load, read = scene.time_s[head], scene.pressure_kpa[head], scene.resistance_ohm[head]

    def said(pressure: np.ndarray, resistance: np.ndarray, full_scale_kpa: float = panel.FULL_SCALE_KPA) -> str:
        recording = checked_recording(time, pressure, resistance)
        return " ".join(remarks(recording, full_scale_kpa, 10.0, varied=True))

    assert not said(load, read)
    assert not said(np.interp(time + 1.0, time, load), read), "a cell may follow late"
    assert "changes 1 s before the pressure" in said(np.interp(time - 1.0, time, load), read)
    assert "does the converter clip" in said(load, np.minimum(read, np.quantile(read, 0.8)))
    assert "beyond it the deviation grows" in said(load, read, 2 * panel.FULL_SCALE_KPA)


def test_a_gap_and_a_full_scale_that_is_hardly_reached_are_remarked_upon() -> None:
    of = _waves()
    kept = (of.time_s < 20) | (of.time_s > 30)
    gap = Recording(of.time_s[kept], of.pressure_kpa[kept], of.resistance_ohm[kept])
    assert not list(remarks(of, 10.0, 10.0, varied=True))
    assert "nothing was read for 10.2 s of 59.9 s" in " ".join(remarks(gap, 10.0, 10.0, varied=True))
    gap = checked_recording(of.time_s, of.pressure_kpa, np.where(kept, of.resistance_ohm, np.nan))
    assert "the resistance was not read for 10.2 s of 59.9 s" in " ".join(remarks(gap, 10.0, 10.0, varied=True))
    assert "the largest load is 10 kPa, full scale 8 kPa" in " ".join(remarks(of, 8.0, 10.0, varied=True))


def test_readings_minutes_apart_are_remarked_upon_and_can_be_learned_from() -> None:
    """Time in milliseconds with presses shorter than 3.6 s. The cell is then as slow as the file says."""
    of = panel.scene("random", "asymmetric", 3)
    head = of.time_s < 60
    recording = checked_recording(
        1e3 * of.time_s[head], of.pressure_kpa[head], of.resistance_ohm[head], trust_units=True
    )
    assert "is time_s in milliseconds?" in " ".join(remarks(recording, panel.FULL_SCALE_KPA, 10.0, varied=True))
    found = training.variations(_normalised(recording), np.random.default_rng(0), 4)
    assert np.isfinite(found[1]).all()


def _normalised(recording: Recording) -> training.NormalisedRecording:
    rest = float(recording.resistance_ohm[0])
    return training.NormalisedRecording(
        time_s=recording.time_s,
        r=recording.resistance_ohm / rest - 1,
        load=recording.pressure_kpa / recording.pressure_kpa.max(),
        rest_resistance_ohm=rest,
        simulation=lambda rng, load, dt: rest * (1 + load),
        unexplained=0.01,
    )


@pytest.mark.parametrize(
    ("kpa", "ohm", "expected"),
    [(1.0, 1.0, ""), (100.0, 1.0, "Pa or mbar"), (0.004, 1.0, "MPa or bar"), (1.0, 1e-3, "kohm"), (1.0, 3e5, "mohm")],
)
def test_numbers_in_an_unusual_unit_are_remarked_upon(kpa: float, ohm: float, expected: str) -> None:
    scene = panel.scene("random", "relays", 2)
    head = scene.time_s < 120
    full = kpa * panel.FULL_SCALE_KPA
    recording = checked_recording(scene.time_s[head], kpa * scene.pressure_kpa[head], ohm * scene.resistance_ohm[head])
    said = list(remarks(recording, full, 10.0, varied=True))
    assert len(said) == bool(expected)
    assert all(f"in {expected}?" in one for one in said)


def test_a_recording_with_its_sign_turned_round_is_refused_in_words() -> None:
    scene = panel.scene("random", "relays", 2)
    with pytest.raises(InputError, match="is its sign turned round"):
        checked_recording(scene.time_s, -scene.pressure_kpa, scene.resistance_ohm)


DRIFTING = (("random", "m10", -0.15), ("speeds", "asymmetric", 0.15))


@pytest.mark.slow
@pytest.mark.parametrize(("load", "material", "share"), DRIFTING)
def test_a_drift_of_r0_is_found_with_its_size(load: str, material: str, share: float) -> None:
    """Readings at the end of the recording are higher or lower by that share than without the drift."""
    drift = _drift(load, material, share)
    assert believed(drift)
    assert drift.share == pytest.approx(share, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("load", "material"), [("random", "m10"), ("cyclic", "relays")])
def test_a_steady_r0_is_not_called_drifting(load: str, material: str) -> None:
    """Relays creep on, so that their readings at rest rise by a fifth, though R0 is steady."""
    assert not believed(_drift(load, material, 0.0))


def _drift(load: str, material: str, share: float) -> Drift:
    scene = panel.scene(load, material, 800)
    head = scene.time_s < scene.head_s
    time = scene.time_s[head]
    drifted = scene.resistance_ohm[head] * (1 + share * time / time[-1])
    recording = checked_recording(time, scene.pressure_kpa[head], drifted)
    (drift,) = [fit.drift for fit in fits(recording, panel.FULL_SCALE_KPA) if fit.drift is not None]
    return drift


def test_a_drift_is_remarked_upon_only_where_it_is_clear() -> None:
    recording = _waves()
    for drift, expected in (
        (Drift(0.12, 0.01, 0.1), True),
        (Drift(-0.05, 0.01, 0.1), True),
        (Drift(0.05, 0.01, 0.1), False),
        (Drift(0.12, 0.05, 0.1), False),
        (Drift(0.12, 0.01, 0.7), False),
    ):
        said = " ".join(remarks(recording, 10.0, 10.0, varied=True, drift=drift))
        assert (f"R0 drifts by {100 * drift.share:+.0f} %" in said) == expected


def _waves() -> Recording:
    time = np.arange(0, 60, 0.1)
    load = 5.0 * (1 - np.cos(time))
    return checked_recording(time, load, 1000 * (1 + 0.05 * load))
