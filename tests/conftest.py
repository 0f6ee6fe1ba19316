"""What all tests share."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import together
from hypothesis import settings

from ohmskin.common import compiled
from ohmskin.driver import discover
from ohmskin.driver._options import Options
from ohmskin.verification import _pressures

pytest_plugins = ["ohmskin.hil.plugin"]  # also where the installed entry point is older than the source

# A busy machine is no failure, and a failure must come again.
settings.register_profile("ohmskin", deadline=None, derandomize=True)
settings.load_profile("ohmskin")
PATIENCE_S = 60.0
"""for which the driver waits in tests that do not say for how long: a process may be kept from running for seconds"""

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts jobs in the background so, and programs that the tests interrupt would inherit it and never end.
    signal.signal(signal.SIGINT, signal.default_int_handler)


LONGEST = ("test_wheel.py", "test_verification.py")

_FASTEST_HZ = _pressures.FASTEST_HZ


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes longest comes first, so that no worker is left with it while the others have nothing to do.

    Otherwise tests run in the random order that pytest-randomly has made before; without it, in that of the files.
    """
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """How to repeat the order of this run, below its failures; the head with the seed may be far above."""
    if config.getoption("randomly_seed", None) is not None:
        seed = config.getoption("randomly_seed")
        terminalreporter.write_line(f"random order: repeat it by --randomly-seed={seed}, or make test SEED={seed}")


def pytest_collection_finish() -> None:
    """Some million objects of modules and tests stay to the end: no collection of garbage is to look at them again."""
    _keep_what_is_there()


@pytest.fixture(scope="session", autouse=True)
def _boards_of_this_process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Emulated boards of other processes, such as tests that run at the same time, are not found here.

    And machine code is compiled before: a board whose cable is pulled after a second does not wait for the compiler.
    """
    _compile_together(together.share(tmp_path_factory))
    _keep_what_is_there()  # what the compiler made stays as well
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OHMSKIN_RUNTIME_DIR", str(tmp_path_factory.mktemp("boards")))
        yield


def _compile_together(folder: Path) -> None:
    """Compile what no other worker has begun to compile, then load what the others have compiled.

    In this process an array of another type than a loop states is a failure; programs that tests start do not look.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(compiled.SWITCH, os.environ.get(compiled.SWITCH, "checked"))
        for number, each in enumerate(compiled._offered):  # the same ones in every worker: all have imported all tests
            with suppress(FileExistsError):
                (folder / f"loop-{number}").touch(exist_ok=False)
                each.machine_code()
        compiled.load()


def _keep_what_is_there() -> None:
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _patient_driver() -> Iterator[None]:
    """The driver's usual three seconds of silence are no verdict on a busy machine."""
    with pytest.MonkeyPatch.context() as patch:
        for waiting in (Options.of.__func__, discover):  # type: ignore[attr-defined]
            assert "timeout" in waiting.__kwdefaults__
            patch.setitem(waiting.__kwdefaults__, "timeout", PATIENCE_S)
        yield


@pytest.fixture
def silent_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver waits for a second: the test is about a board from which nothing comes that is understood."""
    monkeypatch.setitem(Options.of.__func__.__kwdefaults__, "timeout", 1.0)  # type: ignore[attr-defined]


@pytest.fixture
def quick_verification(monkeypatch: pytest.MonkeyPatch) -> None:
    """Presses are followed at 10 frames per second of board time, not 50."""
    monkeypatch.setattr(_pressures, "FASTEST_HZ", 10.0)


@pytest.fixture
def presses_at_full_rate(quick_verification: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """At 10 frames per second the edge of a press is a jump, which counts as a bad contact until the next frame."""
    monkeypatch.setattr(_pressures, "FASTEST_HZ", _FASTEST_HZ)
