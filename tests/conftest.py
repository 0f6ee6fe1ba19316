"""What all tests share."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

import ohmskin.driver  # noqa: F401  # offers the loops that are compiled
from ohmskin import compiled

pytest_plugins = ["ohmskin.hil.plugin"]  # also where the installed entry point is older than the source

# A busy machine is no failure, and a failure must come again.
settings.register_profile("ohmskin", deadline=None, derandomize=True)
settings.load_profile("ohmskin")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts jobs in the background so, and programs that the tests interrupt would inherit it and never end.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _boards_of_this_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Emulated boards of other processes, such as tests that run at the same time, are not found here.

    And machine code is compiled before: a board whose cable is pulled after a second does not wait for the compiler.
    """
    compiled.load()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OHMSKIN_RUNTIME_DIR", str(tmp_path_factory.mktemp("boards")))
        yield
