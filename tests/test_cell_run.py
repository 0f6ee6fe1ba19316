"""Whole histories at once: the same as step by step, however the history is cut, and for some of the cells only."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.cell import AsymmetricModel, Cell, ContactModel, M10Model
from ohmskin.errors import InputError

PAPER = Cell.example()
CELLS = {
    "paper": PAPER,
    "asymmetric": PAPER.replace(
        model=AsymmetricModel(e1_kpa=30.0, e2_kpa=60.0, e3_kpa=400.0, eta2_kpa_s=500.0, eta3_kpa_s=48e3)
    ),
    "m10": PAPER.replace(
        model=M10Model(a=0.2, b=-0.1, alpha1=0.5, rise1_s=0.3, fall1_s=4.0, alpha2=0.1, fall2_s=90.0, k=0.2)
    ),
    "contact": PAPER.replace(model=ContactModel(full_scale_resistance_ohm=500.0, exponent=0.9)),
}
FRAMES, SHAPE = 60, (2, 3)


def history(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps, holds, ramps and gaps: (frames,) dt_s and (frames, 2, 3) kPa."""
    random = np.random.default_rng(seed)
    levels = random.integers(0, 4, (FRAMES, *SHAPE)) * 4.0
    held = random.random((FRAMES, *SHAPE)) < 0.5
    pressure = levels * ~held + np.roll(levels, 1, axis=0) * held
    pressure[random.random(FRAMES) < 0.3] = 0.0
    return random.choice([0.0, 0.01, 0.01, 0.5, 30.0], FRAMES), pressure


@pytest.mark.parametrize("kind", CELLS)
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), cut=st.integers(0, FRAMES))
def test_a_history_at_once_is_the_history_step_by_step(kind: str, seed: int, cut: int) -> None:
    dt, pressure = history(seed)
    rest = np.random.default_rng(seed).uniform(5e3, 2e4, SHAPE)
    stepped, run = (CELLS[kind].forward(SHAPE, rest_resistance_ohm=rest) for _ in range(2))
    expected = np.array([stepped.step(*step) for step in zip(dt, pressure, strict=True)])
    found = np.concatenate([run.run(dt[:cut], pressure[:cut]), run.run(dt[cut:], pressure[cut:])])
    np.testing.assert_allclose(found, expected, rtol=1e-11)
    # The memory is the same as well: both go on alike.
    np.testing.assert_allclose(run.step(1.0, 5.0), stepped.step(1.0, 5.0), rtol=1e-11)


@pytest.mark.parametrize("kind", CELLS)
def test_cutting_a_history_changes_no_bit(kind: str) -> None:
    dt, pressure = history(3)
    whole, cut = (CELLS[kind].forward(SHAPE) for _ in range(2))
    pieces = [cut.run(dt[k : k + 7], pressure[k : k + 7]) for k in range(0, FRAMES, 7)]
    np.testing.assert_array_equal(np.concatenate(pieces), whole.run(dt, pressure))


@pytest.mark.parametrize("kind", CELLS)
def test_some_of_the_cells_live_while_the_others_stay(kind: str) -> None:
    dt, pressure = history(5)
    cells = np.array([1, 3, 4])
    pressure.reshape(FRAMES, -1)[:, [0, 2, 5]] = 0.0
    everything, some = (CELLS[kind].forward(SHAPE) for _ in range(2))
    expected = everything.run(dt, pressure).reshape(FRAMES, -1)
    found = some.run(dt, pressure.reshape(FRAMES, -1)[:, cells], cells)
    np.testing.assert_array_equal(found, expected[:, cells])
    assert (expected[:, [0, 2, 5]] == CELLS[kind].forward(SHAPE).step(0.0, 0.0).flat[0]).all()
    np.testing.assert_array_equal(some.step(0.5, 3.0), everything.step(0.5, 3.0))


@pytest.mark.parametrize("kind", CELLS)
def test_cells_come_to_rest_once_they_have_forgotten(kind: str) -> None:
    cells = np.arange(6)
    skin = CELLS[kind].forward(SHAPE)
    press = np.array([9.0, 0.0, 2.0, 0.0, 0.0, 15.0])
    skin.run([0.0, 1.0], np.stack([press, press]), cells)
    assert skin.put_to_rest(cells, 1e-6).tolist() == [False, True, False, True, True, False]
    skin.run([0.0, 1e-9], np.zeros((2, 6)), cells)
    if kind != "contact":
        assert not skin.put_to_rest(cells, 1e-6)[0]
    skin.run([1e4], np.zeros((1, 6)), cells)
    assert skin.put_to_rest(cells, 1e-6).all()
    fresh = CELLS[kind].forward(SHAPE)
    dt, pressure = history(8)
    np.testing.assert_array_equal(skin.run(dt, pressure), fresh.run(dt, pressure))


@pytest.mark.parametrize(
    ("dt", "pressure"),
    [([-1.0], [[1.0]]), ([np.inf], [[1.0]]), ([1.0], [[np.nan]]), ([1.0, 1.0], [[1.0]]), ([1.0], [[1.0, 2.0]])],
)
def test_a_history_that_cannot_be_is_refused(dt: list[float], pressure: list[list[float]]) -> None:
    with pytest.raises(InputError, match=r"time steps|finite|shape"):
        PAPER.forward((1,)).run(dt, pressure)
