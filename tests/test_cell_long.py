"""What only shows after long: a week of samples, an hour's load, gaps in the readings. Every estimator stands it."""

from __future__ import annotations

from collections.abc import Callable

import cells
import numpy as np
import pytest
from cells import DT, FULL

from ohmskin.cell import Cell, ContactModel, estimate_recording
from ohmskin.cell._cell import Calibrated
from ohmskin.cell.inversions import Limits, StaticCurve


def _unknown() -> Cell:
    return cells.unknown().found.cell


def _paper() -> Cell:
    return cells.paper().cell


EVERY = pytest.mark.parametrize(
    ("make", "name"),
    [
        (_unknown, "static"),
        (_unknown, "distilled"),
        (_paper, "paper"),
        (_paper, "inverse"),
    ],
)


@EVERY
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
    assert np.ptp(means[1:]) < 0.01 * FULL
    fresh = cell.estimator((50,), name)
    learned = float(np.abs(fresh.step(DT, np.full(50, rest))).max())
    assert learned <= 2 * float(fresh.std_kpa.max(initial=0.0, where=np.isfinite(fresh.std_kpa))) + 1e-9
    press = rest * (1 + 0.5 * np.sin(np.linspace(0, np.pi, 200)) ** 2)
    for one in (estimator, fresh):  # at rest as often as the presses, so that both know the noise alike
        for _ in range(100):
            one.step(DT, rest * (1 + 0.001 * rng.standard_normal(50)))
    for reading in press:
        late, first = (one.step(DT, np.full(50, reading)) for one in (estimator, fresh))
        # Of two cells at rest one may sleep already, and shows no load then.
        assert late == pytest.approx(first, abs=0.05 * FULL + learned)


@pytest.mark.slow
@EVERY
def test_an_hours_load_does_not_fade_by_more_than_the_stated_error(make: Callable[[], Cell], name: str) -> None:
    """Half of full scale for an hour, on the cell as identified: what the estimate loses is within two sd."""
    cell = make()
    time = np.concatenate([np.arange(0, 60, DT), np.arange(60, 3660, 1.0)])
    load = np.interp(time, [0, 5, 8, 3660], [0, 0, 0.5, 0.5]) * FULL
    forward = cell.forward(())
    steps = np.diff(time, prepend=0.0)
    read = np.array([float(forward.step(dt, p)) for dt, p in zip(steps, load, strict=True)])
    pressure, std = estimate_recording(cell.estimator((), name), time, read)
    assert std is not None
    early = np.searchsorted(time, 30.0)
    assert abs(pressure[-1] - pressure[early]) < 2 * (std[-1] + std[early])


@EVERY
@pytest.mark.parametrize("lost", [False, True])
def test_a_gap_widens_the_stated_error(make: Callable[[], Cell], name: str, lost: bool) -> None:
    """Whether a cell's samples are missing or whole frames: more doubt the longer. Who reads as at rest then, is."""
    cell = make()
    estimator = cell.estimator((2,), name)
    rest = cell.rest_resistance_ohm
    std: dict[float, np.ndarray] = {}
    for n in range(1200):
        time, reading = round(n * DT, 1), np.full(2, rest)
        if 20 <= time < 40:
            if lost:
                continue
            reading[0] = np.nan
        estimator.step(20.1 if lost and time == 40 else DT, reading)
        std[time] = estimator.std_kpa
    usual = std[19.9][0]
    assert std[40.0][0] == pytest.approx(usual, rel=0.05)
    assert std[119.9][0] == pytest.approx(usual, rel=0.01)
    if lost:
        assert std[40.0][1] == std[40.0][0]
    else:
        assert usual < std[21.0][0] < std[30.0][0] < std[39.9][0]
        assert std[39.9][0] < FULL
        assert std[39.9][1] == pytest.approx(usual, rel=0.05)


@EVERY
def test_a_load_that_came_in_a_gap_is_doubted_more_than_one_that_was_seen(make: Callable[[], Cell], name: str) -> None:
    """Presses that came and went meanwhile may have left a part of the reading behind; the doubt fades."""
    cell = make()
    forward = cell.forward(())
    loads = np.where(np.arange(1000) < 300, 0.0, 0.4 * FULL)
    read = np.array([float(forward.step(DT, load)) for load in loads])
    estimator = cell.estimator((2,), name)
    more = np.zeros(len(loads))
    for n, reading in enumerate(read):
        estimator.step(DT, np.array([np.nan if 280 <= n < 310 else reading, reading]))
        unseen, seen = estimator.std_kpa
        more[n] = np.sqrt(max(unseen**2 - seen**2, 0.0))
    assert more[279] == 0.0
    assert more[312] > 0.02 * FULL
    assert more[990] < 0.2 * more[312]


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


def test_taps_in_a_gap_leave_no_more_than_the_stated_error() -> None:
    """Drummed on before, during and after two seconds without readings; beside it a cell that nobody touched."""
    cell = Cell.example()
    forward = cell.forward(())
    time = np.arange(0, 14, 0.01)
    loads = np.where((time > 3) & (time < 9) & (time % 0.5 < 0.07), 7.0, 0.0)
    read = np.array([float(forward.step(0.01, load)) for load in loads])
    rng = np.random.default_rng(3)
    estimator = cell.estimator((2,))
    off, std = np.zeros((len(time), 2)), np.zeros((len(time), 2))
    for n, reading in enumerate(read):
        noisy = np.array([reading, cell.rest_resistance_ohm]) * (1 + 2e-4 * rng.standard_normal(2))
        pressure = estimator.step(0.01, np.full(2, np.nan) if 500 <= n < 700 else noisy)
        off[n], std[n] = pressure - [loads[n], 0.0], estimator.std_kpa
    after = slice(700, None)
    assert np.abs(off[after, 0]).max() > 5.0  # else this asks nothing
    assert (np.abs(off[after, 0]) < 3 * std[after, 0] + 0.1).all()
    assert std[710, 1] < 1.1 * std[490, 1]


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
    clean, sparked = cell.estimator((), name), cell.estimator((), name)
    off = np.zeros(len(time))
    for n, ohm in enumerate(read):
        off[n] = sparked.step(dt, 3.0 * ohm if during[n] else ohm) - clean.step(dt, ohm)
    assert np.abs(off[~during]).max() < 0.03 * FULL


@pytest.mark.slow
@pytest.mark.parametrize("name", ["static", "distilled"])
def test_a_hold_far_longer_than_any_recorded_is_doubted_more(name: str) -> None:
    """15 minutes of creep after a minute of presses: the sd grows with the hold, covers the error, falls at rest."""
    found, time, load, read, head_s = cells.short_presses()
    estimator = found.cell.estimator((), name)
    assert found.cell.estimators is not None
    assert 0 < found.cell.estimators.seen.longest_load_s < 30
    pressure, std = estimate_recording(estimator, time, read)
    assert std is not None
    held = (time > head_s + 2) & (time < head_s + 902)
    off = np.abs(pressure - FULL * load)
    assert np.mean((off < 2 * std)[held]) > 0.9
    early, late = (std[np.searchsorted(time, head_s + after)] for after in (10.0, 890.0))
    assert late > early + 0.1 * FULL
    rest = found.cell.rest_resistance_ohm
    other = found.cell.estimator((), name)
    other.restore(estimator.state())
    assert other.std_kpa == pytest.approx(estimator.std_kpa, rel=1e-9)
    for _ in range(1000):
        estimator.step(1.0, rest)
    assert estimator.std_kpa < early + 0.02 * FULL
