"""What the driver advises after the first frames: why cells are not valid, and what a tare would mend."""

from __future__ import annotations

import numpy as np

from ..cell import Cell
from ..circuits import Reason, ValidityRule
from ..common.measurement import Measurement
from ._rest import Rest
from ._statistics import Counters
from ._tare import far_from_sheet
from ._tuning import CLEAR_SHARE, FEW_VALID, FIRST_FRAMES, UNSETTLED_FRAMES

_NO_CELL = (
    "the data of the cells are not known, so there are no pressures (NaN): the board does not send them; give them, "
    'Skin.open(..., cell="cell.toml"), as `ohmskin fit` writes them'
)
_WHY_NONE = {
    Reason.NO_CURRENT: "their readings show no current; the drive's voltage, the converter's range and the reference "
    "resistor of the design may not fit each other, or the skin is not connected",
    Reason.SATURATED: "their readings stand at a limit of the converter or the output; a smaller reference resistor, "
    "or a smaller drive voltage, lowers them",
    Reason.DISTURBED: "other cells, which stand at a limit or behind a fault, may shift their readings by more than "
    "was asked for; look for shorted cells, or take a circuit that reads each cell alone",
    Reason.UNSOLVED: "no cells give such readings; the design is not that of this board",
}

_ALIKE = (
    "cells of other resistances would give the same readings; the range of the cells, of CELL.toml or of [cells] in "
    "the design, tells which of them are meant"
)


class Advice:
    """Judges board and skin by their first frames, and writes remarks into the counters."""

    def __init__(
        self, cell: Cell | None, rest: Rest | None, accuracy: float | None, counters: Counters, *, knows_circuit: bool
    ) -> None:
        """Begin.

        Args:
            cell: of the skin.
            rest: its rest resistances; None: the cell is not known.
            accuracy: that was asked for.
            counters: whose ``remark``, ``untared`` and ``notices`` are written.
            knows_circuit: whether there are resistances.

        """
        self._cell, self._rest, self._accuracy, self._counters = cell, rest, accuracy, counters
        self._knows_circuit = knows_circuit
        self.frames: int | None = 0
        """first frames counted so far; None: all have been judged"""
        self._reasons = np.zeros(len(Reason), dtype=np.int64)  # cells of those frames by reason
        self._surest = np.inf  # least uncertainty of their cells
        self._alike = False  # whether other cells would give the same readings
        self._sheet: str | None = None
        """why the data sheet seems to be another skin's"""
        counters.untared = self._why_to_tare()

    def renew(self) -> None:
        """Take other rest resistances into account."""
        if self.frames is None:
            self._counters.untared = self._why_to_tare()

    def take(self, measured: Measurement) -> None:
        """After the first frames, report once why cells are not valid, or that rest resistances are not known."""
        assert self.frames is not None, "all have been judged"
        self.frames += 1
        if self.frames <= UNSETTLED_FRAMES:
            return
        cells = np.bincount(measured.reason.ravel(), minlength=len(Reason))
        if self._cell is not None and self._cell.open_at_rest:  # a cell without current bears no load: no fault
            cells[Reason.VALID] += cells[Reason.NO_CURRENT]
            cells[Reason.NO_CURRENT] = 0
        cells[Reason.NO_CELL] = 0
        self._reasons += cells
        uncertain = measured.reason == int(Reason.UNCERTAIN)
        self._surest = min(self._surest, float(measured.uncertainty.min(initial=np.inf, where=uncertain)))
        self._alike |= bool((uncertain & (measured.least > 0.0) & np.isfinite(measured.greatest)).any())
        if self.frames < FIRST_FRAMES:
            return
        self.frames = None
        if self._reasons[Reason.VALID] <= FEW_VALID * self._reasons.sum():
            self._counters.remark = self._why_none_valid()
            if self._counters.remark:
                self._counters.notices.append(self._counters.remark)
        else:
            self._sheet = self._unlike_sheet(measured)
            self._counters.untared = self._why_to_tare()
            if self._counters.untared and self._sheet:
                self._counters.notices.append(self._counters.untared)

    def _why_none_valid(self) -> str | None:
        cells, valid = self._reasons.sum(), self._reasons[Reason.VALID]
        found, others = "no cell was", "the best one"
        if valid:
            found, others = f"{100 * valid / cells:.1g} % of the cells were", "the best of the others"
        start = f"{found} valid in the first {FIRST_FRAMES} frames: "
        reasons = self._reasons.copy()
        reasons[Reason.VALID] = 0
        why = Reason(int(reasons.argmax()))
        if why in _WHY_NONE:
            return start + _WHY_NONE[why]
        best = self._surest
        if best >= 1.0:
            return start + _ALIKE if self._alike else None
        asked = f"{100 * ValidityRule.of(self._accuracy).limit:g} %"
        return (
            f"{start}{others} is known to {100 * best:.2g} %, and {asked} was asked for; "
            f"Skin.open(..., accuracy={min(1.5 * best, 0.99):.2g}) takes cells known so well; a converter of more "
            "bits, or another reference resistor, tells more"
        )

    def _unlike_sheet(self, measured: Measurement) -> str | None:
        """A remark if the resistance of the typical cell is far from the data sheet's value at rest."""
        if not measured.valid.any():
            return None
        far = far_from_sheet(float(np.median(measured.resistance[measured.valid])), self._cell)
        if not far:
            return None
        return (
            f"{far}: the cell or the design is another skin's or in another unit, or the whole skin is loaded; "
            "correct them, or tare() the unloaded skin"
        )

    def _why_to_tare(self) -> str | None:
        """A remark if rest resistances that nobody measured leave a notable error of the pressures."""
        if self._cell is None or self._rest is None:
            return _NO_CELL if self._knows_circuit else None
        if self._rest.known:
            return None
        if self._sheet:
            return self._sheet
        spread = self._rest.spread
        kpa = self._rest.kpa_of(spread)
        if kpa < CLEAR_SHARE * self._cell.full_scale_kpa:
            return None
        return (
            f"without a tare pressures are known to {kpa:.2g} kPa at best: the cells differ from the rest resistance "
            f"of the data sheet by {100 * spread:.2g} %, or the skin was loaded; tare() the unloaded skin"
        )
