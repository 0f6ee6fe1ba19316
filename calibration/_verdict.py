"""Acceptance test of a fit: which cells are calibrated, why the others are not, and the resulting calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from ..cell import Cell
from ..circuits import Design
from ..common.arrays import BoolArray
from ..common.config import fingerprint
from ..common.text import count_of
from ..driver import Calibration
from ..errors import InputError
from ._fit import Fit, fit_cells
from ._presses import Press, Rest
from ._tuning import ERROR_STDS, GAINS, LEAST_PRESSES, MOST_REST_CHANGE, TOLERANCE, UNKNOWN_GAIN_STD

MOST_NAMED = 4
"""number of cells that a message names"""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A fit, with the reasons why cells are not calibrated."""

    fit: Fit
    rest: Rest
    reasons: dict[tuple[int, int], str]
    """why a cell is not calibrated, by (row, column)"""
    loads_kpa: tuple[float, ...]
    presses: int

    @property
    def good(self) -> BoolArray:
        """(rows, columns) cells that are calibrated."""
        mask = np.ones(self.fit.gain.shape, dtype=np.bool_)
        for place in self.reasons:
            mask[place] = False
        return mask

    def text(self) -> str:
        """All reasons in one line; empty if all cells are calibrated."""
        cells: dict[str, list[tuple[int, int]]] = {}
        for place, reason in self.reasons.items():
            cells.setdefault(reason.partition(":")[0], []).append(place)
        said = []
        for kind, places in cells.items():
            named = ", ".join(map(str, places[:MOST_NAMED])) + (", ..." if len(places) > MOST_NAMED else "")
            detail = self.reasons[places[0]].partition(": ")[2]
            said.append(f"{count_of(len(places), 'cell')} {kind}: {named}" + (f" ({detail})" if detail else ""))
        return "; ".join(said)

    def calibration(
        self,
        design: Design,
        cell: Cell,
        serial_number: str,
        *,
        allow_partial: bool = False,
        date: datetime | None = None,
    ) -> Calibration:
        """The calibration.

        Args:
            design: the design whose inverse gave the resistances.
            cell: the common cell model.
            serial_number: serial number of the board.
            allow_partial: give cells without calibration the median gain of the others, with a remark.
            date: date of the calibration; None: now.

        Raises:
            InputError: a cell could not be calibrated, and ``allow_partial`` is False; or no cell could be calibrated.

        """
        good, text = self.good, self.text()
        if not good.any() or (text and not allow_partial):
            advice = " (--allow-partial leaves them out, with --resume without new presses)" if good.any() else ""
            raise InputError(f"no calibration: {text}{advice}")
        fit = self.fit
        logs = np.log(fit.gain[good])
        median = float(np.exp(np.median(logs)))
        scatter = max(float(logs.std(ddof=1)), 0.01) if len(logs) > 2 else UNKNOWN_GAIN_STD
        measured = self.rest.measured
        typical = float(np.median(fit.rest_ohm[good]))
        rest_ohm = np.where(measured, self.rest.resistance_ohm, typical)
        return Calibration(
            rest_ohm=np.where(good, fit.rest_ohm, rest_ohm),
            gain=np.where(good, fit.gain, median),
            gain_std=np.where(good, fit.gain_std, scatter),
            rest_std_kpa=np.where(good, fit.rest_std_kpa, float(np.median(fit.rest_std_kpa[good]))),
            residual_kpa=np.where(good, fit.residual_kpa, 0.0),
            calibrated=good,
            loads_kpa=self.loads_kpa,
            presses=self.presses,
            serial_number=serial_number,
            design_hash=fingerprint(design),
            cell_hash=fingerprint(cell),
            date=(date or datetime.now(UTC)).isoformat(timespec="seconds"),
            remarks=(text,) if text else (),
        )


def calibrate_cells(cell: Cell, rest: Rest, presses: Sequence[Press], *, tolerance: float = TOLERANCE) -> Verdict:
    """Fit rest resistance and gain of every cell, and decide which cells are calibrated.

    Args:
        cell: the common cell model.
        rest: the skin before the first press.
        presses: in the order of time.
        tolerance: largest rms residual of a calibrated cell, over the load.

    Raises:
        InputError: the tolerance is not positive.

    """
    if not 0 < tolerance < 1:
        raise InputError(f"a tolerance of {tolerance:g}; expected a share of the load above 0 and below 1")
    fit = fit_cells(cell, rest, presses)
    used = [press for press in presses if not press.fault]
    reasons = {}
    for row, column in np.ndindex(fit.gain.shape):
        reason = _reason(fit, (row, column), rest, tolerance)
        if reason:
            reasons[row, column] = reason
    loads = tuple(sorted({press.held_kpa for press in used}))
    return Verdict(fit, rest, reasons, loads, len(used))


def _reason(fit: Fit, at: tuple[int, int], rest: Rest, tolerance: float) -> str:
    """Why a cell is not calibrated; empty if it is. The text after a colon concerns this cell alone."""
    presses, gain = int(fit.presses[at]), float(fit.gain[at])
    change, noise, effect = float(fit.rest_change[at]), float(fit.noise[at]), float(fit.effect[at])
    if not rest.measured[at]:
        return "without a valid reading at rest"
    if fit.unread[at]:
        return "without a valid reading under load: saturated, or not in contact"
    if np.isnan(gain):
        return "never pressed"
    if presses < LEAST_PRESSES:
        return f"pressed too seldom: {presses} times; expected at least {LEAST_PRESSES} presses"
    if not noise < TOLERANCE * effect:
        return f"noisier than a load shows: noise {100 * noise:.2g} %, effect {100 * effect:.2g} % of the resistance"
    if fit.reversed[at]:
        return "changing less under a larger load"
    if not GAINS[0] <= gain <= GAINS[1]:
        return f"with a gain that is not believed: {gain:.3g}; expected {GAINS[0]:g} to {GAINS[1]:g}"
    if not abs(change) <= MOST_REST_CHANGE + ERROR_STDS * noise:
        lower = "lower" if change < 0 else "higher"
        return (
            f"with a drifting rest resistance: {100 * abs(change):.1f} % {lower} than it should be; was the skin "
            "loaded at first?"
        )
    share = float(fit.residual_share[at])
    if not share <= tolerance:
        most = f"at most {100 * tolerance:g} %"
        return f"with presses that contradict each other: {100 * share:.0f} % rms of the load; expected {most}"
    return ""
