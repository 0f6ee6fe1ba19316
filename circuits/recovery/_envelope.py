"""Intervals of known cells beside unknown ones, by numerical continuation.

The solution for the known cells depends on the conductances of the unknown ones. We solve for the known cells at
several values of the unknown conductances; the interval of each known cell is the envelope of those solutions. The
unknown conductances move in steps from their recovered values to the far end of their range.

This envelope is supported by an argument and by tests, not by a proof.
If all known cells were fixed, every potential would be a Moebius function of one unknown conductance. A Moebius
function is monotone between its poles, so the two ends of the range would suffice. The known cells are not fixed,
because they have to keep reproducing their own readings. Their motion is a second-order effect of either sign. Four
measures allow for this effect:

1. Two intermediate points are solved as well (:data:`_CONTINUATION_FACTORS`).
2. A share of the product of the largest changes on a cell's two lines is added (:data:`_COUPLING_SHARE`).
3. All intervals are widened by a safety factor (:data:`MARGIN`).
4. Several unknown cells can compensate each other. They therefore move together first, then one group of lines at a
   time. The changes from the groups are added with equal signs.

Sometimes no conductances of the known cells reproduce the readings at the far end. Cells that have moved before this
point then get an unbounded interval. The tests draw unknown cells at random and check that the known cells lie within
their intervals.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ._frame_model import Model
from ._inversion import Found, Held, Inverter
from ._unknown import Unknown

MARGIN = 2.0  # safety factor on the interval of a known cell if other cells are unknown
_CONTINUATION_FACTORS = (6.0, 40.0, inf)  # unknown over recovered conductance at the points of the continuation
_RETRIES = 1  # smaller steps to try after a continuation step that failed
_EXTRAPOLATION = 4.0  # factor on the changes of the known cells if the continuation ends early
# Relative change above which a cell gets an unbounded interval if the continuation ends early:
_UNBOUNDED_CHANGE = 1e-3  # because the iteration did not converge
_UNBOUNDED_CHANGE_NEGATIVE = 1e-7  # because a cell would need a negative conductance
_COUPLING_SHARE = 0.25  # second-order change of a cell over the product of the largest changes on its two lines
_NOISE = 1e-3  # cell over apparent conductance: smaller cells may appear and vanish with the noise of readings


class Envelope:
    """Continuations of one board, for a stream of frames."""

    def __init__(
        self, model: Model, unread: BoolArray, accuracy: float, most: Callable[[FloatArray], FloatArray]
    ) -> None:
        """For a board.

        Args:
            model: of the board.
            unread: (N, M) cells that no reading depends on.
            accuracy: of the solutions, as in :func:`._recover.recover`.
            most: from conductances S (N, M) to the largest ones that unknown cells may have which conduct so much.

        """
        self._model, self._unread, self._accuracy, self._most = model, unread, accuracy, most
        self._continuations: dict[tuple[int, float], Inverter] = {}
        self._path_ends: dict[int, tuple[BoolArray, float]] = {}

    def distance(self, measured: FloatArray, found: Found, unknown: Unknown) -> tuple[FloatArray, FloatArray]:
        """Distances in S (N, M) from ``found`` to the lower and upper envelope, see the module docstring."""
        known, groups = found.conductance, unknown.groups()
        down, up = [], []
        sides = [bool(group.at_least.any()) for group in groups]
        if max(sides.count(True), sides.count(False)) > 1:  # otherwise one group of a kind is all of it
            groups.insert(0, unknown)
        for number, some in enumerate(groups):
            visited = self._continue_to_far_end(measured, found, unknown, some, number)
            down.append(known - np.min(visited, axis=0))
            up.append(np.max(visited, axis=0) - known)
        less, more = (np.maximum(side[0], np.sum(side[1:], axis=0)) for side in (down, up))
        # Second-order coupling: through an unknown cell and back along another line. Its size is at most the product
        # of the changes on the two lines.
        moved = np.divide(np.maximum(less, more), known, out=np.zeros_like(known), where=(known > 0) & ~unknown.any)
        moved = np.minimum(moved, 1.0)
        around = _COUPLING_SHARE * known * moved.max(axis=1, keepdims=True) * moved.max(axis=0)
        return less + around, more + around

    def _continue_to_far_end(
        self, measured: FloatArray, found: Found, unknown: Unknown, moving: Unknown, number: int
    ) -> list[FloatArray]:
        """Solve by continuation while the unknown cells ``moving`` go to the far end of their range.

        Args:
            measured: V (N, M).
            found: the solution with all unknown cells at their recovered values.
            unknown: all unknown cells; those that are not ``moving`` keep their recovered values.
            moving: the cells that move.
            number: identifies this group of cells from frame to frame.

        Returns:
            Conductances in S, each (N, M), at the points of the continuation, starting with ``found``.

        """
        known = found.conductance
        visited, reached, most = [known], 1.0, self._most(known)
        # The search for the end of a continuation takes the time of many frames. If the same cells are unknown in the
        # next frame, we assume the same end.
        cells, end = self._path_ends.get(number, (None, inf))
        ended = cells is not None and bool((cells == unknown.any).all())
        pending, retries = (
            [times for times in _CONTINUATION_FACTORS if not ended or times < end],
            0 if ended else _RETRIES,
        )
        runaway = _UNBOUNDED_CHANGE
        while pending:
            times = pending[0]
            if (number, times) not in self._continuations:
                self._continuations[number, times] = Inverter(self._model, self._unread, 1e3 * self._accuracy)
            held = Held(unknown.any, moving.moved(known, times, most))
            there = self._continuations[number, times].beside(measured, held, visited[-1])
            # A known cell that conducted has reached zero, so it would need a negative conductance: there is no
            # physical solution at this point.
            if there is not None and ((known > _NOISE * found.target) & (there == 0) & ~unknown.any).any():
                there, runaway = None, _UNBOUNDED_CHANGE_NEGATIVE
            if there is not None:
                visited.append(there)
                reached = pending.pop(0)
            elif retries:
                retries -= 1
                pending.insert(0, reached * float(np.sqrt(min(times / reached, 100.0))))
            else:
                self._path_ends[number], ended, pending = (unknown.any, times), True, []
        if ended:  # no solution at the far end: extrapolate, or give up the bounds of cells that moved
            off = (np.abs(visited[-1] - known) > runaway * known) | (known == 0) | (reached < _CONTINUATION_FACTORS[0])
            onwards = np.maximum(known + _EXTRAPOLATION * (visited[-1] - known), 0.0)
            visited += [np.where(off, inf, onwards), np.where(off, 0.0, onwards)]
        return visited
