"""Live inversion: from readings to cells at the board's frame rate, with a bounded cost per frame.

:mod:`._recover` inverts the circuit model to many digits, at any cost. A board that is read a thousand times a second
needs less: its readings come in ADC steps, and hardly change from one frame to the next. A live recovery therefore
keeps a *base*: conductances, and the results of the circuit model for them. The cells of a new frame follow from the
base and the change of the readings. The base moves only if the change is so large that the result would be off by a
share of an ADC step. The number of evaluations of the circuit model in one frame is limited. If the limit does not
suffice, the cells that are not settled are not valid in this frame, and the next frame continues from there.

Two kinds of boards (:func:`live_recovery`):

* **amplifiers on plain grids** (:mod:`._amplified`);
* **all others** (:mod:`._coupled`): dividers and followers column by column in closed form (:mod:`._column_blocks`);
  boards on which all readings depend on all cells by a matrix that is made in instalments (:mod:`._normal_matrix`);
  continuous sheets by the sliced one and a correction (:mod:`._sheet_model`).
"""

from __future__ import annotations

import numpy as np

from ...errors import InputError
from .._design import Design
from ._amplified import AmplifiedLive
from ._live_fit import FitLive
from ._live_law import LawLive
from ._live_reading import LiveRecovery, ValidityRule


def live_recovery(design: Design, *, accuracy: float | None = None) -> LiveRecovery:
    """The live recovery for a board with a converter: :class:`.AmplifiedLive` or :class:`.CoupledLive`.

    Args:
        design: the board.
        accuracy: relative uncertainty of a conductance up to which a cell is valid; None:
            :data:`._live_reading.ACCURACY`.

    Raises:
        InputError: the design has no [adc], the accuracy is not between 0 and 1, or the board is too large.

    """
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    board, rule = design.board, ValidityRule.of(accuracy)
    law = board.circuit.port_law(board, np.zeros(board.shape[1]))
    if law is None:
        return FitLive(board, rule)
    complete_short = any(fault.ohms == 0 for fault in board.shorts)
    amplified = board.circuit.ends(board) is not None and not board.floating and board.plain and not complete_short
    lines = (board.row_ohms, board.column_ohms, board.column_lead)
    if amplified and all(np.isfinite(part).all() for part in lines):
        return AmplifiedLive(board, rule)
    return LawLive(board, rule)
