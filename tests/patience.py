"""How long tests wait for events: a limit in turns of a loop, not in seconds.

A busy machine makes each turn of a waiting loop longer, and the limit in seconds with it. A limit ends only what would
never come.
"""

from __future__ import annotations

import time

TURN_S = 0.02
"""s for which one turn counts at most: what is beyond was spent by other programs"""
HANG_S = 1800.0
"""limit for programs and calls that nobody can count the turns of; only a hang takes so long"""


class Patience:
    """A limit of ``limit_s`` on an idle machine; call :meth:`spend` in each turn of at most :data:`TURN_S`."""

    def __init__(self, limit_s: float = 60.0) -> None:
        self._left_s = limit_s
        self._last_s = time.monotonic()

    @property
    def is_over(self) -> bool:
        """Whether the limit is reached."""
        return self._left_s <= 0

    def count(self) -> None:
        """Count one turn."""
        now_s = time.monotonic()
        self._left_s -= min(now_s - self._last_s, TURN_S)
        self._last_s = now_s

    def spend(self, what: object = "waited in vain") -> None:
        """Count one turn; AssertionError with ``what`` where the limit is reached."""
        self.count()
        assert not self.is_over, what
