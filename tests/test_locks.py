"""The locks name all that pyproject.toml asks for, on every Python that it allows: each once, with its hashes."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.markers import Marker, default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
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
