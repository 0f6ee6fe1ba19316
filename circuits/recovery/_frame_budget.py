"""Budget of one frame of a coupled board: evaluations of the circuit model, and instalments of new derivatives."""

from __future__ import annotations

from typing import NamedTuple


class Effort(NamedTuple):
    """What a frame may cost."""

    evaluations: int
    """of the circuit model"""
    instalments: int
    """of the renewal of the derivatives, each about as much as one to five evaluations"""
    solutions: int
    """of a continuous sheet"""


USUAL_EFFORT = Effort(evaluations=4, instalments=1, solutions=1)
LARGE_EFFORT = Effort(evaluations=4, instalments=4, solutions=1)
"""of boards on which a step by the matrix of all readings by all cells is most of a usual frame"""
NODE_EFFORT = Effort(evaluations=6, instalments=3, solutions=1)
"""of boards with floating rows and many cells, where a renewal is one inversion of a matrix with a row per line"""
FIRST_EFFORT = Effort(evaluations=40, instalments=700, solutions=4)
"""in the first frame of all, before which nothing is known"""
