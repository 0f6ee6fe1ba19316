"""Readings at a limit of the converter are intervals: they tell what they exclude, and no more."""

from __future__ import annotations

import numpy as np
import pytest
from boards import DESIGN, Wire, lossless, scene
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.cell import Cell, ContactModel
from ohmskin.common.measurement import Measurement
from ohmskin.emulator import Board
from ohmskin.errors import InputError

FULL_KPA, FULL_OHM = 50.0, 1000.0
SENSOR = Cell(
    rest_resistance_ohm=1e8,
    full_scale_kpa=FULL_KPA,
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
    load_kpa = step * FULL_OHM * FULL_KPA
    frames = 0 if fresh else 60
    for n in range(frames):
        press = 20 <= n < 40
        told = (400 * step, 399.5 * step, 400.5 * step) if press else (np.nan, 0.0, step)
        pressure = estimator.update(0.02, read(*told, step))
        if press and n > 35:
            assert pressure[0] == pytest.approx(min(400 * load_kpa, 3 * FULL_KPA), rel=0.05)
    for _ in range(20):
        pressure = estimator.update(0.02, read(np.nan, 0.0, step, step))
    assert pressure[0] < load_kpa


def test_a_reading_at_the_upper_limit_is_at_least_the_load_of_the_limit() -> None:
    estimator = SENSOR.estimator((1,))
    for n in range(60):
        told = (np.nan, 0.6 / FULL_OHM, np.inf) if n > 20 else (np.nan, 0.0, 1e-6)
        pressure = estimator.update(0.02, read(*told))
    assert 0.6 * FULL_KPA < pressure[0] < 1.1 * FULL_KPA
    assert pressure[0] + 2.5 * estimator.std_kpa[0] > FULL_KPA
    assert pressure[0] - 2.5 * estimator.std_kpa[0] < 0.7 * FULL_KPA


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
    assert contact.std_kpa < 0.02 * FULL_KPA
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
    assert pressure == pytest.approx(0.4 * FULL_KPA, rel=1e-3)
    assert bounded[0] == pytest.approx(0.4 * FULL_KPA, rel=1e-3)
    assert estimator.std_kpa > 0.01 * FULL_KPA


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
