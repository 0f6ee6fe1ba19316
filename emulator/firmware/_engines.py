"""Emulators of the ATmega328P: programs that speak the lock-step protocol of ``processor.cjs``."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ...errors import MissingExtra

AVR8JS_VERSION = "0.21.1"
OLDEST_NODE = 18
HELPER = Path(__file__).with_name("processor.cjs")


@dataclass(frozen=True)
class Engine:
    """One emulator of the processor."""

    name: str
    command: tuple[str, ...]
    """program and first arguments; the .hex file and the EEPROM follow"""
    missing: Callable[[], str | None]
    """says what has to be installed, or None"""

    def require(self) -> None:
        """Raise MissingExtra with one line if the engine cannot run here."""
        reason = self.missing()
        if reason is not None:
            raise MissingExtra(reason)


@cache
def missing_for() -> str | None:
    """One line on what the firmware engine lacks on this machine; None if it can run."""
    node = shutil.which("node")
    if node is None:
        return f"the firmware engine needs Node.js {OLDEST_NODE} or newer: no program 'node' was found"
    asked = subprocess.run([node, "--version"], capture_output=True, text=True, timeout=60, check=False)
    version = asked.stdout.strip()
    major = version.removeprefix("v").partition(".")[0]
    if not major.isdecimal() or int(major) < OLDEST_NODE:
        return f"the firmware engine needs Node.js {OLDEST_NODE} or newer; {node} is {version or 'of unknown version'}"
    if not _has_avr8js():
        return (
            f"the firmware engine needs avr8js: run `npm install avr8js@{AVR8JS_VERSION}` in the folder where you run "
            "ohmskin, or name a folder that has it in NODE_PATH"
        )
    return None


def _has_avr8js() -> bool:
    """Look where Node.js and the helper look: from its folder and from the current one upwards, and in NODE_PATH."""
    searched = [Path(part) for part in os.environ.get("NODE_PATH", "").split(os.pathsep) if part]
    for start in (HELPER.resolve().parent, Path.cwd()):
        searched += [folder / "node_modules" for folder in (start, *start.parents)]
    return any((folder / "avr8js" / "package.json").is_file() for folder in searched)


AVR8JS = Engine("avr8js", ("node", str(HELPER)), missing_for)
"""the instruction set of avr8js with peripherals after the data sheet, in Node.js"""
