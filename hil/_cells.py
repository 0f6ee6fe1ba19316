"""Cells of a frame in words, for the messages of assertions."""

from __future__ import annotations

import numpy as np

from ..circuits import Reason
from ..common.arrays import BoolArray
from ..driver import Frame

MOST_NAMED = 8
"""cells that a message names"""


def described(frame: Frame, cells: BoolArray) -> str:
    """The cells (rows, columns) where the mask is set: place, reason if not valid, counts, ohm and kPa, a line each."""
    places = [(int(row), int(column)) for row, column in np.argwhere(cells)]
    lines = [f"{len(places)} of {cells.size} cells in frame {frame.sequence}:"]
    for place in places[:MOST_NAMED]:
        reason = Reason(int(frame.reason[place]))
        why = "" if reason is Reason.VALID else f"{reason.name.lower().replace('_', ' ')}, "
        lines.append(
            f"  cell {place}: {why}{frame.counts[place]} counts, {frame.resistance[place]:.5g} ohm, "
            f"{frame.pressure[place]:.3g} +- {frame.pressure_std[place]:.2g} kPa"
        )
    if len(places) > MOST_NAMED:
        lines.append(f"  and {len(places) - MOST_NAMED} more")
    return "\n".join(lines)
