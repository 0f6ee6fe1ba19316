"""A stream gives the same numbers, bit for bit, however it is cut into blocks of frames."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.cell import Cell, ContactModel, Estimator, M10Model
from ohmskin.common.arrays import FloatArray
from ohmskin.common.measurement import FIELDS, Measurement
from ohmskin.errors import InputError

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
    for frame in range(FRAMES):
        with np.errstate(divide="ignore"):
            conductance = np.where(np.isnan(ohm[frame]), np.nan, 1.0 / ohm[frame])
        conductance[np.isinf(conductance)] = np.nan
        size = np.nan_to_num(conductance)
        limited = draw.random(SHAPE) < 0.05
        blocks[frame] = Measurement.of(
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
