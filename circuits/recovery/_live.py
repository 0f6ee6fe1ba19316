"""Readings to cells at a board's own rate, with a bounded cost per frame.

:mod:`._recover` inverts the circuit model to many digits, whatever it costs. A board that is read a thousand times a
second needs less: its readings come in steps of the converter, and hardly change from one frame to the next. So a
live recovery keeps a *base*: conductances, and what the circuit model makes of them. The cells of a new frame follow
from the base and the change of the readings. The base moves only where the change is so large that the result would be
off by a share of an ADC step, and the evaluations of the circuit model in one frame are limited. When the limit does
not suffice, the cells that are not settled are not valid in this frame, and the next one goes on from where this one
ended.

Three kinds of boards (:func:`live_recovery`):

* **amplifiers on plain grids** (:mod:`._amplified`);
* **all others** up to :data:`LARGEST_COUPLED` cells (:mod:`._coupled`);
* what is left, by the complete inversion, whatever it costs (:class:`_ThoroughLive`).
"""

from __future__ import annotations

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...errors import InputError
from .._adc import adc_error
from .._design import Design
from ._amplified import AmplifiedLive
from ._coupled import CoupledLive
from ._live_reading import SIGMAS, LiveReading, LiveRecovery, Reason, ValidityRule
from ._recover import Recoverer, Status

LARGEST_COUPLED = 1024  # cells; beyond, a matrix of all readings by all cells no longer serves a frame's time
_REASON_OF_STATUS = {
    Status.OPEN: Reason.NO_CURRENT,
    Status.SATURATED: Reason.SATURATED,
    Status.HIDDEN: Reason.HIDDEN,
}


def live_recovery(design: Design, *, accuracy: float | None = None) -> LiveRecovery:
    """The recovery that suits a board with a converter.

    Args:
        design: the board.
        accuracy: relative uncertainty of a conductance up to which a cell is valid; None:
            :data:`._live_reading.ACCURACY`.

    Raises:
        InputError: the design has no [adc], or the accuracy is not between 0 and 1.

    """
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    board, rule = design.board, ValidityRule.of(accuracy)
    complete_short = any(fault.ohms == 0 for fault in board.shorts)
    amplified = board.circuit.ends(board) is not None and not board.floating and board.plain and not complete_short
    lines = (board.row_ohms, board.column_ohms, board.column_lead)
    if amplified and all(np.isfinite(part).all() for part in lines):
        return AmplifiedLive(board, rule)
    if not board.continuous and board.shape[0] * board.shape[1] <= LARGEST_COUPLED and not complete_short:
        return CoupledLive(board, rule)
    return _ThoroughLive(design, rule)


class _ThoroughLive:
    """By :class:`._recover.Recoverer`, whatever it costs: continuous sheets, complete shorts, large coupled boards."""

    def __init__(self, design: Design, rule: ValidityRule) -> None:
        self._design, self._rule = design, rule
        self._recover = Recoverer(design, accuracy=1e-6)
        self._half_step = adc_error(design)

    def __call__(self, volts: FloatArray, limited: BoolArray | None = None, noise: float = 0.0) -> LiveReading:
        """As :class:`.LiveRecovery`."""
        found = self._recover(volts, clipped=limited)
        board = self._design.board
        slope = board.turn(board.circuit.log_conductance_slope(board, board.turn(volts) - board.level))
        own = (self._half_step + SIGMAS * noise) * np.abs(slope)
        uncertainty = found.uncertainty + own
        valid = self._rule.accepts(uncertainty) & (found.resistance < np.inf) & (found.resistance > 0)
        doubtful = Reason.UNCERTAIN if limited is None else Reason.DISTURBED
        reason = np.where(valid, Reason.VALID, doubtful).astype(np.int8)
        for status, why in _REASON_OF_STATUS.items():
            reason[~valid & (found.status == status)] = why
        return LiveReading(found.resistance, valid, reason, lambda: (uncertainty, own))
