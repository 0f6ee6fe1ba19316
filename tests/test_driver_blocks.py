"""A skin gives the same frames, bit for bit, however many are taken and converted at once."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from boards import DESIGN, Wire, described, frame, lossless, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.driver import Frame, Skin
from ohmskin.emulator import Board
from ohmskin.errors import ProtocolError

FRAMES = 110
PRESSES = [
    {"cells": [[1, 1], [2, 1]], "load_kpa": [[0.0, 0.0], [0.2, 0.0], [0.25, 15.5], [0.9, 15.5], [0.95, 0.0]]},
    {"cells": [[0, 0]], "load_kpa": [[0.0, 0.0], [0.5, 0.0], [0.55, 9.0], [1.1, 9.0], [1.15, 0.0]]},
]


def board(**readout: float) -> Board:
    table = {"design": DESIGN | {"readout": DESIGN["readout"] | readout}, "spread": {"rest_percent": 2.0, "seed": 11}}
    return Board(scene(skin=table, board={"frame_rate": 100.0, "noise": 5e-4}, contact=PRESSES))


def taken(readout: dict[str, float], sizes: list[int], tare_at: int, contacts_from: int) -> list[Frame]:
    """Frames that are taken in such numbers, with a tare in between; contacts are asked for from a number on."""
    frames: list[Frame] = []
    with lossless(Wire(board(**readout)), queue=400) as skin:
        for size in itertools.cycle(sizes):
            if len(frames) == tare_at:
                skin.tare(5, force=True)
            wanted = min(size, (tare_at if len(frames) < tare_at else FRAMES) - len(frames))
            block = [skin.read()] if wanted == 1 else skin.read_many(wanted)
            assert 1 <= len(block) <= wanted
            frames += block
            for each in frames[max(len(frames) - len(block), contacts_from) :]:
                assert each.contacts is not None
            if len(frames) == FRAMES:
                return frames
    raise AssertionError


@pytest.mark.parametrize("readout", [{}, {"reference_resistance": 33.2e3}], ids=["plain", "with cells at a limit"])
@given(sizes=st.lists(st.integers(1, 60), min_size=1, max_size=5), tare_at=st.integers(1, 90))
@settings(max_examples=3, deadline=None)
def test_frames_taken_together_are_those_taken_one_by_one(
    readout: dict[str, float], sizes: list[int], tare_at: int
) -> None:
    for one, many in zip(taken(readout, [1], tare_at, 40), taken(readout, sizes, tare_at, 40), strict=True):
        expected, found = one.as_dict(), many.as_dict()
        for name in set(expected) - {"age", "host_time", "monotonic_time"}:
            np.testing.assert_array_equal(found[name], expected[name], name)
        assert one.contacts == many.contacts


def outcomes(take: Callable[[Skin], list[Frame]], spoilt: set[int]) -> list[int | str]:
    """Numbers of the frames that a reader gets, and errors in between; counts of ``spoilt`` frames fit no converter."""
    pieces = [frame(number, level=5000 if number in spoilt else 2000) for number in range(40)]
    seen: list[int | str] = []
    with lossless(described(*pieces), queue=60) as skin:
        while len(seen) < 40:
            try:
                seen += [each.sequence or 0 for each in take(skin)]
            except ProtocolError as error:
                seen.append(str(error))
    return seen


@given(spoilt=st.sets(st.integers(0, 39), max_size=8), most=st.integers(2, 50))
@settings(max_examples=6, deadline=None)
def test_frames_that_do_not_fit_are_reported_where_they_came(spoilt: set[int], most: int) -> None:
    one_by_one = outcomes(lambda skin: [skin.read()], spoilt)
    assert outcomes(lambda skin: skin.read_many(most), spoilt) == one_by_one
    assert [number for number in one_by_one if not isinstance(number, str)] == sorted(set(range(40)) - spoilt)
