"""What a usual frame costs is counted in calls of Python, which do not depend on the machine or its load."""

from __future__ import annotations

import cProfile
import pstats
from collections.abc import Callable

import numpy as np
import pytest
from designs import digitised

from ohmskin.bench._driver import APART_S, design, every_frame, packets_of, port_of, pressed
from ohmskin.cell import Cell
from ohmskin.circuits import adc_codes, scan
from ohmskin.driver import CountReader

WARM, COUNTED = 120, 60


def calls(take: Callable[[int], object]) -> float:
    """Calls for each frame of the last ones, profiled, after :data:`WARM` others."""
    for frame in range(WARM):
        take(frame)
    profile = cProfile.Profile()
    profile.enable()
    for frame in range(WARM, WARM + COUNTED):
        take(frame)
    profile.disable()
    return pstats.Stats(profile).total_calls / COUNTED  # type: ignore[attr-defined]


@pytest.mark.parametrize("kind", ["grounded", "divider", "loaded"])
def test_counts_become_a_measurement_in_a_few_calls(kind: str) -> None:
    board, draw = digitised(kind, 8, 8, 12, array={"row_lead": 5.0}), np.random.default_rng(0)
    assert board.adc is not None
    volts = scan(board, np.full((8, 8), 8e3)).volts
    frames = [adc_codes(board, volts + draw.normal(scale=board.adc.step, size=(8, 8))) for _ in range(WARM + COUNTED)]
    read = CountReader(board)
    assert calls(lambda frame: read(frames[frame])) <= 20


def test_bytes_become_a_frame_in_a_bounded_number_of_calls() -> None:
    """Under five fingers, with standard deviations."""
    board = design(8, "inverting-amplifier", "ground", 12)
    _, cells = pressed(board.array.shape, WARM + COUNTED)
    port = port_of(packets_of(board, cells), board)
    with every_frame(port, board, Cell.example(), None) as skin:

        def take(_: int) -> None:
            port.work(APART_S)
            assert skin.read(0.0).pressure_std.shape == (8, 8)

        assert calls(take) <= MOST_CALLS


MOST_CALLS = 140
