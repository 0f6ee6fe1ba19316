"""Tuned numbers of the searches and samples, each with its unit and what sets it: effort, and what counts as equal.

Effort is counted in *cells solved*: cells of one frame that are read together with others (:meth:`.Target.cost`).
Limits that requirements are judged by are no tuned numbers; they stand with their quantity.
"""

# -- the worst-case search (_search.py) -----------------------------------------------------------------------------

LEAST_SOLVED, MOST_UNKNOWNS = 64, 256 * 256
"""cells, and cells times cells: corners are solved for every cell of up to 16 x 16, and for fewer of larger arrays, per
sign and state"""
MOST_CLIMB_WORK = 1_500_000
"""cells solved while corners are improved: seconds for a quantity"""
MOST_FLIPS = 400_000
"""cells solved for all flips of one corner, up to which flips are solved"""
MOST_NEAR = 200_000
"""cells solved for flips near the worst cell, up to which they are solved where not all are"""
FIRST_ORDER_BEYOND = 100
"""cells of an array beyond which corners are improved by derivatives before their flips are solved"""
FEWEST_CLIMBS = 4
"""corners that are improved on the largest arrays"""
RANDOM_CELLS, RANDOM_CORNERS = 4, 16
"""cells per sign, and corners of each, that are drawn at random"""
MOST_ROUNDS = 30
"""of improvement; two are usual"""
LEAST_GAIN = 1e-9
"""relative; rounding of a solved reading is less"""
WITHOUT_INFLUENCE = 1e-10
"""relative; a flip that changes the value by less changes nothing"""
LINE_POINTS, LINE_POINTS_IN_TIME = 7, 41
"""of a line search along a coordinate; ringing has several peaks between two ends"""
ZOOMS, MOST_LINES = 3, 6
"""of a line search to the neighbours of the best point, a third of the step each; line searches one after the other"""
LEAST_RISE = 1e-5
"""relative, of a line search; less does not show in four digits"""
DIFFERENCE = 1e-3
"""of the way from a nominal value to its end: a derivative is then rounded to 1e-9 of a reading, and curved by 1e-6"""
STARTS_AT_RANDOM = 12
"""random corners among the starts of targets of whole boards"""
MOST_LONGEST_FRAMES, SAME_FRAME_TIME = 4, 1e-3
"""searches for a board with a longer frame, and the relative difference that ends them"""
MOST_CELLS_BY_PART = 16 * 16
"""cells of an array up to which each kind of part is searched alone"""

# -- what one solution costs, and how many are made together ----------------------------------------------------------

ALONE = 30
"""times as many cells solved: boards that are scanned one by one, as all are whose outputs saturate"""
PERIODS = 16.0
"""what the shortest period of a board costs, over one period of it: some thirty periods of one solution are tried"""
CELLS_TOGETHER = 1 << 20
"""cells that are read in one call: arrays of 8 MB"""
ENTRIES_TOGETHER = 1 << 17
"""entries of the matrices of boards in time that are solved in one call"""

# -- random boards (_montecarlo.py) -----------------------------------------------------------------------------------

BLOCK = 100
"""boards that are drawn and computed in one piece; a number of the method, on which the samples depend"""
TOGETHER, MOST_TRIES = 4, 12
"""cells and presses of a board that are solved at once, and so many times at most"""
ROOM = 0.02
"""relative error of a value to first order, within which a candidate may still be the worst"""
MOST_BESIDE = 1_000_000
"""cells solved for the boards beside a worst case"""
FOUND, FOUND_WHOLE = 4, 2
"""presses of the search's own worst corners under which every board is judged, and of boards that are judged whole"""
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
