"""Tasks for worker processes. A spawned process imports them by name, so they cannot be in a test's own module."""

from __future__ import annotations

import os
import time
from pathlib import Path


def fail(number: int) -> float:
    """Raise ZeroDivisionError for 1."""
    return 1 / (1 - number)


def wait_long(file: str) -> None:
    """Write this process's number to ``file``, then sleep longer than any test; fail at once without a file."""
    if not file:
        raise ZeroDivisionError
    Path(file).write_text(f"{os.getpid()}\n")
    time.sleep(600)
