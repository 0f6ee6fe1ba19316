"""Fast slides: what a finger leaves behind it within a frame is no contact, and what still presses is."""

from __future__ import annotations

import numpy as np
import pytest

from ohmskin.bench import _fingers as played
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import Contact, ContactTracker

PITCH_MM, FULL_KPA, SHAPE = 4.0, 20.0, (16, 16)
NOISE, STD_KPA = 1e-3, 0.05
LEFT = 0.5
"""share of a reading that a cell keeps which is unloaded as fast as it was loaded"""


def contacts_of(loads: FloatArray, left: float = LEFT, rate_hz: float = 100.0) -> list[tuple[Contact, ...]]:
    """Contacts of loads (frames, steps, rows, columns) in kPa, after half a second at rest.

    A cell reads, and shows as its pressure, its load at the frame's end, and no less than its residue: the share
    ``left`` of the largest load that it ever had.
    """
    one = ContactTracker(SHAPE, PITCH_MM / 1e3, FULL_KPA)
    rest = np.zeros((50, 1, *SHAPE))
    largest, found = np.zeros(SHAPE), []
    for k, load in enumerate([*rest, *loads]):
        largest = np.maximum(largest, load.max(axis=0))
        kpa = np.maximum(load[-1], left * largest)
        readings = 0.05 * kpa, np.full(SHAPE, NOISE)
        found.append(one.update(k / rate_hz, kpa, np.full(SHAPE, STD_KPA), readings))
    return found[len(rest) :]


def bump(row: FloatArray, column: FloatArray, peak_kpa: float = 10.0) -> FloatArray:
    """(..., rows, columns) of fingers in places (...)."""
    rows, columns = np.indices(SHAPE)
    away = (rows - row[..., None, None]) ** 2 + (columns - column[..., None, None]) ** 2
    load: FloatArray = peak_kpa * np.exp(-away / 1.4)
    load[load < 0.05] = 0.0
    return load


def way(speed: float, length: float, angle: float) -> tuple[FloatArray, FloatArray]:
    """(frames, 8) rows and columns of a finger that goes through the middle, by ``speed`` cells per frame."""
    along = np.arange(-length / 2, length / 2, speed / 8)
    along = along[: along.size // 8 * 8].reshape(-1, 8)
    return 7.5 + along * np.sin(angle), 7.5 + along * np.cos(angle)


def far(contact: Contact, row: float, column: float) -> float:
    return float(np.hypot(contact.y_mm / PITCH_MM - row, contact.x_mm / PITCH_MM - column))


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, 3.9])
@pytest.mark.parametrize("speed", [1.5, 2.0, 3.0])
def test_a_fast_slide_across_the_skin_leaves_no_contact_behind(speed: float, angle: float) -> None:
    rows, columns = way(speed, 26.0, angle)
    seen = contacts_of(np.concatenate([bump(rows, columns), np.zeros((20, 8, *SHAPE))]))
    ids = set()
    inside = (np.abs(rows[:, -1] - 7.5) < 7) & (np.abs(columns[:, -1] - 7.5) < 7)
    for frame in np.flatnonzero(inside)[3:].tolist():
        (contact,) = seen[frame]
        assert far(contact, rows[frame, -1], columns[frame, -1]) < speed
        ids.add(contact.id)
    assert len(ids) == 1
    assert not any(seen[-18:])


@pytest.mark.parametrize("speed", [1.5, 2.0, 3.0])
def test_a_finger_that_stops_after_a_fast_slide_is_held(speed: float) -> None:
    rows, columns = way(speed, 12.0, 0.3)
    held = np.repeat(bump(rows[-1:, -1:], columns[-1:, -1:]), 8, axis=1)
    seen = contacts_of(np.concatenate([bump(rows, columns), np.repeat(held, 100, axis=0)]))
    truth_n = 1e3 * held[0, 0].sum() * (PITCH_MM / 1e3) ** 2
    for contacts in seen[-90:]:
        (contact,) = contacts
        assert far(contact, rows[-1, -1], columns[-1, -1]) < 0.7
        assert contact.force_n == pytest.approx(truth_n, rel=0.25)


def test_a_press_on_cells_that_a_slide_has_left_is_found() -> None:
    rows, columns = way(2.0, 26.0, 0.0)
    loads = [bump(rows, columns), np.zeros((20, 8, *SHAPE))]
    loads.append(np.repeat(bump(np.array([[7.5]]), np.array([[6.0]])), 5, axis=0).repeat(8, axis=1))
    (contact,) = contacts_of(np.concatenate(loads))[-1]
    assert far(contact, 7.5, 6.0) < 0.3


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.0])
def test_a_bar_that_comes_down_from_one_end_to_the_other_stays_one_contact(speed: float) -> None:
    """Readings rise farther and farther on as under a slide, but none falls."""
    rows, columns = np.indices(SHAPE)
    ends = 2.0 + speed * np.arange(1, int(12 / speed) + 1)
    loads = [np.where((np.abs(rows - 7.5) < 1) & (columns >= 2) & (columns < end), 8.0, 0.0) for end in ends]
    seen = contacts_of(np.array([*loads, *loads[-1:] * 50])[:, None])
    covered = [int(np.count_nonzero(load)) for load in loads]
    assert [sum(len(contact.cells) for contact in contacts) for contacts in seen[: len(loads)]][1:] == covered[1:]
    (contact,) = seen[-1]
    assert len(contact.cells) == covered[-1]


@pytest.mark.parametrize("apart", [1, 2])
def test_two_fingers_that_come_down_one_after_the_other_are_both_there(apart: int) -> None:
    """``apart`` frames, and three cells from each other."""
    one, other = bump(np.array([[7.0]]), np.array([[6.0]])), bump(np.array([[7.0]]), np.array([[9.6]]), 8.0)
    loads = [one] * apart + [one + other] * 30
    force_n = [sum(contact.force_n for contact in contacts) for contacts in contacts_of(np.concatenate(loads))]
    truth_n = 1e3 * float((one + other).sum()) * (PITCH_MM / 1e3) ** 2
    assert force_n[-1] == pytest.approx(truth_n, rel=0.1)


@pytest.mark.parametrize("frames", [(2, 5), (2, 6), (3, 6)])
def test_two_fingers_that_come_down_together_within_some_frames_are_both_there(frames: tuple[int, int]) -> None:
    """Their readings rise as one first, then where the one presses, and at last where the other one does, at the rim.

    So do those of a slide that leaves the skin there. But none of them falls.
    """
    rim = bump(np.array([[13.5]]), np.array([[13.0]]), 3.6)
    inside = bump(np.array([[11.0]]), np.array([[10.0]]), 9.0)
    loads = [inside * min(frame / frames[0], 1.0) + rim * min(frame / frames[1], 1.0) for frame in range(1, 40)]
    truth_n = 1e3 * float((inside + rim).sum()) * (PITCH_MM / 1e3) ** 2
    for contacts in contacts_of(np.concatenate(loads), rate_hz=20.0)[10:]:
        assert sum(contact.force_n for contact in contacts) == pytest.approx(truth_n, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_flips_between_two_steps_of_the_adc_are_no_fall_behind_a_slide(seed: int) -> None:
    """A finger comes down, and tilts meanwhile, and another one beside it in the next frame: the heads of a slide.

    The largest reading of each cell is up to a step above the present one, though nothing has fallen.
    """
    rng, step, noise = np.random.default_rng(seed), 0.03, np.full(SHAPE, 0.015)
    one = ContactTracker(SHAPE, PITCH_MM / 1e3, FULL_KPA)
    for frame in range(40):
        finger = bump(np.array([[7.0]]), np.array([[6.0 if frame < 21 else 6.8]]), 8.0)
        other = bump(np.array([[7.3]]), np.array([[11.5]]), 6.0)
        kpa = (finger * np.interp(frame, [19, 20, 21], [0.0, 0.5, 1.0]) + other * (frame >= 22))[0, 0]
        reading = step * np.round(0.08 * kpa / step + rng.integers(0, 2, SHAPE))
        contacts = one.update(0.1 * frame, kpa, np.full(SHAPE, STD_KPA), (reading, noise))
        if frame > 21:
            truth_n = 1e3 * float(kpa.sum()) * (PITCH_MM / 1e3) ** 2
            assert sum(contact.force_n for contact in contacts) == pytest.approx(truth_n, rel=0.1)


def test_swipes_over_a_skin_leave_no_contact_behind() -> None:
    """Six swipes by a cell per frame, 10 mV of noise; without a look at their trails 0.8 s of contacts are left."""
    scene = next(one for one in played.SCENES if one.name == "swipe, 1 cells a frame")
    swipes = played.played(8, ("inverting-amplifier", "ground", 12, 10.0), scene, np.random.default_rng(0))
    assert swipes.false_s < 0.1
    assert swipes.found_percent == swipes.ids_kept_percent == 100.0
    assert swipes.force_share == pytest.approx(0.95, abs=0.1)
