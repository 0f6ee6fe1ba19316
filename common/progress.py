"""How long computations tell what they have done, without knowing whether anyone shows a progress bar."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int, str], None]
"""called with the steps done, the steps in all, and what was done last or is done now"""


def silent(done: int, total: int, what: str) -> None:
    """Show nothing: the default of every function that takes a :data:`Progress`."""
