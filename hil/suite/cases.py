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
from ohmskin.hil import BoardInService, Press, described

FULL_SCALE_KPA = 15.0
FRAMES = 200
"""frames in which a loss of 5 % goes unseen once in 30,000 runs"""


def test_frames_follow_each_other_without_a_gap(skin: Skin) -> None:
    first, *frames = [skin.read() for _ in range(FRAMES + 1)]
    if first.sequence is None:
        pytest.skip("not run: this board does not number its frames")
    gaps = {frame.sequence: frame.lost_before for frame in frames if frame.lost_before or frame.overrun}
    assert not gaps, f"frames lost before these of {FRAMES}: {gaps} (0: the board dropped some, the host was too slow)"


def test_every_cell_is_measured_at_rest(skin: Skin) -> None:
    frame = skin.read()
    assert frame.valid.all(), described(frame, ~frame.valid)


def test_the_skin_reads_little_pressure_at_rest(skin: Skin) -> None:
    skin.tare()
    frame = skin.read()
    pressed = ~(np.abs(frame.pressure) < 0.1 * FULL_SCALE_KPA)
    assert not pressed.any(), described(frame, pressed)


@pytest.mark.ohmskin_loads
def test_a_press_is_seen_where_it_is(skin: Skin, press: Press) -> None:
    skin.tare()
    with press(10.0, cells=[(1, 2)]) as load:
        frames = [load.read(skin) for _ in range(20)]  # the estimate settles within a few frames
    frame = frames[-1]
    elsewhere = ~(frame.pressure < frame.pressure[1, 2])
    elsewhere[1, 2] = False
    assert not elsewhere.any(), (
        f"{frame.pressure[1, 2]:.3g} kPa on the pressed cell (1, 2); {described(frame, elsewhere)}"
    )


@pytest.mark.ohmskin_loads
def test_a_harder_press_lowers_or_raises_the_counts_further(skin: Skin, press: Press) -> None:
    """The direction depends on the circuit; that it is the same for every step does not."""
    counts = []
    for kpa in (0.0, 5.0, 10.0, 15.0):
        with press(kpa, cells=[(0, 0)]) as load:
            counts.append(int(load.read(skin).counts[0, 0]))
    steps = np.diff(counts)
    assert (steps > 0).all() or (steps < 0).all(), f"cell (0, 0) at 0, 5, 10 and 15 kPa: {counts} counts"


@pytest.mark.ohmskin_hardware
def test_the_real_board_says_who_it_is(board: BoardInService, skin: Skin) -> None:
    """Only a real board has a serial number of its own; against an emulated one this is "not run"."""
    assert board.is_hardware
    assert skin.serial_number, f"the board at {board.port} states no serial number"
