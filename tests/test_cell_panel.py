"""Calibration with defaults on materials outside the fitted classes: nested models, the static floor, honest folds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.bench import panel
from ohmskin.bench._materials import LOADS, MATERIALS
from ohmskin.cell import CalibrationResult, checked_recording
from ohmskin.cell import _training as training
from ohmskin.cell._calibrate import _choose
from ohmskin.cell._identify import fits
from ohmskin.cell._learned import DRIFT

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


@pytest.mark.parametrize("names", SUBSET, ids=lambda names: f"{names[0]}, {names[1]}")
def test_the_chosen_estimator_is_never_much_worse_than_the_static_curve(names: tuple[str, str, int]) -> None:
    """On presses that were not learned from; and the stated deviation holds there."""
    _, verdict = judged(*names)
    assert verdict.rmse_percent <= 1.1 * verdict.static_percent
    assert verdict.within_two_std >= 0.9


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


@settings(max_examples=4)
@given(material=st.sampled_from(sorted(MATERIALS)), seed=st.integers(0, 1000))
def test_a_nested_model_never_fits_worse_than_one_it_contains(material: str, seed: int) -> None:
    """m10 contains asymmetric; it is started from where that one ended."""
    scene = shortened(panel.scene("random", material, seed), 80)
    head = scene.time_s < scene.head_s
    recording = checked_recording(scene.time_s[head], scene.pressure_kpa[head], scene.resistance_ohm[head])
    error = {fit.model.kind: fit.error for fit in fits(recording, panel.FULL_SCALE_KPA)}
    assert error["m10"] <= 1.01 * error["asymmetric"] + 1e-4


@given(
    errors=st.lists(st.floats(0.1, 30), min_size=9, max_size=9),
    unexplained=st.floats(0, 0.1),
    presses=st.floats(0.5, 100),
)
def test_the_choice_is_by_the_worst_fold_with_the_static_curve_as_the_floor(
    errors: list[float], unexplained: float, presses: float
) -> None:
    parts = dict(zip(("static", "play", "distilled"), np.reshape(errors, (3, 3)).tolist(), strict=True))
    by_fold = {name: tuple(folds) for name, folds in parts.items()}
    chosen, reason = _choose(by_fold, unexplained, presses, 1.0)  # type: ignore[arg-type]
    worst = {name: max(folds) for name, folds in by_fold.items()}
    assert worst[chosen] <= worst["static"]
    assert max(by_fold[chosen][1:]) <= max(by_fold["static"][1:])
    assert chosen == "static" or worst[chosen] <= 1.1 * min(worst["play"], worst["distilled"])
    assert f"{worst[chosen]:.1f} % of full scale on the worst of 3 folds" in reason


@given(scale=st.floats(0.05, 20), seed=st.integers(0, 100))
def test_deviations_hold_on_the_folds_that_they_were_calibrated_on(scale: float, seed: int) -> None:
    """However wrong the deviations of the regression were, 95 % of held-out errors lie within two of them."""
    rng = np.random.default_rng(seed)
    std = 0.03 * np.exp(rng.standard_normal(3000))
    folds = [(scale * std * rng.standard_normal(3000), std) for _ in range(3)]
    found, _ = judged(*SUBSET[0])
    assert found.cell.estimators is not None
    learned = found.cell.estimators.distilled
    assert learned is not None
    wide = training.calibrated(learned.replace(std_factor=1.0), folds, drift=0.0, most=np.inf)
    for error, stated in folds[1:]:
        final = np.maximum(stated * wide.std_factor, wide.std_floor) / DRIFT
        assert np.mean(np.abs(error) <= 2 * final) >= 0.95


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
