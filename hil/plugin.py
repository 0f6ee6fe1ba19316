"""The plugin of pytest: which board the tests run against, what they get of it, and what the reports say of it.

Options (and variables of the environment): ``--ohmskin-target`` (``OHMSKIN_TARGET``), ``--ohmskin-board``
(``OHMSKIN_BOARD``), ``--ohmskin-scene`` (``OHMSKIN_SCENE``, and ``ohmskin_scene`` in the configuration),
``--ohmskin-seed`` (``OHMSKIN_SEED``), ``--ohmskin-calibration`` (``OHMSKIN_CALIBRATION``), ``--ohmskin-strict``
(``OHMSKIN_STRICT``). docs/hil.md describes them.

A board that is named and not there is an error. What cannot be run on one that is there is reported as "not run" with
its reason, and fails where ``--ohmskin-strict`` is given. The packages of ohmskin are imported when a fixture is used,
so that the plugin costs nothing to other test suites.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import pytest

if TYPE_CHECKING:
    from ..driver import Skin
    from . import BoardInService, Press

NOT_RUN = "not run: "
NO_HARDWARE_TEST = "no test ran on real hardware, which --ohmskin-strict asks for"
_settings = pytest.StashKey["Settings"]()


class Settings:
    """What the options say, and what came of the tests that use them."""

    def __init__(self, config: pytest.Config) -> None:
        self.target = _option(config, "target") or "emulated"
        self.family = _option(config, "board") or "ohmskin"
        self.seed = _whole(config, "seed")
        self.strict = bool(config.getoption("--ohmskin-strict") or os.environ.get("OHMSKIN_STRICT") in ("1", "true"))
        self.scene = _scene(config)
        self.calibration = _option(config, "calibration") or None
        self.revision = os.environ.get("OHMSKIN_REVISION") or _revision(config.rootpath)
        self.not_run: dict[str, str] = {}
        """reason of each test that was not run, by its id"""
        self.used = 0
        """tests that used the board, and passed or failed"""

    @property
    def is_hardware(self) -> bool:
        return self.target not in ("emulated", "firmware")

    def properties(self) -> dict[str, str]:
        """What every report says."""
        return {"target": self.target, "board": self.family, "seed": str(self.seed), "revision": self.revision}


# --- options and markers ----------------------------------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the plugin."""
    group = parser.getgroup("ohmskin", "ohmskin: boards and skins")
    group.addoption("--ohmskin-target", metavar="emulated|firmware|PORT", help="the board under test [emulated]")
    group.addoption(
        "--ohmskin-board", metavar="NAME|FILE.toml", help="family of the board under test, or its BOARD.toml [ohmskin]"
    )
    group.addoption("--ohmskin-scene", metavar="SCENE.toml", help="what the emulated board is [that of the examples]")
    group.addoption("--ohmskin-calibration", metavar="FILE.toml", help="calibration of the skin under test [none]")
    group.addoption("--ohmskin-seed", metavar="K", help="seed of the emulated noise [0]")
    group.addoption(
        "--ohmskin-strict", action="store_true", help="fail where a test is not run, and if none ran on hardware"
    )
    parser.addini("ohmskin_scene", "SCENE.toml of the emulated board, relative to the configuration file")


def pytest_configure(config: pytest.Config) -> None:
    """Markers of the plugin."""
    config.addinivalue_line("markers", "ohmskin_hardware: needs a real board")
    config.addinivalue_line("markers", "ohmskin_loads: needs known loads on the skin")
    settings = Settings(config)
    config.stash[_settings] = settings
    config.pluginmanager.register(_Counter(settings), "ohmskin counter")


def target(config: pytest.Config) -> str:
    """The board under test: "emulated", "firmware", or a port."""
    return config.stash[_settings].target


def _option(config: pytest.Config, name: str) -> str:
    return str(config.getoption(f"--ohmskin-{name}") or os.environ.get(f"OHMSKIN_{name.upper()}") or "")


def _whole(config: pytest.Config, name: str) -> int:
    given = _option(config, name) or "0"
    if not (given.isascii() and given.isdecimal() and len(given) < 19):
        raise pytest.UsageError(f"--ohmskin-{name}: {given!r} is no whole number")
    return int(given)


def _scene(config: pytest.Config) -> Path | None:
    given = _option(config, "scene")
    if given:
        return Path(given)
    written = str(config.getini("ohmskin_scene") or "")
    folder = config.inipath.parent if config.inipath is not None else config.rootpath
    return folder / written if written else None


def _revision(folder: Path) -> str:
    """The commit that is tested, as git names it."""
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"


# --- fixtures ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def board(request: pytest.FixtureRequest) -> Iterator[BoardInService]:
    """The board under test, in service, which nobody has open."""
    from . import TargetMissing, serve

    settings = request.config.stash[_settings]
    _say(request, **settings.properties())
    with ExitStack() as stack:
        service = serve(settings.target, family=settings.family, scene=settings.scene, seed=settings.seed)
        try:
            made = stack.enter_context(service)
        except TargetMissing as error:
            _absent(str(error))
        yield made


@pytest.fixture
def skin(request: pytest.FixtureRequest, board: BoardInService) -> Iterator[Skin]:
    """The board under test, opened by the driver, with every frame delivered."""
    from ..driver import Skin
    from ..errors import LinkError

    calibration = request.config.stash[_settings].calibration
    try:
        opened = Skin.open(board.port, board=board.family, delivery="every", timeout=10.0, calibration=calibration)
    except LinkError as error:
        if not board.is_hardware:
            raise
        _absent(str(error))
    with opened:
        firmware = "" if opened.identity is None else opened.identity.firmware
        _say(request, firmware=firmware, serial_number=opened.serial_number)
        try:
            yield opened
        finally:
            # The test may have tared the skin.
            _say(request, calibration=_calibration(opened))


@pytest.fixture
def press(request: pytest.FixtureRequest, board: BoardInService, skin: Skin) -> Press:
    """Puts known loads on the skin: ``with press(10.0, cells=[(1, 2)]) as load``."""
    from . import Press

    ask = None
    if board.hand is None and board.is_hardware and sys.__stdin__ is not None and sys.__stdin__.isatty():
        ask = _asker(request)
    if board.hand is None and ask is None:
        who = "nobody is there to press" if board.is_hardware else "the firmware's skin takes no loads from tests"
        _not_run(request, f"{who} (target {board.target})")
    return Press(board, skin.design.array.shape, ask)


def _asker(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Asks the person at the terminal, past pytest's capture of output."""
    capture = request.config.pluginmanager.getplugin("capturemanager")

    def ask(what: str) -> None:
        with capture.global_and_fixture_disabled():
            print(f"\n{request.node.name}: {what}. Then press Enter.", flush=True)
            assert sys.__stdin__ is not None
            sys.__stdin__.readline()

    return ask


def _calibration(skin: Skin) -> str:
    """A hash of what turns resistance into pressure: the cell's data, calibration and tare. Empty without a cell."""
    if skin.cell is None:
        return ""
    from ..common.config import fingerprint

    parts: dict[str, object] = {"cell": fingerprint(skin.cell)}
    if skin.calibration is not None:
        parts["calibration"] = skin.calibration.hash
    if skin.tared is not None:
        parts["tare"] = skin.tared.rest_resistance_ohm.tolist()
    return fingerprint(parts)[:16]


def _say(request: pytest.FixtureRequest, **properties: str) -> None:
    """Put properties into the JUnit report of the test."""
    said = {name for name, _ in request.node.user_properties}
    for name, value in properties.items():
        if f"ohmskin.{name}" not in said:
            request.node.user_properties.append((f"ohmskin.{name}", value))


# --- what is not run --------------------------------------------------------------------------------------------------


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that need hardware are not run without it."""
    settings = item.config.stash[_settings]
    if item.get_closest_marker("ohmskin_hardware") is not None and not settings.is_hardware:
        _stop(settings, item, f"needs a real board; --ohmskin-target is {settings.target}")


def _absent(reason: str) -> NoReturn:
    """End the test with an error: the board that was asked for by name is not there."""
    pytest.fail(f"the board under test is not there: {reason}", pytrace=False)


def _not_run(request: pytest.FixtureRequest, reason: str) -> NoReturn:
    _stop(request.config.stash[_settings], request.node, reason)


def _stop(settings: Settings, item: pytest.Item, reason: str) -> NoReturn:
    """End the test as "not run"; as failed where that is asked for."""
    if settings.strict:
        pytest.fail(NOT_RUN + reason, pytrace=False)
    pytest.skip(NOT_RUN + reason)


class _Counter:
    """Counts in the process that reports, which under pytest-xdist is not the one that tests."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take the outcome of one phase of a test."""
        if report.skipped and isinstance(report.longrepr, tuple) and NOT_RUN in str(report.longrepr[2]):
            self._settings.not_run[report.nodeid] = str(report.longrepr[2]).partition(NOT_RUN)[2]
        if report.when == "call" and any(name == "ohmskin.target" for name, _ in report.user_properties):
            self._settings.used += 1


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """A strict run without a test on real hardware fails."""
    settings = session.config.stash[_settings]
    if _misses_hardware(session.config, settings) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Say which board it was, and what was not run and why."""
    settings = config.stash[_settings]
    missed = _misses_hardware(config, settings)
    if not (settings.used or settings.not_run or missed):
        return
    shown = ", ".join(f"{name} {value}" for name, value in settings.properties().items())
    terminalreporter.section("ohmskin", sep="-")
    terminalreporter.line(f"{settings.used} tests used the board: {shown}")
    for test, reason in settings.not_run.items():
        terminalreporter.line(f"NOT RUN {test}: {reason}")
    if missed:
        terminalreporter.line(f"FAILED: {NO_HARDWARE_TEST}", red=True)


def _misses_hardware(config: pytest.Config, settings: Settings) -> bool:
    worker = hasattr(config, "workerinput")  # of pytest-xdist; the controller judges
    return settings.strict and not worker and not (settings.is_hardware and settings.used)


@pytest.fixture(autouse=True, scope="session")
def _suite_properties(request: pytest.FixtureRequest, record_testsuite_property: object) -> None:
    """Target, seed and revision in the head of the JUnit report, also where no test used a board."""
    assert callable(record_testsuite_property)
    for name, value in request.config.stash[_settings].properties().items():
        record_testsuite_property(f"ohmskin.{name}", value)
