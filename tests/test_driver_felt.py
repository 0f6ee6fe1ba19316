"""Contacts in hard cases: coarse readings, cells that are not read, drift of the rest; and laws of symmetry."""

from __future__ import annotations

import json
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.bench import contacts as bench
from ohmskin.bench import contacts as played
from ohmskin.cell import Cell, ContactModel
from ohmskin.cli import run
from ohmskin.common.arrays import FloatArray
from ohmskin.common.geometry import Geometry
from ohmskin.driver import Contact, ContactTracker

PITCH_M, FULL_KPA, SHAPE = 0.004, 20.0, (12, 12)
CELL_N = 1e3 * PITCH_M**2
"""force on a cell under 1 kPa"""
DRIFT_KPA, KNOWN_DRIFT, DRIFT_PER_S = 2.0, 0.1, 0.003
"""a rest that has drifted as far as they do, relative; and how fast they do (docs/contacts.md)"""
MISSING_S, START_SHARE, RIM_SHARE = 0.2, 0.03, 0.005
"""a cell without a reading for longer is missing; least share of full scale that begins a contact, and that counts to
the force of one"""


def bump(row: float, column: float, peak: float, sigma: float = 0.8, shape: tuple[int, int] = SHAPE) -> FloatArray:
    rows, columns = np.indices(shape)
    return np.asarray(peak * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * sigma**2)))


def track(
    frames: FloatArray, std_kpa: float = 0.1, step_s: float = 0.01, drift_kpa: float = 0.0
) -> list[tuple[Contact, ...]]:
    """Contacts of pressures (frames, rows, columns)."""
    tracker = ContactTracker(Geometry.rectangle(frames.shape[1:], PITCH_M), FULL_KPA, drift_kpa)
    std = np.full(frames.shape[1:], std_kpa)
    return [tracker.update(step_s * k, frame, std) for k, frame in enumerate(frames)]


# -- laws ----------------------------------------------------------------------------------------------------------


def wandering(seed: int, shape: tuple[int, int] = SHAPE, frames: int = 25) -> FloatArray:
    """Two fingers that come, wander and go, noise, and a cell without a pressure."""
    rng = np.random.default_rng(seed)
    starts, speeds = rng.uniform(2, 9, (2, 2)), rng.normal(0, 0.15, (2, 2))
    peaks = rng.uniform(1.0, 8.0, 2)
    pressures = rng.normal(0, 0.1, (frames, *shape))
    for k in range(3, frames - 3):
        for start, speed, peak in zip(starts, speeds, peaks, strict=True):
            pressures[k] += bump(*(start + speed * k), peak, shape=shape)
    dead = rng.integers(0, 12, 2)
    pressures[:, dead[0], dead[1]] = np.nan
    return pressures


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_transposed_array_has_transposed_contacts(seed: int) -> None:
    frames = wandering(seed)
    seen, turned = track(frames), track(frames.swapaxes(1, 2))
    for one, other in zip(seen, turned, strict=True):
        assert sorted((c.force_n, c.x_mm, c.y_mm, c.interpolated_n, c.area_mm2) for c in one) == [
            pytest.approx((c.force_n, c.y_mm, c.x_mm, c.interpolated_n, c.area_mm2))
            for c in sorted(other, key=lambda c: c.force_n)
        ]
    # Contacts that begin in the same frame are numbered row by row.
    names = [
        {(c.id, min(other, key=lambda d: abs(d.force_n - c.force_n)).id) for c in one}
        for one, other in zip(seen, turned, strict=True)
    ]
    pairs = set().union(*names)
    assert len(pairs) == len({one for one, _ in pairs}) == len({other for _, other in pairs})


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), down=st.integers(0, 4), right=st.integers(0, 4))
def test_contacts_move_with_the_pressures(seed: int, down: int, right: int) -> None:
    """Rows and columns at rest around the array change nothing, on whichever sides they are."""
    frames = wandering(seed)

    def within(above: int, left: int) -> FloatArray:
        return np.pad(frames, ((0, 0), (above, 5 - above), (left, 5 - left)))

    for one, other in zip(track(within(0, 0)), track(within(down, right)), strict=True):
        assert len(one) == len(other)
        for before, after in zip(one, other, strict=True):
            assert before.id == after.id
            assert astuple(after)[3:6] == pytest.approx(astuple(before)[3:6])
            moved = after.y_mm - before.y_mm, after.x_mm - before.x_mm
            assert moved == pytest.approx((4.0 * down, 4.0 * right), abs=1e-9)
            np.testing.assert_array_equal(after.cells - before.cells, [[down, right]] * len(before.cells))


# -- joint rises ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tap", ["taps of 30 ms", "taps of 80 ms"])
def test_boards_of_8_bits_with_dividers_find_taps(tap: str) -> None:
    """At 1000 frames per second."""
    found = played.played(8, ("voltage-divider", "ground", 8, 4.0), scene(tap), np.random.default_rng(11), 1000.0)
    assert found.seen_percent > 80
    assert found.false <= 1


# -- cells that are not read -----------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(row=st.floats(2.0, 9.0), column=st.floats(2.0, 9.0), peak=st.floats(4.0, 15.0), turned=st.booleans())
def test_a_finger_across_a_dead_line_is_one_contact(row: float, column: float, peak: float, turned: bool) -> None:
    """Its force is between that of the read cells and the true one, and it says how much is interpolated."""
    truth = bump(row, column, peak)
    shown = truth.copy()
    dead = (slice(None), 6) if turned else (6, slice(None))
    shown[dead] = np.nan
    (contact,) = track(shown[None])[0]
    read = np.nansum(shown[tuple(contact.cells.T)]) * CELL_N
    assert contact.interpolated_n <= contact.force_n
    felt, loaded = contact.force_n - contact.interpolated_n, np.nansum(shown[shown > RIM_SHARE * FULL_KPA]) * CELL_N
    assert read * (1 - 1e-9) <= felt <= loaded * (1 + 1e-9)
    away = abs((column if turned else row) - 6)
    if away < 0.6:  # the finger lies across the line
        assert 0.1 < contact.interpolated_n / contact.force_n < 0.5
        assert contact.force_n < 1.02 * truth.sum() * CELL_N
        assert (contact.x_mm / 4, contact.y_mm / 4) == pytest.approx((column, row), abs=0.35)
    if away > 2.5:
        assert contact.interpolated_n == 0
        assert felt == pytest.approx(loaded)


def test_gaps_of_two_rows_and_one_sided_gaps_are_not_bridged() -> None:
    two = bump(4, 5, 9.0) + bump(7.5, 5, 9.0)
    two[5:7] = np.nan
    assert len(track(two[None])[0]) == 2
    rim = bump(0.4, 5, 9.0)
    rim[0] = np.nan
    (contact,) = track(rim[None])[0]
    assert contact.interpolated_n == 0
    assert contact.force_n < 0.8 * bump(0.4, 5, 9.0).sum() * CELL_N


def test_a_row_that_dies_is_bridged_after_a_while() -> None:
    """Its last pressures, at rest, count until then."""
    frames = np.array([bump(6, 5, 9.0)] * 100)
    unread = np.zeros(frames.shape, dtype=bool)
    unread[20:, 6] = True
    frames[:, 6] = 0.0
    tracker, std = ContactTracker(Geometry.rectangle(SHAPE, PITCH_M), FULL_KPA), np.full(SHAPE, 0.1)
    seen = [tracker.update(0.01 * k, frames[k], std, unread[k]) for k in range(100)]
    late = 20 + round(MISSING_S / 0.01) + 2
    assert all(len(contacts) == 2 for contacts in seen[1:39])  # 0.2 s after the last reading
    assert all(len(contacts) == 1 and contacts[0].interpolated_n > 0 for contacts in seen[late:])


# -- drift ---------------------------------------------------------------------------------------------------------


def slowly(rate_kpa_per_s: float, where: FloatArray, seconds: float = 30.0) -> FloatArray:
    time_s = np.arange(0.0, seconds, 0.1)[:, None, None]
    return np.asarray(rate_kpa_per_s * time_s * where)


@pytest.mark.parametrize("which", ["all", "one", "some"])
def test_a_rest_that_drifts_makes_no_contact(which: str) -> None:
    """3 % in 24 s made one; noise of the stated deviation comes on top."""
    where = np.zeros(SHAPE)
    where[{"all": slice(None), "one": (4, 5), "some": (slice(3, 6), slice(2, 7))}[which]] = 1.0
    per_s = 0.8 * DRIFT_PER_S / KNOWN_DRIFT * DRIFT_KPA
    frames = slowly(per_s, where)
    assert frames.max() > 2 * START_SHARE * FULL_KPA
    noise = np.random.default_rng(2).normal(0, 0.02, frames.shape)
    assert any(track(frames + noise, 0.05, 0.1))
    assert not any(track(frames + noise, 0.05, 0.1, DRIFT_KPA))


def test_a_press_on_a_skin_that_has_drifted_is_found_and_is_no_wider() -> None:
    drifted = slowly(0.04, np.ones(SHAPE))
    press = bump(6, 5, 3.0)
    frames = np.concatenate([drifted, [drifted[-1] + press] * 20, [drifted[-1]] * 20])
    seen = track(frames, 0.05, 0.1, DRIFT_KPA)
    assert not any(seen[: len(drifted)])
    alone = track(np.array([press]), 0.05)[0][0]
    for contacts in seen[len(drifted) : len(drifted) + 20]:
        assert [len(c.cells) for c in contacts] == [len(alone.cells)]
    assert not any(seen[-10:])


@pytest.mark.parametrize("peak", [1.0, 6.0])
@pytest.mark.parametrize("width", [0.5, 50.0])
def test_a_held_load_never_fades(peak: float, width: float) -> None:
    """Twenty minutes, of a stylus and of the whole skin, little above the threshold and far."""
    frames = np.concatenate([np.zeros((10, *SHAPE)), [bump(5, 5, peak, width)] * 1200])
    seen = track(frames, 0.05, 1.0, DRIFT_KPA)
    assert [len(contacts) for contacts in seen[12:]] == [1] * 1198
    assert seen[-1][0].force_n == seen[12][0].force_n


# -- scenes of the bench on a whole skin -------------------------------------------------------------------------------

AMPLIFIER, DIVIDER = played.BOARDS[0], ("voltage-divider", "ground", 12, 1.0)


def scene(name: str) -> played.Scene:
    return next(one for one in played.SCENES if one.name == name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two cross", "two pass, 1 cells", "two pass, 2 cells", "one rolls"])
def test_fingers_keep_their_ids_on_a_skin(name: str) -> None:
    """8 x 8 cells: fingers meet soon after they came. What a finger leaves behind may be a contact."""
    found = played.played(8, AMPLIFIER, scene(name), np.random.default_rng(1))
    assert found.ids_kept_percent == 100.0
    assert found.false <= 2
    assert found.found_percent > 98
    assert found.off_cells < 0.1


def test_a_finger_across_a_dead_row_of_a_skin_is_one_contact() -> None:
    """Its force is a lower bound."""
    found = played.played(8, AMPLIFIER, scene("across a dead row"), np.random.default_rng(1))
    assert (found.found_percent, found.ids_kept_percent, found.false) == (100.0, 100.0, 0)
    assert 0.75 < found.force_share < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("board", [AMPLIFIER, DIVIDER])
@pytest.mark.parametrize("name", ["drift of all cells", "drift of one cell"])
def test_a_skin_that_drifts_has_no_contacts(board: tuple[str, str, int, float], name: str) -> None:
    assert played.played(8, board, scene(name), np.random.default_rng(1)).false == 0


# Short taps make contacts, intermittent contacts and other electrical faults make none


EXAMPLE = Cell.example()
FALLING = Cell(
    rest_resistance_ohm=3300.0, full_scale_kpa=20.0, model=ContactModel(exponent=1.1, full_scale_resistance_ohm=900.0)
)
TAPPED_SHAPE = (8, 8)
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


def at_rest(frames: int, cell: Cell = EXAMPLE, shape: tuple[int, int] = TAPPED_SHAPE) -> FloatArray:
    return np.full((frames, *shape), cell.rest_resistance_ohm)


def tapped(tap: bench.Press, rate_hz: float = 100.0) -> FloatArray:
    """Ohm of the example cell, from rest to 0.3 s after the tap."""
    return bench.resistances([tap], TAPPED_SHAPE, rate_hz, tap.end_s + 0.3)


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
def test_intermittent_contacts_of_cells_that_are_no_neighbours_make_no_contact(
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
    ohm = bench.resistances(taps, TAPPED_SHAPE, 100.0, 2.6)
    truth = np.sum([tap.kpa(DT_S * np.arange(1.0, len(ohm) + 1), TAPPED_SHAPE) for tap in taps], axis=0)
    estimator = EXAMPLE.estimator(TAPPED_SHAPE)
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
