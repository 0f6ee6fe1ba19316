"""Clock offset and drift between a board and its host, from one-way delays (lower convex hull).

A frame arrives late by the delays of operating system, line and buffers; never early. Plotted over the board's time,
the arrivals therefore lie above a line, which maps the board's clock to the host's. The line is the supporting edge of
the lower convex hull (Moon, Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements",
INFOCOM 1999; hull by Andrew's monotone chain). A constant delay cannot be seen.

A time that runs at another pace than any oscillator, or stands, is no clock (:attr:`ClockMap.pace`). Frames then have
their times of arrival.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from itertools import pairwise

from ._tuning import BUCKET_S, DRIFT_SPAN_S, GONE_S, KEEP_STATE_S, LARGEST_DRIFT, PACE_PAIRS, STEP_S

WINDOW_BUCKETS, STEP_BUCKETS = round(KEEP_STATE_S / BUCKET_S), round(GONE_S / BUCKET_S)
"""intervals that are kept, and those over which a step of the clock is seen"""


class Pace(enum.Enum):
    """How a board's time goes beside the host's."""

    EVEN = enum.auto()
    SLOW = enum.auto()
    """it stands, or is slower than any oscillator"""
    FAST = enum.auto()
    """as in an emulation that runs as fast as its host reads"""


class ClockMap:
    """Maps board time to host time. Depends only on the added times, so that a replay gives the same times."""

    def __init__(self) -> None:
        self.steps = 0
        """number of times that the board's clock was set or paused"""
        self.pace = Pace.EVEN
        self.rate = 1.0
        """s of the board's time in a second of the host's, where :attr:`pace` is not even"""
        self._origin: tuple[float, float] | None = None
        self._buckets: deque[tuple[float, float]] = deque(maxlen=WINDOW_BUCKETS)
        self._bucket_ends_s = BUCKET_S
        self._least = (0.0, 0.0)
        self._recent: deque[tuple[float, float]] = deque(maxlen=PACE_PAIRS + 1)
        """the last buckets, over which the pace is judged"""
        self._drift: float | None = None
        """None: not known yet"""
        self._span_s = 0.0
        """over which the drift was found"""
        self._anchor = (0.0, 0.0)

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock runs than the board's, in parts per million.

        0 until 5 s of even pace have passed. NaN if the board's time is not that of a clock (:attr:`pace`), or the
        line has the steepest allowed slope.
        """
        drift = self._drift or 0.0
        if self.pace is not Pace.EVEN or abs(drift) >= LARGEST_DRIFT:
            return math.nan
        return 1e6 * drift if self._span_s >= DRIFT_SPAN_S else 0.0

    def add(self, device_s: float, received_s: float) -> float:
        """Take one frame.

        Args:
            device_s: time stamp of the board, in s; not decreasing.
            received_s: time of arrival, in s on the host's clock.

        Returns:
            Arrival time of the frame if it had the least delay seen so far, in s on the host's clock; at most
            ``received_s``. It is ``received_s`` as long as the pace is not even.

        """
        if self._origin is None:
            self._origin = (device_s, received_s)
        x = device_s - self._origin[0]
        elapsed_s = received_s - self._origin[1]
        y = elapsed_s - x
        if elapsed_s >= self._bucket_ends_s:
            self._close_bucket()
            self._bucket_ends_s = elapsed_s + BUCKET_S
            self._least = (x, y)
        elif y < self._least[1]:
            self._least = (x, y)
        if self.pace is not Pace.EVEN:
            return received_s
        drift, (anchor_x, anchor_y) = self._drift, self._anchor
        line = anchor_y if drift is None else anchor_y + drift * (x - anchor_x)
        least = anchor_y - LARGEST_DRIFT * (x - anchor_x) if drift is None else line
        if y < least - STEP_S:
            # No drift does this: the clock was set forward, or all earlier frames had waited in a buffer.
            self._buckets.clear()
            self._drift, self._span_s = None, 0.0
        if y < line:
            # Less delayed than any earlier frame: the line is moved down to this frame.
            self._anchor = (x, y)
            line = y
        return self._origin[1] + x + line

    def _line(self, x: float) -> float:
        """The line at ``x``; level until the drift is known."""
        return self._anchor[1] + (self._drift or 0.0) * (x - self._anchor[0])

    def _close_bucket(self) -> None:
        self._recent.append(self._least)
        self._judge_pace()
        if self.pace is not Pace.EVEN:
            return
        self._buckets.append(self._least)
        last = list(self._buckets)[-STEP_BUCKETS:]
        if len(last) == STEP_BUCKETS and all(y > self._line(x) + STEP_S for x, y in last):
            self.steps += 1
            self._buckets.clear()
            self._buckets.extend(last)
        self._fit()

    def _judge_pace(self) -> None:
        """Whether the board's time is a clock's. Once it is not, it must be even throughout to count as one again."""
        pairs = [(x1 - x0, y1 - y0) for (x0, y0), (x1, y1) in pairwise(self._recent)]
        slow = sum(y > LARGEST_DRIFT * x for x, y in pairs)
        fast = sum(y < -LARGEST_DRIFT * x for x, y in pairs)
        if max(slow, fast) >= PACE_PAIRS - 1:
            passed_s = sum(x for x, _ in pairs)
            self.pace = Pace.SLOW if slow > fast else Pace.FAST
            self.rate = passed_s / (passed_s + sum(y for _, y in pairs))
        elif self.pace is not Pace.EVEN and len(pairs) == PACE_PAIRS and not slow and not fast:
            self.pace, self._drift, self._span_s = Pace.EVEN, None, 0.0
            self._buckets.clear()
            self._buckets.extend(list(self._recent)[:-1])  # the caller adds the last one

    def _fit(self) -> None:
        hull = lower_hull(list(self._buckets))
        span_s = hull[-1][0] - hull[0][0]
        if span_s >= min(DRIFT_SPAN_S, max(self._span_s, 2.0 * BUCKET_S)):
            self._span_s = span_s
            # Of all lines below the points, the one with the least sum of distances passes below their mean. The
            # first of three buckets may hold frames that had waited in a buffer.
            middle = sum(x for x, _ in self._buckets) / len(self._buckets)
            right = next(k for k in range(1, len(hull)) if hull[k][0] > middle or k == len(hull) - 1)
            (x0, y0), (x1, y1) = hull[right - 1], hull[right]
            self._drift = min(max((y1 - y0) / (x1 - x0), -LARGEST_DRIFT), LARGEST_DRIFT)
        # If the drift is limited, or not known, the edge's own ends need not be the lowest points. The anchor is a
        # frame, too, and may be newer.
        slope = self._drift or 0.0
        frames = [*hull, self._anchor] if self._anchor[0] >= hull[0][0] else hull
        self._anchor = min(frames, key=lambda point: point[1] - slope * point[0])


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
