"""Detection of vibration and slip below the noise (excess variance), and uncertainty of the rises that they mimic.

Turning points of vibration and slip go unnoticed if they lie within one frame, or are smaller than the noise. A cell
responds more to a fast rise than to a fast fall, or breaks chains both ways. Unnoticed motion therefore looks like a
rise of the load. The sign of such motion is an excess variance: the readings scatter about a smooth curve by more than
the board's noise. An edge of a load has the same sign, in one window of readings or two. A rise is therefore in doubt
temporarily while one window shows motion, and permanently if several consecutive windows do.
"""

from __future__ import annotations

import math

from ...common.arrays import IntArray
from ...common.compiled import Places, Records, Row, loop
from .._state import CellState
from ._noise import CROSSED

HIDES, SURELY_HIDES = 1.25, 1.6
"""variance ratio (variance of a cell's readings about a parabola, over that of the board's noise) in two consecutive
windows: above the first limit, a load may move within the noise; above the second, it does"""
SUSPECTS, SURELY_SUSPECTS = 2.0, 2.6
"""variance ratio of a single window; noise alone exceeds these limits in 4 and in 0.5 % of all windows"""
UNTOLD = 1.0
"""apparent rise in windows without visible motion, over that of a window in which motion is certain: about half of the
windows do not differ from noise. From slips of a few standard deviations of the noise"""
SUSPICION = 0.5
"""standard deviation of a rise that is temporarily in doubt, over that rise"""

FADES = 0.5
"""fraction of a temporary doubt that remains after the next window, if that window shows no more"""


def accept(cells: Records[CellState], places: IntArray) -> None:
    """Accept the present pressures as those of a load: clears all doubt about their rise."""
    for name in ("risen_from_kpa", "looked_at_kpa"):
        cells[name][places] = cells["pressure_kpa"][places]
    for name in ("waiting_kpa", "edge_kpa"):
        cells[name][places] = 0.0


@loop
def look_each(cells: Records[CellState], places: Places, beside: Row) -> None:
    """Update the suspicion from the pressures, and from the variance ratio ``beside`` (k,) of the readings.

    The ratio is that of :meth:`._noise.NoiseMeter.beside_parabola`.
    """
    for k in range(places.size):
        cell = cells[places[k]]
        cell.edge_kpa = max(cell.edge_kpa, cell.pressure_kpa - cell.looked_at_kpa)
        cell.looked_at_kpa = cell.pressure_kpa
        cell.suspected = max(cell.suspected, share_of(beside[k], HIDES, SUSPECTS))
        cell.amplitude = math.sqrt(min(max(beside[k] - 1.0, 1.0), CROSSED))


@loop
def end_window_each(cells: Records[CellState], places: Places, seeming: float, beside: Row, missed: Row) -> bool:
    """End a window of readings, after :func:`look_each`, and begin the next one.

    Args:
        cells: states of all cells.
        places: those that are followed.
        seeming: :attr:`._inversion.Inversion.seeming`.
        beside: (k,) as in :func:`look_each`.
        missed: (k,) rises in kPa that are permanently in doubt; written.

    Returns:
        Whether any rise is permanently in doubt.
    """
    found = False
    for k in range(places.size):
        cell, present = cells[places[k]], beside[k]
        # The lesser ratio of the last two windows counts, since a single edge lies in only one of them.
        crossed = max(present, cell.beside_before) > CROSSED
        unrest = 0.0 if crossed else min(present, cell.beside_before)
        most_kpa = seeming * cell.noise * (cell.gain_kpa * cell.gain_kpa)
        rise = seeming_rise(cell, cell.amplitude * most_kpa, cell.edge_kpa)
        found |= unrest > HIDES
        sure = share_of(unrest, HIDES, SURELY_HIDES)
        by_two = sure * (rise if rise < most_kpa else 0.0)
        by_three = share_of(min(unrest, cell.unrest_before), SUSPECTS, SURELY_SUSPECTS)
        spread = max(rise - cell.edge_kpa, 0.0)
        now = max(by_two, by_three * spread)
        missed[k] = (now + by_three * cell.waiting_kpa) * (1.0 + UNTOLD * sure)
        spread *= 1.0 - by_three
        waiting_kpa = cell.waiting_kpa * (1.0 - by_three)
        cell.waiting_kpa = cell.suspected * (spread + FADES * waiting_kpa)
        cell.suspected = share_of(present, HIDES, SUSPECTS)
        cell.risen_from_kpa, cell.edge_kpa = cell.pressure_kpa, 0.0
        cell.beside_before, cell.unrest_before = present, unrest
    return found


@loop
def doubted_rise(cell: CellState, seeming: float) -> float:
    """Standard deviation in kPa of a rise that is temporarily in doubt."""
    if cell.suspected == 0.0 and cell.waiting_kpa == 0.0:
        return 0.0
    most_kpa = cell.amplitude * (seeming * cell.noise * (cell.gain_kpa * cell.gain_kpa))
    steepest_kpa = max(cell.edge_kpa, cell.pressure_kpa - cell.looked_at_kpa)
    rise_kpa = seeming_rise(cell, most_kpa, steepest_kpa)
    return (rise_kpa * cell.suspected + cell.waiting_kpa) * SUSPICION


@loop
def seeming_rise(cell: CellState, most_kpa: float, steepest_kpa: float) -> float:
    """Rise of the pressure in kPa in this window that unnoticed motion may explain, which explains ``most_kpa``.

    A larger rise contains the edge of a load. Its steepest part is then certain; the doubt about the rest is limited to
    the doubt from earlier windows.
    """
    rise_kpa = cell.pressure_kpa - cell.risen_from_kpa
    if rise_kpa < most_kpa:
        return max(rise_kpa, 0.0)
    return min(max(rise_kpa - steepest_kpa, 0.0), most_kpa, cell.waiting_kpa)


@loop
def share_of(ratio: float, low: float, high: float) -> float:
    """Where ``ratio`` lies between ``low`` (0) and ``high`` (1)."""
    return min(max((ratio - low) / (high - low), 0.0), 1.0)
