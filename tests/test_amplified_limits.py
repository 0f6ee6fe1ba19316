"""What cells at limits make of others behind amplifiers: the loop and the array operations say the same."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from ohmskin.bench._live_streams import FAMILIES, draw_design
from ohmskin.circuits.recovery._amplified import AmplifiedLive
from ohmskin.circuits.recovery._amplified_limits import CellsAtLimits
from ohmskin.circuits.recovery._amplified_prices import AmplifiedPrices
from ohmskin.circuits.recovery._frame_account import Account
from ohmskin.common import compiled
from ohmskin.driver import CountReader

BOARDS, FRAMES = 60, 6
CLOSE = 1e-10

pytestmark = pytest.mark.skipif(compiled.why_not() is not None, reason="kernels are switched off")


@pytest.mark.parametrize("family", ["inverting events", "row events", "row extremes"])
def test_machine_code_says_of_cells_at_limits_what_array_operations_say(family: str) -> None:
    draw, compared = np.random.default_rng([11, *family.encode()]), 0
    while compared < BOARDS:
        recover = CountReader(draw_design(draw, FAMILIES[family]))._recover
        if not isinstance(recover, AmplifiedLive):
            continue
        parts = recover._board
        board = parts.board
        prices = AmplifiedPrices(parts)
        by_loop = CellsAtLimits(parts, prices)
        with compiled.switched_off():
            by_arrays = CellsAtLimits(parts, prices)
        assert by_loop.is_compiled
        assert not by_arrays.is_compiled
        low, high = board.supply
        span = (max(low, -10.0), min(high, 10.0))
        for _ in range(FRAMES):
            cells = 10.0 ** draw.uniform(-8.0, -2.0, parts.lines.row.shape)
            limited = draw.random(cells.shape) < draw.choice([0.05, 0.3, 1.0])
            volts = draw.choice([span[0], span[1], 0.9 * span[0] + 0.1 * span[1], 0.5 * sum(span)], cells.shape)
            found = by_loop(cells, volts, limited, 1e-3, None, Account(inf))
            np.testing.assert_allclose(found, by_arrays(cells, volts, limited, 1e-3, None, Account(inf)), rtol=CLOSE)
        compared += 1
