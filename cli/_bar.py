"""Progress on standard error: a bar on a terminal, else now and then a line, as the log of a CI job needs it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from time import monotonic
from typing import Any

import click

from ..common.progress import Progress
from ..common.text import printable

FIRST_S, LATER = 10.0, 1.25
"""after which the first line comes, and each further one: after so many times as long, and as many seconds again"""


@contextmanager
def progress_bar(label: str) -> Iterator[Progress]:
    """What a long computation tells of its progress; silent until it tells something."""
    with _bar(label) if sys.stderr.isatty() else _lines(label) as tell:
        yield tell


@contextmanager
def _bar(label: str) -> Iterator[Progress]:
    with ExitStack() as stack:
        bar: Any = None

        def tell(done: int, total: int, what: str) -> None:
            nonlocal bar
            if bar is None:
                bar = stack.enter_context(
                    click.progressbar(
                        length=total, label=label, file=sys.stderr, item_show_func=lambda item: str(item or "")
                    )
                )
            bar.length = total
            bar.update(done - bar.pos, what)

        yield tell


@contextmanager
def _lines(label: str) -> Iterator[Progress]:
    began, ended, latest = monotonic(), threading.Event(), ""

    def tell(done: int, total: int, what: str) -> None:
        nonlocal latest
        latest = f"{100 * done // max(total, 1)} %, {what}"

    def say() -> None:
        at_s = FIRST_S
        while not ended.wait(at_s - (monotonic() - began)):
            if latest:
                click.echo(printable(f"{label}, {monotonic() - began:.0f} s: {latest}"), err=True)
            at_s = LATER * at_s + FIRST_S

    saying = threading.Thread(target=say, daemon=True, name="progress")
    saying.start()
    try:
        yield tell
    finally:
        ended.set()
        saying.join()
