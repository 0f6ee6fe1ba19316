"""The layer above the cells: equilibrium, limits and the half-space solution integrated numerically."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from boards import DESIGN, scene
from scipy.integrate import dblquad

from ohmskin.emulator import EmulatedSkin, shares, spread

MIDDLES = (np.arange(6) + 0.5) / 6 - 0.5


@pytest.mark.parametrize("depth", [0.01, 0.1, 0.5, 2.0])
def test_force_is_conserved_and_symmetric(depth: float) -> None:
    share = shares(depth)
    # What is missing has gone beyond the kernel: at most what a point load puts outside a circle of 4.5 pitches.
    outside = 1 - (1 - 1 / (1 + (4.5 / depth) ** 2) ** 1.5)
    assert 1 - 1.3 * outside - 1e-3 < share.sum() <= 1 + 1e-3
    np.testing.assert_allclose(share, share.T, atol=1e-14)
    np.testing.assert_allclose(share, share[::-1], atol=1e-14)
    assert (share > 0).all()


def test_against_boussinesq_integrated_over_the_loaded_cell() -> None:
    """Stress at the middle of a cell and of its neighbour, from the point-load solution 3 z^3 / (2 pi R^5)."""
    depth = 0.7

    def below(x: float, y: float) -> float:
        return dblquad(
            lambda v, u: 3 * depth**3 / (2 * np.pi * ((x - u) ** 2 + (y - v) ** 2 + depth**2) ** 2.5),
            *(-0.5, 0.5, -0.5, 0.5),
        )[0]

    # Midpoint rule over the cell, good to 4e-3 here.
    fine = np.mean([[below(a, b) for a in MIDDLES] for b in MIDDLES])
    side = np.mean([[below(1 + a, b) for a in MIDDLES] for b in MIDDLES])
    assert shares(depth)[4, 4] == pytest.approx(fine, rel=1e-2)
    assert shares(depth)[4, 5] == pytest.approx(side, rel=1e-2)


def test_a_thin_layer_spreads_little_and_none_nothing() -> None:
    pressure = np.zeros((4, 5))
    pressure[1, 2] = 10.0
    assert spread(pressure, 0.0) is pressure
    thin, thick = spread(pressure, 0.02), spread(pressure, 0.5)
    assert thin[1, 2] > thick[1, 2]
    assert thin[1, 3] < thick[1, 3]
    np.testing.assert_allclose(thin, pressure, atol=0.5)


def test_a_cover_and_an_uncut_sheet_spread_what_presses_on_the_skin() -> None:
    def felt(design: dict[str, Any], **skin: float) -> np.ndarray:
        emulated = EmulatedSkin(scene(skin={"design": design, **skin}, board={"frame_rate": 0.5}))
        emulated.read()
        block, second = emulated.read()
        return block.resistance_ohm[second]

    uncut = {**DESIGN, "array": {**DESIGN["array"], "sheet": "continuous"}}
    pressed, beside = (1, 1), (1, 0)
    sliced, covered, continuous = felt(DESIGN), felt(DESIGN, cover_thickness=0.003), felt(uncut)
    assert sliced[beside] == 10e3
    for shared in (covered, continuous):
        assert shared[beside] > 10e3
        assert shared[pressed] < sliced[pressed]
