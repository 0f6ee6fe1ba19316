"""Machine code of the estimators: frame for frame the same numbers as the array operations, which are the reference.

Every step starts both forms from the same state, so that a difference shows in the frame that makes it. Sums, products,
quotients and square roots round alike, and so all is equal to the last bit. Only where a branch of the material changes
over within a frame, which takes logarithms and exponentials, the last bits may differ.
"""

from __future__ import annotations

import copy
import os
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.cell import AsymmetricModel, Cell, ContactModel, Estimator, M10Model
from ohmskin.cell.inversions import _doubts as doubts
from ohmskin.cell.inversions import _limits as limits
from ohmskin.cell.inversions._inverse import AsymmetricInversion
from ohmskin.common import compiled
from ohmskin.common.arrays import FloatArray
from ohmskin.common.compiled import SWITCH

DT_S = 0.005
EXAMPLE = Cell.example()
ASYMMETRIC = AsymmetricModel(e1_kpa=30, e2_kpa=60, e3_kpa=90, eta2_kpa_s=30, eta3_kpa_s=900, rise_s=0.2)
M10 = M10Model(
    **{"a": 0.5, "b": 0.1, "alpha1": 0.2, "rise1_s": 0.1, "fall1_s": 1.0},
    **{"alpha2": 0.1, "rise2_s": 3.0, "fall2_s": 20.0, "k": 0.1, "tau_s": 9.0},
)
CELLS = {
    "paper": EXAMPLE,
    "asymmetric": EXAMPLE.replace(model=ASYMMETRIC),
    "m10": EXAMPLE.replace(model=M10),
    "m10 that flattens": EXAMPLE.replace(model=M10.replace(b=-0.1)),
    "m10 without breakdown": EXAMPLE.replace(model=M10.replace(k=0.0, b=0.0)),
    "contact": EXAMPLE.replace(model=ContactModel(full_scale_resistance_ohm=500.0, exponent=0.8)),
}


NEARLY = 1e-11
"""relative, and in kPa: where a branch changes over"""


def equal(one: object, other: object, what: str, nearly: float = 0.0) -> None:
    np.testing.assert_allclose(np.asarray(one), np.asarray(other), rtol=nearly, atol=nearly, err_msg=what)


def compare(estimator: Estimator, times_s: FloatArray, frames: FloatArray) -> Estimator:
    """Step the compiled ``estimator`` through frames, and before each step a copy by array operations, too."""
    assert estimator.compile()
    for number, (dt, ohm) in enumerate(zip(times_s, frames, strict=True)):
        reference = copy.deepcopy(estimator)
        reference._use(machine_code=False)
        changed: dict[str, int] = {}
        if isinstance(reference.inversion, AsymmetricInversion):
            _count(reference, "inversion._solve_crossed", "changes", changed)
        expected = reference.step(float(dt), ohm)
        nearly = NEARLY if sum(changed.values()) else 0.0
        equal(estimator.step(float(dt), ohm), expected, f"pressures of frame {number}", nearly)
        equal(estimator.std_kpa, reference.std_kpa, f"deviations of frame {number}", nearly)
        if number % 7 == 0:
            found = copy.deepcopy(estimator).state()
            for name, value in reference.state().items():
                equal(found[name], value, f"{name} after frame {number}", nearly)
    return estimator


def readings(cell: Cell, shape: tuple[int, ...], frames: int, noise: float, seed: int, **events: Any) -> FloatArray:
    """(frames, *shape) ohm of cells that are pressed, tapped, held and released, with what else happens to them."""
    random = np.random.default_rng(seed)
    forward, full = cell.forward(shape), cell.full_scale_kpa
    kpa, target, speed = np.zeros(shape), np.zeros(shape), np.ones(shape)
    ohms = np.empty((frames, *shape))
    for frame in range(frames):
        anew = random.random(shape) < 0.05
        target = np.where(anew, full * np.maximum(random.uniform(-0.5, 1.2, shape), 0.0), target)
        speed = np.where(anew, full * 10 ** random.uniform(-3, 0, shape), speed)
        kpa = kpa + np.clip(target - kpa, -speed, speed)
        ohms[frame] = forward.step(DT_S, kpa)
    ohms *= 1 + noise * random.standard_normal(ohms.shape)
    for share, value in ((events.get("sparks", 0.0), 3.0), (events.get("opens", 0.0), np.inf)):
        ohms[random.random(ohms.shape) < share] *= value
    ohms[random.random(ohms.shape) < events.get("missing", 0.0)] = np.nan
    return ohms


def test_light_and_slow_loads_are_doubted_alike() -> None:
    """Taps of one percent of full scale, each with a noise of its own: some are noticed, and others only doubted.

    Beside them strong taps, and after these presses that rise within two seconds.
    """
    frames, noise, full = 900, 0.005 * np.geomspace(0.2, 3.0, 12), EXAMPLE.full_scale_kpa
    time = 0.01 * np.arange(frames)[:, None]
    light = np.repeat(0.01 * (time % 0.3 < 0.115), 12, axis=1)
    strong = 0.8 * np.interp(time % 0.5, [0.0, 0.03, 0.18, 0.21], [0.0, 1.0, 1.0, 0.0]) * (time < 3.0)
    slow = np.clip((time - 3.2) / 2.0, 0.0, 1.0) * np.linspace(0.1, 0.6, 6)
    ohms = EXAMPLE.forward((18,)).run(np.full(frames, 0.01), full * np.hstack([light, strong + slow]))
    ohms *= 1 + np.append(noise, np.full(6, 3e-4)) * np.random.default_rng(0).standard_normal(ohms.shape)
    estimator = compare(EXAMPLE.estimator((18,)), np.full(frames, 0.01), ohms)
    assert estimator.std_kpa[:12].max() > 0.02 * full


@pytest.mark.parametrize("kind", CELLS)
@given(
    seed=st.integers(0, 10**6),
    cells=st.sampled_from([1, 2, 7, 30]),
    noise=st.sampled_from([1e-7, 1e-5, 1e-4, 1e-3, 1e-2]),
    sparks=st.sampled_from([0.0, 0.01]),
    opens=st.sampled_from([0.0, 0.002]),
    missing=st.sampled_from([0.0, 0.002]),
    expected=st.sampled_from([None, 1e-4]),
    rest_error=st.sampled_from([None, 0.02]),
    jitter=st.booleans(),
)
@settings(max_examples=6, deadline=None)
def test_machine_code_does_what_array_operations_do(
    kind: str,
    seed: int,
    cells: int,
    noise: float,
    sparks: float,
    opens: float,
    missing: float,
    expected: float | None,
    rest_error: float | None,
    jitter: bool,
) -> None:
    cell = CELLS[kind]
    frames = readings(cell, (cells,), 60, noise, seed, sparks=sparks, opens=opens, missing=missing)
    times = np.full(len(frames), DT_S)
    if jitter:
        times *= np.random.default_rng(seed).uniform(0.8, 1.2, times.size)
        times[20] = 3.0
    compare(cell.estimator((cells,), noise=expected, rest_error=rest_error), times, frames)


def share(estimator: Estimator, own_std: float) -> None:
    """Tell of noise and steps that scale columns, three times as large as those of a cell itself."""
    own = np.full(estimator.shape, own_std)
    estimator.resolve(own, np.full(estimator.shape, EXAMPLE.rest_resistance_ohm), 3.0 * own, scales_columns=True)


@pytest.mark.parametrize("shares", [True, False])
def test_noise_that_columns_share(shares: bool) -> None:
    """A finger on three columns, bad contacts and missing readings; and a board whose columns share no noise."""
    shape, random, frames = (8, 8), np.random.default_rng(0), 300
    finger = np.exp(-((np.arange(8.0)[:, None] - 3) ** 2 + (np.arange(8.0) - 4) ** 2))
    kpa = 9.0 * np.sin(np.arange(frames) / 9.0) ** 2 * (np.arange(frames) > 120)
    ohms = EXAMPLE.forward(shape).run(np.full(frames, 0.01), kpa[:, None, None] * finger)
    ohms *= 1 + 1e-3 * random.standard_normal(ohms.shape) + 3e-3 * shares * random.standard_normal((frames, 1, 8))
    ohms[random.random(ohms.shape) < 0.002] *= 3.0
    ohms[random.random(ohms.shape) < 0.002] = np.nan
    estimator = EXAMPLE.estimator(shape)
    share(estimator, 1e-3)
    compare(estimator, np.full(frames, 0.01), ohms)
    assert estimator._shared_noise.ratio == (pytest.approx(8.0) if shares else 0.0)


def test_a_large_skin_that_mostly_sleeps() -> None:
    """Presses wake a few cells; the readings of those asleep leave something open, too."""
    shape, random = (64, 64), np.random.default_rng(0)
    forward, kpa = EXAMPLE.forward(shape), np.zeros(shape)
    ohms = []
    for frame in range(110):
        kpa[10:14, 20:24] = 8.0 * np.sin(frame / 15.0) ** 2 if frame > 70 else 0.0
        ohms.append(forward.step(DT_S, kpa) * (1 + 1e-4 * random.standard_normal(shape)))
    estimator = compare(EXAMPLE.estimator(shape, rest_error=0.01), np.full(110, DT_S), np.array(ohms))
    asleep = np.count_nonzero(~estimator._sleep.awake)
    assert 3000 < asleep <= 4096 - 16


def test_rare_events_do_happen_in_these_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else agreement would say nothing of them: turns, sparks, limits, corrections, sleep, changes of branches."""
    seen: dict[str, int] = {}
    for room, function in ((limits, "limit_some"), (limits, "correct"), (doubts, "_keep")):
        monkeypatch.setattr(room, function, _counted(getattr(room, function), function, seen))
    for kind, methods in {
        "paper": (
            "_sparks._add",
            "_sparks.put_back",
            "_put_to_sleep",
            "_part",
            "_following._look_for_tremor_compiled",
        ),
        "m10": ("_sparks._add", "_sparks.put_back", "_put_to_sleep"),
        "asymmetric": ("_sparks._add",),
    }.items():
        estimator = CELLS[kind].estimator((30,))
        for name in methods:
            _count(estimator, name, f"{kind} {name}", seen)
        assert estimator.compile()
        by_arrays = CELLS[kind].estimator((30,))
        for ohm in readings(CELLS[kind], (30,), 200, 1e-3, 0, sparks=0.01, opens=0.002):
            estimator.step(DT_S, ohm)
            by_arrays.step(DT_S, ohm)
    assert min(seen.values()) > 0, seen


def _count(estimator: Estimator, method: str, name: str, counts: dict[str, int]) -> None:
    """Count the calls of a method of the estimator, or of one of its parts."""
    *path, method = method.split(".")
    owner: object = estimator
    for part in path:
        owner = getattr(owner, part)
    setattr(owner, method, _counted(getattr(owner, method), name, counts))


def _counted(original: Callable[..., Any], name: str, counts: dict[str, int]) -> Callable[..., Any]:
    """A function that does the same, and counts its calls by ``name``."""
    counts[name] = 0

    def counted(*given: Any, **options: Any) -> Any:
        counts[name] += 1
        return original(*given, **options)

    return counted


def _calls(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often an estimator calls each of its loops in a stream of rest and presses, on a board of shared noise."""
    shape, random = (9, 8), np.random.default_rng(0)
    estimator = cell.estimator(shape)
    expected = os.environ.get(SWITCH) != "0"
    assert estimator.compile() is expected
    counts: dict[str, int] = {}
    with monkeypatch.context() as patched:
        for each in estimator._loops():
            patched.setattr(
                each, "unchecked", _counted(each.unchecked, f"{each.__module__}.{each.__qualname__}", counts)
            )
        share(estimator, 1e-4)
        pressed = readings(cell, shape, 20, 1e-4, 0)
        rest = cell.rest_resistance_ohm * (1 + 1e-4 * random.standard_normal((64, *shape)))
        rest *= 1 + 3e-4 * random.standard_normal((64, 1, 8))
        noisy = readings(cell, shape, 60, 1e-2, 1)
        for ohm in (*rest, *pressed, *noisy):
            estimator.step(DT_S, ohm)
            assert np.isfinite(estimator.std_kpa).all() or not estimator.states_std
    return counts


@pytest.mark.parametrize("kind", [kind for kind in CELLS if kind != "contact"])  # which is normalised differently
def test_frames_are_worked_out_by_machine_code_unless_it_is_switched_off(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = _calls(CELLS[kind], monkeypatch)
    assert min(calls.values()) > 0, calls
    monkeypatch.setenv(SWITCH, "0")
    assert set(_calls(CELLS[kind], monkeypatch).values()) == {0}


LAYOUTS: dict[str, Callable[[FloatArray], Any]] = {
    "transposed": lambda ohm: ohm.T.copy().T,
    "every second": lambda ohm: np.repeat(ohm, 2, axis=1)[:, ::2],
    "backwards": lambda ohm: ohm[::-1, ::-1].copy()[::-1, ::-1],
    "other bytes": lambda ohm: ohm.astype(">f8"),
    "whole ohms": lambda ohm: np.rint(ohm).astype(np.int32),
    "read only": lambda ohm: np.frombuffer(ohm.tobytes()).reshape(ohm.shape),
    "lists": lambda ohm: ohm.tolist(),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", ["paper", "m10", "contact"])
def test_readings_of_any_layout_are_taken_as_they_are(kind: str, layout: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loops that do not look at the types of their arrays, as in users' programs, get none of the user's own."""
    cell = CELLS[kind]
    for each in cell.estimator((3, 4))._loops():
        each.machine_code()
        monkeypatch.setattr(each, "unchecked", compiled._without_dispatcher(each.code))
    estimator, usual = cell.estimator((3, 4)), cell.estimator((3, 4))
    assert estimator.compile()
    for ohm in np.rint(readings(cell, (3, 4), 120, 1e-3, 0)):
        given = LAYOUTS[layout](ohm)
        equal(estimator.step(DT_S, given), usual.step(DT_S, ohm), layout, NEARLY)
        equal(estimator.std_kpa, usual.std_kpa, layout, NEARLY)


def test_a_pickled_estimator_goes_on_where_there_is_no_machine_code(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = readings(EXAMPLE, (9,), 80, 1e-3, 0, sparks=0.01)
    estimator = EXAMPLE.estimator((9,))
    assert estimator.compile()
    for ohm in frames[:40]:
        estimator.step(DT_S, ohm)
    pickled = pickle.dumps(estimator)
    here = pickle.loads(pickled)
    monkeypatch.setenv(SWITCH, "0")
    elsewhere = pickle.loads(pickled)
    assert [each._compiled for each in (estimator, here, elsewhere)] == [True, True, False]
    for ohm in frames[40:]:
        expected = estimator.step(DT_S, ohm)
        for other in (here, elsewhere):
            equal(other.step(DT_S, ohm), expected, "pressures")
            equal(other.std_kpa, estimator.std_kpa, "deviations")


@pytest.mark.parametrize("compiled_first", [False, True])
def test_a_state_that_one_form_saved_the_other_goes_on_from(compiled_first: bool) -> None:
    frames = readings(EXAMPLE, (9,), 80, 1e-3, 0)
    first, same, other = (EXAMPLE.estimator((9,)) for _ in range(3))
    for estimator, form in ((first, compiled_first), (same, compiled_first), (other, not compiled_first)):
        assert estimator.compile()
        estimator._use(machine_code=form)
    for ohm in frames[:40]:
        first.step(DT_S, ohm)
    for estimator in (same, other):
        estimator.restore(first.state())
    for ohm in frames[40:]:
        equal(same.step(DT_S, ohm), other.step(DT_S, ohm), "pressures")
        equal(same.std_kpa, other.std_kpa, "deviations")


def test_the_deviation_of_a_step_stays_that_of_the_step() -> None:
    frames = readings(EXAMPLE, (9,), 30, 1e-3, 0)
    estimator = EXAMPLE.estimator((9,))
    asked, then = [], []
    for number, ohm in enumerate(frames):
        estimator.step(DT_S, ohm)
        asked.append(estimator.variance_of_last_step())
        then.append(estimator.std_kpa**2)
        if number == 10:
            assert estimator.compile()
    for function, variance in zip(asked, then, strict=True):
        np.testing.assert_allclose(function(), variance, rtol=1e-12)


def test_exact_readings_have_no_machine_code() -> None:
    assert not EXAMPLE.estimator((9,), noise=0.0).compile()
