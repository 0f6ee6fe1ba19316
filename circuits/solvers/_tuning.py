"""Tuned numbers of the solvers, each with its unit and what sets it."""

IDEAL_WIRE = 1e40
"""conductance of 0 ohm over the largest one beside it, or ohm of an open end: its effect is far below rounding, and its
square and cube are no overflow"""
LARGEST_PART = 1e14
"""S: largest conductance of a part outside the grid (load, lead, Rref / (1 + A))"""
LEAST_OHM = 1e-60
"""ohm of a wire that is not ideal: products of larger conductances could overflow"""
SAFE_SHARE = 1e-3
"""of a node's conductance that must leave its block for LU; four digits may cancel, of sixteen"""
SUM_OF_GROWTHS = 8
"""nodes up to which a sharper rounding bound is not worth another matrix product"""
LEAF = 5
"""crosspoints along the side of the smallest blocks; single crosspoints take 1.2 to 2 times as long"""
MOST_BRANCHES = 48
"""that are assembled without halving, in networks that are no plain grids"""
KEPT_NUMBERS = 1 << 24
"""that each thread keeps in memory between calls (128 MB)"""
