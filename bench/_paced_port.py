"""A port in memory on simulated time: benchmarks of the driver without a line and without an operating system."""

from __future__ import annotations

import threading
from time import process_time

from ..driver import Arrival


class PacedPort:
    """A port in memory: packet k comes at ``k * period_s``. Only the reader who asks reads; the thread rests."""

    name = "memory"

    def __init__(self, packets: list[bytes], period_s: float) -> None:
        self._packets, self._period_s = packets, period_s
        self._began, self._worked_s = process_time(), 0.0
        self._sent = 0
        self._interrupted = threading.Event()

    def work(self, seconds: float) -> None:
        """Let time pass."""
        self._worked_s += seconds

    def now(self) -> float:
        return process_time() - self._began + self._worked_s

    def wait(self, timeout_s: float) -> bool:
        self._interrupted.wait(max(timeout_s, 0.0))
        self._interrupted.clear()
        return False

    def read(self) -> Arrival:
        now = self.now()
        come = min(int(now / self._period_s), len(self._packets))
        data = b"".join(self._packets[self._sent : come])
        self._sent = come
        return Arrival(data, now, 1e9 + now)

    def write(self, data: bytes) -> None:
        pass

    def interrupt(self) -> None:
        self._interrupted.set()

    def close(self) -> None:
        pass
