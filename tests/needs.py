"""Tests that need a program of the system skip without it on a laptop, and fail in CI, where it must be."""

from __future__ import annotations

import os

import pytest


def need(reason: str | None) -> None:
    """``reason``: why the test cannot run here, or None."""
    if reason is None:
        return
    if os.environ.get("CI") == "true":
        pytest.fail(reason)
    pytest.skip(reason)
