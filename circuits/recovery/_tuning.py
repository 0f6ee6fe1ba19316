"""Tuned numbers of the recovery, each with its unit and what sets it."""

from ..solvers import ULP

# -- Validity ----------------------------------------------------------------------------------------------------------

ACCURACY = 0.5
"""default relative uncertainty of a conductance up to which a cell is valid. The uncertainty bounds the error, so a
resistance is never off by a factor of two; the root mean square of errors is about a sixth of the uncertainty"""
MOST_NOISE = 0.95
"""relative uncertainty of a noisy reading that an average can use"""
SIGMAS = 3.0
"""standard deviations of the readings' noise that an uncertainty covers"""
OF_STEPS = 0.105
"""share of an uncertainty up to which noisy readings serve that ADC steps may have in it: averages do not reduce it"""
BY_STEPS, BY_NOISE = 4.5, 3.5
"""standard deviations of other readings' steps and noise that are covered"""
ALIKE = 2.0
"""by how much rounding of equal readings exceeds independent errors in the sum of a column: measured where cells at
rest are alike; 1.8 in a pressed column of equal cells"""
RANGE_SPARE = 10.0
"""lowest resistance within the range of loads over the least of any cell: overloads, cells that differ"""
OFTEN = 3
"""frames with readings that no cells give, after which the design is taken for wrong"""

# -- All answers (_answers.py) -----------------------------------------------------------------------------------------

MOST_WIRE = 2.0
"""resistance of a cell's lines over its own from which on it reads like a short"""
STANDS_OUT = 10.0
"""port conductance over the usual one of its column, from which on a short may be behind it"""
FEW_ROWS = 3
"""below which the usual one is that of all cells"""
CONTACT_OHM = 0.01
"""of a cell of which nothing is declared: contacts of metals have as much"""
ONE = 3.0
"""largest over least conductance of all answers, up to which they are one within their errors"""
NARROWING_ROUNDS = 40
"""of narrowing bounds on all answers"""
NARROWED = 1e-3
"""largest relative change of a bound in the last round"""

# -- Laws (_law_kernels.py, _law_frames.py, _live_law.py) --------------------------------------------------------------

LEAST = 1e-12
"""share of a voltage that counts as none"""
OPEN_SCALE, OPEN_ROW = 0.7, 0.3
"""error of what is left of a column's drive or of a row's, relative to it, from which on its scale is open"""
OPEN = 1e-14
"""S, of an open cell in the model"""
LARGEST_LOG = 50.0
"""logarithm that is as good as infinite"""
BEYOND = 3.0
"""errors by which a column may seem to leave less than nothing of its drive"""
ONE_WITHIN = 0.1
"""relative change of a cell within the error in which all answers lie, up to which they are one"""
DOMINATED = 0.1
"""share of the drive at a column over the largest one, up to which a cell is small beside another"""
SHEET_EVALUATIONS = 1
"""of a continuous sheet in a frame, a hundred times as dear as that of a sliced one"""
MOST_HIDDEN = 10.0
"""conductance of a cell behind a named break over the median of others, if no range is known"""
HIDDEN_MARGIN = 2.0
"""for some of the cells behind a break that conduct well, where the effects of all at once cancel"""
COUPLED = 0.3
"""share of a column's current that may pass to others, from which on steps do not tell what is left"""

# -- Factors beside a law (_factors.py) --------------------------------------------------------------------------------

EVALUATIONS, FIRST_EVALUATIONS = 4, 30
"""of the full model in one frame, and in the first one of all"""
FRESH = 0.2
"""share of an uncertainty that a factor may be off by"""
ROUGHLY = 0.5
"""share of the law's error that a cell may be off by which is not valid and only loads others"""
LEAST_FACTOR, MOST_FACTOR = 0.2, 5.0
"""beyond, a difference takes the place of the factor"""
STRIDE = 1.0
"""of the logarithm of a cell that is not valid, half of which a step takes"""
EXPONENTS = -40.0, 7.0
"""range of the logarithms of conductances"""
REGULAR = 1e-12
"""of the equations of steps, over their scale: what nothing determines stays"""

# -- Bounds beside unknown cells (_enclosure.py) -----------------------------------------------------------------------

ENCLOSURE_MARGIN = 1.2
"""for segments, and for what is beyond the first order"""
UNCLEAR = 0.1
"""relative error from which on a cell's own error counts in other columns"""
TIES_ROW = 0.01
"""share of a row's drive from which on a cell ties its column to the row"""
UNUSUAL = 30.0
"""largest ratio of a cell beside a short to the best conducting one, behind amplifiers"""
COLUMN_ROUNDS = 12
"""to the bounds of cells along a column; more of them change none by a tenth"""
MOST_CHANGE = 1e6
"""relative change that stands for any larger one"""
MOST_CORRECTED = 3.0
"""by which a cell beyond the law's counts"""
LEAST_DRIVE_LEFT = 1e-9
"""of a row's drive"""

# -- Coupled fits (_live_fit.py, _usual_fits.py) -----------------------------------------------------------------------

FIT_STEPS, FIRST_STEPS = 6, 60
"""evaluations of the model in one frame, and in the first one of all"""
USUAL_STEPS = 3
"""evaluations of the model in a usual frame"""
RENEWALS, FIRST_RENEWALS = 3, 20
"""new derivatives in one frame, and in the first one of all"""
LARGEST_MATRIX = 4096
"""cells up to which a matrix of all readings by all cells is made: 0.3 GB"""
MOST_BESIDE = 256
"""cells up to which they are one beside shorts and cells that nothing reads, which no structure fits"""
SMALL_MATRIX = 100
"""cells up to which the derivatives are a matrix"""
ALIKE_ERRORS = 20.0
"""inverse of the relative change of the readings' errors up to which covariances are alike"""
FITS, MISFIT = 0.5, 8.0
"""half steps and noise: by rounding alone, and from which on no cells give these readings"""
NO_FIT = 1.5
"""half steps of readings from those of the cells: no fit yet. As many cells as readings fit closely, or it is another
minimum"""
SETTLED, LARGE = 0.3, 0.02
"""step that does not matter, in standard deviations of a share; change of one that always does"""
SHORT_SHARE = 0.98
"""of the reading of a short, from which on a cell may be one"""
FAR, FAR_ERRORS, LEAST_FAR = 0.4, 3.0, 0.02
"""change for which derivatives no longer serve: of a logarithm, in standard deviations of a share, and of a share as
far as it is not that of a short"""
NEARER, FIRST_HALF = 0.8, 0.9
"""largest part of the way to a short in one step, and largest share after a step from the first half"""
FAR_BELOW, LEAST_BELOW, MOST_BELOW = 5.0, 0.01, 0.2
"""how far a share may be below nothing, in standard deviations, and as a share at least and at most"""
HELD = 0.5
"""sum of a line's conductances over that of their sizes, below which no cell of the line may be below nothing"""
LEAST_CELL = 1e-18
"""S: a cell's resistance has to be a number"""
NEAR = 0.04
"""change of the shares, over the largest one that derivatives serve, for which new ones are alike"""
SLOW = 0.2
"""length of a step over the one before, above which derivatives are to blame"""
PROGRESS = 0.7
"""misfit at the end of a frame over that at its beginning, above which steps lead nowhere"""
SHORTER, LONGER = 0.2, 3.0
"""limit of a step over one that leads away, and over the limit of one that does not"""
STUCK = 1e-9
"""limit of a step below which they have come to their end"""
MORE_DAMPING, MOST_DAMPING = 10.0, 1e3
"""times the damping until a step is short enough; most over the largest root"""
JUMP = 20.0
"""half steps from which on closed formulas may be a nearer start"""
LEAST_READING = 0.03
"""half steps: reading of the least conductance of cells behind a break"""
TIES_LINES = 0.5
"""share from which on a cell may tie lines as a short does"""
LEAST_BEHIND = 1e-4
"""resistance that a cell sees of its lines, over the reading's resistor"""
WIRES_AS_SHORT, SHORT_SIEMENS = 1e5, 1e6
"""wires of a cell over its own resistance, and S, from which on it is as good as a short"""
TIE = 0.02
"""cell over the reference resistor, below which it ties lines to each other"""
MOST_UNREAD, MOST_TIED = 3, 8
"""cells whose intervals are gone through, by all corners and by the outermost ones"""
PATH_POINTS = 4
"""on the way of a cell of unknown size to a short"""
BESIDE_STEPS, BESIDE_STEP = 10, 0.01
"""steps to the others beside it, and relative change of shares in the last one"""
SHARE_BESIDE = 0.3
"""least share that counts beside several cells: at their corners small ones are hardly determined"""
BESIDE_SLOW = 0.5
"""of a step's length over the one before, above which derivatives are made anew"""
SWING = 0.07
"""of a share, up to which derivatives hold"""
MOST_AXES = 6
"""of the covariance along which the model is asked"""
SLOWEST = 0.9
"""ratio of two steps back to the readings, from which on they do not end"""
CONTRACTS = 0.5
"""factor of a map that surely has one fixed point, with room for derivatives that change"""
CALM = 3
"""frames by the same derivatives, after which those of many cells are worth a matrix"""
TYPICAL = 1e-5
"""S, of a cell if no reading shows a conductance"""

# -- Models and derivatives (_lines.py, _quick_model.py, _node_blocks.py, _sheet_model.py) -----------------------------

SWEEPS = 4
"""along lines, each of which gains the digits that their losses leave"""
SMALL_DENSE = 144
"""cells up to which the dense system is solved: beyond, a nested dissection is quicker"""
MOST_LOST = 1e6
"""voltage along a line over that across a cell, up to which rounding leaves ten digits"""
COMPLETE_SHORT = 1e-5
"""ohm that stands for a short of 0 ohm"""
AT_ONCE = 4096
"""derivatives that are computed together, if those of one row are fewer"""
SOME_OHM = 1e4
"""of all cells, by which it is found out whether sweeps serve"""
LIGHT = 0.25
"""largest loss in the lines for which sweeps are accurate to a percent"""
ITERATIONS = 16
"""largest number of conjugate gradients in one step"""
TOLERANCE = 0.01
"""of the residual, in the preconditioner's norm, that a step may leave"""
LINE_FITS = 3
"""alternating least squares for the two vectors of a line"""
PER_TIE = 0.5
"""missing part of a standard deviation per measure of ties: 0.1 to 0.45 on boards tried"""
LEAST_REST = 1e-6
"""least conductance of the rest of a crosspoint's lines over its own, so that a quotient is defined"""
STRUCTURE_MARGIN = 1.15
"""standard deviations by structure are 0.90 to 1.05 of the exact ones on boards tried"""
SHEET_SHARE = 0.1
"""of a change of the cells since the last solution, error of the difference"""
SHEET_SERVES = 0.01
"""change of a logarithm up to which the difference is kept"""

# -- Single frames (_recover.py) ---------------------------------------------------------------------------------------

READ_TOLERANCE = 1e4
"""largest relative error of a cell that counts as read, over the requested accuracy"""
FINER = 1e-2
"""error of the readings over the drive and the requested accuracy, so that weak cells are read as well"""
ROUNDING = 64.0 * ULP
"""of a reading, over the largest one"""
KNOWN = 0.999
"""relative uncertainty from which on nothing is known of a cell"""
RECOVERY_MARGIN = 1.5
"""for bounds beside cells of unknown size, which are of first order"""
FRAMES = 12
"""repetitions until steps have ended"""
COARSER = 30.0
"""errors of the next recovery over those of one that failed, at least"""
