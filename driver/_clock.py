"""Clock offset and drift between a board and its host, from one-way delays (lower convex hull).

A frame arrives late by the delays of operating system, line and buffers; never early. Plotted over the board's time,
the arrivals therefore lie above a line, which maps the board's clock to the host's. The line is the supporting edge of
the lower convex hull (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements",
INFOCOM 1999; hull by Andrew's monotone chain). A constant delay cannot be seen.
"""

from __future__ import annotations

import math
from collections import deque

BUCKET_S = 0.5
"""s; only the least delayed frame of each such interval is kept"""
WINDOW_BUCKETS = 120
"""intervals that are kept: the line follows a changing drift, as with temperature, within a minute"""
DRIFT_SPAN_S = 5.0
"""shorter spans do not determine the drift"""
LARGEST_DRIFT = 0.02
"""2 %: the worst on-chip oscillators; a steeper line is no drift"""
STEP_S = 0.05
STEP_BUCKETS = 6
"""if all frames of 3 s are later than the line by 50 ms, the board's clock was set or has paused"""


class ClockMap:
    """Maps board time to host time. Depends only on the added times, so that a replay gives the same times."""

    def __init__(self) -> None:
        self.steps = 0
        """number of times that the board's clock was set or paused"""
        self._origin: tuple[float, float] | None = None
        self._buckets: deque[tuple[float, float]] = deque(maxlen=WINDOW_BUCKETS)
        self._bucket_ends = 0.0
        self._least = (0.0, 0.0)
        self._drift = 0.0
        self._anchor = (0.0, 0.0)

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock runs than the board's, in parts per million.

        0 until 5 s of even pace have passed.

        NaN if the line has the steepest allowed slope: the board's time is then not that of a clock, as in an emulation
        at the fast clock, which runs as fast as its host reads.
        """
        return 1e6 * self._drift if abs(self._drift) < LARGEST_DRIFT else math.nan

    def add(self, device_s: float, received_s: float) -> float:
        """Take one frame.

        Args:
            device_s: time stamp of the board, in s; increasing.
            received_s: time of arrival, in s on the host's clock.

        Returns:
            Arrival time of the frame if it had the least delay seen so far, in s on the host's clock; at most
            ``received_s``.

        """
        if self._origin is None:
            self._origin = (device_s, received_s)
            self._bucket_ends = BUCKET_S
            self._least = (0.0, 0.0)
        x = device_s - self._origin[0]
        y = received_s - self._origin[1] - x
        if x >= self._bucket_ends:
            self._close_bucket()
            self._bucket_ends = x + BUCKET_S
            self._least = (x, y)
        elif y < self._least[1]:
            self._least = (x, y)
        line = self._line(x)
        if y < line - STEP_S:
            # No drift does this: the clock was set forward, or all earlier frames had waited in a buffer.
            self._buckets.clear()
            self._drift = 0.0
            line = self._line(x)
        if y < line:
            # Less delayed than any earlier frame: the line is moved down to this frame.
            self._anchor = (x, y)
            line = y
        return self._origin[1] + x + line

    def _line(self, x: float) -> float:
        return self._anchor[1] + self._drift * (x - self._anchor[0])

    def _close_bucket(self) -> None:
        self._buckets.append(self._least)
        recent = [self._buckets[k] for k in range(-min(STEP_BUCKETS, len(self._buckets)), 0)]
        if len(recent) == STEP_BUCKETS and all(y > self._line(x) + STEP_S for x, y in recent):
            self.steps += _keeps_pace(recent)
            self._buckets.clear()
            self._buckets.extend(recent)
        hull = lower_hull(list(self._buckets))
        if hull[-1][0] - hull[0][0] < DRIFT_SPAN_S:
            self._drift = 0.0
            self._anchor = min(hull, key=lambda point: point[1])
            return
        # Of all lines below the points, the one with the least sum of distances passes below their mean.
        middle = sum(x for x, _ in self._buckets) / len(self._buckets)
        right = next(k for k in range(1, len(hull)) if hull[k][0] >= middle or k == len(hull) - 1)
        (x0, y0), (x1, y1) = hull[right - 1], hull[right]
        self._drift = min(max((y1 - y0) / (x1 - x0), -LARGEST_DRIFT), LARGEST_DRIFT)
        # If the drift is limited, the edge's own ends need not be the lowest points.
        self._anchor = min(hull, key=lambda point: point[1] - self._drift * point[0])


def _keeps_pace(points: list[tuple[float, float]]) -> bool:
    """Whether a clock can give the times of ``points``, which increase in x: a fast emulation keeps no pace."""
    (x0, y0), (x1, y1) = points[0], points[-1]
    return abs(y1 - y0) <= LARGEST_DRIFT * (x1 - x0) + STEP_S


def lower_hull(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The corners of the lower convex hull of ``points``, which increase in x."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) >= 2:
            (x0, y0), (x1, y1) = hull[-2], hull[-1]
            if (y1 - y0) * (x - x0) < (y - y0) * (x1 - x0):
                break
            hull.pop()
        hull.append((x, y))
    return hull
