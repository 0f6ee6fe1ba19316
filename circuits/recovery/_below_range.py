"""Readings below the converter's range: the conductances that they leave open, and the effect of these on other cells.

An amplifier's offset, and the currents that it drives through a floating grid, may push the output of a cell far below
the range. The code then only says that the cell conducts less than what would lift the output into the range. A fit
takes any such conductance, and the linear model treats its reading as known.

Derivatives column by column neglect currents that reach a column through other columns and rows, where hard presses and
leads lift these. A cell that carries only such a current changes other readings of its column by more than these
derivatives say. The model is therefore also evaluated without these cells.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._frame_budget import Budget
from ._linearised import Base

_ONE_BY_ONE = 8  # readings whose effects are added up as absolute values; the effects of the others keep their signs
_ALIKE = 1.2  # ratio of open voltages up to which effects are kept from frame to frame
_OPEN = 30.0  # change of a logarithm that makes a conductance zero


class BelowRange:
    """Effect of the readings of one board that lie below the range."""

    def __init__(self, parts: CoupledBoard) -> None:
        """For a board."""
        board = parts.board
        with np.errstate(divide="ignore"):
            per_siemens = 1.0 / np.abs(board.circuit.conductance_slope(board, np.zeros(parts.shape)))
        self._parts = parts
        self._per_siemens = np.broadcast_to(per_siemens, parts.shape).ravel()  # V
        self._kept: tuple[Base | None, BoolArray, FloatArray, FloatArray] | None = None
        self._alone: tuple[Base | None, dict[int, FloatArray]] = None, {}

    def __call__(self, frame: Frame, known: Known, base: Base, budget: Budget, step_price: float) -> FloatArray | float:
        """Largest relative change (n,) of the conductances over all possible values of cells below the range.

        Args:
            frame: the readings, some of which are at the lower end of the range.
            known: the cells found for the readings.
            base: the linear model about these.
            budget: of the frame. Work that it cannot pay for is done in the next frames while the base stays; until
                then the result is too low, and :attr:`.Budget.suffices` is False.
            step_price: price of a step by the base.

        """
        open_volts = self._open_volts(frame, known)
        chosen = open_volts > frame.error
        if not chosen.any():
            return 0.0
        kept = self._kept
        if kept is None or kept[0] is not base or (chosen & ~kept[1]).any() or (open_volts > kept[2])[chosen].any():
            allowed = np.where(chosen, _ALIKE * open_volts, 0.0)
            effects = self._effects(allowed, base, budget, step_price)
            if effects is not None and not base.whole:
                if budget.judge(self._parts.price(known.log) + step_price):
                    np.maximum(effects, self._effects_of_opening(known, chosen, allowed, base), out=effects)
                else:
                    effects = None
            if effects is None:
                return 0.0
            kept = self._kept = base, chosen, allowed, effects
        return kept[3]

    def _open_volts(self, frame: Frame, known: Known) -> FloatArray:
        """V (n,) by which each reading may differ from that of the fit, if its cell conducts more or nothing."""
        assert frame.bottom is not None
        above = frame.measured + frame.error - known.volts
        below = self._per_siemens * np.exp(known.log)
        return np.where(frame.bottom & (above > 0.0), np.maximum(above, below), 0.0)

    def _effects_of_opening(self, known: Known, chosen: BoolArray, volts: FloatArray, base: Base) -> FloatArray:
        """Relative change (n,) of other cells if those ``chosen`` (n,) change as far as ``volts`` (n,) allow."""
        changed = self._parts.at(np.where(chosen, known.log - _OPEN, known.log)).volts - known.volts
        changed[chosen] = 0.0
        own = (self._per_siemens * np.exp(known.log))[chosen]  # V by which opening a cell changes its own reading
        times = float((volts[chosen] / np.maximum(own, np.finfo(np.float64).tiny)).max())
        more: FloatArray = times * np.abs(base.step(changed))
        more[chosen] = 0.0
        return more

    def _effects(self, volts: FloatArray, base: Base, budget: Budget, step_price: float) -> FloatArray | None:
        """Relative change (n,) of other cells if readings are off by ``volts`` (n,). None: not paid for."""
        order = np.argsort(volts)[::-1]
        largest = [place for place in order[:_ONE_BY_ONE].tolist() if volts[place] > 0.0]
        of, before = self._alone
        alone = {place: before[place] for place in largest if place in before} if of is base else {}
        self._alone = base, alone
        for place in largest:
            if place not in alone:
                if not budget.judge(step_price):
                    return None
                alone[place] = self._effect_alone(place, base)
        changed: FloatArray = volts[largest] @ np.array([alone[place] for place in largest])
        rest = volts.copy()
        rest[largest] = 0.0
        if rest.any():
            if not budget.judge(step_price):
                return None
            changed += np.abs(base.step(rest))
        return changed

    def _effect_alone(self, place: int, base: Base) -> FloatArray:
        """Relative change (n,) of the other cells per volt of error of the reading at ``place``."""
        alone = np.zeros(len(self._per_siemens))
        alone[place] = 1.0
        change: FloatArray = np.abs(base.step(alone))
        change[place] = 0.0
        return change
