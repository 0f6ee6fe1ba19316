"""Diagnosis of the installation: Python, packages and their extras, ngspice, Chromium, Node."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Iterator, Sequence

from .. import __version__
from ..circuits.spice import command_available, library_available
from ..common import compiled
from ..common.extras import PACKAGE, install_command
from ._finding import Finding, State

DEVELOPMENT = ("dev", "test")
"""extras that a user does not need"""
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
LONGEST_ANSWER_S = 20.0
"""for a program that is asked for its version; Chromium takes seconds on a small machine"""

_requirement = re.compile(r"(?P<name>[A-Za-z0-9._-]+)[^;]*(;.*extra\s*==\s*['\"](?P<extra>[^'\"]+)['\"])?")


def examine_installation() -> list[Finding]:
    """Versions of Python, ohmskin, its packages and the programs that some commands need."""
    return [
        Finding(State.OK, "ohmskin", f"{__version__} on Python {platform.python_version()}, {platform.platform()}"),
        *_packages(importlib.metadata.requires(PACKAGE) or []),
        _machine_code(),
        *_spice(),
        _program("Chromium", CHROMIUM, "the tests of pages in a browser", "sudo apt install chromium"),
        _program("Node", ("node",), "the tests of pages without a browser", "sudo apt install nodejs"),
    ]


def _packages(requirements: Sequence[str]) -> Iterator[Finding]:
    """One finding for the packages that are always needed, and one for each extra.

    Args:
        requirements: as the metadata of a package lists them: ``jinja2>=3.1; extra == "report"``.

    """
    groups: dict[str, list[str]] = defaultdict(list)
    for requirement in requirements:
        parts = _requirement.match(requirement)
        if parts is not None and parts["name"] != PACKAGE:
            groups[parts["extra"] or ""].append(parts["name"])
    for extra, names in groups.items():
        if extra in DEVELOPMENT:
            continue
        versions = {name: _version(name) for name in names}
        shown = ", ".join(f"{name} {version}" for name, version in versions.items() if version)
        missing = [name for name, version in versions.items() if version is None]
        subject = f"extra '{extra}'" if extra else "packages"
        if not missing:
            yield Finding(State.OK, subject, shown)
        else:
            state = State.OPTIONAL if extra else State.PROBLEM
            yield Finding(state, subject, f"missing: {', '.join(missing)}", install_command(extra))


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _machine_code() -> Finding:
    """Whether the driver works by machine code."""
    why_not = compiled.why_not()
    if why_not is None and compiled.is_kept():
        return Finding(State.OK, "machine code", "the first skin that is opened compiles the driver's loops, once")
    if why_not is None:
        found = f"every program compiles kernels anew, for {compiled.WAIT}: no folder to keep them in can be written"
        return Finding(
            State.OPTIONAL, "machine code", found, "export NUMBA_CACHE_DIR=DIR, a folder that can be written"
        )
    switch = next(name for name in (compiled.SWITCH, compiled.NUMBA_SWITCH) if name in why_not)
    return Finding(State.PROBLEM, "machine code", f"{why_not}; frames take a thousand times as long", f"unset {switch}")


def _spice() -> Iterator[Finding]:
    for subject, reason, without, mend in (
        ("ngspice", command_available(), "what needs a transient or noise says 'not run'", "sudo apt install ngspice"),
        (
            "libngspice",
            library_available(),
            "frames are checked by the command ngspice, more slowly",
            f"{install_command('spice')} && sudo apt install libngspice0",
        ),
    ):
        if reason is None:
            yield Finding(State.OK, subject, "can be used")
        else:
            yield Finding(State.OPTIONAL, subject, f"{reason}; {without}", mend)


def _program(subject: str, names: Sequence[str], purpose: str, mend: str) -> Finding:
    """A program of the system that goes by one of ``names``."""
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        return Finding(State.OPTIONAL, subject, f"not installed; {purpose} need it", mend)
    try:
        answer = subprocess.run(
            [path, "--version"], capture_output=True, text=True, timeout=LONGEST_ANSWER_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return Finding(State.OPTIONAL, subject, f"{path} does not start: {error}", mend)
    lines = answer.stdout.splitlines()
    return Finding(State.OK, subject, f"{lines[0].strip() if lines else 'of unknown version'} ({path})")
