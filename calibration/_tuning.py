"""Tuned numbers of the calibration, each with its unit and what sets it."""

from __future__ import annotations

# -- levels of noise, in standard deviations ---------------------------------------------------------------------------

SURE_STDS = 6.0
"""of a change at rest, and of a load that was not held still, beyond its other limit"""
CLEAR_STDS = 5.0
"""least load of a press that begins, of a smoothed load"""
ERROR_STDS = 4.0
"""of an averaged reading at rest, beyond :data:`MOST_REST_CHANGE`"""

# -- the skin at rest --------------------------------------------------------------------------------------------------

SHEET_FACTOR = 3.0
"""largest ratio between the median cell and the data sheet that manufacturing tolerances explain"""
CELL_FACTOR = 2.0
"""largest ratio between one cell and the median cell"""
REST_CHANGE = 0.01
"""largest relative change of a cell during the rest measurement"""
MOST_REST_CHANGE = 0.03
"""largest relative error of a rest resistance: 3 % correspond to 4 to 6 % of full scale (docs/estimator.md)"""
BASELINE_RISE_S, BASELINE_FALL_S = 5.0, 0.3
"""time constants with which the baseline follows rising and falling estimates between presses"""

# -- presses -----------------------------------------------------------------------------------------------------------

BEGIN, END = 0.25, 0.5
"""a press begins at the first fraction of the planned load, and ends at the second fraction of its own largest load"""
MOST_BESIDE, LEAST_COVERED = 0.5, 0.5
"""most that another cell may bear of the load on a target; least share of the target's cells that must be under load"""
TOUCH = 0.2
"""fraction of the hold; shorter loads are touches or noise, and ignored"""
MOST_SMOOTHED = 0.25
"""longest averaging time, over the hold"""
UNREAD_S = 0.2
"""a cell that was read at rest, and is not read for longer than this, counts as pressed too hard"""
UNREAD_LOADS = 10.0
"""largest load of a cell, over the largest of the plan; a cell without a reading counts as this much"""
OTHER_STEP = 0.4
"""a press is assigned to another step if its (logarithmic) distance to that step's load is below this fraction of the
distance to the present step's load"""
STEADY = 0.1
"""largest relative departure of the load, or of a reference, from its mean over the second half of a hold"""
LEAST_HOLD = 0.8
"""least duration of a hold, over the requested one"""
HOLD_WINDOWS = 3
"""number of averaging windows in the second half of a hold"""
LONGEST_WINDOW_S = 10.0
"""longest evaluated part of a hold, counted back from its end; longer parts add no information"""
MARGIN = 0.05
"""gap between the averaging window before a press and the press, over the duration of the rest measurement"""
PATIENCE_S = 600.0
"""longest time without an event, by the board's clock"""

# -- fit and verdict ---------------------------------------------------------------------------------------------------

STEP = 1e-4
"""step of ln R0 and ln gain, for finite differences"""
ROUNDS, ENOUGH = 20, 1e-9
"""most iterations, and change of ln R0 and ln gain in one that ends them"""
LARGEST_MOVE = 1.0
"""largest change of ln gain in one iteration"""
GAINS = (0.25, 4.0)
"""range of believable gains"""
LEAST_PRESSES = 2
"""least number of presses of each cell; a single press does not show its own error"""
TOLERANCE = 0.1
"""largest rms residual over the presses of a cell, over the load; largest noise of a window mean, over the measured
effect of a load"""
UNKNOWN_GAIN_STD = 0.2
"""relative standard deviation of the gain of cells without calibration, if fewer than three calibrated cells show the
scatter of gains"""

# -- clocks of a reference sensor --------------------------------------------------------------------------------------

RASTER_S = 0.02
"""common raster of skin and reference"""
LEAST_CORRELATION = 0.8
"""of their loads after alignment"""
LONGEST_DRIFT_PPM = 2000.0
"""of their clocks: the worst oscillators of loggers"""
