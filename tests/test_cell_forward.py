"""Forward models against the paper's transfer functions, and their exactness in the time step."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal
from scipy.integrate import solve_ivp

from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel, Percolation, drifted_rest_resistance
from ohmskin.cell.materials import lag
from ohmskin.cell.materials._forward import M10_PARAMETERS
from ohmskin.cell.materials._simulate import m10, paper
from ohmskin.errors import InputError

EXAMPLE = Cell.example()
PAPER = EXAMPLE.model
assert isinstance(PAPER, PaperModel)
ASYMMETRIC = AsymmetricModel(e1_kpa=32, e2_kpa=60, e3_kpa=480, eta2_kpa_s=505, eta3_kpa_s=48000)
M10 = M10Model(a=0.3, b=-0.2, alpha1=0.5, rise1_s=0.3, fall1_s=4, alpha2=0.2, fall2_s=90, k=0.2, tau_s=20)
CONTACT = ContactModel(exponent=0.9, full_scale_resistance_ohm=500)
FULL = EXAMPLE.full_scale_kpa
CELLS = {model.kind: EXAMPLE.replace(model=model) for model in (PAPER, ASYMMETRIC, M10, CONTACT)}


def run(cell: Cell, time_s: np.ndarray, pressure_kpa: np.ndarray) -> np.ndarray:
    """The normalised resistance at ``time_s``, from rest at the first of them."""
    forward = cell.forward(())
    steps = np.diff(time_s, prepend=time_s[0])
    resistance = [float(forward.step(dt, p)) for dt, p in zip(steps, pressure_kpa, strict=True)]
    return np.array(resistance) / cell.rest_resistance_ohm - 1


def test_rising_is_g_up() -> None:
    """P4: any load that never falls, against equation (3) simulated by scipy."""
    time = np.linspace(0, 40, 4001)
    load = np.interp(time, [0, 3, 10, 12, 40], [0, 10, 10, 15.5, 15.5])
    _, expected, _ = signal.lsim(PAPER.rising_transfer_function(), load, time)
    assert run(EXAMPLE, time, load) == pytest.approx(expected, abs=1e-10)


def test_on_a_logarithmic_scale_the_model_is_one_of_the_logarithm() -> None:
    """r = ln(R0/R)/span follows the load as R/R0 - 1 does without it; blocks, single steps and some cells alike."""
    time = np.linspace(0, 20, 400)
    load = np.interp(time, [0, 3, 10, 12, 20], [0, 10, 10, 15.5, 0])
    fallen = EXAMPLE.replace(log_span=3.0)
    r = np.log(1.0 / (1.0 + run(fallen, time, load))) / 3.0
    assert r == pytest.approx(run(EXAMPLE, time, load), abs=1e-12)
    forward = fallen.forward((2,))
    ohm = forward.run(np.diff(time, prepend=time[0]), load[:, None], cells=np.array([1]))
    assert ohm[:, 0] == pytest.approx(10e3 * np.exp(-3.0 * r), rel=1e-12)


def test_the_corrected_numerator_is_the_sum_of_the_two_terms() -> None:
    """P4: the constant of the numerator is Eu2; with the printed Eu1 the gain at rest would be 1/Eu2."""
    numerator, denominator = PAPER.rising_transfer_function()
    s = 1j * np.logspace(-4, 4, 50)
    terms = 1 / PAPER.eu1_kpa + s / (PAPER.etau2_kpa * s + PAPER.eu2_kpa_per_s)
    assert np.polyval(numerator, s) / np.polyval(denominator, s) == pytest.approx(terms, rel=1e-12)
    assert numerator[-1] / denominator[-1] == pytest.approx(1 / PAPER.eu1_kpa)


def test_polynomial_and_partial_fractions_agree() -> None:
    """P5: equations (4) to (7) are equation (8)."""
    numerator, denominator = PAPER.transfer_function()
    s = 1j * np.logspace(-5, 4, 50)
    fractions = 1 / PAPER.e1_kpa + 1 / (PAPER.eta2_kpa_s * s + PAPER.e2_kpa) + 1 / (PAPER.eta3_kpa_s * s + PAPER.e3_kpa)
    assert np.polyval(numerator, s) / np.polyval(denominator, s) == pytest.approx(fractions, rel=1e-12)


@pytest.mark.parametrize("kind", ["paper", "asymmetric"])
def test_recovery_is_g(kind: str) -> None:
    """P5: after a long hold, falls and pauses against equation (4) simulated by scipy, both models."""
    cell = CELLS[kind]
    hold = 4000.0
    time = hold + np.linspace(0, 60, 6001)
    load = np.interp(time - hold, [0, 0.01, 20, 23, 60], [15.5, 9, 9, 1, 1])
    _, change, _ = signal.lsim(PAPER.transfer_function(), load - 15.5, time - hold)
    expected = 15.5 * PAPER.gain_per_kpa + change
    actual = run(cell, np.concatenate(([0, 1], time)), np.concatenate(([0, 15.5], load)))[2:]
    assert actual == pytest.approx(expected, abs=1e-9)


def test_m10_contains_the_rising_phase() -> None:
    """With b = 0, instant charging and a rising load, M10 is equation (3)."""
    full, tau = EXAMPLE.full_scale_kpa, PAPER.tu_s
    model = M10Model(
        a=0.3 * full / PAPER.eu1_kpa,
        alpha1=0.5 * full / PAPER.eu1_kpa,
        rise1_s=1e-9,
        fall1_s=5,
        alpha2=0.2 * full / PAPER.eu1_kpa,
        rise2_s=1e-9,
        fall2_s=90,
        k=full / PAPER.etau2_kpa,
        tau_s=tau,
    )
    time = np.linspace(0, 40, 401)
    load = np.interp(time, [0, 3, 10, 12, 40], [0, 10, 10, 15.5, 15.5])
    assert run(EXAMPLE.replace(model=model), time, load) == pytest.approx(run(EXAMPLE, time, load), abs=1e-7)


@pytest.mark.parametrize("kind", CELLS)
@settings(max_examples=30, deadline=None)
@given(
    corners=st.lists(st.tuples(st.floats(0.1, 30), st.floats(0, 15.5)), min_size=1, max_size=8),
    parts=st.integers(2, 7),
)
def test_any_time_step_gives_the_same_answer(kind: str, corners: list[tuple[float, float]], parts: int) -> None:
    """Piecewise-linear loads, whole segments or many parts of them."""
    cell = CELLS[kind]
    time = np.concatenate(([0.0], np.cumsum([dt for dt, _ in corners])))
    load = np.array([0.0] + [p for _, p in corners])
    fine = np.unique(np.concatenate([time, np.linspace(0, time[-1], parts * len(time))]))
    at = np.searchsorted(fine, time)
    assert run(cell, fine, np.interp(fine, time, load))[at] == pytest.approx(run(cell, time, load), abs=1e-9)


def test_example_recovers_as_the_paper_says() -> None:
    """P7, both at once: 95 % within 25 s, and full (to half a percent) in five minutes, not sooner."""
    time = np.concatenate(([0, 0.1, 3600, 3600.01], 3600.01 + np.arange(1, 301)))
    load = np.array([0, 15.5, 15.5] + [0.0] * 301)
    r = run(EXAMPLE, time, load)
    left = r[4:] / r[2]
    assert np.argmax(left <= 0.05) + 1 == pytest.approx(25, abs=1)
    assert left[-1] < 0.005
    assert left[149] > 0.005


def test_repeated_presses_leave_creep() -> None:
    """P9, Fig. 11: what is left of r before the next press grows from press to press."""
    time = np.concatenate(([0.0], np.cumsum([0.1, 20, 0.1, 10] * 3)))
    load = np.array([0.0] + [15.5, 15.5, 0, 0] * 3)
    left = run(EXAMPLE, time, load)[4::4]
    assert left[0] < left[1] < left[2]


def test_unbonded_cells_fall_and_do_not_remember() -> None:
    """P2: R falls with pressure as a power once the contact dominates, and depends on nothing else."""
    cell = CELLS["contact"]
    forward = cell.forward((4,), rest_resistance_ohm=1e9)
    load = np.array([1.0, 2.0, 4.0, 8.0])
    first = forward.step(0.1, load)
    assert np.diff(np.log(first)) == pytest.approx(-0.9 * np.log(2) * np.ones(3), rel=1e-5)
    forward.step(0.1, 15.5)
    assert (forward.step(0.1, load) == first).all()


def test_rest_resistance_per_cell_scales_each_cell() -> None:
    rest = np.array([[5e3, 1e4], [2e4, 4e4]])
    resistance = EXAMPLE.forward((2, 2), rest_resistance_ohm=rest).step(0.5, 8.0)
    assert resistance / rest == pytest.approx(np.full((2, 2), resistance[0, 0] / rest[0, 0]))


def test_reset_is_rest() -> None:
    for cell in CELLS.values():
        forward = cell.forward((3,))
        first = forward.step(1.0, 7.0)
        forward.step(1.0, 2.0)
        forward.reset()
        assert (forward.step(1.0, 7.0) == first).all()


def test_bad_steps_are_refused() -> None:
    forward = EXAMPLE.forward((2, 2))
    with pytest.raises(InputError, match="time step is -1"):
        forward.step(-1.0, 0.0)
    with pytest.raises(InputError, match=r"shape \(3,\), expected \(2, 2\)"):
        forward.step(1.0, np.zeros(3))
    with pytest.raises(InputError, match="not finite"):
        forward.step(1.0, np.nan)
    with pytest.raises(InputError, match="rest resistance has shape"):
        EXAMPLE.forward((2, 2), rest_resistance_ohm=np.ones(3))
    with pytest.raises(InputError, match="must be positive"):
        EXAMPLE.forward((2, 2), rest_resistance_ohm=-1.0)


@pytest.mark.parametrize(
    "cell",
    [
        Cell.example(),
        Cell.example().replace(
            model=AsymmetricModel(e1_kpa=32, e2_kpa=60, e3_kpa=480, eta2_kpa_s=505, eta3_kpa_s=48000)
        ),
    ],
)
def test_a_pull_that_leaves_no_resistance_is_refused(cell: Cell) -> None:
    forward = cell.forward((2,))
    assert (forward.step(0.1, -5.0) > 0).all()
    with pytest.raises(InputError, match="leaves no resistance"):
        forward.step(0.1, -40.0)
    assert (forward.step(0.1, 0.0) > 0).all()


@given(exponent=st.floats(-12, 3))
def test_weights_of_a_lag_keep_full_precision(exponent: float) -> None:
    z = 10.0**exponent
    gone, ramp = lag.weights(z, 1.0)
    with mpmath.workdps(40):
        exact_gone = -mpmath.expm1(-mpmath.mpf(z))
        exact_ramp = 1 - exact_gone / mpmath.mpf(z)
    assert float(gone) == pytest.approx(float(exact_gone), rel=4e-16)
    assert float(ramp) == pytest.approx(float(exact_ramp), rel=1e-12)


@pytest.mark.parametrize(("held", "then"), [(0.2, 1.0), (0.8, 0.0), (0.5, 1.0), (1.0, -0.5)])
def test_a_branch_that_changes_over_within_a_step_solves_its_equation(held: float, then: float) -> None:
    """x' = (s - x)/T, with T = 0.4 s while s > x, else 5 s, against a solver of differential equations."""
    cell = EXAMPLE.replace(model=M10Model(a=0.0, alpha1=1.0, rise1_s=0.4, fall1_s=5.0, alpha2=0.0, fall2_s=9.0))
    steps, shares = np.array([0.3, 1.0, 3.0]), np.array([1.0, held, then])
    r = cell.forward(()).run(steps, FULL * shares) / cell.rest_resistance_ohm - 1
    corners = np.array([0.0, 0.3, 1.3, 4.3])

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        lead = np.interp(t, corners, [0.0, *shares]) - x
        return np.where(lead > 0, lead / 0.4, lead / 5.0)

    found = solve_ivp(slope, (0, 4.3), [0.0], t_eval=corners[1:], rtol=1e-10, atol=1e-12, max_step=0.01).y[0]
    assert r == pytest.approx(found, abs=1e-6)


@pytest.mark.parametrize("kind", ["paper", "m10"])
@given(loads=st.lists(st.floats(0.0, 1.1), min_size=3, max_size=30), dt=st.sampled_from([0.01, 0.2, 3.0]))
@settings(max_examples=30)
def test_a_simulation_of_many_cells_is_the_forward_model_of_each(kind: str, loads: list[float], dt: float) -> None:
    """From where a cell comes to that was brought to its first load slowly and kept there for long."""
    cell, load = CELLS[kind], np.array(loads)
    if kind == "paper":  # held at a load, both phases of a simulated cell come to the same
        gain, lag_s = np.array([0.7, 0.25, 0.05]), np.array([9.0, 80.0])
        own = [gain[0], gain[1], lag_s[0], gain[2], lag_s[1], 0.4, 12.0]
        e1, e2, e3 = FULL / gain
        tables = {"e1_kpa": e1, "e2_kpa": e2, "e3_kpa": e3, "eta2_kpa_s": e2 * lag_s[0], "eta3_kpa_s": e3 * lag_s[1]}
        tables |= {"eu1_kpa": FULL, "etau2_kpa": FULL / 0.4, "eu2_kpa_per_s": FULL / 0.4 / 12.0}
        cell = cell.replace(model=PaperModel(**tables))
    else:
        own = [getattr(M10, name) for name in M10_PARAMETERS]
    other = 1.1 * np.array(own)
    simulated = {"paper": paper, "m10": m10}[kind](np.stack([own, other], axis=1), load[:, None], dt)
    forward = cell.forward(())
    for seconds in (1e6, 1e8):
        settled = float(forward.step(seconds, FULL * load[0]))
    found = [settled, *(float(forward.step(dt, FULL * level)) for level in load[1:])]
    assert simulated[:, 0] == pytest.approx(np.array(found) / cell.rest_resistance_ohm - 1, abs=1e-7)
    assert load.max() < 0.01 or np.abs(simulated[:, 1] - simulated[:, 0]).max() > 0


# Whole histories at once: the same as step by step, however the history is cut, and for some of the cells only


FRAMES, SHAPE = 60, (2, 3)


def history(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps, holds, ramps and gaps: (frames,) dt_s and (frames, 2, 3) kPa."""
    random = np.random.default_rng(seed)
    levels = random.integers(0, 4, (FRAMES, *SHAPE)) * 4.0
    held = random.random((FRAMES, *SHAPE)) < 0.5
    pressure = levels * ~held + np.roll(levels, 1, axis=0) * held
    pressure[random.random(FRAMES) < 0.3] = 0.0
    return random.choice([0.0, 0.01, 0.01, 0.5, 30.0], FRAMES), pressure


@pytest.mark.parametrize("kind", CELLS)
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), cut=st.integers(0, FRAMES))
def test_a_history_at_once_is_the_history_step_by_step(kind: str, seed: int, cut: int) -> None:
    dt, pressure = history(seed)
    rest = np.random.default_rng(seed).uniform(5e3, 2e4, SHAPE)
    stepped, run = (CELLS[kind].forward(SHAPE, rest_resistance_ohm=rest) for _ in range(2))
    expected = np.array([stepped.step(*step) for step in zip(dt, pressure, strict=True)])
    found = np.concatenate([run.run(dt[:cut], pressure[:cut]), run.run(dt[cut:], pressure[cut:])])
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    # The memory is the same as well: both go on alike.
    np.testing.assert_allclose(run.step(1.0, 5.0), stepped.step(1.0, 5.0), rtol=1e-11)


@pytest.mark.parametrize("kind", CELLS)
def test_some_of_the_cells_live_while_the_others_stay(kind: str) -> None:
    dt, pressure = history(5)
    cells = np.array([1, 3, 4])
    pressure.reshape(FRAMES, -1)[:, [0, 2, 5]] = 0.0
    everything, some = (CELLS[kind].forward(SHAPE) for _ in range(2))
    expected = everything.run(dt, pressure).reshape(FRAMES, -1)
    found = some.run(dt, pressure.reshape(FRAMES, -1)[:, cells], cells)
    np.testing.assert_array_equal(found, expected[:, cells])
    assert (expected[:, [0, 2, 5]] == CELLS[kind].forward(SHAPE).step(0.0, 0.0).flat[0]).all()
    np.testing.assert_array_equal(some.step(0.5, 3.0), everything.step(0.5, 3.0))


@pytest.mark.parametrize("kind", CELLS)
def test_cells_come_to_rest_once_they_have_forgotten(kind: str) -> None:
    cells = np.arange(6)
    skin = CELLS[kind].forward(SHAPE)
    press = np.array([9.0, 0.0, 2.0, 0.0, 0.0, 15.0])
    skin.run([0.0, 1.0], np.stack([press, press]), cells)
    assert skin.put_to_rest(cells, 1e-6).tolist() == [False, True, False, True, True, False]
    skin.run([0.0, 1e-9], np.zeros((2, 6)), cells)
    if kind != "contact":
        assert not skin.put_to_rest(cells, 1e-6)[0]
    skin.run([1e4], np.zeros((1, 6)), cells)
    assert skin.put_to_rest(cells, 1e-6).all()
    fresh = CELLS[kind].forward(SHAPE)
    dt, pressure = history(8)
    np.testing.assert_array_equal(skin.run(dt, pressure), fresh.run(dt, pressure))


@pytest.mark.parametrize(
    ("dt", "pressure"),
    [([-1.0], [[1.0]]), ([np.inf], [[1.0]]), ([1.0], [[np.nan]]), ([1.0, 1.0], [[1.0]]), ([1.0], [[1.0, 2.0]])],
)
def test_a_history_that_cannot_be_is_refused(dt: list[float], pressure: list[list[float]]) -> None:
    with pytest.raises(InputError, match=r"time steps|finite|shape"):
        EXAMPLE.forward((1,)).run(dt, pressure)


# The percolation law: its power, its pole, and the known cell on it; temperature and age; held loads


LAW = Percolation(fraction=0.015, rest_resistance_ohm=10e3, sensitivity=0.775)


def test_the_known_cell_is_on_the_curve() -> None:
    assert LAW.rest_resistance(0.015) == pytest.approx(10e3, rel=1e-14)
    assert LAW.sensitivities(0.015) == pytest.approx(0.775, rel=1e-12)
    assert LAW.resistance(0.015, 0.0) == pytest.approx(10e3, rel=1e-14)


def test_conduction_is_a_power_of_the_distance_to_the_threshold() -> None:
    fractions = np.geomspace(0.008, 0.3, 30)
    slope = np.polyfit(np.log(fractions - 0.006), np.log(LAW.rest_resistance(fractions)), 1)[0]
    assert slope == pytest.approx(-2.0, rel=1e-12)


@given(st.floats(0.0111, 0.2), st.floats(1.001, 1.5))
def test_resistance_and_sensitivity_rise_as_the_fraction_falls(fraction: float, ratio: float) -> None:
    assert LAW.rest_resistance(fraction) > LAW.rest_resistance(fraction * ratio)
    assert LAW.sensitivities(fraction) > LAW.sensitivities(fraction * ratio) > 0


def test_at_the_threshold_nothing_conducts() -> None:
    assert np.isinf(LAW.rest_resistance([0.006, 0.001])).all()
    assert np.isinf(LAW.sensitivities([0.006, 0.0065])).all()


@pytest.mark.parametrize("wrong", [{"fraction": 0.005}, {"sensitivity": 0.0}, {"exponent": -1.0}])
def test_bad_families_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        Percolation(**{"fraction": 0.015, "rest_resistance_ohm": 10e3, "sensitivity": 0.775} | wrong)


def test_the_equilibrium_of_a_cell_is_what_its_forward_model_settles_to() -> None:
    cell = Cell.example()
    contact = cell.replace(model=ContactModel(exponent=0.9, full_scale_resistance_ohm=500))
    for kind in (cell, contact, cell.replace(log_span=2.0)):
        forward = kind.forward(())
        forward.step(1.0, 0.7 * kind.full_scale_kpa)
        settled = float(forward.step(1e6, 0.7 * kind.full_scale_kpa))
        assert float(kind.equilibrium_ohm(0.7)) == pytest.approx(settled, rel=1e-9)
        assert kind.falls == (settled < kind.rest_resistance_ohm)


def test_temperature_and_age_move_the_rest_resistance() -> None:
    assert drifted_rest_resistance(1e4, temperature_change_c=1.0) == pytest.approx(1.07e4)
    warm = drifted_rest_resistance(1e4, temperature_change_c=3.0)
    assert drifted_rest_resistance(warm, temperature_change_c=-3.0) == pytest.approx(1e4)
    assert drifted_rest_resistance(1e4, age_s=9 * 3600, per_decade=0.05) == pytest.approx(1.05e4)
