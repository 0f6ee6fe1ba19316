"""Simulated cells, and what is learned from them, by machine code against array operations."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.cell.inversions._features import Bank
from ohmskin.cell.materials import _simulate as simulate
from ohmskin.common import compiled


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


@settings(deadline=None)
@given(
    cells=st.integers(1, 5),
    seed=st.integers(0, 1000),
    lags=st.integers(0, 2),
    paths=st.integers(0, 2),
    smoothed=st.booleans(),
)
def test_machine_code_finds_the_same_features(cells: int, seed: int, lags: int, paths: int, smoothed: bool) -> None:
    """To the last bit, of recordings with any steps in time."""
    rng = np.random.default_rng(seed)
    bank = Bank(0.1, (0.5, 8.0)[:lags], (0.01, 0.05, 0.3), (2.0, 20.0)[:paths], smoothed)
    r, steps = np.cumsum(0.05 * rng.standard_normal((60, cells)), axis=0), rng.uniform(0.01, 0.3, 60)
    found = bank.run(steps, r)
    with compiled.switched_off():
        assert (found == bank.run(steps, r)).all()
