"""The common interface of the estimators, and the paper's estimator on the paper's experiments."""

import json

import numpy as np
import pytest
from cells import exactly
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel
from ohmskin.cell.estimation._conditions import Conditions
from ohmskin.cell.estimation._estimator import Estimator
from ohmskin.cell.estimation._scale import Ratio
from ohmskin.cell.inversions._learned import Limits, StaticCurve
from ohmskin.cell.inversions._static import StaticCurveInversion
from ohmskin.errors import InputError

EXAMPLE = Cell.example()
PAPER = EXAMPLE.model
assert isinstance(PAPER, PaperModel)
ASYMMETRIC = EXAMPLE.replace(model=AsymmetricModel(e1_kpa=32, e2_kpa=60, e3_kpa=480, eta2_kpa_s=505, eta3_kpa_s=48000))
M10 = EXAMPLE.replace(
    model=M10Model(a=0.4, b=0.1, alpha1=0.15, rise1_s=0.3, fall1_s=3, alpha2=0.1, fall2_s=40, k=0.1, tau_s=20)
)
NAMES = ("static", "paper", "inverse")


def steps(time_s: np.ndarray, *presses: tuple[float, float]) -> np.ndarray:
    """Full scale between each pair of times, 0 elsewhere."""
    held = sum(((time_s > start) & (time_s < end)).astype(float) for start, end in presses)
    return EXAMPLE.full_scale_kpa * np.asarray(held)


def sense(cell: Cell, time_s: np.ndarray, pressure_kpa: np.ndarray) -> np.ndarray:
    forward = cell.forward(pressure_kpa.shape[1:])
    dt = np.diff(time_s, prepend=time_s[0])
    return np.stack([forward.step(step, p) for step, p in zip(dt, pressure_kpa, strict=True)])


def estimate(cell: Cell, name: str, time_s: np.ndarray, resistance_ohm: np.ndarray) -> np.ndarray:
    return exactly(cell, name, time_s, resistance_ohm)


@given(
    rest_ohm=st.lists(st.floats(1e4, 1e6), min_size=1, max_size=5),
    pressure=st.floats(0.5, 20),
    exponent=st.floats(0.5, 2.0),
)
def test_contacts_of_different_rest_resistance_show_the_same_pressure(
    rest_ohm: list[float], pressure: float, exponent: float
) -> None:
    """A contact conducts beside the rest resistance of its cell; no cell may be read by the curve of another."""
    model = ContactModel(exponent=exponent, full_scale_resistance_ohm=5e3)
    cell = Cell(full_scale_kpa=20.0, rest_resistance_ohm=1e5, model=model)
    shape = (len(rest_ohm),)
    forward = cell.forward(shape, rest_resistance_ohm=rest_ohm)
    estimator = cell.estimator(shape, rest_resistance_ohm=rest_ohm, noise=0)
    found = estimator.step(0.01, forward.step(0.01, np.full(shape, pressure)))
    np.testing.assert_allclose(found, pressure, rtol=2e-3, atol=0.01)


@pytest.mark.parametrize("dt", [0.01, 0.03, 0.1])
def test_paper_estimator_inverts_the_paper_model(dt: float) -> None:
    """P9: one step, then three with creep, without noise: exact, as steps cross a threshold at once."""
    time = np.arange(0, 140, dt)
    for presses in ([(10, 40)], [(10, 25), (35, 50), (60, 75)]):
        load = steps(time, *presses)
        found = estimate(EXAMPLE, "paper", time, sense(EXAMPLE, time, load))
        assert found == pytest.approx(load, abs=1e-8)


def test_paper_estimator_with_noise() -> None:
    """P9 with noise of 0.5 % of R0: at most 2 % of full scale, a quarter of the static error."""
    time = np.arange(0, 140, 0.05)
    load = np.repeat(steps(time, (10, 25), (35, 50), (60, 75))[:, None], 16, axis=1)
    resistance = sense(EXAMPLE, time, load)
    noise = np.random.default_rng(1).standard_normal(resistance.shape)
    resistance += 0.005 * EXAMPLE.rest_resistance_ohm * noise
    rmse = {
        name: np.sqrt(np.mean((estimate(EXAMPLE, name, time, resistance) - load) ** 2)) / EXAMPLE.full_scale_kpa
        for name in NAMES
    }
    assert rmse["paper"] < 0.02
    assert rmse["static"] > 4 * rmse["paper"]


def test_a_held_load_must_not_read_as_release() -> None:
    """P8: with the default threshold a hold stays; with one inside the settling slope it drifts."""
    time = np.arange(0, 60, 0.05)
    load = steps(time, (5, 100))
    resistance = sense(EXAMPLE, time, load)
    assert estimate(EXAMPLE, "paper", time, resistance)[-1] == pytest.approx(15.5, abs=1e-6)
    slope = PAPER.settling_slope_per_s(15.5)
    assert slope == pytest.approx(15.5 * 16 / 80**2)
    hasty = PAPER.replace(recovery_threshold_per_s=0.3 * slope)
    lost = estimate(EXAMPLE.replace(model=hasty), "paper", time, resistance)
    assert np.abs(lost[110:] - 15.5).max() > 0.3


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_is_on_its_own(name: str) -> None:
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.005, 0.05, 300))
    load = np.cumsum(rng.standard_normal((300, 3, 2)), axis=0) % 15.5
    resistance = sense(EXAMPLE, time, load)
    together = estimate(EXAMPLE, name, time, resistance)
    alone = np.stack([estimate(EXAMPLE, name, time, resistance[:, i, 1]) for i in range(3)], axis=1)
    assert together[:, :, 1] == pytest.approx(alone, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_missing_sample_holds_the_pressure_of_its_cell_alone(name: str, seed: int) -> None:
    """Under a load that holds meanwhile, the cell then reads on as if nothing had been missed."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.01, 0.1, 60))
    load = np.repeat(np.cumsum(rng.standard_normal((6, 2)), axis=0) % 15.5, 10, axis=0)
    load[:10] = 0.0
    resistance = sense(EXAMPLE, time, load)
    missing = (rng.random(60) < 0.6) & (np.arange(60) % 10 > 0)
    holed = resistance.copy()
    holed[missing, 0] = rng.choice([np.nan, np.inf])
    whole, found = (estimate(EXAMPLE, name, time, read) for read in (resistance, holed))
    assert found[:, 1] == pytest.approx(whole[:, 1], abs=1e-9)
    if name == "inverse":
        assert found[:, 0] == pytest.approx(whole[:, 0], abs=0.02 * 15.5)  # turns below 1 % are not seen
    for k in range(1, 60):
        assert not missing[k] or found[k, 0] == found[k - 1, 0]


@pytest.mark.parametrize("name", NAMES)
def test_a_saved_state_continues(name: str) -> None:
    time = np.arange(0, 30, 0.05)
    resistance = sense(EXAMPLE, time, steps(time, (5, 15), (20, 25)))
    resistance *= 1 + 0.001 * np.random.default_rng(3).standard_normal(len(time))
    first, second, third = (EXAMPLE.estimator((), name) for _ in range(3))
    whole = [float(first.step(0.05, r)) for r in resistance]
    for r in resistance[:250]:
        second.step(0.05, r)
    third.restore(json.loads(json.dumps({key: value.tolist() for key, value in second.state().items()})))
    rest = [float(third.step(0.05, r)) for r in resistance[250:]]
    assert rest == whole[250:]
    with pytest.raises(InputError, match="not a saved state"):
        EXAMPLE.estimator((2,), name).restore(second.state())


@pytest.mark.parametrize("name", NAMES)
def test_rest_resistance_per_cell(name: str) -> None:
    rest = np.array([5e3, 1e4, 3e4])
    time = np.arange(0, 20, 0.05)
    load = np.repeat(steps(time, (5, 15))[:, None], 3, axis=1)
    forward = EXAMPLE.forward((3,), rest_resistance_ohm=rest)
    estimator = EXAMPLE.estimator((3,), name, rest_resistance_ohm=rest, noise=0.0)
    for p in load:
        found = estimator.step(0.05, forward.step(0.05, p))
        assert found == pytest.approx(np.full(3, found[0]), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("cell", [EXAMPLE, ASYMMETRIC, M10], ids=lambda cell: cell.model.kind)
@pytest.mark.parametrize("ohm", [1.0, 1e6, 1e12])
def test_a_reading_that_no_load_can_give_leaves_no_trace(cell: Cell, ohm: float) -> None:
    """A cell about to open reads some megohms for one sample: a memory that takes that in is off for minutes."""
    time = np.arange(0, 30, 0.05)
    resistance = sense(cell, time, steps(time, (5, 15), (20, 25)))
    clean = estimate(cell, "inverse", time, resistance)
    resistance[200] = ohm
    found = estimate(cell, "inverse", time, resistance)
    assert found[200] == found[199]
    np.testing.assert_allclose(found, clean, atol=1e-9 * cell.full_scale_kpa)


def test_three_times_full_scale_is_still_answered() -> None:
    time = np.arange(0, 30, 0.05)
    load = 3 * steps(time, (5, 15))
    for cell in (EXAMPLE, ASYMMETRIC, M10):
        np.testing.assert_allclose(estimate(cell, "inverse", time, sense(cell, time, load)), load, atol=1e-6)


VELOSTAT = Cell(
    full_scale_kpa=40.0, rest_resistance_ohm=3e4, model=ContactModel(full_scale_resistance_ohm=900.0, exponent=1.1)
)


@pytest.mark.parametrize("share", [0.02, 0.3, 1.0, 2.0, 2.9])
def test_a_contact_pressed_hard_is_neither_full_scale_nor_surer_than_its_noise(share: float) -> None:
    """Noise of the conductance relative to itself: its pressure scatters by as much of the pressure, at every load."""
    relative, load = 0.02, share * VELOSTAT.full_scale_kpa
    rng = np.random.default_rng(2)
    ohm = VELOSTAT.forward(()).step(0.01, load) / (1 + relative * rng.standard_normal(4000))
    r = ohm / VELOSTAT.rest_resistance_ohm - 1
    memory = VELOSTAT.estimator((), "static", noise=0.0).inversion.begin(r)
    assert np.median(memory[0]) == pytest.approx(load, rel=0.01)
    stated = relative * (1 + np.median(r)) * np.median(memory[1])
    assert stated == pytest.approx(memory[0].std(), rel=0.1 if share > 0.1 else 0.5)


def test_a_cell_whose_resistance_falls_is_estimated_with_memory() -> None:
    """r = ln(R0/R)/span: presses are followed, none is left after them, and an open cell bears none."""
    model = M10Model(a=0.3, alpha1=0.3, rise1_s=0.3, fall1_s=5.0, alpha2=0.1, fall2_s=90.0)
    cell = Cell(rest_resistance_ohm=20e3, full_scale_kpa=20.0, model=model, log_span=4.0)
    time = np.arange(0.0, 20.0, 0.02)
    load = np.interp(time, [0, 2, 2.2, 6, 6.1, 9, 11, 15, 15.2], [0, 0, 12, 12, 4, 4, 18, 18, 0])
    read = cell.forward(()).run(np.full(time.size, 0.02), load)
    read = read * np.exp(0.003 * np.random.default_rng(2).standard_normal(time.size))
    read[time > 18.0] = np.inf
    estimator = cell.estimator(())
    pressure, std = np.array([(float(estimator.step(0.02, one)), float(estimator.std_kpa)) for one in read]).T
    assert np.sqrt(np.mean((pressure - load) ** 2)) < 0.02 * cell.full_scale_kpa
    assert np.mean(np.abs(pressure - load) < 2.0 * std) > 0.97
    assert np.abs(pressure[time > 18.5]).max() < 0.01 * cell.full_scale_kpa
    assert estimator.side < 0.0


def test_a_static_curve_states_its_deviation() -> None:
    curve = StaticCurve(coefficients=(0.0, 1.0), limits=Limits(lowest=0.0, highest=1.0), std_kpa=0.5)
    inversion, rest = StaticCurveInversion(curve, 10.0, 1.0, exact=True), np.array([1e3])
    estimator = Estimator(inversion, (), rest, Ratio(rest), Conditions(model_std_kpa=1e-9, noise=0.0))
    for resistance in (1.1e3, 1.2e3):
        estimator.step(0.1, resistance)
        assert estimator.std_kpa == pytest.approx(0.5)


def test_bad_steps_are_refused() -> None:
    estimator = EXAMPLE.estimator((2,))
    estimator.step(1.0, np.full(2, 1e4))
    for elapsed in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="time stamps that increase"):
            estimator.step(elapsed, np.full(2, 1e4))
    with pytest.raises(InputError, match=r"shape \(3,\), expected \(2,\)"):
        estimator.step(1.0, np.full(3, 1e4))
    with pytest.raises(InputError, match="no estimator 'papr'"):
        EXAMPLE.estimator((2,), "papr")
