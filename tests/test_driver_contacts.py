"""Contacts: places and forces of presses that are known, and ids that last."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from boards import DESIGN, Wire, lossless, scene
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from uncompiled import switched_off

from ohmskin.common.arrays import FloatArray
from ohmskin.common.geometry import Geometry
from ohmskin.driver import MESSAGE_SCHEMAS, Contact, ContactTracker, messages_of
from ohmskin.driver._contacts import ContactsOfFrames, PressureView
from ohmskin.driver._touch import Memory
from ohmskin.driver._tracks import free_place
from ohmskin.driver._tuning import MEMORY_S, QUEUE
from ohmskin.emulator import Board
from ohmskin.errors import InputError

PITCH_M = 0.004
FULL_KPA = 20.0


def bump(shape: tuple[int, int], row: float, column: float, peak_kpa: float, sigma: float = 0.8) -> FloatArray:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    values: FloatArray = peak_kpa * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * sigma**2))
    return values


def tracker(shape: tuple[int, int] = (16, 16)) -> ContactTracker:
    return ContactTracker(Geometry.rectangle(shape, PITCH_M), FULL_KPA)


def track(frames: list[FloatArray], std_kpa: float = 0.0, step_s: float = 0.01) -> list[tuple[Contact, ...]]:
    one = tracker(frames[0].shape)
    return [one.update(k * step_s, frame, np.full(frame.shape, std_kpa)) for k, frame in enumerate(frames)]


def test_place_area_force_and_peak_of_a_block() -> None:
    pressure = np.zeros((16, 16))
    pressure[3:5, 10:13] = 10.0
    pressure[4, 12] = 16.0
    (contact,) = tracker().update(0.0, pressure, np.zeros((16, 16)))
    assert contact.area_mm2 == pytest.approx(6 * 16.0)
    assert contact.force_n == pytest.approx((5 * 10e3 + 16e3) * 16e-6)
    assert contact.peak_kpa == 16.0
    rows, columns = np.nonzero(pressure)
    weights = pressure[rows, columns]
    assert contact.y_mm == pytest.approx(4.0 * np.average(rows, weights=weights))
    assert contact.x_mm == pytest.approx(4.0 * np.average(columns, weights=weights))
    np.testing.assert_array_equal(contact.cells, np.argwhere(pressure > 0))


@given(st.floats(3, 12), st.floats(3, 12), st.floats(4, 20))
def test_a_bump_is_where_it_was_put(row: float, column: float, peak: float) -> None:
    (contact,) = tracker().update(0.0, bump((16, 16), row, column, peak), np.zeros((16, 16)))
    assert contact.y_mm == pytest.approx(4.0 * row, abs=0.4)
    assert contact.x_mm == pytest.approx(4.0 * column, abs=0.4)


def test_a_cell_joins_a_contact_at_more_deviations_than_it_leaves_it_at() -> None:
    """So that noise neither widens contacts nor makes them flicker."""
    frames = []
    for beside in (0.0, 2.3, 2.7, 1.2, 0.4):
        frames.append(np.zeros((16, 16)))
        frames[-1][4:6, 4:6], frames[-1][4, 6] = 9.0, 0.5 * beside
    assert [len(contact.cells) for (contact,) in track(frames, std_kpa=0.5)] == [4, 4, 5, 5, 4]


def test_what_comes_back_in_the_place_of_a_strong_press_is_a_contact_later_only() -> None:
    """8 % of it may be what it has left in the estimates, unless it was seconds ago."""
    press, none = np.zeros((16, 16)), np.zeros((16, 16))
    press[4:6, 4:6] = 10.0
    begun = track([press] * 30 + [none] * 5 + [0.08 * press] * 20 + [none] * 300 + [0.08 * press] * 20)
    assert [len(contacts) for contacts in begun] == [1] * 30 + [0] * 325 + [1] * 20


def test_of_fingers_that_jump_each_is_known_by_its_force() -> None:
    """In slow frames the nearest finger may be the other one."""
    before = bump((16, 16), 4.7, 3, 12.0) + bump((16, 16), 5.7, 9, 4.0)
    after = bump((16, 16), 8, 6, 12.0) + bump((16, 16), 3, 6, 4.0)
    for frames in ((before, after), (after, before)):
        one, other = track([*frames], step_s=0.04)
        assert [contact.id for contact in one] == [contact.id for contact in other]


@pytest.mark.parametrize(("frames", "step_s"), [(6, 1e-5), (200, 0.01)])
def test_a_finger_has_the_velocity_of_the_line_through_its_places(frames: int, step_s: float) -> None:
    """By least squares, whose weights fade with the memory of the g-h filter."""
    rng, one, x_mm = np.random.default_rng(3), tracker(), []
    for k in range(frames):
        column = 4.0 + 6.0 * k / frames + rng.uniform(-0.4, 0.4)
        (contact,) = one.update(k * step_s, bump((16, 16), 8, column, 10.0), np.zeros((16, 16)))
        x_mm.append(contact.x_mm)
    before_s = step_s * np.arange(1 - frames, 1)
    slope, _ = np.polyfit(before_s, x_mm, 1, w=np.exp(before_s / MEMORY_S / 2))
    assert one._memory.tracks["mm_per_s"][0, 0] == pytest.approx(slope, rel=1e-3)


@given(st.integers(0, 2**32), st.integers(1, 6))
def test_every_cell_is_in_at_most_one_contact_and_ids_are_distinct(seed: int, presses: int) -> None:
    rng = np.random.default_rng(seed)
    one = tracker()
    for k in range(5):
        pressure = sum(bump((16, 16), *rng.uniform(0, 15, 2), rng.uniform(1, 20)) for _ in range(presses))
        contacts = one.update(0.01 * k, np.asarray(pressure), np.full((16, 16), 0.1))
        cells = np.concatenate([np.empty((0, 2), dtype=int), *(contact.cells for contact in contacts)])
        assert len(np.unique(cells, axis=0)) == len(cells)
        assert len({contact.id for contact in contacts}) == len(contacts)
        assert [c.force_n for c in contacts] == sorted((c.force_n for c in contacts), reverse=True)
        for contact in contacts:
            assert contact.peak_kpa > 0.03 * FULL_KPA or k > 0


def fingers(paths: FloatArray, rate_hz: float, seed: int, noise_kpa: float = 0.1) -> list[tuple[Contact, ...]]:
    """Contacts of fingers with forces of their own. ``paths`` (fingers, frames, 2) are rows and columns of cells."""
    rng = np.random.default_rng(seed)
    shapes = rng.uniform([6.0, 0.7], [12.0, 0.9], (len(paths), 2))  # peak in kPa, width in cells
    frames = [
        np.sum([bump((16, 16), *place, *shape) for place, shape in np.stack([places, shapes], axis=1).tolist()], axis=0)
        + rng.normal(0, noise_kpa, (16, 16))
        for places in paths.swapaxes(0, 1)
    ]
    return track(frames, std_kpa=noise_kpa, step_s=1 / rate_hz)


def ids_at(contacts: tuple[Contact, ...], places: FloatArray) -> list[int]:
    """The ids of the contacts nearest to places (fingers, 2) of cells."""
    return [min(contacts, key=lambda c: float(np.hypot(c.y_mm / 4 - row, c.x_mm / 4 - col))).id for row, col in places]


def direction(angle: float) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle)])


def through_one_point(count: int, frames: int, seed: int) -> FloatArray:
    """Fingers that all pass by the middle of the skin, from everywhere, within a third of a cell and at once."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, 2 * np.pi) + np.arange(count) * (rng.uniform(1.05, np.pi) if count == 2 else 2.1)
    along = np.linspace(-6, 6, frames)[:, None]
    return np.array([7.5 + rng.normal(0, 0.3, 2) + along * direction(angle) for angle in angles])


def touching(frames: int, seed: int) -> FloatArray:
    """Two fingers that come together to two cells, stay so for as long, and go back where they came from."""
    third = frames // 3
    gap = np.concatenate([np.linspace(8, 2, third), np.full(third, 2.0), np.linspace(2, 8, third)])[:, None]
    towards = direction(np.random.default_rng(seed).uniform(0, 2 * np.pi))
    return np.array([7.5 + gap / 2 * towards, 7.5 - gap / 2 * towards])


def passing(frames: int, seed: int) -> FloatArray:
    """Two fingers that pass each other at the distance of a cell and a half."""
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    ahead, aside = direction(angle), direction(angle + np.pi / 2)
    along = np.linspace(-6, 6, frames)[:, None]
    return np.array([7.5 + along * ahead + 0.75 * aside, 7.5 - along * ahead - 0.75 * aside])


@pytest.mark.parametrize(("seed", "rate_hz"), [(0, 100.0), (1, 1000.0)])
@pytest.mark.parametrize("how", ["two cross", "three cross", "touch and part", "pass"])
def test_ids_survive_crossing_touching_and_parting(how: str, seed: int, rate_hz: float) -> None:
    """Ten to forty cells per second; merged for a tenth of a second to a second."""
    frames = 120 if rate_hz == 100 else 300
    paths = {
        "two cross": lambda: through_one_point(2, frames, seed),
        "three cross": lambda: through_one_point(3, frames, seed),
        "touch and part": lambda: touching(frames, seed),
        "pass": lambda: passing(frames, seed),
    }[how]()
    seen = fingers(paths, rate_hz, seed)
    merged = [k for k, contacts in enumerate(seen) if len(contacts) < len(paths)]
    assert len(merged) > frames / 12, "they must touch, or the test tries nothing"
    names = ids_at(seen[0], paths[:, 0])
    assert sorted(names) == list(range(1, len(paths) + 1))
    assert ids_at(seen[-1], paths[:, -1]) == names
    for contacts in seen:
        assert sorted(name for c in contacts for name in (c.id, *c.joined)) == sorted(names)


def test_json_names_the_contacts_that_have_run_into_another() -> None:
    frames = [bump((16, 16), 7, near, 9.0) + bump((16, 16), 7, 12, 8.0) for near in np.arange(6.0, 10.0, 0.1)]
    contacts = track(frames)[-1]
    with lossless(Wire(Board(scene(contact=[])))) as skin:
        message = messages_of(replace(next(skin), _contacts=lambda: contacts))["/ohmskin/frame"]
    (told,) = json.loads(json.dumps(message))["contacts"]
    assert (told["id"], told["joined"]) == (contacts[0].id, list(contacts[0].joined))
    assert {told["id"], *told["joined"]} == {1, 2}
    properties: Any = MESSAGE_SCHEMAS["/ohmskin/frame"]["properties"]
    assert set(told) == set(properties["contacts"]["items"]["properties"])
    assert set(message) == set(properties)


@pytest.mark.parametrize("stays", [0, 1])
def test_the_finger_that_stays_keeps_its_id_when_the_one_that_it_touched_is_lifted(stays: int) -> None:
    frames = []
    for k in range(60):
        near, force = 6.0 + min(0.2 * k, 3.9), 8.0 * min(max(55 - k, 0) / 10, 1.0)
        pressures = [7.0 if f == stays else force for f in (0, 1)]
        frames.append(bump((16, 16), 7, near, pressures[0]) + bump((16, 16), 7, 12, pressures[1]))
    seen = track(frames)
    names = ids_at(seen[0], np.array([[7.0, 6.0], [7.0, 12.0]]))
    assert len(seen[40]) == 1
    assert {seen[40][0].id, *seen[40][0].joined} == {1, 2}
    assert [c.id for c in seen[-1]] == [names[stays]]


def test_a_new_contact_gets_a_new_id_and_a_short_dropout_keeps_the_old_one() -> None:
    press, nothing = bump((16, 16), 8, 8, 10.0), np.zeros((16, 16))
    seen = track([press] + [nothing] * 10 + [press] + [nothing] * 40 + [press])
    ids = [contacts[0].id for contacts in seen if contacts]
    assert ids == [1, 1, 2]


def test_a_hand_of_eight_fingers_that_is_lifted_at_once_leaves_no_place_of_memory_out_of_bounds() -> None:
    """As plain Python, where an index beyond an array is an error: machine code would write there."""
    angles = np.arange(8) * np.pi / 4
    spread = [
        sum(bump((12, 12), 5.5 + d * np.sin(a), 5.5 + d * np.cos(a), 10.0, 0.6) for a in angles) for d in (5, 4.5)
    ]
    palm = [np.maximum(one, 9.5) for one in spread]
    untouched = [np.zeros((12, 12))]
    with switched_off():
        found = track([*spread, *palm, *untouched, *spread])
    assert [len(one) for one in found[:2]] == [8, 8]
    assert [len(one.joined) for one in found[3]] == [7]
    assert found[4] == ()
    assert {one.id for one in found[6]} == {one.id for one in found[0]}


def test_frames_of_one_moment_lift_fingers_as_others_do() -> None:
    """Boards of a joined skin may have sent at the same time; a finger's patch is that of the frame before."""
    three = np.sum([bump((4, 16), 1.5, c, 10.0, 0.6) for c in (2.0, 7.0, 12.0)], axis=0)
    frames = [three, bump((4, 16), 1.5, 2.0, 10.0, 0.6), np.zeros((4, 16)), three]
    with switched_off():
        found = track(frames, step_s=0.0)
    assert [len(one) for one in found] == [3, 1, 0, 3]
    assert {one.id for one in found[3]} == {one.id for one in found[0]}


def test_where_no_place_for_a_finger_is_free_the_one_lifted_first_is_forgotten() -> None:
    memory = Memory.of_nothing(2)
    (progress,), tracks = memory.progress, memory.tracks
    assert [int(free_place.function(progress, tracks)) for _ in tracks] == [0] * len(tracks)
    tracks["id"], tracks["seen_s"], progress.tracks = 1.0, np.roll(np.arange(len(tracks)), 3), len(tracks)
    assert free_place.function(progress, tracks) == 3


@given(st.lists(st.tuples(st.floats(0, 15), st.floats(0, 15), st.floats(5, 15)), max_size=3), st.floats(0.0, 1e4))
def test_contacts_do_not_depend_on_when_the_clock_began(
    places: list[tuple[float, float, float]], start_s: float
) -> None:
    """Fingers that come, jump and go within some frames: next to a cell it is the same finger, and far off another."""
    frames = [bump((16, 16), 3, 3, 9.0), np.zeros((16, 16)), *(bump((16, 16), *one) for one in places)]
    frames += [bump((16, 16), 12, 12, 9.0)]

    def ids(first_s: int) -> list[list[int]]:
        one = tracker()
        return [[c.id for c in one.update(first_s + k / 128, f, 0.0 * f)] for k, f in enumerate(frames)]

    assert ids(start_s) == ids(0)


def test_noise_makes_no_contacts_and_a_weak_press_does_not_flicker() -> None:
    """Noise of 1 kPa with a correct standard deviation; a press between the two thresholds once it has begun."""
    rng = np.random.default_rng(8)
    noise = [rng.normal(0, 1.0, (16, 16)) for _ in range(400)]
    assert not any(track(noise, std_kpa=1.0))
    press = bump((16, 16), 8, 8, 4.0, sigma=1.5)
    seen = track([2 * press + noise[0], *(press + sample for sample in noise)], std_kpa=1.0)
    present = [any(contact.cells.tolist().count([8, 8]) for contact in contacts) for contacts in seen]
    assert np.mean(present) > 0.9


@pytest.mark.parametrize("cells", [(slice(7, 8), slice(3, 6)), (slice(2, 5), slice(9, 10)), (slice(4, 5), slice(6, 8))])
def test_cells_of_one_line_are_no_contact_for_a_single_frame(cells: tuple[slice, slice]) -> None:
    """An impulse of a motor disturbs readings that are converted one after another, and none in the next frame."""
    press, nothing = np.zeros((16, 16)), np.zeros((16, 16))
    press[cells] = 8.0
    assert not any(track([nothing, press, nothing, nothing, press, nothing]))
    assert [len(contacts) for contacts in track([nothing, press, press, press, nothing])] == [0, 0, 1, 1, 0]


@pytest.mark.parametrize("cells", [(slice(7, 8), slice(3, 6)), (slice(5, 6), slice(7, 8))])
def test_a_held_press_of_one_line_is_a_contact_in_the_first_frame_that_is_asked_about(
    cells: tuple[slice, slice],
) -> None:
    """Who looks once, as before a grasp, has seen no frame before; a disturbance lasts for one frame in thousands."""
    press, one = np.zeros((16, 16)), tracker()
    press[cells] = 8.0
    assert [len(one.update(0.01 * k, press, np.full((16, 16), 1.2))) for k in range(15)] == [1] * 15


def when_found(
    cells: tuple[slice, slice], std_kpa: float, lasting_s: float, *, rise_s: float = 1e-3, faults_press: bool = True
) -> list[float]:
    """Times after the start of a press, in s, at which there is a contact, at 1000 frames per second.

    The press is 2 kPa after ``rise_s``.
    """
    pressure, one = (
        np.zeros((16, 16)),
        ContactTracker(Geometry.rectangle((16, 16), PITCH_M), FULL_KPA, faults_press=faults_press),
    )
    pressure[cells] = 2.0
    times = np.arange(-100, round(1e3 * lasting_s)) / 1e3
    shares = np.clip((times + 1e-3) / rise_s, 0.0, 1.0).tolist()
    std = np.full((16, 16), std_kpa)
    return [t for t, share in zip(times.tolist(), shares, strict=True) if one.update(t, share * pressure, std)]


@pytest.mark.parametrize("faults_press", [True, False])
@pytest.mark.parametrize("rise_s", [1e-3, 0.02])
def test_a_lone_cell_is_a_contact_in_its_second_frame_that_is_sure(faults_press: bool, rise_s: float) -> None:
    """Whether its reading was that of a bad contact is what the estimator tells."""
    lone = slice(5, 6), slice(7, 8)
    for std_kpa in (0.02, 0.1):
        assert when_found(lone, std_kpa, 0.09, rise_s=rise_s, faults_press=faults_press)[0] < 0.01


@pytest.mark.parametrize(
    "cells", [(slice(12, 13), slice(0, 3)), (slice(13, 16), slice(2, 3)), (slice(8, 9), slice(3, 9))]
)
def test_ends_and_long_parts_of_a_line_wait_for_a_tenth_of_a_second(cells: tuple[slice, slice]) -> None:
    assert when_found(cells, 0.3, 0.09) == []
    assert when_found(cells, 0.3, 0.2)


def test_neighbours_tell_together_of_a_load_that_no_cell_is_sure_of() -> None:
    """Neither does a column of a divider whose readings are all off, nor one row of a bad wire."""
    fingertip, std = bump((16, 16), 7, 7, 8.0, sigma=1.2), np.full((16, 16), 2.0)
    (contact,) = tracker().update(0.0, fingertip, std)
    assert (contact.y_mm, contact.x_mm) == (pytest.approx(7e3 * PITCH_M), pytest.approx(7e3 * PITCH_M))
    for line in ((slice(None), slice(7, 8)), (slice(7, 8), slice(None)), (slice(None), slice(6, 9))):
        off = np.zeros((16, 16))
        off[line] = 7.0
        assert tracker().update(0.0, off, std) == ()


def test_a_held_contact_keeps_its_force_while_its_deviation_grows() -> None:
    """What the material does in minutes is uncertain; the pressures do not fall."""
    press, one = np.zeros((16, 16)), tracker()
    press[5:9, 5:9] = 3.6
    for k, std_kpa in enumerate(np.linspace(0.2, 2.7, 100)):
        (contact,) = one.update(0.1 * k, press, np.full((16, 16), std_kpa))
    assert contact.force_n == pytest.approx(1e3 * PITCH_M**2 * 16 * 3.6)
    assert contact.force_std_n == pytest.approx(1e3 * PITCH_M**2 * 16 * 2.7)
    assert one.update(10.1, 0.0 * press, np.full((16, 16), 2.7)) == ()


@pytest.mark.parametrize("share", [0.1, 0.15, 0.2, 0.3, 0.4])
def test_a_cell_between_two_fingers_does_not_part_and_join_them_in_turns(share: float) -> None:
    """The valley between the fingers goes up and down by a twentieth about some depth."""
    frames = []
    for k in range(20):
        pressure = np.zeros((5, 7))
        pressure[2, [1, 2, 4, 5]] = 10.0
        pressure[2, 3] = (1 - share) * 10.0 * (1.05 if k % 2 else 0.95)
        frames.append(pressure)
    counts = [len(contacts) for contacts in track(frames)[1:]]
    assert min(counts) >= 1
    assert np.count_nonzero(np.diff(counts)) <= 1


@pytest.mark.parametrize("share", [0.012, 0.015, 0.0173, 0.0192, 0.025])
def test_a_cell_at_the_rim_does_not_come_and_go_in_turns(share: float) -> None:
    """Its pressure goes up and down by a tenth about some share of full scale."""
    frames = []
    for k in range(20):
        pressure = np.zeros((5, 7))
        pressure[2, [1, 2]] = 10.0
        pressure[2, 3] = share * FULL_KPA * (1.1 if k % 2 else 0.9)
        frames.append(pressure)
    counts = [len(contact.cells) for (contact,) in track(frames)[1:]]
    assert np.count_nonzero(np.diff(counts)) <= 1


@settings(max_examples=40)
@given(
    gap=st.floats(2.6, 6.0),
    angle=st.floats(0, 2 * np.pi),
    peaks=st.tuples(st.floats(6.0, 15.0), st.floats(6.0, 15.0)),
    sigma=st.floats(0.6, 1.2),
    smear=st.floats(0.3, 1.5),
    seed=st.integers(0, 2**32 - 1),
)
def test_two_fingers_are_two_contacts_once_the_valley_between_them_is_clear(
    gap: float, angle: float, peaks: tuple[float, float], sigma: float, smear: float, seed: int
) -> None:
    """Crosstalk presses all cells a little, so that every cell is above the threshold; 0.1 kPa of noise."""
    to = gap / 2 * direction(angle)
    fine = sum(bump((16, 16), *(7.5 + sign * to), peak, sigma) for sign, peak in zip((-1, 1), peaks, strict=True))
    pressure = np.asarray(fine) + smear
    ends = np.round(7.5 + np.outer([-1, 1], to)).astype(int)
    way = np.round(np.linspace(*ends, 40)).astype(int)
    valley = pressure[tuple(way.T)].min()
    lower = min(pressure[tuple(end)] for end in ends)
    assume(valley < 0.6 * lower)
    frame = pressure + np.random.default_rng(seed).normal(0, 0.1, (16, 16))
    contacts = [c for c in tracker().update(0.0, frame, np.full((16, 16), 0.1)) if c.peak_kpa > 2.5]
    assert len(contacts) == 2
    for end in ends:
        assert min(np.abs(contact.cells - end).sum(axis=1).min() for contact in contacts) <= 1


@settings(max_examples=25)
@given(
    place=st.tuples(st.floats(3, 12), st.floats(3, 12)),
    sigma=st.floats(0.6, 4.0),
    peak=st.floats(2.0, 20.0),
    std=st.floats(0.02, 0.6),
    unevenness=st.floats(0.0, 0.05),
    seed=st.integers(0, 2**32 - 1),
)
def test_one_press_is_never_parted_by_noise(
    place: tuple[float, float], sigma: float, peak: float, std: float, unevenness: float, seed: int
) -> None:
    """Ten frames of a fingertip or of half a hand, with cells whose gains differ."""
    rng = np.random.default_rng(seed)
    press = bump((16, 16), *place, peak, sigma) * rng.normal(1.0, unevenness, (16, 16))
    frames = [press + rng.normal(0, std, (16, 16)) for _ in range(10)]
    for contacts in track(frames, std_kpa=std):
        assert sum(contact.peak_kpa > max(6.0 * std, 0.3 * peak) for contact in contacts) <= 1


def big_scene() -> Board:
    what = DESIGN | {
        "array": {"rows": 8, "columns": 8, "row_lead": 20.0},
        "sheet": {"pitch": 0.01, "electrode_width": 0.008},
    }
    bumps = [
        {"bump": {"center": [2.0, 2.0], "sigma_cells": 0.8}, "load_kpa": [[0.2, 0.0], [0.3, 12.0], [3.0, 12.0]]},
        {"bump": {"center": [6.5, 6.0], "sigma_cells": 0.6}, "load_kpa": [[0.6, 0.0], [0.7, 9.0], [3.0, 9.0]]},
    ]
    return Board(scene(skin={"design": what}, contact=bumps, board={"frame_rate": 100.0}))


def test_contacts_of_a_skin_are_where_it_is_pressed() -> None:
    with lossless(Wire(big_scene())) as skin:
        frames = list(islice(skin, 120))
        assert frames[10].contacts == ()
        first, second = frames[-1].contacts
        assert frames[-1].contacts is frames[-1].contacts
    assert (first.x_mm, first.y_mm) == pytest.approx((20.0, 20.0), abs=1.0)
    assert (second.x_mm, second.y_mm) == pytest.approx((60.0, 65.0), abs=1.0)
    # The force under a bell is 2 pi sigma^2 times its peak; its skirt lies below the threshold.
    assert first.force_n == pytest.approx(2 * np.pi * 0.008**2 * 12e3, rel=0.1)


@pytest.mark.parametrize("asked_first", [0, 60, -1])
def test_contacts_are_the_same_in_whatever_order_frames_are_asked(asked_first: int) -> None:
    with lossless(Wire(big_scene())) as skin:
        each_at_once = [frame.contacts for frame in islice(skin, 120)]
    with lossless(Wire(big_scene())) as skin:
        frames = list(islice(skin, 60))
        if asked_first >= 0:
            frames[asked_first % 60].contacts  # noqa: B018  the request is what counts
        frames += islice(skin, 60)
        frames[asked_first].contacts  # noqa: B018
        assert [frame.contacts for frame in reversed(frames)] == each_at_once[::-1]


def test_frames_without_contacts_that_nobody_holds_are_forgotten() -> None:
    contacts, none = ContactsOfFrames(ContactTracker(Geometry.rectangle((1, 1), 0.01), FULL_KPA)), np.zeros((1, 1))
    held = []
    for number in range(20 * QUEUE):
        view = PressureView(0.01 * number, none, none, none > 0)
        contacts.pass_by(view)
        if number % QUEUE == 0:
            held.append(view)
    assert len(contacts._waiting) <= 2 * (len(held) + QUEUE)
    assert all(contacts.of(view) == () for view in held)


def test_cells_that_are_not_square_have_two_pitches() -> None:
    """The same pressures on cells of 5 mm along a row and 10 mm along a column."""
    press = bump((16, 16), 4.0, 9.0, 10.0)
    (square,) = ContactTracker(Geometry.rectangle((16, 16), 0.01), FULL_KPA).update(0.0, press, np.zeros((16, 16)))
    (oblong,) = ContactTracker(Geometry.rectangle((16, 16), (0.005, 0.01)), FULL_KPA).update(
        0.0, press, np.zeros((16, 16))
    )
    assert (oblong.x_mm, oblong.y_mm) == pytest.approx((45.0, 40.0), abs=0.1)
    assert (oblong.x_mm, oblong.y_mm) == pytest.approx((square.x_mm / 2, square.y_mm))
    assert oblong.force_n == pytest.approx(square.force_n / 2)
    assert oblong.area_mm2 == pytest.approx(square.area_mm2 / 2)


def test_a_skin_tells_the_pitch_of_oblong_cells_and_has_no_single_one() -> None:
    with lossless(Wire(big_scene()), pitch=(0.005, 0.01)) as skin:
        assert skin.pitch_xy_m == (0.005, 0.01)
        with pytest.raises(InputError, match="pitch_xy_m"):
            _ = skin.pitch_m
        contact = list(islice(skin, 120))[-1].contacts[0]
    assert (contact.x_mm, contact.y_mm) == pytest.approx((10.0, 20.0), abs=0.5)


def test_a_single_uncertain_cell_at_the_top_of_a_finger_does_not_join_it_to_its_neighbour() -> None:
    """The cells around the top tell of the valley, too."""
    pressure = bump((16, 16), 7.3, 5.4, 12.0, 0.9) + bump((16, 16), 7.3, 9.4, 9.0, 0.9)
    std = np.full((16, 16), 0.3)
    assert len(tracker().update(0.0, pressure, std)) == 2
    std[7, 9] = 3.0
    assert len(tracker().update(0.0, pressure, std)) == 2


@settings(max_examples=30)
@given(
    share=st.floats(0.02, 0.1),
    angle=st.floats(0, 2 * np.pi),
    peak=st.floats(5.0, 15.0),
    lasting_s=st.floats(0.1, 3.0),
)
def test_what_a_moving_finger_leaves_behind_is_no_contact(
    share: float, angle: float, peak: float, lasting_s: float
) -> None:
    """The estimates of the cells that it has passed keep up to a tenth of their largest pressure, and forget it."""
    behind, frames = np.zeros((16, 16)), []
    for along in np.linspace(-5.0, 5.0, 120):
        press = bump((16, 16), *(7.5 + along * direction(angle)), peak)
        behind = np.maximum(behind * np.exp(-0.01 / lasting_s), share * press)
        frames.append(np.maximum(press, behind))
    assert {contact.id for contacts in track(frames, std_kpa=0.02) for contact in contacts} == {1}


@pytest.mark.parametrize("fingers", [1, 2])
def test_hysteresis_keeps_a_contact_of_as_many_pieces_as_it_has_fingers(fingers: int) -> None:
    """A light press falls apart into two patches, both between the thresholds."""
    apart, whole, parts = np.zeros((3, 5, 9))
    apart[1:4, [1, 2, 6, 7]] = whole[1:4, 2:7] = 1.5 * 0.03 * FULL_KPA
    parts[1:4, 2:7] = 0.8 * 0.03 * FULL_KPA
    parts[1:4, 5] = 0.0
    begun, (before,), after = track([apart if fingers == 2 else whole, whole, parts])
    assert [contact.id for contact in begun] == [before.id, *before.joined] == sorted(contact.id for contact in after)
    assert max(len(contact.cells) for contact in after) == 9


@pytest.mark.parametrize(("sigma", "peak_kpa"), [(1.0, 9.0), (3.0, 9.0), (3.0, 1.5), (4.0, 4.0)])
def test_the_force_of_a_soft_contact_does_not_end_at_a_threshold(sigma: float, peak_kpa: float) -> None:
    """Cells around the touched ones bear the rest of the force: all of it is within two deviations."""
    row, column = np.mgrid[0:32, 0:32]
    pressure = peak_kpa * np.exp(-((row - 15) ** 2 + (column - 15) ** 2) / 2 / sigma**2)
    tracker = ContactTracker(Geometry.rectangle((32, 32), 0.005), 15.5)
    for n in range(20):
        (contact, *others) = tracker.update(0.02 * n, pressure, np.full((32, 32), 0.08)) or (None,)
    assert contact is not None
    assert not others
    truth_n = 25e-3 * float(pressure.sum())
    assert abs(contact.force_n - truth_n) < 2 * contact.force_std_n
    assert contact.force_n > 0.95 * truth_n


def test_the_rim_between_two_contacts_is_shared_out() -> None:
    row, column = np.mgrid[0:24, 0:32]
    one, other = (6.0 * np.exp(-((row - 12) ** 2 + (column - at) ** 2) / 2 / 2.0**2) for at in (8, 22))
    tracker = ContactTracker(Geometry.rectangle((24, 32), 0.005), 15.5)
    for n in range(20):
        contacts = tracker.update(0.02 * n, one + other, np.full((24, 32), 0.08))
    assert len(contacts) == 2
    for contact in contacts:
        assert contact.force_n == pytest.approx(25e-3 * float(one.sum()), rel=0.03)
