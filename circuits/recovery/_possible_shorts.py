"""Cells of a fit that may be shorts, and the cells whose values such shorts would disturb."""

from __future__ import annotations

from functools import partial
from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ._coupled_board import CoupledBoard, Frame, Known
from ._frame_budget import Budget
from ._live_reading import SIGMAS

_FAR_BELOW = 0.05  # cell over the resistance of its leads, below which it is as good as a short
_TIES = 1.0  # the same, below which a cell may connect lines with each other
_ALIKE = 0.125  # least reading of a short over the largest reading of its column
_RESOLVED = 4.0  # half steps and noise of a reading that is clearly not zero


class PossibleShorts:
    """Effect of possible shorts on the readings of one board."""

    def __init__(self, parts: CoupledBoard, price: float) -> None:
        """For a board; ``price`` of a round of the search for shorts that could explain other cells' readings."""
        self._price = price
        self._looked, self._always_looked = False, True
        self.usually_looks = False
        """whether every frame so far has made such a search"""
        board, lines = parts.board, parts.lines
        self._board, self._shape = board, parts.shape
        explained = parts.gone.reshape(parts.shape)
        self._short = np.where(explained, 0.0, _FAR_BELOW * parts.leads)  # (N, M) ohm
        self._tie = np.where(explained | (parts.leads == 0.0), -inf, _TIES * parts.leads).ravel()  # (n,) ohm
        self._row_lead = np.where(np.isfinite(lines.to_driver), lines.to_driver, 0.0)
        self._least_signal = parts.half_step + (0.0 if board.adc is None else board.adc.step)

    def as_good_as_short(self, known: Known) -> BoolArray | None:
        """(N, M) cells far below their leads that no fault explains; None: no such cells."""
        found: BoolArray = known.cells < self._short
        return found if np.count_nonzero(found) else None

    def joins_lines(self, known: Known) -> bool:
        """Whether a cell is below its leads: then other cells, far from these, may give the same readings."""
        return bool((known.cells.ravel() < self._tie).any())

    def disturb(
        self,
        frame: Frame,
        known: Known,
        uncertainty: FloatArray,
        lost: BoolArray | None,
        lost_rows: BoolArray | None,
        budget: Budget,
    ) -> BoolArray | None:
        """Cells whose values would be wrong if possible shorts were actual ones.

        Args:
            frame: the readings.
            known: the cells found for the readings.
            uncertainty: (n,) of the conductances, without the effect of lost columns.
            lost: (M,) columns that are left out; None: there are none.
            lost_rows: (N,) rows that are left out, whose effects are bounded elsewhere; None: there are none.
            budget: of the frame.

        Returns:
            (N, M); None where there are none.

        """
        excess = frame.signal - _RESOLVED * frame.error
        if lost is not None:
            excess[:, lost] = 0.0  # their effect on their rows is known
        tied = self._tied(known, uncertainty, excess)
        least = self._least_signal + SIGMAS * frame.noise
        signal = frame.volts - self._board.level
        row_lead = self._row_lead
        if lost_rows is not None:
            row_lead = np.where(lost_rows[:, None], 0.0, row_lead)
        self._looked, may_look = False, partial(self._may_look, budget)
        imitated = self._board.circuit.imitated_by_shorts(self._board, row_lead, signal, least, may_look)
        self._always_looked &= self._looked
        self.usually_looks = self._always_looked
        if tied is None or imitated is None:
            return imitated if tied is None else tied
        return tied | imitated

    def _may_look(self, budget: Budget) -> bool:
        """Pay for a round of the search."""
        self._looked = True
        return budget.judge(self._price)

    def _tied(self, known: Known, uncertainty: FloatArray, excess: FloatArray) -> BoolArray | None:
        """Cells on lines that two possible shorts connect with each other through a third line.

        Two shorts in a column divide the voltage between their rows' leads, whichever of the two rows is driven. Both
        rows then read alike, and a few ohm of the two cells decide how the rows share the readings. The same holds for
        columns.

        Args:
            known: the cells.
            uncertainty: (n,) of the conductances.
            excess: (N, M) V of the readings above the least clear ones.

        Returns:
            (N, M); None where there are none.

        """
        small = (1.0 - uncertainty) * known.cells.ravel() < self._tie
        suspect = small.reshape(self._shape) & (excess > 0.0)
        if np.count_nonzero(suspect) < 2:
            return None
        # Shorts of one column read alike, but for the leads of their rows.
        suspect &= excess > _ALIKE * excess.max(axis=0)
        rows = (suspect & (suspect.sum(axis=0) > 1)).any(axis=1)
        columns = (suspect & (suspect.sum(axis=1, keepdims=True) > 1)).any(axis=0)
        beside: BoolArray = rows[:, None] | columns
        return beside
