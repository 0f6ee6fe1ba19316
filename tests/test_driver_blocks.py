"""A skin gives the same frames, bit for bit, however many are taken and converted at once."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from boards import DESIGN, Wire, described, frame, lossless, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.bench import scenes
from ohmskin.circuits import Reason
from ohmskin.common.measurement import CONDUCTANCE, Measurement
from ohmskin.driver import Calibration, Frame, Skin
from ohmskin.driver._estimate import Estimate
from ohmskin.driver._rest import Rest
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


@pytest.mark.parametrize("kind", ["example", "fsr"])
def test_an_estimate_is_the_estimator_s_of_what_was_measured_with_each_cell_s_gain(kind: str) -> None:
    """Of one frame and of several; without a current a cell that is open at rest bears no load; nothing is changed."""
    cell, random, frames = scenes.cells()[kind], np.random.default_rng(3), 30
    kpa = np.abs(np.cumsum(random.normal(0.0, 0.05, (frames, 3, 2)), axis=0)) * cell.full_scale_kpa
    conductance = 1.0 / cell.forward((3, 2)).run(np.full(frames, 0.02), kpa)
    measured = [Measurement.of(conductance=each, noise_variance=(1e-3 * each) ** 2) for each in conductance]
    for each in measured:
        each.reason[:] = 0
        each.reason[2, 1], each.conductance[2, 1] = Reason.NO_CURRENT, np.nan
    gain, ones = np.linspace(0.8, 1.3, 6).reshape(3, 2), np.ones((3, 2))
    given = {"rest_ohm": cell.rest_resistance_ohm * ones, "gain": gain, "gain_std": 0.1 * ones, "rest_std_kpa": ones}
    kept = {"residual_kpa": ones, "calibrated": ones > 0.0, "loads_kpa": (1.0,), "presses": 1, "serial_number": ""}
    calibration = Calibration(**given, **kept, design_hash="", cell_hash="", date="")  # type: ignore[arg-type]
    rest, dt_s = Rest(cell, calibration), np.full(frames, 0.02)
    estimator = cell.estimator((3, 2), rest_resistance_ohm=rest.ohm, rest_error=rest.error)
    blocks = np.stack([each.block for each in measured])
    before = blocks.copy()
    if cell.open_at_rest:
        blocks[:, CONDUCTANCE, 2, 1] = 0.0
    pressure, std = estimator.run_measured(dt_s, blocks)
    estimate = Estimate(cell, (3, 2), None, rest, calibration)
    taken = [estimate.take(dt_s[a:b].tolist(), measured[a:b]) for a, b in itertools.pairwise([0, 1, 2, 12, 13, frames])]
    found, spread = (np.concatenate(parts) for parts in zip(*taken, strict=True))
    np.testing.assert_allclose(found, gain * pressure)
    np.testing.assert_allclose(spread, np.sqrt((gain * std) ** 2 + (0.1 * gain * pressure) ** 2 + 1.0))
    assert np.isfinite(found[1:, 2, 1]).all() == cell.open_at_rest
    np.testing.assert_array_equal([each.block for each in measured], before)
