"""Short taps make contacts, contact sparks and other electrical faults make none."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.bench import contacts as bench
from ohmskin.cell import Cell, ContactModel
from ohmskin.cli import run
from ohmskin.common.arrays import FloatArray
from ohmskin.common.geometry import Geometry
from ohmskin.driver import ContactTracker

EXAMPLE = Cell.example()
FALLING = Cell(
    rest_resistance_ohm=3300.0, full_scale_kpa=20.0, model=ContactModel(exponent=1.1, full_scale_resistance_ohm=900.0)
)
SHAPE = (8, 8)
DT_S = 0.01
QUIET = 40
"""frames at rest, in which the noise becomes known"""


def contacts_of(ohm: FloatArray, cell: Cell = EXAMPLE, dt_s: float = DT_S, noise: float = 1e-3) -> list[int]:
    """Number of contacts in each frame (frames, rows, columns), read with relative noise."""
    shape = (ohm.shape[1], ohm.shape[2])
    estimator = cell.estimator(shape)
    tracker = ContactTracker(Geometry.rectangle(shape, 0.004), cell.full_scale_kpa, faults_press=estimator.side > 0)
    random = np.random.default_rng(0)
    numbers = []
    for n, frame in enumerate(ohm * (1.0 + noise * random.standard_normal(ohm.shape))):
        pressure = estimator.step(dt_s, frame)
        numbers.append(len(tracker.update(n * dt_s, pressure, estimator.std_kpa)))
    return numbers


def at_rest(frames: int, cell: Cell = EXAMPLE, shape: tuple[int, int] = SHAPE) -> FloatArray:
    return np.full((frames, *shape), cell.rest_resistance_ohm)


def tapped(tap: bench.Press, rate_hz: float = 100.0) -> FloatArray:
    """Ohm of the example cell, from rest to 0.3 s after the tap."""
    return bench.resistances([tap], SHAPE, rate_hz, tap.end_s + 0.3)


@settings(max_examples=40, deadline=None)
@given(
    row=st.floats(0.0, 7.0),
    column=st.floats(0.0, 7.0),
    width=st.floats(0.5, 1.0),
    share=st.floats(0.25, 0.9),
    duration_s=st.sampled_from([0.03, 0.05, 0.08]),
)
def test_a_short_tap_is_one_contact_at_once(
    row: float, column: float, width: float, share: float, duration_s: float
) -> None:
    """From its second frame on at the latest, and hardly longer than it lasts."""
    start_s = 0.4 + 1e-3
    tap = bench.Press.tap(start_s, duration_s, row, column, width, share * EXAMPLE.full_scale_kpa)
    seen = contacts_of(tapped(tap))
    first, last = round(start_s / DT_S), round((start_s + duration_s) / DT_S)
    assert not any(seen[: first - 1])
    assert 1 in seen[first : first + 3]
    assert all(number >= 1 for number in seen[first + 2 : last - 1])
    assert not any(seen[last + 4 :])


@settings(max_examples=40, deadline=None)
@given(
    cells=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=6, unique=True),
    factor=st.floats(1.1, 4.0),
    frames=st.integers(1, 9),
    rate_hz=st.sampled_from([100.0, 400.0]),
)
def test_sparks_of_cells_that_are_no_neighbours_make_no_contact(
    cells: list[tuple[int, int]], factor: float, frames: int, rate_hz: float
) -> None:
    """Up to 90 ms at 100 frames per second; several at once."""
    apart = [cells[0]]
    for cell in cells[1:]:
        if all(abs(cell[0] - other[0]) + abs(cell[1] - other[1]) > 1 for other in apart):
            apart.append(cell)
    ohm = at_rest(QUIET + 30)
    for row, column in apart:
        ohm[QUIET : QUIET + frames, row, column] *= factor
    assert not any(contacts_of(ohm, dt_s=1.0 / rate_hz))


@pytest.mark.parametrize("factor", [1.15, 3.0])
@pytest.mark.parametrize("where", ["row", "column", "all", "end of a row", "impulse"])
def test_faults_with_the_shape_of_the_wiring_make_no_contact(where: str, factor: float) -> None:
    """Bad lines and connectors, a crack that cuts the end of a line, and three readings disturbed in one frame."""
    places: dict[str, tuple[slice, slice]] = {
        "row": (slice(3, 4), slice(None)),
        "column": (slice(None), slice(0, 1)),
        "all": (slice(None), slice(None)),
        "end of a row": (slice(5, 6), slice(6, None)),
        "impulse": (slice(4, 5), slice(2, 5)),
    }
    frames = 1 if where == "impulse" else 8
    ohm = at_rest(QUIET + 30)
    ohm[(slice(QUIET, QUIET + frames), *places[where])] *= factor
    assert not any(contacts_of(ohm))


def test_a_tap_on_two_cells_of_one_line_is_a_contact_in_its_second_frame() -> None:
    """A narrow stylus between two cells; a disturbance of the converter would be over by then."""
    ohm = at_rest(QUIET + 30)
    ohm[QUIET : QUIET + 5, 3, 4:6] *= 1.3
    seen = contacts_of(ohm)
    assert seen[QUIET - 1 : QUIET + 6] == [0, 0, 1, 1, 1, 1, 0]


@pytest.mark.parametrize(("factor", "number"), [(0.5, 1), (2.0, 0)])
def test_a_bad_contact_adds_resistance_and_a_press_on_electrodes_that_touch_takes_it_away(
    factor: float, number: int
) -> None:
    ohm = at_rest(QUIET + 30, FALLING)
    ohm[QUIET : QUIET + 5, 3, 4] *= factor
    assert max(contacts_of(ohm, FALLING)) == number


def test_a_fingertip_as_wide_as_a_short_row_of_electrodes_that_touch_is_one_contact() -> None:
    """Their resistance falls by nearly all under a light load, so that the whole row has moved alike in r."""
    cell = Cell(
        rest_resistance_ohm=2e5, full_scale_kpa=50.0, model=ContactModel(exponent=0.9, full_scale_resistance_ohm=1500.0)
    )
    shape = (8, 5)
    row, column = np.indices(shape)
    load = np.zeros((QUIET + 30, *shape))
    load[QUIET : QUIET + 12] = 25.0 * np.exp(-((row - 3.8) ** 2 + (column - 1.4) ** 2) / 2.0)
    forward = cell.forward(shape)
    ohm = np.array([forward.step(DT_S, frame) for frame in load])
    assert contacts_of(ohm, cell) == [0] * QUIET + [1] * 12 + [0] * 18


@pytest.mark.parametrize("where", [(slice(3, 5), slice(None)), (slice(None), slice(0, 1)), (slice(None), slice(None))])
def test_lines_of_electrodes_that_touch_which_conduct_more_at_once_make_no_contact(where: tuple[slice, slice]) -> None:
    """As the converter of a column that is off: it reads all cells of the line alike."""
    ohm = at_rest(QUIET + 30, FALLING)
    ohm[(slice(QUIET, QUIET + 8), *where)] *= 0.5
    assert not any(contacts_of(ohm, FALLING))


def test_a_tap_leaves_rest_behind_and_its_deviation_is_honest() -> None:
    """Errors within three deviations nearly always: those of taps on a whole array were stated as half of the jump."""
    taps = [bench.Press.tap(0.4 + 0.4 * k, 0.05, 1.0 + k, 6.0 - k, 0.7, 10.0) for k in range(5)]
    ohm = bench.resistances(taps, SHAPE, 100.0, 2.6)
    truth = np.sum([tap.kpa(DT_S * np.arange(1.0, len(ohm) + 1), SHAPE) for tap in taps], axis=0)
    estimator = EXAMPLE.estimator(SHAPE)
    noisy = ohm * (1.0 + 1e-3 * np.random.default_rng(5).standard_normal(ohm.shape))
    found = np.array([(estimator.step(DT_S, frame), estimator.std_kpa) for frame in noisy])
    error, std = np.abs(found[:, 0] - truth), found[:, 1]
    pressed = truth > 2.0
    assert np.mean(error[pressed] < 2 * std[pressed]) > 0.9
    assert np.median(std[pressed]) < 0.15 * np.median(truth[pressed])
    assert np.abs(found[-10:, 0]).max() < 0.5


@pytest.mark.parametrize("kind", bench.FAILURES)
def test_contacts_that_fail_are_no_fingers(kind: str) -> None:
    """Of a whole skin."""
    scene = next(one for one in bench.SCENES if one.failing == kind)
    found = bench.played(8, bench.BOARDS[0], scene, np.random.default_rng(1))
    assert (found.false, found.false_s) == (0, 0.0)


def test_the_command_prints_what_was_found(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A board of 4 x 4 cells, which has scenes of taps and of contacts that fail; the rows as text and as JSON."""
    monkeypatch.setattr(bench, "BOARDS", bench.BOARDS[:1])
    monkeypatch.setattr(bench, "SCENES", [bench.SCENES[0], bench.SCENES[-1]])
    assert run(["bench", "--contacts", "--size", "4"]) == 0
    assert "4 x 4" in capsys.readouterr().out
    assert run(["bench", "--contacts", "--size", "4", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["size"], row["scene"], row["rate_hz"]) for row in rows] == [
        (4, "impulse fails", 100.0),
        (4, "impulse fails", 1000.0),
    ]
