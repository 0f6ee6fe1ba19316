"""What every estimator promises: smoothing, noise, sleep, faults, deviations, saved states, refusal of bad input."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from typing import Any

import cells
import numpy as np
import pytest
from boards import DESIGN, Wire, lossless, scene
from cells import DT, EXAMPLE, FULL, exactly
from hypothesis import given, settings
from hypothesis import strategies as st
from uncompiled import switched_off

from ohmskin.bench import scenarios, scenes
from ohmskin.cell import Cell, ContactModel, Estimator, M10Model, estimate_recording
from ohmskin.cell._cell import Calibrated
from ohmskin.cell.inversions import Limits, StaticCurve
from ohmskin.common.arrays import FloatArray
from ohmskin.common.config import parse
from ohmskin.common.measurement import Measurement
from ohmskin.emulator import Board
from ohmskin.errors import InputError

DT_S = 0.01
REST_OHM, FULL_KPA = EXAMPLE.rest_resistance_ohm, EXAMPLE.full_scale_kpa
KINDS = {kind: scenes.cells()[kind] for kind in ("example", "contact")}
EVERY = pytest.mark.parametrize("cell", KINDS.values(), ids=KINDS)


def stepped(estimator: Estimator, ohms: FloatArray, dt_s: float = DT_S) -> tuple[FloatArray, FloatArray]:
    """Pressures and standard deviations in kPa, each as ``ohms`` (frames, *cells)."""
    pressure, std = np.empty((2, *ohms.shape))
    for n, frame in enumerate(ohms):
        pressure[n] = estimator.step(dt_s, frame)
        std[n] = estimator.std_kpa
    return pressure, std


def sensed(cell: Cell, share: FloatArray, noise: float, seed: int = 0, dt_s: float = DT_S) -> FloatArray:
    """Readings in ohm of shares of full scale (frames, *cells); noise of conductances, relative to that at rest."""
    ohms = cell.forward(share.shape[1:]).run(np.full(len(share), dt_s), share * cell.full_scale_kpa)
    scale = min(cell.rest_resistance_ohm, float(ohms.min()))
    return np.asarray(1.0 / (1.0 / ohms + noise / scale * np.random.default_rng(seed).standard_normal(ohms.shape)))


def presses(frames: int, cells: int = 6) -> FloatArray:
    """(frames, cells) shares of full scale: presses of other strengths, one cell of three is left alone."""
    time_s = DT_S * np.arange(frames)[:, None]
    strength = np.linspace(0.3, 0.9, cells)
    strength[::3] = 0.0
    return np.asarray(strength * np.interp((time_s - 0.6) % 1.5, [0.0, 0.1, 0.6, 0.7], [0, 1, 1, 0]) * (time_s > 0.6))


# -- smoothing and noise: the static curve is linear on this cell, so that pressures are the smoothed readings --


@pytest.mark.parametrize("slope_per_s", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_ramps_pass_without_lag_with_less_noise_than_readings_and_as_much_as_is_stated(
    slope_per_s: float, noise: float
) -> None:
    random, r = np.random.default_rng(1), slope_per_s * DT_S * np.arange(500)[:, None] + 0.1
    read = r + noise * (1.0 + r) ** 2 * random.standard_normal((500, 100))
    pressure, std = stepped(EXAMPLE.estimator((100,), "static"), REST_OHM * (1.0 + read))
    per_r = 1.0 / EXAMPLE.model.gain_per_kpa  # type: ignore[union-attr]
    error, raw = (pressure - per_r * r)[250:], (per_r * (read - r))[250:]
    assert abs(error.mean()) < 0.2 * raw.std()
    assert error.std() < 0.8 * raw.std()
    assert np.mean(np.abs(error) < 2.0 * std[250:]) > 0.95


def test_a_jump_is_followed_in_its_own_frame() -> None:
    read = np.where(np.arange(300) < 150, 0.05, 0.5)[:, None] + 1e-3 * np.random.default_rng(1).standard_normal(
        (300, 50)
    )
    pressure, _ = stepped(EXAMPLE.estimator((50,), "static"), REST_OHM * (1.0 + read))
    assert pressure[150] == pytest.approx(pressure[-1], rel=0.03)


@pytest.mark.parametrize("cells", [2, 64])
@pytest.mark.parametrize("rises", [1.0, 10.0])
def test_the_noise_is_measured_however_it_changes(cells: int, rises: float) -> None:
    """The deviation of a load that is held is that of its noise, also after the noise has risen for good."""
    random, noise = np.random.default_rng(5), np.where(np.arange(1800) < 600, 1e-3, rises * 1e-3)[:, None]
    read = 0.5 + noise * random.standard_normal((1800, cells))
    pressure, std = stepped(EXAMPLE.estimator((cells,), "inverse", noise=1e-3), REST_OHM * (1.0 + read))
    scatter, stated = pressure[1500:].std(axis=0).mean(), std[1500:].mean()
    assert scatter < stated < 0.1 * FULL_KPA * np.sqrt(rises)


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_deviations_grow_with_noise_and_where_a_cell_is_pressed(noise: float) -> None:
    share = np.interp(np.arange(400), [100, 110], [0, 1])[:, None] * [0.0, 0.6]
    std = [stepped(EXAMPLE.estimator((2,)), sensed(EXAMPLE, share, level))[1][-50:] for level in (noise, 10 * noise)]
    assert std[1].mean() > std[0].mean()
    assert std[0][:, 1].mean() > std[0][:, 0].mean()


# -- sleep --


def noisy_rest(frames: int, cells: int, noise: float = 1e-3) -> FloatArray:
    return np.asarray(REST_OHM * (1.0 + noise * np.random.default_rng(2).standard_normal((frames, cells))))


@pytest.mark.parametrize("frames", [300, 319])  # just after, and long after, the last look at cells that sleep
@pytest.mark.parametrize("restored", [False, True])
def test_a_skin_at_rest_shows_none_of_its_noise_and_wakes_at_the_first_press(frames: int, restored: bool) -> None:
    rest, estimator = noisy_rest(frames + 1, 30), EXAMPLE.estimator((30,))
    pressure, _ = stepped(estimator, rest[:-1])
    assert pressure[150:].max() < 0.02 * FULL_KPA
    assert pressure[-50:].mean() < 0.003 * FULL_KPA
    if restored:
        state, estimator = estimator.state(), EXAMPLE.estimator((30,))
        estimator.restore(state)
    rest[-1, 4] *= 1.3
    assert np.flatnonzero(estimator.step(DT_S, rest[-1]) > 1.0).tolist() == [4]


def test_a_load_below_the_noise_of_a_reading_is_seen_in_the_mean() -> None:
    """Four readings in five are within the noise of rest."""
    cells = noisy_rest(500, 20, 5e-3)
    cells[200:, :10] *= 1.012
    pressure, std = stepped(EXAMPLE.estimator((20,)), cells)
    load_kpa = 0.012 / EXAMPLE.model.gain_per_kpa  # type: ignore[union-attr]
    assert (np.abs(pressure[-1, :10] - load_kpa) < 2.0 * std[-1, :10] + 0.05).mean() > 0.8


# -- faults --


@pytest.mark.parametrize("name", ["static", "paper", "inverse"])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_missing_reading_holds_the_pressure_of_its_cell_alone(name: str, seed: int) -> None:
    """Under a load that holds meanwhile, the cell then reads on as if nothing had been missed."""
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(0.01, 0.1, 60))
    load = np.repeat(np.cumsum(random.standard_normal((6, 2)), axis=0) % FULL_KPA, 10, axis=0)
    load[:10] = 0.0
    resistance = EXAMPLE.forward((2,)).run(np.diff(time, prepend=time[0]), load)
    missing = (random.random(60) < 0.6) & (np.arange(60) % 10 > 0)
    holed = resistance.copy()
    holed[missing, 0] = random.choice([np.nan, np.inf])
    whole, found = (exactly(EXAMPLE, name, time, read) for read in (resistance, holed))
    assert found[:, 1] == pytest.approx(whole[:, 1], abs=1e-9)
    assert (found[1:, 0] == found[:-1, 0])[missing[1:]].all()


@pytest.mark.parametrize("ohm", [1.0, 1e6, 1e12])
def test_a_reading_that_no_load_can_give_leaves_no_trace(ohm: float) -> None:
    """A cell about to open reads some megohms for one sample: a memory that takes that in is off for minutes."""
    time = 0.05 * np.arange(400)
    read = EXAMPLE.forward(()).run(np.full(400, 0.05), FULL_KPA * ((time > 3) & (time < 15) | (time > 18)))
    clean, spoilt = exactly(EXAMPLE, "inverse", time, read), read.copy()
    spoilt[200] = ohm
    found = exactly(EXAMPLE, "inverse", time, spoilt)
    assert found[200] == found[199]
    np.testing.assert_allclose(found, clean, atol=5e-3 * FULL_KPA)


@EVERY
@pytest.mark.parametrize("share", [0.97, 0.7])
def test_a_reading_below_rest_leaves_no_load_beyond_the_deviation(cell: Cell, share: float) -> None:
    """No load leaves a resistance beyond that at rest: what a bad line or low supply does to the memory is in doubt."""
    beyond = 1.0 / share if cell.falls else share
    read = cell.rest_resistance_ohm * np.where((np.arange(400) > 100) & (np.arange(400) < 150), beyond, 1.0)[:, None]
    read = read * (1.0 + 5e-4 * np.random.default_rng(0).standard_normal((400, 4)))
    pressure, std = stepped(cell.estimator((4,)), read, 0.02)
    assert (np.abs(pressure) < 2.0 * std)[155:].all()
    assert (pressure[-1] < 0.5 * pressure[155] + 0.01 * cell.full_scale_kpa).all()


# -- columns of a divider, which share noise --

OWN, SHARED = 0.004, 0.012


def on_columns(share: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pressures and deviations (frames, 8, columns) in kPa, of columns that share noise."""
    random, cell = np.random.default_rng(0), EXAMPLE
    ohms = cell.forward(share.shape[1:]).run(np.full(len(share), DT_S), share * FULL_KPA)
    siemens = 1.0 / ohms
    siemens = siemens * (1.0 + SHARED * random.standard_normal((len(share), 1, share.shape[2])))
    siemens += OWN / REST_OHM * random.standard_normal(share.shape)
    estimator = cell.estimator(share.shape[1:])
    pressure, std = np.empty((2, *share.shape))
    for n, frame in enumerate(siemens):
        own = np.full(frame.shape, (OWN / REST_OHM) ** 2)
        told = Measurement.of(conductance=frame, noise_variance=own, column_std=SHARED * frame)
        pressure[n], std[n] = estimator.update(DT_S, told), estimator.std_kpa
    return pressure, std


def test_noise_that_a_column_shares_is_taken_out_where_cells_at_rest_tell_it() -> None:
    """A held cell, with seven at rest beside it, scatters by less than the shared noise does to it."""
    share = np.zeros((500, 8, 3))
    share[100:, 2] = 0.6
    pressure, std = on_columns(share)
    held = pressure[250:, 2]
    assert held.std() < 0.75 * SHARED * 1.465 / 0.97 * FULL_KPA
    assert np.mean(np.abs(held - 0.6 * FULL_KPA) < 2.0 * std[250:, 2]) > 0.9
    assert np.abs(pressure[250:, [0, 1, 3, 4, 5, 6, 7]]).mean() < 0.01 * FULL_KPA


@pytest.mark.parametrize("columns", [1, 6])
def test_a_load_on_whole_columns_is_no_noise(columns: int) -> None:
    """A plate moves all cells of a column alike, as shared noise does; beside a cell that is held before."""
    time_s = DT_S * np.arange(450)
    share = np.zeros((450, 8, 6))
    share[:, :, :columns] = 0.4 * np.interp(time_s, [2.0, 2.2], [0.0, 1.0])[:, None, None]
    share[:, 2, 0] = 0.5 * np.interp(time_s, [1.0, 1.1], [0.0, 1.0])
    pressure, _ = on_columns(share)
    off = np.abs(pressure - FULL_KPA * share)[:, :, :columns]
    assert np.sqrt(np.mean(off[280:] ** 2)) < 0.15 * FULL_KPA


# -- laws of all estimators --


@pytest.mark.parametrize("name", ["static", "paper", "inverse"])
def test_every_cell_is_on_its_own_and_has_its_own_rest_resistance(name: str) -> None:
    random, rest = np.random.default_rng(2), np.array([5e3, 1e4, 3e4])
    time = np.cumsum(random.uniform(0.005, 0.05, 200))
    load = np.cumsum(random.standard_normal((200, 3)), axis=0) % FULL_KPA
    read = EXAMPLE.forward((3,), rest_resistance_ohm=rest).run(np.diff(time, prepend=time[0]), load)
    estimator, steps = EXAMPLE.estimator((3,), name, rest_resistance_ohm=rest, noise=0.0), np.diff(time, prepend=0.0)
    together = np.array([estimator.step(float(dt), frame) for dt, frame in zip(steps, read, strict=True)])
    alone = np.stack([exactly(EXAMPLE, name, time, read[:, i] / rest[i] * REST_OHM) for i in range(3)], axis=1)
    assert together == pytest.approx(alone, abs=1e-7)


def test_an_overload_is_shown_as_one() -> None:
    time = 0.05 * np.arange(500)
    load = 2.0 * FULL_KPA * ((time > 5) & (time < 15))
    found = exactly(EXAMPLE, "inverse", time, EXAMPLE.forward(()).run(np.full(500, 0.05), load))
    assert (found[120:290] > FULL_KPA).all()


@given(
    rest_ohm=st.lists(st.floats(1e4, 1e6), min_size=1, max_size=5),
    pressure=st.floats(0.5, 20),
    exponent=st.floats(0.5, 2.0),
)
@settings(max_examples=30)
def test_contacts_of_different_rest_resistance_show_the_same_pressure(
    rest_ohm: list[float], pressure: float, exponent: float
) -> None:
    """A contact conducts beside the rest resistance of its cell; no cell may be read by the curve of another."""
    model = ContactModel(exponent=exponent, full_scale_resistance_ohm=5e3)
    cell = Cell(full_scale_kpa=20.0, rest_resistance_ohm=1e5, model=model)
    shape = (len(rest_ohm),)
    forward = cell.forward(shape, rest_resistance_ohm=rest_ohm)
    estimator = cell.estimator(shape, rest_resistance_ohm=rest_ohm, noise=0)
    for _ in range(2):  # in the first frame a deviation of some tenths of a kPa is stated
        found = estimator.step(0.01, forward.step(0.01, np.full(shape, pressure)))
    np.testing.assert_allclose(found, pressure, rtol=2e-3, atol=0.01)


def test_a_cell_whose_resistance_falls_is_estimated_with_memory() -> None:
    """r = ln(R0/R)/span: presses are followed, none is left after them, and an open cell bears none."""
    cell = EXAMPLE.replace(rest_resistance_ohm=20e3, full_scale_kpa=20.0, log_span=4.0)
    time = np.arange(0.0, 20.0, 0.02)
    load = np.interp(time, [0, 2, 2.2, 6, 6.1, 9, 11, 15, 15.2], [0, 0, 12, 12, 4, 4, 18, 18, 0])
    read = cell.forward(()).run(np.full(time.size, 0.02), load)
    read = read * np.exp(0.003 * np.random.default_rng(2).standard_normal(time.size))
    read[time > 18.0] = np.inf
    estimator = cell.estimator(())
    pressure, std = stepped(estimator, read, 0.02)
    assert np.sqrt(np.mean((pressure - load) ** 2)) < 0.02 * cell.full_scale_kpa
    assert np.mean(np.abs(pressure - load) < 2.0 * std) > 0.65
    assert np.abs(pressure[time > 18.5]).max() < 0.01 * cell.full_scale_kpa
    assert estimator.side < 0.0


# -- the paper's estimator on the paper's experiments --


def test_the_papers_estimator_inverts_the_papers_model_and_needs_its_threshold() -> None:
    """P9: steps with creep, without noise: exact. P8: with a threshold inside the settling slope a hold drifts."""
    time = np.arange(0, 80, 0.05)
    held = sum(((time > start) & (time < end)).astype(float) for start, end in ((10, 25), (35, 50), (60, 75)))
    load, steps = FULL_KPA * np.asarray(held), np.full(time.size, 0.05)
    found = exactly(EXAMPLE, "paper", time, EXAMPLE.forward(()).run(steps, load))
    assert found == pytest.approx(load, abs=1e-8)
    model: Any = EXAMPLE.model
    hasty = model.replace(recovery_threshold_per_s=0.3 * model.settling_slope_per_s(FULL_KPA))
    held = np.where(time > 5, FULL_KPA, 0.0)
    read = EXAMPLE.forward(()).run(steps, held)
    assert exactly(EXAMPLE, "paper", time, read)[-1] == pytest.approx(FULL_KPA, abs=1e-6)
    lost = exactly(EXAMPLE.replace(model=hasty), "paper", time, read)
    assert np.abs(lost[110:] - FULL_KPA).max() > 0.3


def test_the_papers_estimator_is_exact_at_every_turn() -> None:
    """Where dr/dt is that of the frame: pressure and resistance are continuous where the model changes."""
    model: Any = EXAMPLE.model
    time = 0.02 * np.arange(400)
    load = FULL_KPA * np.interp(time, [0.04, 2, 3.5, 5.5, 6.5, 8], [0, 0.5, 0.2, 0.8, 0.4, 0.9])
    read = EXAMPLE.forward(()).run(np.full(time.size, 0.02), load)
    assert exactly(EXAMPLE.replace(model=model.replace(derivative_s=0.0)), "paper", time, read) == pytest.approx(
        load, abs=1e-8
    )


# -- states, copies, kernels --

_NAMES = [("example", "static"), ("example", "paper"), ("example", "inverse"), ("contact", None)]
SAVED: dict[str, Callable[[Estimator], Estimator]] = {
    "pickled": lambda estimator: pickle.loads(pickle.dumps(estimator)),
    "copied": copy.deepcopy,
}


@pytest.mark.parametrize(("kind", "name"), _NAMES)
def test_a_saved_state_goes_on(kind: str, name: str | None) -> None:
    """To the last bit, through JSON, with gaps and in the middle of bad contacts; also as a copy and a pickle."""
    cell = KINDS[kind]
    read, random = sensed(cell, presses(260), 1e-3), np.random.default_rng(3)
    read[128:132, ::2] *= 2.5
    read[random.random(read.shape) < 0.01] = np.nan
    first, second = (cell.estimator((6,), name) for _ in range(2))
    stepped(first, read[:130])
    second.restore(json.loads(json.dumps({key: value.tolist() for key, value in first.state().items()})))
    others = [second, *(save(first) for save in SAVED.values())]
    expected = stepped(first, read[130:])
    for other in others:
        np.testing.assert_array_equal(stepped(other, read[130:]), expected)
    with pytest.raises(InputError, match="not a saved state"):
        cell.estimator((2,), name).restore(second.state())


@pytest.mark.parametrize(("kind", "name"), _NAMES)
def test_kernels_do_the_same_as_plain_python(kind: str, name: str | None) -> None:
    """With bad contacts, missing readings, a lost frame, steps of the ADC, and noise that columns share."""
    cell, random = KINDS[kind], np.random.default_rng(1)
    read = sensed(cell, presses(90, 6), 2e-3)[30::2].reshape(30, 3, 2)
    read *= 1.0 + 4e-3 * random.standard_normal((30, 1, 2))
    read[20:23, 1, 1] *= 2.5
    read[random.random(read.shape) < 0.01] = np.nan
    step, rest = np.full((3, 2), 1e-4), np.full((3, 2), cell.rest_resistance_ohm)

    def found() -> list[FloatArray]:
        estimator, values = cell.estimator((3, 2), name), []
        estimator.resolve(step, rest)
        for n, frame in enumerate(read):
            values += [estimator.step(0.3 if n == 10 else 2.0 * DT_S, frame), estimator.std_kpa]
        return values

    by_code = found()
    with switched_off():
        np.testing.assert_array_equal(found(), by_code)


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
def test_readings_of_any_layout_are_taken_as_they_are(layout: str) -> None:
    """Kernels that do not look at the types of their arrays, as in users' programs, get none of the user's own."""
    usual, estimator = (EXAMPLE.estimator((3, 4)) for _ in range(2))
    for ohm in np.rint(sensed(EXAMPLE, presses(40, 12), 1e-3)).reshape(-1, 3, 4):
        np.testing.assert_array_equal(estimator.step(DT_S, LAYOUTS[layout](ohm)), usual.step(DT_S, ohm))


# -- bad input, and the regression scenarios --


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


def test_the_default_of_no_cell_is_the_papers_switch() -> None:
    assert all(cell.default_estimator != "paper" for cell in scenes.cells().values())


@pytest.mark.slow
def test_deviations_are_honest_in_the_regression_scenarios() -> None:
    """Eight errors in ten within two deviations, on every quick row."""
    for verdict in scenarios.judge(scenarios.rows(quick=True), scenarios.maker(None)):
        today = verdict.row.today
        assert today is None or verdict.found.within > 80.0, verdict.row.name


def test_a_contact_without_memory_has_no_doubt_about_its_past() -> None:
    """First seen under a load, then released: what it was before leaves nothing."""
    model = ContactModel(full_scale_resistance_ohm=5e3)
    cell = Cell(rest_resistance_ohm=1e6, full_scale_kpa=100.0, model=model)
    forward, estimator = cell.forward((2,)), cell.estimator((2,))
    for n in range(100):
        load = np.array([40.0 if n < 50 else 0.0, 0.0])
        pressure = estimator.step(0.02, forward.step(0.02, load))
        if n in (45, 95):
            assert pressure == pytest.approx(load, abs=0.1)
            assert (estimator.std_kpa < 0.01 * load + 0.6).all()


@pytest.mark.parametrize("rest_ohm", [3e4, 1e5, 1e9])
def test_a_cell_of_a_contact_mat_that_is_not_read_may_bear_any_load_after_a_second(rest_ohm: float) -> None:
    """The slope of a contact's curve at rest tells nothing of the loads that its next reading may show."""
    model = ContactModel(full_scale_resistance_ohm=2e3)
    cell = Cell(rest_resistance_ohm=rest_ohm, full_scale_kpa=60.0, model=model)
    estimator, draw = cell.estimator((1,)), np.random.default_rng(0)
    stated = []
    for frame in range(120):
        read = rest_ohm * (1.0 + 0.002 * draw.normal()) if frame < 20 else np.nan
        estimator.step(0.01, [read])
        stated.append(estimator.std_kpa.item() / 60.0)
    assert max(stated[:21]) < 0.01  # while it is read, and just after
    assert stated[-1] > 0.25
    assert (np.diff(stated[20:]) > -1e-9).all()


# What only shows after long: a week of samples, an hour's load, gaps in the readings. Every estimator stands it


def _unknown() -> Cell:
    return cells.unknown().found.cell


def _paper() -> Cell:
    return cells.paper().cell


EVERY_S = pytest.mark.parametrize(
    ("make", "name"),
    [
        (_unknown, "static"),
        (_unknown, "distilled"),
        (_paper, "paper"),
        (_paper, "inverse"),
    ],
)


def test_an_estimator_that_is_learned_from_a_model_states_its_errors() -> None:
    """Loads of other kinds than it was taught by; its deviations are neither too small nor far too large."""
    cell = EXAMPLE.replace(model=M10Model(a=0.3, alpha1=0.4, rise1_s=0.3, fall1_s=4.0, alpha2=0.2, fall2_s=60.0))
    share = np.interp(DT * np.arange(900)[:, None], [3, 4, 20, 22, 50, 51, 70], [0, 1, 1, 0.3, 0.3, 0.8, 0]) * [
        0.9,
        0.5,
    ]
    pressure, std = stepped(cell.estimator((2,), "distilled", noise=0.0), sensed(cell, share, 0.0, dt_s=DT), DT)
    used = (pressure - FULL * share)[40:700] / std[40:700]
    assert np.mean(np.abs(used) < 2.0) > 0.8
    assert np.sqrt(np.mean(used**2)) > 0.1
    assert std[40:700].max() < 0.15 * FULL


@pytest.mark.parametrize(
    ("readings", "loads", "message"),
    [
        ((1.0,), (2.0,), "1 readings and 1 loads; expected as many, at least 2"),
        ((1.0, 2.0), (2.0, 3.0, 4.0), "2 readings and 3 loads"),
        ((1.0, 1.0), (2.0, 3.0), "readings must increase"),
        ((1.0, 2.0, 3.0), (2.0, 3.0, 1.0), "loads must rise, or fall, all along"),
    ],
)
def test_a_curve_that_is_no_function_is_refused(
    readings: tuple[float, ...], loads: tuple[float, ...], message: str
) -> None:
    tables = {"readings": readings, "loads": loads, "limits": {"lowest": 0, "highest": 1}, "std_kpa": 0.1}
    with pytest.raises(InputError, match=message):
        parse(tables, StaticCurve, source="curve")


@EVERY_S
def test_a_week_at_rest_leaves_no_drift(make: Callable[[], Cell], name: str) -> None:
    """Noise at rest, every ten minutes for a week: no trend, and a press after it is answered as on the first day."""
    cell = make()
    rest = cell.rest_resistance_ohm
    rng = np.random.default_rng(5)
    estimator = cell.estimator((50,), name)
    days = []
    for _ in range(1008):
        noisy = rest * (1 + 0.001 * rng.standard_normal(50))
        days.append(float(np.mean(estimator.step(600.0, noisy))))
    means = np.reshape(days, (7, -1)).mean(axis=1)
    # What a learned estimator shows at R0 ends when the cells sleep, within the first day, and is stated.
    assert np.ptp(means[1:]) < 0.02 * FULL
    fresh = cell.estimator((50,), name)
    learned = float(np.abs(fresh.step(DT, np.full(50, rest))).max())
    assert learned <= 2 * float(fresh.std_kpa.max(initial=0.0, where=np.isfinite(fresh.std_kpa))) + 1e-9
    press = rest * (1 + 0.5 * np.sin(np.linspace(0, np.pi, 200)) ** 2)
    for one in (estimator, fresh):  # at rest as often as the presses, so that both know the noise alike
        for _ in range(600):
            one.step(DT, rest * (1 + 0.001 * rng.standard_normal(50)))
    for reading in press:
        late, first = (one.step(DT, np.full(50, reading)) for one in (estimator, fresh))
        # Of two cells at rest one may sleep already, and shows no load then.
        stated = 3 * np.hypot(estimator.std_kpa, fresh.std_kpa)
        assert (np.abs(late - first) <= np.maximum(0.05 * FULL + learned, stated)).all()


@pytest.mark.parametrize("calibrated", [False, True])
def test_a_contact_has_no_doubt_about_a_gap_once_it_is_read_again(calibrated: bool) -> None:
    """It has no memory: under load, and at rest after it, the reading tells as much as if there had been no gap."""
    model = ContactModel(full_scale_resistance_ohm=4e3)
    cell = Cell(rest_resistance_ohm=6e4, full_scale_kpa=FULL, model=model)
    if calibrated:
        curve = StaticCurve(
            readings=(-0.9, 3.0),
            loads=(-0.333, 1.11),
            limits=Limits(lowest=0, highest=1.2),
            std_kpa=0.3,
            logarithmic=True,
        )
        found = Calibrated(default="static", reason="", held_out_percent={"static": 1.0}, static=curve)
        cell = cell.replace(estimators=found)
    forward = cell.forward(())
    estimator = cell.estimator((2,))
    for n in range(600):
        reading = float(forward.step(DT, 0.5 * FULL if 100 <= n < 400 else 0.0))
        estimator.step(DT, np.array([np.nan if 90 <= n < 300 or 350 <= n < 450 else reading, reading]))
        unseen, seen = estimator.std_kpa
        if n in (299, 449):
            assert unseen > 2 * seen
        if 310 <= n < 350 or n >= 460:
            assert unseen == pytest.approx(seen, rel=0.02)


@pytest.mark.parametrize("name", ["static", "distilled"])
def test_readings_with_gaps_are_within_the_stated_error(name: str) -> None:
    """Seconds to half a minute without a reading, over and over: nine in ten within two sd, missing ones included."""
    of = cells.unknown()
    rng = np.random.default_rng(7)
    read, n = of.read.copy(), 0
    while n < len(read):
        n += rng.integers(50, 300)
        gap = rng.integers(10, 300)
        read[n : n + gap] = np.nan
        n += gap
    pressure, std = estimate_recording(of.found.cell.estimator((), name), of.time, read)
    assert std is not None
    off = np.abs(pressure - FULL * of.load)[of.learned :]
    assert np.mean(off < 2 * std[of.learned :]) > 0.9
    missing = np.isnan(read[of.learned :])
    assert np.mean((off < 2 * std[of.learned :])[missing]) > 0.85


@pytest.mark.parametrize("name", ["static", "distilled"])
def test_a_bad_contact_of_a_calibrated_cell_is_over_when_it_is_over(name: str) -> None:
    """60 ms at three times the resistance, under load and at rest: what the cell remembers is put back."""
    cell, dt = cells.unknown().found.cell, 0.02
    time = np.arange(0, 12, dt)
    r = np.interp(time, [0, 1, 3, 7, 7.5], [0.0, 0.0, 0.1, 0.1, 0.0])
    rng = np.random.default_rng(0)
    read = cell.rest_resistance_ohm * (1 + r) * (1 + 1e-3 * rng.standard_normal(len(time)))
    during = (np.abs(time[:, None] - [5.02, 11.02]) < 1.5 * dt).any(axis=1)
    assert np.count_nonzero(during) == 6
    clean, disturbed = cell.estimator((), name), cell.estimator((), name)
    off = np.zeros(len(time))
    for n, ohm in enumerate(read):
        off[n] = disturbed.step(dt, 3.0 * ohm if during[n] else ohm) - clean.step(dt, ohm)
    assert np.abs(off[~during]).max() < 0.03 * FULL


# Readings at a limit of the converter are intervals: they tell what they exclude, and no more


RANGE_KPA, FULL_OHM = 50.0, 1000.0
SENSOR = Cell(
    rest_resistance_ohm=1e8,
    full_scale_kpa=RANGE_KPA,
    model=ContactModel(full_scale_resistance_ohm=FULL_OHM),
)
"""a force-sensing resistor: open at rest, and its conductance is proportional to the load"""


def read(siemens: float, least: float, greatest: float, step: float = 1e-6) -> Measurement:
    """One cell: ``siemens`` in the middle of a step, or NaN where only bounds are known."""
    known = np.isfinite(siemens)
    half = 0.5 * step if known else 0.0
    one = np.ones(1)
    return Measurement.of(
        conductance=siemens * one,
        noise_variance=1e-16 * known * one,
        half_step=half * one,
        least=least * one,
        greatest=greatest * one,
    )


@given(st.floats(1e-7, 1e-4), st.booleans())
def test_a_reading_below_a_step_bears_no_load_to_within_that_step(step: float, fresh: bool) -> None:
    """What is shown is less than the load that would read as a step."""
    estimator = SENSOR.estimator((1,))
    load_kpa = step * FULL_OHM * RANGE_KPA
    frames = 0 if fresh else 60
    for n in range(frames):
        press = 20 <= n < 40
        told = (400 * step, 399.5 * step, 400.5 * step) if press else (np.nan, 0.0, step)
        pressure = estimator.update(0.02, read(*told, step))
        if press and n > 35:
            assert pressure[0] == pytest.approx(min(400 * load_kpa, 3 * RANGE_KPA), rel=0.05)
    for _ in range(20):
        pressure = estimator.update(0.02, read(np.nan, 0.0, step, step))
    assert pressure[0] < load_kpa


def test_a_reading_at_the_upper_limit_is_at_least_the_load_of_the_limit() -> None:
    estimator = SENSOR.estimator((1,))
    for n in range(60):
        told = (np.nan, 0.6 / FULL_OHM, np.inf) if n > 20 else (np.nan, 0.0, 1e-6)
        pressure = estimator.update(0.02, read(*told))
    assert 0.6 * RANGE_KPA < pressure[0] < 1.1 * RANGE_KPA
    assert pressure[0] + 2.5 * estimator.std_kpa[0] > RANGE_KPA
    assert pressure[0] - 2.5 * estimator.std_kpa[0] < 0.7 * RANGE_KPA


def test_a_cell_whose_resistance_rises_has_its_load_bounded_from_above() -> None:
    """It reads a conductance beyond the converter's range: less load than that of the limit. No current: nothing."""
    cell = Cell.example()
    rest = 1.0 / cell.rest_resistance_ohm
    estimator = cell.estimator((1,))
    assert np.isnan(estimator.update(0.02, read(np.nan, 0.0, 0.1 * rest))).all()
    for _ in range(20):
        pressure = estimator.update(0.02, read(np.nan, 0.8 * rest, np.inf))
    assert pressure[0] == 0.0
    assert estimator.std_kpa[0] > 0.1 * cell.full_scale_kpa


def test_the_memory_of_a_load_beyond_the_range_is_in_doubt_after_its_release() -> None:
    """The inverse has followed the least load of the interval, so that the cell recovers from more than it knows."""
    cell = Cell.example().replace(log_span=2.0)  # its resistance falls
    estimator, random = cell.estimator((1,)), np.random.default_rng(1)
    load = 0.9 * cell.full_scale_kpa * np.interp(np.arange(400.0), [80, 84, 240, 244], [0, 1, 1, 0])
    siemens = 1.0 / cell.forward(()).run(np.full(400, 0.0125), load)
    step, most = siemens.max() / 1000, 0.5 * siemens.max()
    errors = []
    for truth, kpa in zip(siemens, load, strict=True):
        near = step * np.round(truth / step + 0.2 * random.standard_normal())
        told = (near, near - step / 2, near + step / 2) if near < most else (np.nan, most, np.inf)
        errors.append(abs(estimator.update(0.0125, read(*told, step))[0] - kpa) / estimator.std_kpa[0])
    assert np.mean(np.array(errors[40:]) < 2.5) > 0.9


def test_without_current_a_contact_is_at_rest_and_another_cell_is_not_read() -> None:
    contact, silicone = SENSOR.estimator(()), Cell.example().estimator(())
    for n in range(60):
        pressure = contact.step(0.02, 2500.0 if 20 <= n < 40 else np.inf)
        shown = silicone.step(0.02, np.inf if n > 30 else 10e3)
    assert pressure == 0.0
    assert contact.std_kpa < 0.02 * RANGE_KPA
    assert shown == 0.0
    assert silicone.std_kpa > 0.02 * Cell.example().full_scale_kpa


@given(st.floats(1.5, 1e4))
def test_a_contact_that_conducts_at_rest_is_not_connected_where_it_reads_no_current(factor: float) -> None:
    """Its load stays as it was. Intervals say the same where they exclude its rest resistance."""
    cell = SENSOR.replace(rest_resistance_ohm=5.0 * FULL_OHM)
    estimator, other = cell.estimator(()), cell.estimator((1,))
    bound = 1.0 / (cell.rest_resistance_ohm * factor)
    for n in range(50):
        pressed = 1.0 / (1.0 / cell.rest_resistance_ohm + 0.4 / FULL_OHM)
        pressure = estimator.step(0.02, pressed if n < 40 else np.inf)
        told = (1.0 / pressed, 0.99 / pressed, 1.01 / pressed) if n < 40 else (np.nan, 0.0, bound)
        bounded = other.update(0.02, read(*told))
    assert pressure == pytest.approx(0.4 * RANGE_KPA, rel=1e-3)
    assert bounded[0] == pytest.approx(0.4 * RANGE_KPA, rel=1e-3)
    assert estimator.std_kpa > 0.01 * RANGE_KPA


def test_readings_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="conductance has shape"):
        SENSOR.estimator((2,)).update(0.02, read(1e-4, 1e-4, 1e-4))


def test_a_mat_that_is_open_at_rest_is_tared_and_comes_back_to_no_load() -> None:
    """Counts of 0 at rest; a press of 3 kPa in between."""
    press = {"cells": [[2, 1]], "load_kpa": [[0.0, 0.0], [1.0, 0.0], [1.05, 3.0], [2.0, 3.0], [2.01, 0.0]]}
    mat = scene(skin={"design": DESIGN, "cell": SENSOR.model_dump()}, contact=[press])
    with lossless(Wire(Board(mat)), cell=SENSOR) as skin:
        tare = skin.tare(20)
        assert tare.remarks == ()
        frames = [skin.read() for _ in range(260)]
    shown = np.array([frame.pressure for frame in frames])
    assert np.nanmax(shown[:, 2, 1]) == pytest.approx(3.0, rel=0.05)
    np.testing.assert_array_equal(shown[-20:], 0.0)
    assert np.isfinite(shown).all()
