"""Which model teaches the learned estimators, and simulated cells by machine code against array operations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin import compiled
from ohmskin.cell import AsymmetricModel, Cell, M10Model
from ohmskin.cell import _simulate as simulate
from ohmskin.cell._fitted import Fit
from ohmskin.cell._models import Model
from ohmskin.cell._teaching import explaining, find_teacher

PAPER = Cell.example().model
ASYMMETRIC = AsymmetricModel(e1_kpa=20, e2_kpa=20, e3_kpa=80, eta2_kpa_s=100, eta3_kpa_s=8000)
UNBROKEN = M10Model(a=0.4, alpha1=0.3, rise1_s=0.4, fall1_s=5, alpha2=0.1, fall2_s=100)
BROKEN = UNBROKEN.replace(k=0.2)


def _unused(rng: np.random.Generator, loads: np.ndarray, dt: float) -> np.ndarray:
    raise AssertionError("the choice of a teacher simulates nothing")


def _fits(errors: Sequence[tuple[Model, float]]) -> list[Fit]:
    """Fits with the same error on every fold as on the whole."""
    return [Fit(model, 1000.0, (), error, (error, error), _unused, (_unused, _unused)) for model, error in errors]


@pytest.mark.parametrize(
    ("asymmetric", "paper", "m10", "expected"),
    [
        (0.05, 0.02, 0.02, BROKEN),
        (0.019, 0.019, 0.02, BROKEN),  # a close call
        (0.013, 0.02, 0.02, ASYMMETRIC),
        (0.03, 0.01, 0.03, PAPER),  # far better
        (0.015, 0.01, 0.03, ASYMMETRIC),  # better, but an asymmetric cell is nearly as good
    ],
)
def test_the_richest_smooth_kind_teaches_unless_it_explains_clearly_less(
    asymmetric: float, paper: float, m10: float, expected: Model
) -> None:
    fits = _fits([(BROKEN, m10), (ASYMMETRIC, asymmetric), (PAPER, paper)])
    assert find_teacher(fits).model == expected


def test_kinds_explain_a_recording_that_leave_less_than_twice_the_least_error() -> None:
    fits = _fits([(ASYMMETRIC, 0.05), (PAPER, 0.021), (UNBROKEN, 0.019), (BROKEN, 0.01)])
    assert [fit.model for fit in explaining(fits)] == [UNBROKEN, BROKEN]


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
