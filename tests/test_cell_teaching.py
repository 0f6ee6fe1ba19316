"""Which models teach the learned estimators, and simulated cells by machine code against array operations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin import compiled
from ohmskin.cell import AsymmetricModel, Cell, M10Model, PaperModel
from ohmskin.cell import _simulate as simulate
from ohmskin.cell._identify import Fit, Simulation
from ohmskin.cell._models import Model
from ohmskin.cell._teaching import find_teacher, in_turns

PAPER = Cell.example().model
ASYMMETRIC = AsymmetricModel(e1_kpa=20, e2_kpa=20, e3_kpa=80, eta2_kpa_s=100, eta3_kpa_s=8000)
UNBROKEN = M10Model(a=0.4, alpha1=0.3, rise1_s=0.4, fall1_s=5, alpha2=0.1, fall2_s=100)
BROKEN = UNBROKEN.replace(k=0.2)


def _adding(ohm: float) -> Simulation:
    """Resistance that tells by its size which simulation made it."""
    return lambda rng, load, dt: load + ohm


def _fits(errors: Sequence[tuple[Model, float]]) -> list[Fit]:
    """Fits with the same error on every fold as on the whole, whose simulations add 10, 20, ... ohm."""
    return [
        Fit(model, 1000.0, (), error, (error, error), _adding(10 * n), (_adding(10 * n + 1), _adding(10 * n + 2)))
        for n, (model, error) in enumerate(errors, 1)
    ]


def _taught_by(fits: Sequence[Fit]) -> set[float]:
    load = np.zeros((3, 12))
    found = find_teacher(fits).simulate(np.random.default_rng(0), load, 0.1)
    return set(found.ravel().tolist())


def test_all_kinds_that_explain_a_recording_teach() -> None:
    """Not those that leave twice as much, and not the paper's two models, which only teach alone."""
    fits = _fits([(ASYMMETRIC, 0.05), (PAPER, 0.02), (UNBROKEN, 0.02), (BROKEN, 0.018)])
    assert _taught_by(fits) == {30.0, 40.0}
    folds = find_teacher(fits).simulate_folds
    found = [set(one(np.random.default_rng(0), np.zeros((2, 4)), 0.1).ravel().tolist()) for one in folds]
    assert found == [{31.0, 41.0}, {32.0, 42.0}]


def test_the_papers_models_teach_alone_where_they_are_far_better() -> None:
    fits = _fits([(ASYMMETRIC, 0.015), (PAPER, 0.01), (UNBROKEN, 0.03), (BROKEN, 0.03)])
    assert _taught_by(fits) == {10.0}, "an asymmetric cell explains it nearly as well"
    assert _taught_by(_fits([(ASYMMETRIC, 0.03), (PAPER, 0.01), (UNBROKEN, 0.03), (BROKEN, 0.03)])) == {20.0}
    assert isinstance(PAPER, PaperModel)


@given(cells=st.integers(1, 9), kinds=st.integers(1, 4))
def test_cells_take_turns(cells: int, kinds: int) -> None:
    load = np.arange(float(cells))[None] / 100
    found = in_turns([_adding(10.0 * n) for n in range(kinds)])(np.random.default_rng(0), load, 0.1)
    assert found[0] == pytest.approx([10.0 * (cell % kinds) + cell / 100 for cell in range(cells)])


@settings(deadline=None)  # the first example waits for the compiler
@given(cells=st.integers(1, 12), seed=st.integers(0, 1000), dt=st.floats(0.02, 2))
def test_machine_code_simulates_the_same_cells(cells: int, seed: int, dt: float) -> None:
    """To the last bit; without the extra ``fast`` both are array operations."""
    rng = np.random.default_rng(seed)
    load = simulate.random_loads(rng, 200, cells, dt)
    m10 = np.array([0.3, -0.2, 0.8, 0.4, 5, 0.2, 1, 100, 0.2, 30])[:, None] * rng.uniform(0.5, 2, (10, cells))
    paper = np.array([0.5, 0.4, 5, 0.1, 100, 0.2, 5])[:, None] * rng.uniform(0.5, 2, (7, cells))
    begun = rng.uniform(-0.1, 0.1, (3, cells))
    found = simulate.m10(m10, load, dt, begun), simulate.m10(m10, load[:, :1], dt), simulate.paper(paper, load, dt)
    with compiled.switched_off():
        again = simulate.m10(m10, load, dt, begun), simulate.m10(m10, load[:, :1], dt), simulate.paper(paper, load, dt)
    for one, other in zip(found, again, strict=True):
        assert (one == other).all()
