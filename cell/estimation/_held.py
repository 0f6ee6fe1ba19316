"""How long a cell was loaded in a recording."""

from __future__ import annotations

import numpy as np

from ...common.arrays import FloatArray

LOADED = 0.05
"""fraction of full scale above which a cell counts as loaded"""
COUNTS_OFF = 3.0
"""seconds of load that one second without load subtracts"""


def longest_s(time_s: FloatArray, load: FloatArray) -> float:
    """Longest time that a cell was loaded in a recording (n,); short pauses do not end a long load."""
    step_s = np.diff(time_s, prepend=time_s[0])
    walk = np.cumsum(np.where(load > LOADED, step_s, -COUNTS_OFF * step_s))
    return float(np.max(walk - np.minimum(np.minimum.accumulate(walk), 0.0)))
