"""A stream gives the same numbers, bit for bit, however it is cut into blocks of frames."""

from __future__ import annotations

import cProfile
import itertools
import pstats
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from boards import DESIGN, Wire, described, frame, lossless, scene
from designs import digitised
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ohmskin.bench._driver import APART_S, design, every_frame, packets_of, port_of, pressed
from ohmskin.cell import Cell, ContactModel, Estimator, M10Model
from ohmskin.circuits import adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.common.measurement import FIELDS, Measurement
from ohmskin.driver import CountReader, Frame, Skin
from ohmskin.emulator import Board
from ohmskin.errors import InputError, ProtocolError

SHAPE, FRAMES = (3, 2), 90
EXAMPLE = Cell.example()
CELLS = {
    "paper": EXAMPLE,
    "contact": Cell(
        full_scale_kpa=100.0,
        rest_resistance_ohm=1e9,
        model=ContactModel(full_scale_resistance_ohm=2e3, exponent=1.0),
    ),
    "m10": Cell(
        full_scale_kpa=10.0,
        rest_resistance_ohm=1e4,
        model=M10Model(
            a=0.2, b=0.1, alpha1=0.1, rise1_s=0.1, fall1_s=0.3, alpha2=0.1, rise2_s=3.0, fall2_s=9.0, k=0.05, tau_s=20.0
        ),
    ),
}
EACH = [
    ("paper", "static"),
    ("paper", "paper"),
    ("paper", "inverse"),
    ("contact", "static"),
    ("m10", "static"),
    ("m10", "distilled"),
]


@cache
def made(kind: str, name: str) -> Estimator:
    """An estimator that has taken nothing."""
    return CELLS[kind].estimator(SHAPE, name)


def fresh(kind: str, name: str) -> Estimator:
    estimator = CELLS[kind].estimator(SHAPE, name)
    estimator.restore(made(kind, name).state())
    return estimator


def stream(kind: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Steps of time (frames,), and resistances (frames, shape): presses in noise, and readings that are missing."""
    cell, draw = CELLS[kind], np.random.default_rng(seed)
    load = np.clip(np.cumsum(draw.normal(0.0, 0.08, (FRAMES, *SHAPE)), axis=0), 0.0, 1.0)
    ohm = cell.forward(SHAPE).run(np.full(FRAMES, 0.01), cell.full_scale_kpa * load)
    ohm = ohm * np.exp(draw.normal(0.0, 1e-3, ohm.shape))
    for what in (np.nan, np.inf, 0.0):
        ohm[draw.random(ohm.shape) < 0.02] = what
    ohm[draw.random(FRAMES) < 0.03] = np.nan
    return draw.choice([0.01, 0.02, 0.0101], FRAMES), ohm


cuts = st.lists(st.integers(1, FRAMES - 1), max_size=6).map(lambda at: [0, *sorted(at), FRAMES])


@pytest.mark.parametrize(("kind", "name"), EACH)
@given(seed=st.integers(0, 2**16), at=cuts, stepped=st.booleans())
@settings(max_examples=8, deadline=None)
def test_resistances_in_blocks_give_what_they_give_one_by_one(
    kind: str, name: str, seed: int, at: list[int], stepped: bool
) -> None:
    elapsed_s, ohm = stream(kind, seed)
    single, block = fresh(kind, name), fresh(kind, name)
    if stepped:
        for each in (single, block):
            each.resolve(np.full(SHAPE, 2e-3), ohm[0])
    expected = [(single.step(float(dt), frame), single.std_kpa) for dt, frame in zip(elapsed_s, ohm, strict=True)]
    found = [block.run(elapsed_s[start:end], ohm[start:end]) for start, end in itertools.pairwise(at)]
    for place in range(2):
        np.testing.assert_array_equal(
            np.concatenate([each[place] for each in found]), np.stack([each[place] for each in expected])
        )
    assert all(np.array_equal(value, block.state()[part], equal_nan=True) for part, value in single.state().items())


@pytest.mark.parametrize(("kind", "name"), EACH)
@given(seed=st.integers(0, 2**16), at=cuts)
@settings(max_examples=8, deadline=None)
def test_measurements_in_blocks_give_what_they_give_one_by_one(kind: str, name: str, seed: int, at: list[int]) -> None:
    """With noise and steps that columns share, and readings of which only bounds are known."""
    elapsed_s, ohm = stream(kind, seed)
    draw, blocks = np.random.default_rng(seed + 1), np.empty((FRAMES, FIELDS, *SHAPE))
    for number in range(FRAMES):
        with np.errstate(divide="ignore"):
            conductance = np.where(np.isnan(ohm[number]), np.nan, 1.0 / ohm[number])
        conductance[np.isinf(conductance)] = np.nan
        size = np.nan_to_num(conductance)
        limited = draw.random(SHAPE) < 0.05
        blocks[number] = Measurement.of(
            conductance=np.where(limited, np.nan, conductance),
            noise_variance=(1e-3 * size) ** 2,
            column_std=1e-3 * size,
            half_step=1e-3 * size,
            column_half_step=2e-3 * size,
            least=np.where(limited, 0.5 * size, 0.0),
        ).block
    single, block = fresh(kind, name), fresh(kind, name)
    reasons = np.zeros(SHAPE, dtype=np.int8)
    expected = [
        (single.update(float(dt), Measurement(each, reasons)), single.std_kpa)
        for dt, each in zip(elapsed_s, blocks, strict=True)
    ]
    found = [block.run_measured(elapsed_s[start:end], blocks[start:end]) for start, end in itertools.pairwise(at)]
    for place in range(2):
        np.testing.assert_array_equal(
            np.concatenate([each[place] for each in found]), np.stack([each[place] for each in expected])
        )


def test_a_block_whose_time_stands_is_refused_as_a_whole() -> None:
    estimator, ohm = EXAMPLE.estimator(SHAPE), np.full((4, *SHAPE), 1e4)
    estimator.run(np.full(4, 0.01), ohm)
    before = estimator.state()
    for elapsed_s in ([0.01, 0.0, 0.01, 0.01], [0.01, 0.01, np.nan, 0.01]):
        with pytest.raises(InputError, match="time stamps that increase"):
            estimator.run(elapsed_s, ohm)
    with pytest.raises(InputError, match="shape"):
        estimator.run([0.01, 0.01], ohm)
    assert all(np.array_equal(value, estimator.state()[part], equal_nan=True) for part, value in before.items())


# A skin gives the same frames, bit for bit, however many are taken and converted at once


BLOCK_FRAMES = 110
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
            wanted = min(size, (tare_at if len(frames) < tare_at else BLOCK_FRAMES) - len(frames))
            block = [skin.read()] if wanted == 1 else skin.read_many(wanted)
            assert 1 <= len(block) <= wanted
            frames += block
            for each in frames[max(len(frames) - len(block), contacts_from) :]:
                assert each.contacts is not None
            if len(frames) == BLOCK_FRAMES:
                return frames
    raise AssertionError


@pytest.mark.parametrize("readout", [{}, {"reference_resistance": 33.2e3}], ids=["plain", "with cells at a limit"])
@given(sizes=st.lists(st.integers(1, 60), min_size=1, max_size=5), tare_at=st.integers(1, 90))
@example(sizes=[60], tare_at=20)
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


# What a usual frame costs is counted in calls of Python, which do not depend on the machine or its load


WARM, COUNTED = 120, 60


def calls(take: Callable[[int], object]) -> float:
    """Calls for each frame of the last ones, profiled, after :data:`WARM` others."""
    for number in range(WARM):
        take(number)
    profile = cProfile.Profile()
    profile.enable()
    for number in range(WARM, WARM + COUNTED):
        take(number)
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
