"""The state of a cell, by name: what the estimator keeps of every cell, and the memory of each inversion beside that.

Each field has one owner, which writes it. A record lies contiguously in memory, so that a kernel reaches all that it
needs of a cell at once.
"""

from __future__ import annotations

from ..common.compiled import Record


class CellState(Record):
    """One cell of an estimator: its readings, its estimate, and the doubt about both."""

    # -- readings of the frame, by the estimator --
    reading: float
    """r"""
    noise: float
    """standard deviation of the reading; 0: exact"""

    # -- the line through recent readings, by `estimation._smoothing` --
    level: float
    """present end of the line, which is the smoothed reading"""
    std: float
    """standard deviation of the level by the noise"""
    slope: float
    """per second"""
    count: float
    """number of readings since the line began"""
    up: float
    """CUSUM of departures upwards, in standard deviations"""
    down: float
    """the same downwards"""
    level_before: float
    """the line before the frame: this and the next four"""
    slope_before: float
    count_before: float
    up_before: float
    down_before: float

    # -- the estimate, by the inversion --
    pressure_kpa: float
    gain_kpa: float
    """kPa per unit of r, by which noise enters the pressure"""
    variance_kpa2: float
    """by the uncertainty of the memory"""
    last_kpa: float
    """pressure of the last frame; of inversions whose ``bends`` are not 0, as the next one"""
    before_last_kpa: float
    released: float
    """1 where the last change of the load was a fall, else 0; of inversions whose ``rests`` are not 0, as the next
    ones"""
    unconfirmed: float
    """1 where the last turning point is not confirmed, else 0"""
    left_kpa: float
    """where it is not confirmed, the extreme of sign times pressure that was left at the turn"""
    turn_variance_kpa2: float
    """by turning points at uncertain times; a part of the variance"""
    rest_variance_kpa2: float
    """of a released cell by its memory"""
    rested: float
    """1 where the cell is classified as at rest, else 0"""

    # -- motion within the noise, by `estimation._tremor` --
    risen_from_kpa: float
    """pressure at the beginning of the window"""
    looked_at_kpa: float
    """pressure at the last look"""
    edge_kpa: float
    """largest rise from one look to the next in this window; an edge of a load lies between two looks"""
    waiting_kpa: float
    """rise in earlier windows that is in doubt until this window ends"""
    suspected: float
    """largest suspicion in this window, 0 to 1"""
    amplitude: float
    """estimated amplitude of the motion over that of the noise"""
    beside_before: float
    """variance ratio of the last window"""
    unrest_before: float
    """lesser variance ratio of the last two windows"""
