"""Kernels as plain Python, for comparisons within one process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from ohmskin.common import compiled


@contextmanager
def switched_off() -> Iterator[None]:
    """Run all kernels as plain Python meanwhile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(compiled.SWITCH, "off")
        for each in compiled._offered:
            patch.setattr(each, "code", each.function)
            patch.setattr(each, "unchecked", each.function)
        yield
