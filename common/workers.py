"""Worker processes (a process pool) that end with their parent, however the parent ends.

The workers of ``concurrent.futures`` outlive a parent that is killed, and an interrupted pool waits until every task is
done. Here each worker holds the reading end of a pipe whose writing end only the parent has. The kernel closes that end
when the parent dies, and the parent closes it when it gives up; either way the worker leaves at once.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import TypeVar

from .system import interrupts_blocked

T = TypeVar("T")
R = TypeVar("R")


def in_processes(
    function: Callable[[T], R],
    items: Iterable[T],
    *,
    jobs: int,
    executor: Executor | None = None,
    done: Callable[[R], None] | None = None,
) -> list[R]:
    """``[function(item) for item in items]``, computed by ``jobs`` processes side by side, or by an executor.

    The processes are spawned, so that a script which calls this needs ``if __name__ == "__main__":``. They ignore
    Ctrl-C; the exception that it raises in the parent ends them.

    Args:
        function: a function of a module; it and the items are pickled.
        items: one task each.
        jobs: 1 computes in this process.
        executor: of somebody else's workers, such as Dask's, in place of processes here.
        done: called in the parent with each result as it arrives, for progress.

    Raises:
        Whatever ``function`` raises; the tasks that are left are then given up.

    """
    tell = done or (lambda result: None)
    if executor is not None:
        futures = [executor.submit(function, item) for item in items]
        for future in as_completed(futures):
            tell(future.result())
        return [future.result() for future in futures]
    if jobs == 1:
        results = []
        for item in items:
            results.append(function(item))
            tell(results[-1])
        return results
    context = multiprocessing.get_context("spawn")
    alive, held_by_parent = context.Pipe(duplex=False)
    with _imports_from_safe_places():  # it starts a process that keeps count of semaphores
        pool = ProcessPoolExecutor(jobs, context, _begin_worker, (alive,))
    try:
        # A spawned process inherits the mask; Ctrl-C is for the parent to handle.
        with interrupts_blocked(), _imports_from_safe_places():
            futures = [pool.submit(function, item) for item in items]
        for future in as_completed(futures):
            tell(future.result())
        return [future.result() for future in futures]
    except BaseException:
        held_by_parent.close()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        held_by_parent.close()
        alive.close()


@contextmanager
def _imports_from_safe_places() -> Iterator[None]:
    """New Python processes import nothing from the working folder before they know this process's path.

    They begin with ``python -c``, which would take a ``signal.py`` of that folder, anybody's perhaps, for Python's.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _begin_worker(alive: Connection) -> None:
    """In a new worker: leave when the parent ends, and log nothing, since each worker would say the same."""
    logging.getLogger("ohmskin").addHandler(logging.NullHandler())

    def wait() -> None:
        try:
            alive.recv_bytes()  # nothing is ever sent
        except (EOFError, OSError):
            os._exit(1)

    threading.Thread(target=wait, daemon=True, name="end with parent").start()
