"""A progress bar on standard error, where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import click

from ..common.progress import Progress, silent


@contextmanager
def progress_bar(label: str) -> Iterator[Progress]:
    """What a long computation tells of its progress; silent where nobody watches, and until it tells something."""
    if not sys.stderr.isatty():
        yield silent
        return
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
