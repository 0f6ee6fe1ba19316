"""Diagnosis of serial ports on Linux: permissions, other users of a port, FTDI latency timer, ModemManager, brltty."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

from ..common.system import POSIX, grp, pwd
from ._finding import Finding, State

GOOD_LATENCY_MS = 1
"""the least that the FTDI driver accepts; its default of 16 ms delays every frame by up to as much"""
RULES_SOURCE = "docs/60-ohmskin.rules"
DOCUMENT = "docs/doctor.md"
MOST_USERS = 5
"""programs that have a port open, of which a finding names so many"""
GRABBERS = {
    "ModemManager": (
        "opens new serial ports to look for modems, and keeps them busy for seconds",
        f"install {RULES_SOURCE} (see {DOCUMENT}), or: sudo systemctl disable --now ModemManager",
    ),
    "brltty": (
        "takes serial adapters with a CH340 chip for Braille displays, and removes their port",
        "sudo apt remove brltty, unless you use a Braille display",
    ),
}
"""programs that open ports of boards by themselves -> what they do, and how to stop that"""


@dataclass(frozen=True)
class System:
    """Where this machine's files are, and who asks; another root is for tests."""

    root: Path = Path("/")
    user: str = ""

    def path(self, absolute: str) -> Path:
        return self.root / absolute.lstrip("/")

    def is_device(self, path: Path) -> bool:
        """Whether a path is a character device. Those of a test's root are files."""
        return self.root != Path("/") or stat.S_ISCHR(path.stat().st_mode)

    def processes(self) -> Iterator[Path]:
        """Folders of the running processes in /proc."""
        return (folder for folder in sorted(self.path("/proc").glob("[0-9]*")) if folder.is_dir())

    def command(self, process: Path) -> str:
        """A process's name, at most 15 characters."""
        try:
            return (process / "comm").read_text().strip()
        except OSError:
            return ""


def examine_ports(system: System | None = None) -> list[Finding]:
    """Every serial port that the operating system lists, and the programs that interfere with such ports."""
    system = system or System()
    ports = sorted(list_ports.comports())
    findings = [finding for port in ports for finding in examine_device(port.device, system, port.description or "")]
    if not findings:
        findings.append(Finding(State.OK, "serial ports", "none; is the board plugged in? (dmesg --follow shows it)"))
    return [*findings, *_grabbers(system)]


def examine_device(device: str, system: System | None = None, description: str = "") -> list[Finding]:
    """One serial device: whether it is there, may be opened, is free, and answers without delay."""
    system = system or System()
    path = system.path(os.path.abspath(device))
    other = "see `ohmskin doctor` for the ports that there are"
    if not POSIX and any(port.device == device for port in list_ports.comports()):
        return [Finding(State.OK, device, "is there; only opening it shows whether it is free")]
    if not device or not path.exists():
        return [Finding(State.PROBLEM, device or "PORT", "is not there", f"plug the board in, or {other}")]
    if not system.is_device(path):
        kind = "folder" if path.is_dir() else "file"
        return [Finding(State.PROBLEM, device, f"is a {kind}; expected a serial port such as /dev/ttyACM0", other)]
    named = f" ({description})" if description and description != "n/a" else ""
    findings = [_permission(device, path, system, named)]
    # The program at the other end of a pseudo-terminal, which plays the board, may have this end open, too.
    users = [] if os.path.realpath(path).startswith("/dev/pts/") else list(_users(path, system))
    if users:
        shown = [*users[:MOST_USERS], *([f"{len(users) - MOST_USERS} more"] if len(users) > MOST_USERS else [])]
        findings.append(Finding(State.PROBLEM, device, f"in use by {', '.join(shown)}", "end that program first"))
    findings.extend(_latency(device, path, system))
    return findings


def _permission(device: str, path: Path, system: System, named: str) -> Finding:
    if os.access(path, os.R_OK | os.W_OK):
        return Finding(State.OK, device, f"may be opened{named}")
    status = path.stat()
    group = _group_name(status.st_gid)
    if not status.st_mode & stat.S_IRGRP or not status.st_mode & stat.S_IWGRP:
        mend = f"install {RULES_SOURCE} (see {DOCUMENT}), then unplug the board and plug it in again"
        return Finding(State.PROBLEM, device, f"permission denied{named}; not even its group may use it", mend)
    user = system.user or pwd.getpwuid(os.getuid()).pw_name
    if user in _members(group):
        mend = "log out and in again: the membership is not in force yet"
        return Finding(State.PROBLEM, device, f"permission denied{named}, though {user} is in group {group}", mend)
    mend = f"sudo usermod -aG {group} {user}, then log out and in again"
    return Finding(State.PROBLEM, device, f"permission denied{named}; {user} is not in group {group}", mend)


def _group_name(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _members(group: str) -> list[str]:
    try:
        return grp.getgrnam(group).gr_mem
    except KeyError:
        return []


def _users(path: Path, system: System) -> Iterator[str]:
    """Processes that have the device open; only the user's own are visible without root."""
    real = os.path.realpath(path)
    for process in system.processes():
        if process.name == str(os.getpid()):
            continue
        try:
            targets = [os.path.realpath(descriptor) for descriptor in (process / "fd").iterdir()]
        except OSError:
            continue
        if real in targets:
            yield f"{system.command(process) or 'a program'} (process {process.name})"


def _latency(device: str, path: Path, system: System) -> Iterable[Finding]:
    """The latency timer of an FTDI chip, where the port has one."""
    name = Path(os.path.realpath(path)).name
    timer = f"/sys/bus/usb-serial/devices/{name}/latency_timer"
    try:
        milliseconds = int(system.path(timer).read_text())
    except (OSError, ValueError):
        return []
    found = f"FTDI latency timer {milliseconds} ms"
    if milliseconds <= GOOD_LATENCY_MS:
        return [Finding(State.OK, device, found)]
    mend = f"echo {GOOD_LATENCY_MS} | sudo tee {timer} (for good: {RULES_SOURCE}, see {DOCUMENT})"
    return [Finding(State.PROBLEM, device, f"{found}: frames come up to that much late", mend)]


def _grabbers(system: System) -> Iterator[Finding]:
    running = {system.command(process) for process in system.processes()}
    for name, (harm, mend) in GRABBERS.items():
        if name in running:
            yield Finding(State.PROBLEM, name, f"runs; it {harm}", mend)
        else:
            yield Finding(State.OK, name, "does not run")
