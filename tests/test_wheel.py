"""What a user gets from `pip install ohmskin`: the wheel, in an environment that has nothing else."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from ohmskin.cli import COMMANDS

ROOT = Path(__file__).parent.parent
ROOMS = ("bench", "cell", "circuits", "driver", "emulator", "verification", "wire", "src/ohmskin")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing left over in the tree can slip in or out."""
    source = tmp_path_factory.mktemp("source") / "ohmskin"
    leave = shutil.ignore_patterns(".venv", ".git", "build", "*.egg-info", "__pycache__", ".*_cache", ".hypothesis")
    shutil.copytree(ROOT, source, symlinks=True, ignore=leave)
    target = tmp_path_factory.mktemp("wheel")
    _run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--disable-pip-version-check", "-w", target, source)
    (built,) = target.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def clean(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a new environment with the wheel and the extra `report`, without `spice`."""
    home = tmp_path_factory.mktemp("clean")
    _run(sys.executable, "-m", "venv", home)
    _run(home / "bin" / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check", f"{wheel}[report]")
    return home / "bin"


def _run(*command: str | Path, cwd: Path | None = None, exit_code: int = 0) -> str:
    """Standard output of a command that must end with ``exit_code`` and say nothing on standard error."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == exit_code, done.stdout + done.stderr
    assert "pip" in command or not done.stderr, done.stderr  # pip has its own opinions
    return done.stdout


def test_the_wheel_holds_every_file_of_every_room(wheel: Path) -> None:
    packed = set(zipfile.ZipFile(wheel).namelist())
    for room in ROOMS:
        for file in (ROOT / room).rglob("*"):
            if file.suffix not in (".py", ".toml", ".html", ".typed") or "__pycache__" in file.parts:
                continue
            inside = file.relative_to(ROOT / "src" if room.startswith("src") else ROOT)
            name = str(inside if room.startswith("src") else Path("ohmskin") / inside)
            if not any(part.is_symlink() for part in (ROOT / "src" / inside).parents):
                assert name in packed


def test_the_wheel_holds_no_tests(wheel: Path) -> None:
    assert not [name for name in zipfile.ZipFile(wheel).namelist() if "test" in name.lower()]


def test_every_command_starts(clean: Path, tmp_path: Path) -> None:
    assert _run(clean / "ohmskin", "--help", cwd=tmp_path).startswith("Usage: ohmskin")
    for command in COMMANDS:
        assert _run(clean / "ohmskin", command, "--help", cwd=tmp_path).startswith(f"Usage: ohmskin {command}")


def test_the_demo_runs_without_ngspice(clean: Path, tmp_path: Path) -> None:
    _run(clean / "ohmskin", "verify", "-o", "report", cwd=tmp_path, exit_code=3)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    for claim in report["claims"]:
        assert claim["outcome"] != "fail"
    crosstalk = next(claim for claim in report["claims"] if claim["id"] == "P13")
    (judged,) = [check for check in crosstalk["checks"] if "ngspice" in check["name"]]
    assert judged["outcome"] == "not run"
    assert "ohmskin[spice]" in judged["reason"]


def test_the_public_names_import(clean: Path, tmp_path: Path) -> None:
    code = "from ohmskin.circuits import Design, scan; from ohmskin.driver import Skin; print(Skin.open.__name__)"
    assert _run(clean / "python", "-W", "error", "-c", code, cwd=tmp_path) == "open\n"
