"""Calibration: known cells are found again, unknown materials are estimated with honest errors."""

from pathlib import Path

import numpy as np
import pytest

from ohmskin.bench import independent
from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel, protocol, simulate
from ohmskin.cell.calibrate import Calibration, calibrate, run
from ohmskin.cell.identify import fits, recovery_branches
from ohmskin.cell.inverse import margin
from ohmskin.cell.recording import Recording, checked
from ohmskin.errors import InputError

EXAMPLE = Cell.example()
DT = 0.1
FULL = EXAMPLE.full_scale_kpa


def sense(cell: Cell, load: np.ndarray, dt: float = DT) -> np.ndarray:
    forward = cell.forward(())
    return np.array([float(forward.step(dt, cell.full_scale_kpa * s)) for s in load])


def protocol_recording(cell: Cell, noise: float, seed: int = 0) -> Recording:
    time, load = protocol.load(DT)
    clean = sense(cell, load)
    return checked(time, FULL * load, clean * (1 + noise * np.random.default_rng(seed).standard_normal(len(load))))


@pytest.fixture(scope="module")
def paper() -> Calibration:
    """The example cell, from the 251 s protocol with 0.5 % noise."""
    return calibrate(protocol_recording(EXAMPLE, 0.005))


@pytest.fixture(scope="module")
def unknown() -> tuple[Calibration, np.ndarray, np.ndarray]:
    """Relays and fractional creep: half to learn from, then loads and readings to judge by."""
    rng = np.random.default_rng(3)
    load = independent.presses(rng, 900, DT, holds=True)
    read = independent.resistance(load, DT, rng)
    load, read = load[-6000:], read[-6000:]  # conditioned before
    part = len(load) // 2
    found = calibrate(checked(DT * np.arange(part), FULL * load[:part], read[:part]), full_scale_kpa=FULL)
    return found, load, read


def test_the_example_cell_is_found_again(paper: Calibration) -> None:
    model = paper.cell.model
    assert isinstance(model, PaperModel)
    truth = EXAMPLE.model
    assert isinstance(truth, PaperModel)
    assert paper.cell.rest_resistance_ohm == pytest.approx(1e4, rel=0.01)
    assert model.eu1_kpa == pytest.approx(truth.eu1_kpa, rel=0.02)
    assert model.overshoot - 1 == pytest.approx(truth.overshoot - 1, rel=0.1)
    assert model.tu_s == pytest.approx(truth.tu_s, rel=0.1)
    assert model.e1_kpa == pytest.approx(truth.e1_kpa, rel=0.03)
    assert model.t2_s == pytest.approx(truth.t2_s, rel=0.1)
    for parameter in paper.fit.parameters:
        assert parameter.std_error >= 0
    assert paper.cell.default_estimator == "inverse"
    assert "explains" in (paper.cell.estimators.reason if paper.cell.estimators else "")


def test_the_default_estimates_the_papers_experiments(paper: Calibration) -> None:
    """P9 after calibration, with noise of 0.5 % of R0: at most 2 % of full scale."""
    time = np.arange(0, 140, DT)
    rng = np.random.default_rng(4)
    for presses in ([(10, 40)], [(10, 25), (35, 50), (60, 75)]):
        load = sum(((time > a) & (time <= b)).astype(float) for a, b in presses)
        read = sense(EXAMPLE, np.asarray(load)) + 50 * rng.standard_normal(len(time))
        pressure, std = run(paper.cell.estimator(()), time, read)
        error = pressure / FULL - load
        assert np.sqrt(np.mean(error**2)) < 0.02
        assert std is not None
        assert np.mean(np.abs(error) * FULL < 2 * std) > 0.9


def test_an_unknown_material_is_estimated_better_than_by_its_static_curve(
    unknown: tuple[Calibration, np.ndarray, np.ndarray],
) -> None:
    found, load, read = unknown
    later = np.arange(len(load)) >= len(load) // 2
    time = DT * np.arange(len(load))

    def rmse(name: str | None) -> float:
        pressure, std = run(found.cell.estimator((), name), time, read)
        error = (pressure / FULL - load)[later]
        assert std is not None
        assert np.mean(np.abs(error) * FULL < 2 * std[later]) > 0.90
        return float(np.sqrt(np.mean(error**2)))

    best, static = rmse(None), rmse("static")
    assert best < static


def test_a_wrong_rest_resistance_is_survived(unknown: tuple[Calibration, np.ndarray, np.ndarray]) -> None:
    """R0 off by 3 % cannot be told from load; it costs the learned estimator no more than the static curve."""
    found, load, read = unknown
    time = DT * np.arange(len(load))

    def rmse(name: str, factor: float) -> float:
        rest = factor * found.cell.rest_resistance_ohm
        pressure, _ = run(found.cell.estimator((), name, rest_resistance_ohm=rest), time, read)
        return float(np.sqrt(np.mean((pressure / FULL - load) ** 2)))

    for factor in (0.97, 1.03):
        assert rmse("distilled", factor) < rmse("static", factor)


def test_a_held_load_does_not_fade_by_more_than_the_stated_error(
    unknown: tuple[Calibration, np.ndarray, np.ndarray],
) -> None:
    """Half of full scale for an hour, on the cell as identified: what the estimate loses is within two sd."""
    cell = unknown[0].cell
    time = np.concatenate([np.arange(0, 60, DT), np.arange(60, 3660, 1.0)])
    forward = cell.forward(())
    load = np.interp(time, [0, 5, 8, 3660], [0, 0, 0.5, 0.5]) * FULL
    dt = np.diff(time, prepend=0.0)
    read = np.array([float(forward.step(step, p)) for step, p in zip(dt, load, strict=True)])
    for name in ("play", "distilled"):
        pressure, std = run(cell.estimator((), name), time, read)
        assert std is not None
        early, late = np.searchsorted(time, 30.0), -1
        assert abs(pressure[late] - pressure[early]) < 2 * (std[late] + std[early])


def test_a_saved_cell_estimates_the_same(unknown: tuple[Calibration, np.ndarray, np.ndarray], tmp_path: Path) -> None:
    found, _, read = unknown
    found.cell.save(tmp_path / "cell.toml", comment="two\nlines")
    again = Cell.load(tmp_path / "cell.toml")
    assert again == found.cell
    time = DT * np.arange(200)
    for name in ("static", "play", "distilled"):
        assert (
            run(again.estimator((), name), time, read[:200])[0]
            == run(found.cell.estimator((), name), time, read[:200])[0]
        ).all()


def test_learned_estimators_keep_cells_apart(unknown: tuple[Calibration, np.ndarray, np.ndarray]) -> None:
    """Many cells with missing samples, against each alone; still cells keep their answer within the tolerance."""
    found, _, read = unknown
    rng = np.random.default_rng(6)
    frames = np.stack([read[start : start + 150] for start in rng.integers(0, len(read) - 150, 6)], axis=1)
    frames[rng.random(frames.shape) < 0.1] = np.nan
    many = found.cell.estimator((2, 3), "distilled")
    together = np.stack([many.update(DT * n, frame.reshape(2, 3)).pressure_kpa for n, frame in enumerate(frames)])
    for cell in range(6):
        alone = run(found.cell.estimator((), "distilled"), DT * np.arange(150), frames[:, cell])[0]
        assert together.reshape(150, 6)[:, cell] == pytest.approx(alone, abs=1e-4, nan_ok=True)


def test_contact_cells_are_told_apart() -> None:
    """P2: R falls with pressure; the exponent is found, the estimate is static, plateaus within 8 %."""
    model = ContactModel(exponent=0.9, full_scale_resistance_ohm=500)
    found = calibrate(protocol_recording(EXAMPLE.model_copy(update={"model": model}), 0.01))
    assert isinstance(found.cell.model, ContactModel)
    assert found.cell.model.exponent == pytest.approx(0.9, abs=0.03)
    assert found.cell.default_estimator == "static"
    time = np.arange(0, 60, DT)
    load = np.repeat([0.0, 0.25, 0.5, 0.75, 1.0, 0.3], 100)
    read = sense(EXAMPLE.model_copy(update={"model": model}), load)
    pressure, _ = run(found.cell.estimator(()), time, read)
    assert np.abs(pressure / FULL - load).max() < 0.08


def test_the_papers_graphical_way() -> None:
    """P6: the branches read from a recovery curve are those it was made of."""
    truth = EXAMPLE.model
    assert isinstance(truth, PaperModel)
    time = np.concatenate(([0.0], np.linspace(0.001, 400, 4001)))
    r = 15.5 * (np.exp(-time / truth.t2_s) / truth.e2_kpa + np.exp(-time / truth.t3_s) / truth.e3_kpa)
    r[0] = 15.5 * truth.gain_per_kpa
    e1, e2, e3, t2, t3 = recovery_branches(time, r, 15.5)
    assert (e1, e2, e3) == pytest.approx((truth.e1_kpa, truth.e2_kpa, truth.e3_kpa), rel=0.02)
    assert (t2, t3) == pytest.approx((truth.t2_s, truth.t3_s), rel=0.02)
    with pytest.raises(InputError, match="does not decay"):
        recovery_branches(time, 1 + time, 15.5)


def test_the_fast_simulation_is_the_forward_model() -> None:
    model = M10Model(a=0.3, b=-0.2, alpha1=0.5, rise1_s=0.3, fall1_s=4, alpha2=0.2, fall2_s=90, k=0.2, tau_s=20)
    load = simulate.random_loads(np.random.default_rng(1), 2000, 1, DT)
    parameters = np.array([[getattr(model, name)] for name in simulate.M10_PARAMETERS])
    fast = simulate.m10(parameters, load, DT)[:, 0]
    exact = sense(EXAMPLE.model_copy(update={"model": model}), load[:, 0]) / EXAMPLE.rest_resistance_ohm - 1
    assert fast == pytest.approx(exact, abs=0.01)
    assert np.sqrt(np.mean((fast - exact) ** 2)) < 0.001


def test_a_kind_that_forgets_is_not_taken_for_one_that_remembers() -> None:
    """One set of states: the asymmetric cell is found as such, without breakdown or hand-over."""
    model = AsymmetricModel(e1_kpa=32, e2_kpa=60, e3_kpa=480, eta2_kpa_s=510, eta3_kpa_s=48000)
    best = fits(protocol_recording(EXAMPLE.model_copy(update={"model": model}), 0.002), FULL)[0]
    assert isinstance(best.model, AsymmetricModel)
    assert best.model.e1_kpa == pytest.approx(32, rel=0.03)
    assert best.model.t2_s == pytest.approx(8.5, rel=0.1)
    assert margin(best.model, FULL) > 0


TIME = np.arange(0, 60, 0.1)
PRESS = 10.0 * ((TIME > 10) & (TIME < 30))
READ = 1e4 + 300 * PRESS


@pytest.mark.parametrize(
    ("time", "pressure", "resistance", "message"),
    [
        (TIME[:50], PRESS[:50], READ[:50], "too short"),
        (TIME, 0 * PRESS, READ, "pressure_kpa stays at 0"),
        (TIME, PRESS, 0 * READ + 1e4, "resistance_ohm stays at 10000"),
        (TIME, READ, PRESS, "are the columns exchanged"),
        (TIME, READ, 1 + PRESS, "never released"),
        (TIME[::-1], PRESS, READ, "time_s must increase"),
        (TIME, np.where(TIME > 5, np.nan, PRESS), READ, "pressure_kpa of sample 52 is nan"),
    ],
)
def test_nonsense_is_refused(time: np.ndarray, pressure: np.ndarray, resistance: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        checked(time, pressure, resistance)


def test_a_resistance_that_follows_nothing_is_refused() -> None:
    noise = np.random.default_rng(8).standard_normal(len(TIME))
    with pytest.raises(InputError, match="does not follow the pressure"):
        fits(checked(TIME, PRESS, 1e4 + 100 * noise), 10.0)


def test_the_protocol_is_checked() -> None:
    recording = protocol_recording(EXAMPLE, 0.0)
    assert len(protocol.check(recording, FULL)) == len(protocol.CONDITIONING) + len(protocol.PROTOCOL)
    assert len(protocol.check(recording)) == 11
    short = recording.time_s < 200
    cut = checked(recording.time_s[short], recording.pressure_kpa[short], recording.resistance_ohm[short])
    with pytest.raises(InputError, match="step 10 of the protocol is missing: hold 100 % of full scale for 60 s"):
        protocol.check(cut, FULL)
    text = protocol.describe()
    assert "hold 50 % of full scale for 20 s" in text
