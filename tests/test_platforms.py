"""What works where POSIX-only modules and calls are missing, as on Windows: shown by taking them away."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from ohmskin.common.system import POSIX

ROOT = Path(__file__).parents[1]
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
    design, scene = ROOT / "verification" / "prototype.toml", ROOT / "examples" / "fingers.toml"
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
    for path in (ROOT / "src" / "ohmskin").resolve().parents[1].glob("*/**/*.py"):
        room = path.relative_to(ROOT).parts[0]
        if room in ("tests", "bench", "src", ".venv", "build") or path.name == "system.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            assert not POSIX_ONLY & set(names), f"{path.relative_to(ROOT)}: {names}"
