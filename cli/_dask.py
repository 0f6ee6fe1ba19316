"""Options of commands that compute for long: processes side by side, or the workers of a Dask scheduler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any

import click

from ..common.extras import install_command
from ..errors import InputError, MissingExtra


def workers(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options ``--jobs`` and ``--dask``."""
    jobs = click.option(
        "--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Processes side by side."
    )
    dask = click.option("--dask", metavar="ADDRESS", help="Compute on the workers of this Dask scheduler.")
    return jobs(dask(command))


@contextmanager
def dask_executor(jobs: int, address: str | None) -> Iterator[Executor | None]:
    """An executor on the workers of a Dask scheduler, or None; InputError if processes are asked for, too."""
    if address is not None and jobs > 1:
        raise InputError("give --jobs or --dask, not both")
    if address is None:
        yield None
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtra(f"--dask needs Dask: {install_command('dask')}") from error
    try:
        client: Any = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--dask {address}: no scheduler answers there: {error}") from error
    with client:
        yield client.get_executor(retries=3)
