"""Readings below the converter's range: conductances that such readings leave open, and what they make of other cells.

An amplifier's offset, and what it drives through a floating grid, may push the output of a cell far below the range.
Its code then says only that the cell conducts no more than would lift the output into the range. A fit takes any
such conductance, and the linear model takes its reading for one that is known.

Derivatives column by column do not know of current that reaches a column by way of other columns and rows, where hard
presses and leads lift these. A cell that only such current passes changes other readings of its column by more than
they say. So the model is evaluated without these cells, too.
"""

from __future__ import annotations

import numpy as np

from ...arrays import BoolArray, FloatArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._linearised import Base

_ONE_BY_ONE = 8  # readings whose effects are added up without their signs; those of the others keep them
_ALIKE = 1.2  # ratio of what is open by which effects are kept from frame to frame
_OPEN = 30.0  # change of a logarithm that leaves nothing of a conductance


class BelowRange:
    """The readings of one board."""

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        board = parts.board
        with np.errstate(divide="ignore"):
            per_siemens = 1.0 / np.abs(board.circuit.conductance_slope(board, np.zeros(parts.shape)))
        self._parts = parts
        self._per_siemens = np.broadcast_to(per_siemens, parts.shape).ravel()  # V
        self._kept: tuple[Base | None, BoolArray, FloatArray, FloatArray] | None = None

    def __call__(self, frame: Frame, known: Known, base: Base) -> FloatArray | float:
        """Relative change (n,) of the conductances while cells below the range take any value they can have.

        Args:
            frame: the readings, some of which are at the lower end of the range.
            known: the cells that have been found for them.
            base: the linear model about these.

        """
        open_volts = self._open_volts(frame, known)
        chosen = open_volts > frame.error
        if not chosen.any():
            return 0.0
        kept = self._kept
        if kept is None or kept[0] is not base or (chosen & ~kept[1]).any() or (open_volts > kept[2])[chosen].any():
            allowed = np.where(chosen, _ALIKE * open_volts, 0.0)
            effects = self._effects(allowed, base)
            if not base.whole:
                np.maximum(effects, self._effects_of_opening(known, chosen, allowed, base), out=effects)
            kept = self._kept = base, chosen, allowed, effects
        return kept[3]

    def _open_volts(self, frame: Frame, known: Known) -> FloatArray:
        """V (n,) that each reading may be above or below that of the fit, as its cell conducts more or nothing."""
        assert frame.bottom is not None
        above = frame.measured + frame.error - known.volts
        below = self._per_siemens * np.exp(known.log)
        return np.where(frame.bottom & (above > 0.0), np.maximum(above, below), 0.0)

    def _effects_of_opening(self, known: Known, chosen: BoolArray, volts: FloatArray, base: Base) -> FloatArray:
        """Relative change (n,) of the other cells if those ``chosen`` (n,) change as far as ``volts`` (n,) allow."""
        changed = self._parts.at(np.where(chosen, known.log - _OPEN, known.log)).volts - known.volts
        changed[chosen] = 0.0
        own = (self._per_siemens * np.exp(known.log))[chosen]  # V by which opening a cell changes its own reading
        times = float((volts[chosen] / np.maximum(own, np.finfo(np.float64).tiny)).max())
        more: FloatArray = times * np.abs(base.step(changed))
        more[chosen] = 0.0
        return more

    def _effects(self, volts: FloatArray, base: Base) -> FloatArray:
        """Relative change (n,) of the other cells by volts (n,) that readings may be off."""
        order = np.argsort(volts)[::-1]
        changed = np.zeros(len(volts))
        for place in order[:_ONE_BY_ONE]:
            if volts[place] > 0.0:
                alone = np.zeros(len(volts))
                alone[place] = volts[place]
                change = np.abs(base.step(alone))
                change[place] = 0.0
                changed += change
        rest = volts.copy()
        rest[order[:_ONE_BY_ONE]] = 0.0
        if rest.any():
            changed += np.abs(base.step(rest))
        return changed
