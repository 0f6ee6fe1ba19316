"""Tuned numbers of the searches and samples, each with its unit and what sets it: effort, and what counts as equal.

Effort is counted in *cells solved*: cells of one frame that are read together with others (:meth:`.Target.cost`).
Limits that requirements are judged by are no tuned numbers; they stand with their quantity.
"""

# -- the worst-case search (_search.py) -----------------------------------------------------------------------------

LEAST_SOLVED, MOST_UNKNOWNS = 64, 256 * 256
"""cells, and cells times cells: corners are solved for every cell of up to 16 x 16, and for fewer of larger arrays, per
sign and state"""
WORK = 1_600_000
"""cells solved while corners are improved, and for the boards beside a worst case: seconds for a quantity"""
MOST_FLIPS, MOST_NEAR = WORK // 4, WORK // 8
"""cells solved for all flips of one corner, up to which flips are solved; and else for those near the worst cell"""
FIRST_ORDER_BEYOND = 100
"""cells of an array beyond which corners are improved by derivatives before their flips are solved"""
FEW = 4
"""corners that are improved on the largest arrays; cells per sign that have corners drawn at random; presses that a
random board is judged under at once; searches for a board with a longer frame"""
RANDOM_CORNERS = 16
"""corners of each of these cells, and random ones among the starts of targets of whole boards"""
MOST_ROUNDS = 30
"""of improvement; two are usual"""
ROUNDING = 1e-9
"""relative; a flip that changes the value by less changes nothing"""
LINE_POINTS, LINE_POINTS_IN_TIME = 7, 41
"""of a line search along a coordinate; ringing has several peaks between two ends"""
ZOOMS, MOST_LINES = 3, 6
"""of a line search to the neighbours of the best point, a third of the step each; line searches one after the other"""
LEAST_RISE = 1e-5
"""relative, of a line search or of the longest frame; less does not show in four digits"""
DIFFERENCE = 1e-3
"""of the way from a nominal value to its end: a derivative is then rounded to 1e-9 of a reading, and curved by 1e-6"""
MOST_CELLS_BY_PART = 16 * 16
"""cells of an array up to which each kind of part is searched alone"""

# -- what one solution costs, and how many are made together ----------------------------------------------------------

ALONE = 30
"""times as many cells solved: boards that are scanned one by one, as all are whose outputs saturate"""
PERIODS = 16.0
"""what the shortest period of a board costs, over one period of it: some thirty periods of one solution are tried"""
CELLS_TOGETHER = 1 << 20
"""cells that are read in one call: arrays of 8 MB"""

# -- random boards (_montecarlo.py) -----------------------------------------------------------------------------------

BLOCK = 100
"""boards that are drawn and computed in one piece; a number of the method, on which the samples depend"""
MOST_TRIES = 12
"""times that :data:`FEW` cells and presses of a board are solved"""
ROOM = 0.02
"""relative error of a value to first order, within which a candidate may still be the worst"""
MOST_BOARDS = 10_000_000
"""beyond which nobody is told how many boards would decide"""

# -- exploration (_explore.py) ----------------------------------------------------------------------------------------

TRIES = 20
"""random draws for each combination wanted"""
FRACTIONS_BETWEEN = 9
"""carbon-black fractions between the neighbours of the best one of the grid"""
MOST_AVERAGED = 1000
"""frames; a remedy that takes more is none"""
FARTHEST, FARTHEST_READING = 1e3, 3.0
"""factors on a part beyond which a change is no help; on a reference resistor or drive voltage, outputs saturate"""
STRIDES = (1.25, 2.0, 5.0, 20.0, 100.0, FARTHEST)
"""factors that are looked at before the bisection: not all quantities are monotone"""
HALVINGS = 7
"""of the logarithm of the factor, which is then known to 2 %"""
