"""Live inversion: from readings to cells at the board's frame rate, with a bounded cost per frame.

Readings come in ADC steps, a thousand frames a second, and hardly change from one to the next. A live recovery keeps
what depends on the cells but slowly. It evaluates the circuit model again only where the result would else be off
by a share of the uncertainty, and a limited number of times in one frame. If the limit does not suffice, the cells that
are not settled are not valid in this frame, and the next frame continues from there.
"""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from .._design import Design
from ._known_board import KnownBoard
from ._live_fit import FitLive
from ._live_law import LawLive
from ._live_reading import LiveRecovery, ValidityRule
from ._tuning import RANGE_SPARE


def live_recovery(design: Design, *, accuracy: float | None = None, lowest_ohm: float | None = None) -> LiveRecovery:
    """The live recovery for a board with a converter.

    :class:`.FitLive` for dividers with floating or pulled rows, :class:`.LawLive` for all others.

    Args:
        design: the board.
        accuracy: relative uncertainty of a conductance up to which a cell is valid; None:
            :data:`._tuning.ACCURACY`.
        lowest_ohm: the lowest resistance in the cells' range of loads; None: that of ``[cells]``, if the design has
            it. Where readings may have several answers, those with cells below a tenth of it do not count.

    Raises:
        InputError: the design has no [adc], the accuracy is not between 0 and 1, the board is too large, or its
            circuit does not determine the cells.

    """
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    if lowest_ohm is None and design.cells is not None:
        lowest_ohm = min(design.cells.rest_resistance, design.cells.full_scale_resistance)
    least = 0.0 if lowest_ohm is None else lowest_ohm / RANGE_SPARE
    return live_inverse(KnownBoard(design.board), ValidityRule.of(accuracy), least)


def live_inverse(known: KnownBoard, rule: ValidityRule, least_ohm: float) -> LiveRecovery:
    """The same for a board whose cells have at least so many ohm, shorts apart.

    Raises:
        InputError: the board is too large, or its circuit does not determine the cells.

    """
    board = known.board
    if why := board.circuit.ambiguity(board):
        raise InputError(f"the cells cannot be recovered from readings: {why}")
    kind = FitLive if board.circuit.port_law(board, np.zeros(board.shape[1])) is None else LawLive
    return kind(known, rule, least_ohm)
