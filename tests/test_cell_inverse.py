"""The exact inverse on the cells it is meant for, and the hard cases every estimator must stand."""

import numpy as np
import pytest
from cells import exactly
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel
from ohmskin.cell.inversions import _inverse as inverse
from ohmskin.cell.materials import _lag as lag
from ohmskin.errors import InputError

EXAMPLE = Cell.example()


def cell_of(model: AsymmetricModel | M10Model) -> Cell:
    return EXAMPLE.replace(model=model)


ASYMMETRIC = AsymmetricModel(e1_kpa=32, e2_kpa=60, e3_kpa=480, eta2_kpa_s=510, eta3_kpa_s=48000)
SAFE = M10Model(a=0.5, b=-0.1, alpha1=0.3, rise1_s=0.3, fall1_s=4, alpha2=0.1, fall2_s=90, k=0.1, tau_s=20)
WIDE = M10Model(a=0.4, alpha1=0.3, rise1_s=1e-3, fall1_s=2e-3, alpha2=0.2, rise2_s=1e-3, fall2_s=3600)
CANCELLING = M10Model(a=0.5, alpha1=1e-9, rise1_s=3.0, fall1_s=3.0 + 1e-9, alpha2=0.2, rise2_s=3.0, fall2_s=3.0)
STIFF_UNLOADING = M10Model(a=0.3, alpha1=0.8, rise1_s=0.4, fall1_s=5, alpha2=0.2, fall2_s=400, k=0.5, tau_s=50)


@pytest.mark.parametrize("model", [ASYMMETRIC, SAFE, WIDE, CANCELLING], ids=["asymmetric", "m10", "wide", "cancel"])
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_inverse_is_exact_at_any_time_steps(model: AsymmetricModel | M10Model, seed: int) -> None:
    """Random loads, time steps from 0.1 ms to 10 s in one recording."""
    rng = np.random.default_rng(seed)
    cell = cell_of(model)
    dt = 10 ** rng.uniform(-4, 1, 60)
    load = rng.choice([0.0, 15.5, -1.0], (60, 3)) * rng.random((60, 3))
    load[0] = 0
    forward, estimator = cell.forward((3,)), cell.estimator((3,), "inverse", noise=0.0)
    estimator.step(1.0, forward.step(1.0, load[0]))
    for n in range(1, 60):
        assert estimator.step(dt[n], forward.step(dt[n], load[n])) == pytest.approx(load[n], abs=1e-5)


def bracketed(model: M10Model, dt: float, readings: np.ndarray) -> np.ndarray:
    """The load of one cell at readings r, each step's equation solved by a root finder that knows only its sign."""
    slope = model.a + model.alpha1 + model.alpha2
    s = brentq(lambda load: model.b * load**2 + slope * load - readings[0], -2, 2, xtol=1e-15)
    x, broken, loads = np.array([model.alpha1 * s, model.alpha2 * s]), 0.0, [s]
    alpha = np.array([model.alpha1, model.alpha2])
    rise, fall = np.array([model.rise1_s, model.rise2_s]), np.array([model.fall1_s, model.fall2_s])
    gone, ramp = lag.weights(dt, model.tau_s)

    def after(load: float) -> tuple[np.ndarray, float]:
        moved = float(broken * (1 - gone) + model.k * abs(load - s) * (1 - ramp))
        return lag.asymmetric(x, alpha * s, alpha * load, dt, rise, fall), moved

    def excess(load: float, r: float) -> float:
        branches, moved = after(load)
        return float(model.a * load + model.b * load**2 + branches.sum() + moved - r)

    bend = (model.a - model.k) / (2 * model.b) if model.b else np.inf  # the curve turns back there
    lowest, highest = (-bend, np.inf) if model.b >= 0 else (-np.inf, -bend)
    for r in readings[1:]:
        found = brentq(excess, max(s - 2, lowest), min(s + 2, highest), args=(r,), xtol=1e-15)
        x, broken = after(found)
        s = found
        loads.append(s)
    return np.array(loads)


REVERSED = M10Model(a=0.5, b=-0.1, alpha1=0.3, rise1_s=4, fall1_s=0.3, alpha2=0.1, fall2_s=90, k=0.1, tau_s=20)


STIFFENING = M10Model(a=0.6, b=0.1, alpha1=0.4, rise1_s=3.0, fall1_s=0.1, alpha2=0.2, fall2_s=50.0, k=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.005, 0.03])
@pytest.mark.parametrize("dt", [1e-3, 0.05, 2.0])
@pytest.mark.parametrize(
    "model", [SAFE, WIDE, CANCELLING, REVERSED, STIFFENING], ids=["m10", "wide", "cancel", "reversed", "stiffening"]
)
def test_noise_that_turns_branches_in_every_sample_costs_no_accuracy(model: M10Model, dt: float, noise: float) -> None:
    """Noisy readings against bracketing, sample by sample: 1e-9 of full scale."""
    rng = np.random.default_rng(9)
    readings = 0.4 * np.sin(np.arange(120) / 15)[:, None] ** 2 + noise * rng.standard_normal((120, 3))
    found = exactly(cell_of(model), "inverse", dt * np.arange(120), EXAMPLE.rest_resistance_ohm * (1 + readings))
    for cell in range(3):
        expected = 15.5 * bracketed(model, dt, readings[:, cell])
        assert found[:, cell] == pytest.approx(expected, abs=15.5e-9)


def test_a_reading_beyond_the_models_reach_stays_finite() -> None:
    """With b < 0 the resistance has a top; above it there is no load, and the next readings are answered again."""
    readings = np.array([0.0, 0.1, 0.05, 50.0, 40.0, 0.2, 0.1, 0.0])
    read = EXAMPLE.rest_resistance_ohm * (1 + readings)
    assert np.isfinite(exactly(cell_of(SAFE), "inverse", 0.05 * np.arange(8), read)).all()


def test_an_ambiguous_cell_is_refused() -> None:
    assert inverse.margin(STIFF_UNLOADING, 15.5) < 0
    with pytest.raises(InputError, match="more than one answer"):
        cell_of(STIFF_UNLOADING).estimator((2,), "inverse")
    assert cell_of(STIFF_UNLOADING).default_estimator == "static"
    assert cell_of(SAFE).default_estimator == "inverse"
    contact = EXAMPLE.replace(model=ContactModel(full_scale_resistance_ohm=500))
    with pytest.raises(InputError, match="of kind 'paper', 'asymmetric' or 'm10'"):
        contact.estimator((2,), "inverse")


def test_the_margin_is_where_two_loads_begin_to_share_a_resistance() -> None:
    """A fast release from a settled load: r falls if and only if the margin is positive."""
    for k in (0.05, 0.29, 0.31, 0.6):
        model = STIFF_UNLOADING.replace(k=k)
        forward = cell_of(model).forward(())
        forward.step(1.0, 15.5)
        held = forward.step(1000.0, 15.5)
        assert (forward.step(1e-6, 15.0) < held) == (inverse.margin(model, 15.5) > 0)


@pytest.mark.parametrize(
    ("cell", "name"),
    [(EXAMPLE, "paper"), (EXAMPLE, "inverse"), (cell_of(ASYMMETRIC), "inverse"), (cell_of(SAFE), "inverse")],
)
def test_a_held_load_does_not_fade(cell: Cell, name: str) -> None:
    """An hour at 10 kPa, then a gap of a week: the estimate stays."""
    forward, estimator = cell.forward(()), cell.estimator((), name, noise=0.0)
    estimator.step(1.0, forward.step(1.0, 0.0))
    estimator.step(0.05, forward.step(0.05, 10.0))
    for _ in range(900):
        held = estimator.step(4.0, forward.step(4.0, 10.0))
    assert held == pytest.approx(10.0, abs=1e-6)
    assert estimator.step(604800.0, forward.step(604800.0, 10.0)) == pytest.approx(10.0, abs=1e-6)


@pytest.mark.parametrize(("cell", "name"), [(EXAMPLE, "paper"), (EXAMPLE, "inverse"), (cell_of(ASYMMETRIC), "inverse")])
def test_a_cell_that_opens_and_returns(cell: Cell, name: str) -> None:
    """Open, shorted, saturated to nonsense: missing; when it is back, it reads as if it had been looked at rarely."""
    forward, estimator = cell.forward((2,)), cell.estimator((2,), name, noise=0.0)
    for n in range(400):
        load = 8.0 if n >= 100 else 0.0
        read = forward.step(0.05, load)
        if 150 <= n < 250:
            read[0] = [np.inf, 0.0, -5.0, np.nan][n % 4]
        found = estimator.step(0.05, read)
        assert np.isfinite(found).all()
    assert found == pytest.approx([8.0, 8.0], abs=1e-6)


def test_a_wrong_rest_resistance_costs_no_more_than_itself() -> None:
    """R0 off by 3 % shifts r by 3 % of 1 + r; the estimate is off by that over the slope, and does not run away."""
    cell = cell_of(ASYMMETRIC)
    estimator = cell.estimator((), "inverse", rest_resistance_ohm=1.03 * cell.rest_resistance_ohm, noise=0.0)
    forward = cell.forward(())
    worst = 0.0
    for n in range(4000):
        load = 7.0 + 7.0 * np.sin(n / 150) * np.sin(n / 47)
        worst = max(worst, abs(float(estimator.step(0.1, forward.step(0.1, load))) - load))
    assert worst < 2 * 0.03 * (1 + 0.775) * 32


@pytest.mark.parametrize("model", [EXAMPLE.model, ASYMMETRIC, SAFE], ids=["paper", "asymmetric", "m10"])
@given(share=st.floats(0.2, 0.95), error=st.floats(0.001, 0.005))
def test_the_deviation_counts_an_error_of_r0_as_what_it_does_to_the_answer(
    model: PaperModel | AsymmetricModel | M10Model, share: float, error: float
) -> None:
    """Of a load held long: the answer with a wrong R0 differs from the one with the right R0 by that deviation."""
    cell = EXAMPLE.replace(model=model)
    forward = cell.forward(())
    for _ in range(3):
        read = forward.step(1e6, share * cell.full_scale_kpa)
    right, wrong = (
        cell.estimator((), "static", noise=0.0, rest_resistance_ohm=rest, rest_error=error)
        for rest in (cell.rest_resistance_ohm, (1 + error) * cell.rest_resistance_ohm)
    )
    sure = cell.estimator((), "static", noise=0.0)
    shift = abs(float(wrong.step(1.0, read)) - float(right.step(1.0, read)))
    sure.step(1.0, read)
    added = np.sqrt(float(right.std_kpa) ** 2 - float(sure.std_kpa) ** 2)
    assert added == pytest.approx(shift, rel=0.1)


def test_an_absurd_error_of_r0_is_refused() -> None:
    for error in (-0.1, 1.5, np.nan):
        with pytest.raises(InputError, match="error of R0"):
            EXAMPLE.estimator((), rest_error=error)
