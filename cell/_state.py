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

    begun: float
    """1 where the reading of the frame starts a new line, else 0"""

    # -- a jump that may be a bad contact, by `estimation._sparks` --
    jump: float
    """of r, from the line before; 0: none"""
    jump_s: float
    """time since the jump"""
    jumped_from_kpa: float

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


class NoiseState(Record):
    """The noise of one cell, by `estimation._noise`."""

    variance: float
    """of the cell's own noise at rest"""
    crowd: float
    """recent fraction of outliers among the third differences"""
    on_line: float
    """number of readings since the smoothing last noticed a change; written by the smoothing"""
    blind: float
    """number of further frames for which the window contains a substituted reading"""
    excess: float
    """variance at rest of the shared noise that is left, over that of own noise; set by `estimation._shared_noise`"""
    resolution: float
    """standard deviation of r at rest by quantisation; 0: not known"""
    at_rest: float
    """standard deviation of r at rest"""


class ColumnState(Record):
    """One column of a divider, by `estimation._shared_noise`."""

    telling: float
    """number of sleeping cells that measured the shared noise in the last frame; negative: not known"""
    load_sum: float
    """CUSUM of their mean departure in the direction of loads, in standard deviations of its noise"""
    frames: float
    """since the sum was zero"""
    untold: float
    """1 where the telling cells are too few, else 0"""
