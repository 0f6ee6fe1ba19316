"""Enclosure of all sets of cells that give the readings of a follower board.

A follower of finite gain A or with an offset holds idle lines a little below the sensed column, by the voltage e. The
column's conductance S to all idle lines then takes the current e S, in addition to that of the reference resistor:

    Y_ij (drive - V_ij) = V_ij / Rref + e_ij S_ij,        Y_ij = G_ij / att_ij.

Y is the conductance from the row's driver to the column's end, and att the attenuation by the leads of row and column.
Both att and S grow with all cells. The cells of a row whose lead takes most of the drive may therefore conduct many
times as much, if those of the columns do too: the larger S demands what the larger att loses. For equal cells this is a
quadratic equation, and both of its solutions may be those of real cells.

For given readings the equations are a fixed point G = F(G), and F grows with each cell. Let b be the largest factor, at
one cell or more, by which some other solution exceeds the found one. There,

    b G_ij <= F_ij(b G).

If F(b G) < b G at all cells, no solution exceeds the found one by a largest factor of b. This is tried for all b up to
cells of 1 ohm, and likewise for all factors below 1. From the largest possible factor we start the sequence of F, which
falls to the largest solution, cell by cell. Other sets with cells of less than 1 ohm are not enclosed.

Idle lines above the sensed column bring current into it instead, for example by an offset while a poor conductor is
read. The sequence uses the found S for them. If other solutions may be far away, S is enclosed with these, and so is
its effect on such a reading. The same holds for current that reaches the column by detours: over a column's own wire,
other rows and their cells.
"""

from __future__ import annotations

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._follower_law import LEAST, FollowerLaw, enclose
from ._frame_budget import Budget
from ._linearised import Base

_LARGEST_SIEMENS = 1e6  # for cells whose fit ran away to infinity
_BOUNDLESS = 1e12  # 1/S, for readings of nearly zero
_LARGEST_ERROR = 1e3  # relative, of a reading without current
_DRIFTED = 1.65  # factor by which cells may differ from those of a base while it serves
_ALIKE, _ALIKE_MARGIN = 0.05, 1.25  # change of logarithms up to which a result is kept, and the factor on it


class FollowerSolutions:
    """Encloses all sets of cells with the readings of one board."""

    def __init__(self, parts: CoupledBoard, price: float) -> None:
        """For a board; ``price`` of an enclosure."""
        self._price = price
        board, lines = parts.board, parts.lines
        self._parts = parts
        self._row, self._wire = _finite(lines.to_driver), _finite(lines.to_end)  # (N, M) ohm
        self._lead = _finite(np.broadcast_to(board.column_lead, parts.shape[1:]))  # (M,) ohm
        self.applies = board.circuit.drives_idle_lines
        """whether the circuit has followers that drive idle lines"""
        self._enclose = enclose.machine_code() if self.applies else None
        self._kept: tuple[Base | None, bool] = None, False  # whether others are conceivable while a base serves
        self._last: tuple[FloatArray, FloatArray | None] | None = None  # logarithms (n,) and the change found for them

    def change(self, frame: Frame, known: Known, base: Base, budget: Budget) -> FloatArray | None:
        """Largest relative change (n,) from the found cells to others with the same readings.

        Args:
            frame: the readings.
            known: the cells found for the readings.
            base: the linear model of the fit.
            budget: of the frame.

        Returns:
            None if linear uncertainties suffice, as in nearly all frames, or if the frame cannot pay.

        """
        if self._kept[0] is base:
            if not self._kept[1]:
                return None
            if self._last is not None and np.abs(self._last[0] - known.log).max() <= _ALIKE:
                return self._last[1]
        if not budget.judge(self._price):
            return None
        law = self._law(frame, known)
        found = law.change()
        if self._kept[0] is not base:
            self._kept = base, found is not None or law.is_conceivable(_DRIFTED)
        change = None if found is None else _ALIKE_MARGIN * found.ravel()
        self._last = known.log, change
        return change

    def _law(self, frame: Frame, known: Known) -> FollowerLaw:
        """The fixed-point equation for a frame's readings."""
        board, shape = self._parts.board, self._parts.shape
        conductance = np.minimum(board.cell_conductance(known.cells), _LARGEST_SIEMENS)
        column = known.volts.reshape(shape) / board.loop_share - board.level - board.offset
        sign = float(np.sign(board.drive))
        below = sign * (board.inverse_gain * column - board.follower_lift)
        current = np.maximum(sign * (column / board.reference + board.bias), LEAST)
        counts: BoolArray = ~self._parts.gone.reshape(shape)
        if frame.ignored is not None:
            counts = counts & ~frame.ignored.reshape(shape)
        error = np.minimum(frame.error * frame.slope, _LARGEST_ERROR).reshape(shape)
        per_siemens = np.clip(below / current, -_BOUNDLESS, _BOUNDLESS)
        leads = self._row, self._wire, self._lead
        return FollowerLaw(*leads, conductance, per_siemens, error, counts, self._enclose)


def _finite(ohm: FloatArray) -> FloatArray:
    """Ohm, contiguous; 0 where lines are broken."""
    return np.ascontiguousarray(np.where(np.isfinite(ohm), ohm, 0.0))
