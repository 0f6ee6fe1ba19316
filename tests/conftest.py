"""What all tests share."""

from __future__ import annotations

from hypothesis import settings

pytest_plugins = ["ohmskin.hil.plugin"]  # also where the installed entry point is older than the source

# A busy machine is no failure, and a failure must come again.
settings.register_profile("ohmskin", deadline=None, derandomize=True)
settings.load_profile("ohmskin")
