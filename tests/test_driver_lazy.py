"""Standard deviations that are computed when they are asked for: of their own frame, whoever asks and whenever."""

from __future__ import annotations

import threading
from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest
from boards import DESIGN, Wire, lossless, scene

from ohmskin.common.arrays import FloatArray
from ohmskin.driver import Frame
from ohmskin.emulator import Board

FRAMES = 160
PRESSES = [
    {"cells": [[1, 1]], "load_kpa": [[0.0, 0.0], [0.2, 0.0], [0.25, 15.5], [0.9, 15.5], [0.95, 0.0]]},
    {"cells": [[0, 0]], "load_kpa": [[0.0, 0.0], [0.5, 0.0], [0.55, 9.0], [0.7, 9.0], [0.75, 0.0]]},
]


def frames(each: Callable[[Frame], object], **readout: float) -> list[Frame]:
    """The frames of a board with noise, cells that differ, and a tare in between."""
    skin_table = {
        "design": DESIGN | {"readout": DESIGN["readout"] | readout},
        "spread": {"rest_percent": 2.0, "seed": 11},
    }
    board = Board(scene(skin=skin_table, board={"frame_rate": 100.0, "noise": 5e-4}, contact=PRESSES))
    taken = []
    with lossless(Wire(board)) as skin:
        for frame in islice(skin, FRAMES // 2):
            each(frame)
            taken.append(frame)
        skin.tare(5, force=True)
        for frame in islice(skin, FRAMES // 2):
            each(frame)
            taken.append(frame)
    return taken


@pytest.mark.parametrize("readout", [{}, {"reference_resistance": 33.2e3}], ids=["plain", "with cells at a limit"])
def test_a_deviation_asked_for_late_is_the_one_asked_for_at_once(readout: dict[str, float]) -> None:
    at_once: list[FloatArray] = []
    frames(lambda frame: at_once.append(frame.pressure_std), **readout)
    later = frames(lambda frame: None, **readout)
    if readout:
        assert len({frame.valid.tobytes() for frame in later}) > 2
    for frame, expected in reversed(list(zip(later, at_once, strict=True))):
        np.testing.assert_array_equal(frame.pressure_std, expected)


def test_all_who_ask_get_the_same_array_which_nobody_can_change() -> None:
    for frame in frames(lambda frame: None)[::80]:
        found: list[FloatArray] = []
        ready = threading.Barrier(4)

        def ask(frame: Frame = frame, found: list[FloatArray] = found, ready: threading.Barrier = ready) -> None:
            ready.wait()
            found.append(frame.pressure_std)

        threads = [threading.Thread(target=ask) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(found) == 4
        assert all(array is found[0] for array in found)
        assert frame.as_dict()["pressure_std"] is found[0]
        with pytest.raises(ValueError, match="read-only"):
            found[0][0, 0] = 0.0
