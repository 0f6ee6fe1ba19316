"""Tests of a skin. They run against an emulated board, the firmware, or a real board::

    pytest                                         # the emulated board of scene.toml
    pytest --ohmskin-target firmware               # the reference board's firmware on an emulated processor
    pytest --ohmskin-target /dev/ttyACM0           # a real board; a person is asked to press
    pytest --ohmskin-target /dev/ttyACM0 --ohmskin-strict --junit-xml report.xml    # in a laboratory's CI

The fixtures ``board``, ``skin`` and ``press`` come with ohmskin. docs/hil.md describes them.
"""

import numpy as np
import pytest

from ohmskin.driver import Skin
from ohmskin.hil import BoardInService, Press

FULL_SCALE_KPA = 15.0


def test_frames_follow_each_other_without_a_gap(skin: Skin) -> None:
    frames = [skin.read() for _ in range(50)]
    assert sum(frame.lost_before or 0 for frame in frames) == 0
    assert not any(frame.overrun for frame in frames)


def test_every_cell_is_measured_at_rest(skin: Skin) -> None:
    frame = skin.read()
    assert frame.valid.all()


def test_the_skin_reads_little_pressure_at_rest(skin: Skin) -> None:
    skin.tare()
    assert np.abs(skin.read().pressure).max() < 0.1 * FULL_SCALE_KPA


@pytest.mark.ohmskin_loads
def test_a_press_is_seen_where_it_is(skin: Skin, press: Press) -> None:
    skin.tare()
    with press(10.0, cells=[(1, 2)]) as load:
        frames = [load.read(skin) for _ in range(20)]  # the estimate settles within a few frames
    pressure = frames[-1].pressure
    row, column = np.unravel_index(pressure.argmax(), pressure.shape)
    assert (int(row), int(column)) == (1, 2)


@pytest.mark.ohmskin_loads
def test_a_harder_press_lowers_or_raises_the_counts_further(skin: Skin, press: Press) -> None:
    """The direction depends on the circuit; that it is the same for every step does not."""
    counts = []
    for kpa in (0.0, 5.0, 10.0, 15.0):
        with press(kpa, cells=[(0, 0)]) as load:
            counts.append(int(load.read(skin).counts[0, 0]))
    steps = np.diff(counts)
    assert (steps > 0).all() or (steps < 0).all()


@pytest.mark.ohmskin_hardware
def test_the_real_board_says_who_it_is(board: BoardInService, skin: Skin) -> None:
    """Only a real board has a serial number of its own; against an emulated one this is "not run"."""
    assert board.is_hardware
    assert skin.serial_number
