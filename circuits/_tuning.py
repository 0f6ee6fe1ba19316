"""Tuned numbers of the package but for those of its solvers and of recovery, each with its unit and what sets it."""

import numpy as np

# -- numbers in general ------------------------------------------------------------------------------------------------

ROUNDING, NEGLIGIBLE = 1e-9, 1e-3
"""relative: to which a number in time is known; and the share of a sum that may be left out"""
LEAK = 1e-20
"""of the largest conductance, from each node to ground: sets the potential of nodes that nothing else holds, and is far
below an ulp beside all others"""
ROUNDS = 50
"""of all outputs that change their limits at once, before one at a time does, which cannot cycle; ten are usual"""

# -- frames and derivatives (_scan.py, _sensitivity.py) ----------------------------------------------------------------

SMALL = 64
"""cells up to which a frame is read exactly at once, since that takes hardly longer than two tries"""
FEW_NODES = 150
"""of a grid, up to which dense equations are solved faster than sparse ones"""
SHORT = 1e8
"""conductance that stands for a short, over the largest other one: readings change by about 1e-8, and derivatives keep
four digits. Grids whose conductances span as much are solved by sparse elimination, whose order keeps more digits"""
MOST_BUILT = 64
"""designs that are kept while many boards are read one by one"""

# -- readouts ----------------------------------------------------------------------------------------------------------

MOST_COLUMNS = 32
"""up to which compiled loops are faster than matrix products and LAPACK"""
LEAST_LEAD = 1e-5
"""ohm: stands for an ideal lead beside others that are not, where ten digits are enough"""
CONNECTED = 1e13
"""impedance of a node over that of a mean node, beyond which rounding alone connects it"""

# -- ends of lines (ends/, readouts/_described.py) ---------------------------------------------------------------------

HELD = 1e-3
"""of an output's slope (V/A), up to which the resistance of an end is that of a virtual ground"""
LOOSE = 1e-13
"""of the largest coefficient: leak of unknowns without which equations are singular; a few hundred ulp"""
MOST_SIEMENS = 1e8
"""S: stands for ideal wires and shorts within the ports of a grid whose ends are solved node by node"""
MOST_VOLTS = 1e10
"""V or A: only contradictions of ideal sources give so much"""
MOST_STEPS = 400
"""of Newton's method; diodes take 10 to 60"""
CONVERGED, STANDS, STANDING = 1e-11, 0.5, 1e4
"""V, and relative: a step that is the last one (the bound includes what is left); and steps that do not halve any more
are rounding up to so many times that"""
CURVE, CURVE_POINTS = (-10.0, 2.0), 241
"""logarithms of a cell's conductance in S where diodes bend its output, and points between them: 20 for each decade"""
PROBES_S = 1e-6, 1e-4
"""conductances of a cell from which its output without others follows: ordinary cells"""

# -- time (timing/) ----------------------------------------------------------------------------------------------------

WORST_CONDITION = ROUNDING / float(np.finfo(np.float64).eps)
"""condition number of eigenvectors up to which the modal form is known to :data:`ROUNDING`"""
LONG = -float(np.log(np.finfo(np.float64).eps))
"""time constants after which a deviation is below rounding"""
SLOWEST, WIDEST_HZ = 1e-6, 1e9
"""1/s, of a capacitor that nothing discharges, so that its noise is finite; and Hz: white noise beyond is that of
contacts"""
LEAST_SIEMENS = 1e-16
"""S: less is the conductance of nodes that nothing is connected to"""
NEAR = 0.1
"""of the limit: by how much less a deviation may rise between two steps of a quarter of a radian"""
FULL_GAIN, NO_GAIN = 1e-9, 10.0
"""of the gain-bandwidth: where an amplifier still has all of its gain, and where it has none left"""
MOST_CROSSINGS = 60
"""steps of a search for a crossing; each third halves the bracket"""

# -- ngspice (spice/) --------------------------------------------------------------------------------------------------

LEAST_LIMIT_S, LIMIT_PER_CARD_S, MOST_LIMIT_S = 20, 0.05, 1800
"""s of processor time for one run of the command, as a constant and by cards of the netlist, and whatever it says; a
macro-model may find no convergence for ever"""
WAITING = 20.0
"""ratio of time to processor time on a busy machine, beyond which a run is given up all the same"""
SHARPEST_EDGE_S = 1e-9
"""s of the selected row, if a macro-model has to follow: faster edges than any board's stop the convergence of some"""
POINTS_PER_DECADE = 200
"""of the loop gain"""
