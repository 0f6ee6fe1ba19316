"""Frame times of a board without a clock, from arrival times.

The operating system delivers bytes in bursts, so several frames can have the same arrival time. The last of them came
then; the frames before it are spread backwards by the usual time between two frames, the median of recent intervals.
"""

from __future__ import annotations

from collections import deque
from statistics import median

from ._tuning import REMEMBERED


class ArrivalTimes:
    """Frame times, arrival by arrival. Depends only on the added times, as :class:`._clock.ClockMap` does."""

    def __init__(self) -> None:
        self._intervals_s: deque[float] = deque(maxlen=REMEMBERED)
        self._last_s: float | None = None
        self._received_s = 0.0
        self._step_s = 0.0
        self._left = 0

    @property
    def usual_s(self) -> float:
        """The usual time between two frames; 0: not known."""
        return median(self._intervals_s) if self._intervals_s else 0.0

    def arrive(self, received_s: float, frames: int) -> None:
        """Take an arrival with ``frames`` frames; :meth:`next` then gives their times."""
        if not frames:
            return
        step_s = 0.0
        if self._last_s is not None:
            step_s = (received_s - self._last_s) / frames if received_s > self._last_s else 0.0
            self._intervals_s.append(step_s)
            # After a pause of the board its frames do not come more slowly than usual.
            step_s = min(step_s, self.usual_s) if frames > 1 else step_s
        self._received_s = self._last_s = received_s
        self._step_s, self._left = step_s, frames

    def next(self, received_s: float) -> float:
        """The time of the next frame, which came at ``received_s``, in s on the host's clock."""
        if received_s != self._received_s or not self._left:
            return received_s
        self._left -= 1
        return received_s - self._step_s * self._left
