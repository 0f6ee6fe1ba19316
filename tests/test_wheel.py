"""What a user gets from `pip install ohmskin`: the wheel, in an environment that has nothing else."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.markers import Marker, default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from ohmskin.cli import COMMANDS
from ohmskin.common.system import POSIX

LOWEST_PYTHON = (3, 11)
ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE = ROOT / "src" / "ohmskin"
PACKAGES = sorted(package.name for package in PACKAGE.iterdir() if package.is_dir() and package.name != "__pycache__")
LEFT_OVER = shutil.ignore_patterns(
    ".venv",
    ".git",
    "build",
    "dist",
    "*.egg-info",
    "__pycache__",
    ".*_cache",
    ".hypothesis",
    "ohmskin-report",
    "node_modules",
)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the source distribution and the wheel made from it.

    Built from a copy, so that nothing left over in the tree can slip in or out.
    """
    source = tmp_path_factory.mktemp("source") / "ohmskin"
    shutil.copytree(ROOT, source, symlinks=True, ignore=LEFT_OVER)
    target = tmp_path_factory.mktemp("built")
    _run(sys.executable, "-m", "build", "--outdir", target, source)
    return target


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (file,) = built.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def clean(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a new environment with the wheel and the extra `report`.

    All that they require is there in the lowest versions that the metadata allows, on the Python that these are made
    for; the newest versions are those of the environment of the tests.
    """
    home = tmp_path_factory.mktemp("clean")
    _run(sys.executable, "-m", "venv", "--without-pip", home)
    lowest = _lowest_versions() if sys.version_info[:2] == LOWEST_PYTHON else []
    (home / "limits.txt").write_text("\n".join(lowest))
    _install(home / "bin", "-c", home / "limits.txt", f"{wheel}[report]")
    return home / "bin"


def _install(environment: Path, *packages: str | Path) -> None:
    """Install into the environment of this bin folder, by the pip of the environment of the tests.

    Modules become bytecode when they are first imported: most of what NumPy and SciPy bring is never.
    """
    pip = [sys.executable, "-m", "pip", "--python", environment / "python", "install", "-q", "--no-compile"]
    _run(*pip, "--disable-pip-version-check", *packages)


def _run(*command: str | Path, cwd: Path | None = None, exit_code: int = 0, path: Path | None = None) -> str:
    """Standard output of a command that must end with ``exit_code`` and say on standard error how far it is at most.

    It finds programs in the folder ``path``; None: where the tests find theirs.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    environment |= {} if path is None else {"PATH": str(path)}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == exit_code, done.stdout + done.stderr
    said = [line for line in done.stderr.splitlines() if not re.match(r"verifying, \d+ s: ", line)]
    assert {"pip", "build"} & set(command) or not said, done.stderr  # these have their own opinions
    return done.stdout


def test_the_wheel_holds_every_file_of_every_room(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    own = [(file, file.relative_to(PACKAGE)) for file in PACKAGE.iterdir() if file.is_file()]
    packaged = [package for package in PACKAGES if package != "bench"]
    packages = [(file, file.relative_to(ROOT)) for package in packaged for file in (ROOT / package).rglob("*")]
    assert len(packaged) > 10
    assert not any(name.startswith("ohmskin/bench/") for name in packed), "measurements are for a checkout"
    for file, inside in [*own, *packages]:
        packs = file.suffix in (".py", ".toml", ".html", ".typed", ".cjs", ".hex", ".js", ".css", ".svg")
        if packs and not {"__pycache__", "node_modules"} & set(file.parts):
            assert str(Path("ohmskin") / inside) in packed


def test_the_source_distribution_holds_what_a_maintainer_needs(built: Path) -> None:
    """The packages lie below src/ohmskin there; `make` puts links to them beside it."""
    (file,) = built.glob("*.tar.gz")
    with tarfile.open(file) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    folders = [(ROOT / folder, Path(folder)) for folder in ("docs", "examples", "firmware", "tests", ".ci")]
    for folder, place in [*folders, *((ROOT / package, Path("src/ohmskin") / package) for package in PACKAGES)]:
        for path in folder.rglob("*"):
            if path.is_file() and not {"__pycache__", "node_modules", "build"} & set(path.parts):
                assert str(place / path.relative_to(folder)) in packed
    assert {"Makefile", "README.md", "CHANGELOG.md", "LICENSE", "pyproject.toml"} <= packed


def _lowest_versions() -> list[str]:
    """One line NAME==VERSION for every requirement of the package and of its extra `report`."""
    lines = []
    for text in [*PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"]["report"]]:
        requirement = Requirement(text)
        (bound,) = [clause.version for clause in requirement.specifier if clause.operator in (">=", "==")]
        lines.append(f"{requirement.name}=={bound}")
    return lines


def test_measurements_say_that_they_need_a_checkout(clean: Path, tmp_path: Path) -> None:
    code = "import sys; from ohmskin.cli import run; sys.stderr = sys.stdout; sys.exit(run(['bench']) - 2)"
    assert "run this in a checkout" in _run(clean / "python", "-c", code, cwd=tmp_path)


def test_every_command_starts(clean: Path, tmp_path: Path) -> None:
    assert _run(clean / "ohmskin", "--help", cwd=tmp_path).startswith("Usage: ohmskin")
    code = "from ohmskin.cli import run; [run([command, '--help']) for command in __import__('sys').argv[1:]]"
    said = _run(clean / "python", "-c", code, *COMMANDS, cwd=tmp_path)
    for command in COMMANDS:
        assert f"Usage: ohmskin {command} " in said


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_demo_runs_without_ngspice(clean: Path, tmp_path: Path) -> None:
    """All but what follows presses frame by frame or calibrates a cell, which takes a minute without Numba.

    One worst case is searched for, and those of the error budget; the others take the same way.
    """
    requirements = (f"D{k}" for k in range(1, 21) if k not in (1, 3, 8, 13, 14, 15))
    only = ",".join([*requirements, "P3", *(f"P{k}" for k in range(10, 15))])
    _run(clean / "ohmskin", "verify", "-o", "report", "--only", only, cwd=tmp_path, exit_code=3, path=clean)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    for claim in report["claims"]:
        assert claim["outcome"] != "fail"
    judged = next(requirement for requirement in report["requirements"] if requirement["id"] == "D19")
    assert judged["outcome"] == "not run"
    assert "ngspice" in judged["reason"]


@pytest.mark.parametrize(
    ("compiled", "scene", "rows"),
    [("off", str(ROOT / "examples" / "fingers.toml"), 4), pytest.param("1", "demo", 16, marks=pytest.mark.slow)],
)
def test_pressures_come_without_extras(clean: Path, tmp_path: Path, compiled: str, scene: str, rows: int) -> None:
    """Compiling takes a quarter of a minute of processor time."""
    code = (
        "import logging, os, sys; os.environ['OHMSKIN_COMPILED'] = sys.argv[2];"
        "logging.getLogger('ohmskin').setLevel('ERROR');"  # it tells that kernels are compiled
        "from ohmskin.driver import Skin; skin = Skin.open('ohmskin://' + sys.argv[1]);"
        "frames = [next(skin) for _ in range(20)]; skin.close();"
        "print(frames[-1].pressure.shape, frames[-1].valid.all())"
    )
    said = _run(clean / "python", "-W", "error", "-c", code, scene, compiled, cwd=tmp_path)
    assert said == f"({rows}, {rows}) True\n"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_command_line_works_with_the_lowest_versions_that_the_metadata_allows(clean: Path, tmp_path: Path) -> None:
    """In a copy of the environment, which gets what tests need."""
    if sys.version_info[:2] != LOWEST_PYTHON:
        pytest.skip("the lowest versions are made for Python {}.{}".format(*LOWEST_PYTHON))
    shutil.copytree(clean.parent, tmp_path / "copy", symlinks=True)
    own = tmp_path / "copy" / "bin"
    _install(own, "hypothesis", "pytest", "pytest-timeout")
    tests = [ROOT / "tests" / name for name in ("test_cli.py", "test_cell_cli.py")]
    pytest_alone = [own / "python", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    # An old matplotlib calls what a newer pyparsing deprecates.
    _run(*pytest_alone, "-W", "ignore::DeprecationWarning", *tests, cwd=ROOT)


# The locks name all that pyproject.toml asks for, on every Python that it allows: each once, with its hashes


PYTHONS = ("3.11.0", "3.12.0", "3.13.0", "3.14.0")
_PIN = re.compile(r"^(?P<name>[\w.-]+)==(?P<version>\S+)(?: ; (?P<marker>.*?))? \\$")


def _asked(extras: list[str]) -> Iterator[Requirement]:
    """Of the project itself, of these extras and of those that they name, and of what builds it."""
    optional = PROJECT["project"]["optional-dependencies"]
    for text in PROJECT["project"]["dependencies"] + PROJECT["build-system"]["requires"]:
        yield Requirement(text)
    waiting, seen = list(extras), set(extras)
    while waiting:
        for text in optional[waiting.pop()]:
            requirement = Requirement(text)
            if requirement.name == PROJECT["project"]["name"]:
                waiting += requirement.extras - seen
                seen |= requirement.extras
            else:
                yield requirement


def _entries(lock: Path) -> dict[str, list[tuple[Version, Marker | None, list[str]]]]:
    """Version, marker and the indented lines below, by name."""
    found: dict[str, list[tuple[Version, Marker | None, list[str]]]] = {}
    below: list[str] = []
    for line in lock.read_text().splitlines():
        if pin := _PIN.match(line):
            below = []
            marker = Marker(pin["marker"]) if pin["marker"] else None
            found.setdefault(canonicalize_name(pin["name"]), []).append((Version(pin["version"]), marker, below))
        elif line.startswith("    "):
            below.append(line.strip())
        else:
            assert line.startswith("#"), line
    return found


@pytest.mark.parametrize(("name", "extra"), [("demo", "report"), ("dev", "dev")])
def test_a_lock_is_current(name: str, extra: str) -> None:
    lock = ROOT / "locks" / f"{name}.txt"
    pins = _entries(lock)
    asked = list(_asked([extra]))
    for python in PYTHONS:
        here = {**default_environment(), "python_full_version": python, "python_version": python.rpartition(".")[0]}
        for requirement in asked:
            if requirement.marker is not None and not requirement.marker.evaluate(here):
                continue
            versions = [
                version
                for version, marker, _ in pins.get(canonicalize_name(requirement.name), [])
                if marker is None or marker.evaluate(here)
            ]
            assert len(versions) == 1, f"{lock.name}: {requirement.name} on Python {python}: {versions}; make lock"
            assert requirement.specifier.contains(versions[0]), f"{lock.name}: {requirement}: {versions[0]}; make lock"
    ours = {n for n, entries in pins.items() if any("ohmskin (pyproject.toml)" in "".join(e[2]) for e in entries)}
    build = {canonicalize_name(Requirement(text).name) for text in PROJECT["build-system"]["requires"]}
    assert ours - build == {canonicalize_name(requirement.name) for requirement in asked} - build, "make lock"


@pytest.mark.parametrize("lock", sorted((ROOT / "locks").glob("*.txt")), ids=lambda path: path.stem)
def test_every_version_of_a_lock_has_hashes_and_no_place(lock: Path) -> None:
    for name, entries in _entries(lock).items():
        for _, _, below in entries:
            hashes = [line for line in below if line.startswith("--hash=")]
            assert hashes, name
            assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}( \\)?", line) for line in hashes), name
    assert "://" not in lock.read_text()
    assert "--index" not in lock.read_text()
    assert "--find-links" not in lock.read_text()


def test_both_locks_have_the_same_versions() -> None:
    demo, dev = (_entries(ROOT / "locks" / f"{name}.txt") for name in ("demo", "dev"))
    assert demo.keys() <= dev.keys()
    for name, entries in demo.items():
        assert {version for version, _, _ in entries} == {version for version, _, _ in dev[name]}


# What works where POSIX-only modules and calls are missing, as on Windows: shown by taking them away


SOURCES = Path(__file__).parents[1]
POSIX_ONLY = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
WITHOUT = """
import asyncio, os, select, signal, socket, subprocess, sys, tempfile, multiprocessing.util
import serial, serial.rfc2217, serial.tools.list_ports, numba, pydantic, scipy.linalg
for name in {modules!r}:
    sys.modules[name] = None
for module, names in (
    (signal, "SIGHUP SIGALRM SIGPIPE SIGKILL setitimer ITIMER_REAL pthread_sigmask SIG_BLOCK"),
    (os, "getuid geteuid getgroups getegid fchmod fchown set_blocking O_NOFOLLOW O_DIRECTORY O_CLOEXEC O_NONBLOCK "
         "O_NOCTTY openpty ttyname fork register_at_fork mkfifo pread pwrite sched_getaffinity"),
    (select, "poll epoll POLLRDHUP POLLPRI"),
):
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
"""
WORK = """
import pathlib, threading, urllib.request
import numpy as np
from ohmskin.circuits import Design, scan
from ohmskin.cell import Cell
from ohmskin.cli import run
from ohmskin.common.system import POSIX
from ohmskin.driver import Skin
from ohmskin.emulator import PtyPort, Scene, TcpPort, running
from ohmskin.errors import InputError
from ohmskin.view import LiveSource, serve

folder, scene_file, design_file = map(pathlib.Path, sys.argv[1:])
assert not POSIX
design = Design.load(design_file)
assert np.isfinite(scan(design, np.full(design.array.shape, 1e4)).volts).all()
assert run(["verify", str(design_file), "--only", "D1", "-o", str(folder / "report")]) in (0, 1, 3)
try:
    PtyPort()
except InputError as error:
    print(error)
port = TcpPort.at(":0")
with running(Scene.load(scene_file), port, clock="real"):
    with Skin.open(port.name, record=folder / "press.mcap") as skin:
        print([next(skin).pressure.shape for _ in range(5)][-1])

        async def page():
            with LiveSource(skin, name="here") as source:
                async with serve(source, ports=[0]) as served:
                    loop = asyncio.get_running_loop()
                    return await loop.run_in_executor(None, lambda: urllib.request.urlopen(served.url).read())

        assert b"<title>ohmskin</title>" in asyncio.run(page())
with Skin.open(folder / "press.mcap") as replayed:
    print(next(replayed).resistance.shape)
assert run(["fit", "--help"]) == 0
"""


def test_circuits_cells_boards_and_recordings_work_without_posix(tmp_path: Path) -> None:
    program = WITHOUT.format(modules=sorted(POSIX_ONLY)) + WORK
    design, scene = SOURCES / "verification" / "prototype.toml", SOURCES / "examples" / "fingers.toml"
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path), str(scene), str(design)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "a pseudo-terminal needs Linux or macOS; give the board a TCP port (--tcp)" in done.stdout
    assert done.stdout.count("(4, 4)") == 2


def test_only_one_module_imports_what_only_posix_has() -> None:
    """The harness of measurements is no part of the package; it may."""
    assert POSIX
    for path in (SOURCES / "src" / "ohmskin").resolve().parents[1].glob("*/**/*.py"):
        package = path.relative_to(SOURCES).parts[0]
        if package in ("tests", "bench", "src", ".venv", "build") or path.name == "system.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            assert not POSIX_ONLY & set(names), f"{path.relative_to(SOURCES)}: {names}"
