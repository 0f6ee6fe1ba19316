"""The state of a cell, by name: what the estimator keeps of every cell, and the memory of each inversion beside that.

Each field has one owner, which writes it. A record lies contiguously in memory, so that a kernel reaches all that it
needs of a cell at once.
"""

from __future__ import annotations

from typing import Annotated

from ..common.arrays import FloatArray
from ..common.compiled import Record

Pair = Annotated[FloatArray, 2]
Scales = Annotated[FloatArray, 4]
"""one number for each block length"""


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
    level_std: float
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
    """pressure before the jump"""
    jump_is_load: float
    """1 where neighbouring cells tell that the jump is a load, else 0; by `estimation._taps`, as the next one"""
    jump_frames: float
    """number of frames in which a neighbour has moved with the jump"""

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


class PaperState(Record):
    """Memory of a paper cell: two hypotheses about its last turning point, the tests on them, and its path length."""

    # -- `inversions._linear_models`: state of the rising and of the recovery model --
    r: float
    rising_kpa: float
    settled_kpa: float
    """the pressure behind the lag of the rising model"""
    rising_x3: float
    """r of the slow branch, as the rising model has it"""
    recovery_kpa: float
    x2: float
    """r of the fast branch in recovery"""
    recovery_x3: float

    # -- `inversions._hypotheses` --
    direction: float
    """1: the rising model is in force; -1: the recovery model"""
    turn_due: float
    """1: the readings refute the hypothesis in force, so that the next frame takes over the other one; else 0"""
    third_last_kpa: float
    """pressure of three frames ago"""
    extreme_kpa: float
    """largest direction times pressure since the last turn, less some standard deviations of noise"""
    peak_kpa: float
    """the same, less one standard deviation"""
    recent_extreme_kpa: float
    """an extreme that fades as fast as an error of the memory may"""
    earlier_kpa: float
    """by how much the other hypothesis would be further back if the load had turned earlier: the third hypothesis"""
    earlier_least_kpa: float
    """direction times the least pressure of the third hypothesis since it began"""
    earlier_from_kpa: float
    """direction times the pressure when it began, plus what the pressure went in frames in which it seemed to rise"""

    # -- `inversions._sequential_tests`: rest of a released cell --
    drift_kpa: float
    """by how much an error of the memory that fades may make the pressure seem to turn by now"""
    drift_end_kpa: float
    """the same in the end"""
    released_kpa: float
    """pressure from which a recovering cell has fallen; 0: it did not fall"""
    subtracted_kpa: float
    """pressure that was taken for an error since the release"""
    subtracted_before_kpa2: float
    """square of the pressure that earlier rests have subtracted"""

    # -- release --
    largest_mean_kpa: float
    """largest pressure of late by means of readings"""
    cusum: float
    """sum of the standard deviations by which means have been below it"""

    # -- onset --
    may_bear_kpa: float
    """standard deviation by a load that may have begun to rise while the cell recovers"""
    looks_at_rest: float
    """looks since the recovering cell was taken for one at rest; negative where a load was taken over"""
    begun_kpa: float
    """pressure of a rising model that began at the last moment without a sign of a load, and its settled state"""
    begun_settled_kpa: float
    expected_x2: float
    """r of the branches if no load has risen since that moment"""
    expected_x3: float
    pull_kpa: float
    """negative pressure that the recovery model needs if so"""
    clear_pull_kpa: float
    """the same when it became clear; 0: not yet"""

    # -- `inversions._tremor_path`: unexplained motion --
    direction_before: float
    """at the last look"""
    last_r: float
    extreme_r: float
    """largest r since the load turned up, or the least since it turned down"""
    unexplained_r: float
    """r less all of its progress beyond the extreme"""
    looks_back: float
    """looks since r last went beyond the extreme"""
    unexplained_before_r: Annotated[FloatArray, 8]
    """the unexplained r at earlier looks, as known now"""

    # -- path length --
    looks: float
    looks_held: float
    """looks since an edge"""
    mean_r: Scales
    """mean of the last block"""
    mean_before_r: Scales
    bends: Scales
    """mean squares of second differences, of first and of second ones upwards, and of both downwards, in units of the
    variance by noise and less the part of noise"""
    up: Scales
    bends_up: Scales
    down: Scales
    bends_down: Scales
    balance_r: float
    """path that is told less that which turns have explained, where it is negative"""
    may_balance_r: float
    """the same of the path that may be"""
