"""A progress bar on standard error, where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from ..common.progress import Progress, silent


@contextmanager
def progress_bar(label: str) -> Iterator[Progress]:
    """What a long computation tells of its progress; silent where nobody watches."""
    if not sys.stderr.isatty():
        yield silent
        return
    bar: Any = click.progressbar(length=1, label=label, file=sys.stderr, item_show_func=lambda item: str(item or ""))
    with bar as shown:
        shown.length = 0

        def tell(done: int, total: int, what: str) -> None:
            shown.length = total
            shown.update(done - shown.pos, what)

        yield tell
