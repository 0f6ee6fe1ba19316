"""What the processes that test at the same time make together: each of them makes a part, or waits for another one."""

from __future__ import annotations

import fcntl
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar, cast

import pytest

T = TypeVar("T")
_shared: list[Path] = []


def share(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Let what is made :func:`once` be made once in this run; returns the folder for it, which no other run has."""
    own = tmp_path_factory.getbasetemp()
    run = own.parent if own.name.startswith("popen-") else own  # pytest-xdist gives each worker a folder in the run's
    folder = run / "together"
    folder.mkdir(exist_ok=True)
    _shared[:] = [folder]
    return folder


def once(make: Callable[[], T]) -> Callable[[], T]:
    """A function without arguments whose answer the first process makes, and others read: a decorator.

    Others wait meanwhile. Outside a run of the tests, every process makes its own.
    """

    @cache
    def made() -> T:
        if not _shared:
            return make()
        kept = _shared[0] / f"{make.__module__}.{make.__qualname__}"
        with kept.with_name(f"{kept.name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # until the file is closed
            if not kept.exists():
                kept.write_bytes(pickle.dumps(make()))
        return cast(T, pickle.loads(kept.read_bytes()))

    return made
