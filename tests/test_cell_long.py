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
    clean, sparked = cell.estimator((), name), cell.estimator((), name)
    off = np.zeros(len(time))
    for n, ohm in enumerate(read):
        off[n] = sparked.step(dt, 3.0 * ohm if during[n] else ohm) - clean.step(dt, ohm)
    assert np.abs(off[~during]).max() < 0.03 * FULL
