"""Names of ports: the ports of this machine, and the reason why one of them cannot be opened."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from urllib.parse import parse_qsl, unquote, urlsplit

from serial.tools import list_ports

from ..common.rendezvous import announced_ports
from ..common.system import POSIX
from ..errors import LinkError

EMULATED_HERE = "ohmskin://"
"""address scheme of a board that is emulated in this process"""


def is_unpaced(name: str) -> bool:
    """Whether ``name`` is the address of a board that is emulated here as fast as its frames are read."""
    return name.startswith(EMULATED_HERE) and dict(parse_qsl(urlsplit(name).query)).get("clock") == "fast"


def usb_serial_number(name: str) -> str | None:
    """The serial number of the USB device behind the port ``name``; None if it has none."""
    device = os.path.realpath(name)
    return next((port.serial_number for port in list_ports.comports() if port.device == device), None)


def ports_with(usb_serial: str) -> list[str]:
    """The names of all ports of the USB device with this serial number."""
    return [port.device for port in list_ports.comports() if port.serial_number == usb_serial]


def serial_ports() -> list[str]:
    """The names of the serial ports that the operating system lists. Pseudo-terminals are not among them."""
    return [port.device for port in list_ports.comports()]


def emulated_ports() -> list[str]:
    """The names of the pseudo-terminals and sockets of the emulated boards on this machine."""
    return [port.name for port in announced_ports() if port.is_listed]


def is_numbered_terminal(name: str) -> bool:
    """Whether ``name`` is a numbered pseudo-terminal. The next one opened gets the number when this one is closed."""
    return name.startswith("/dev/pts/")


def refuse_missing(name: str) -> None:
    """Raise the LinkError of :func:`._port.open_port` if a check of ``name`` suffices, without opening anything.

    The cases are: no device is there; this user may not read and write it; the scene of an ``ohmskin://`` address is no
    file. Other addresses (``socket://...``) pass.
    """
    if name.startswith(EMULATED_HERE):
        parts = urlsplit(name)
        path = unquote(parts.netloc + parts.path)
        if path != "demo" and not os.path.isfile(path):
            raise LinkError(f"{name}: no such scene")
    elif "://" not in name:
        if has_gone(name):
            raise LinkError(f"{name}: {why_not_opened(name, FileNotFoundError(errno.ENOENT, 'no such port'))}")
        if POSIX and not os.access(name, os.R_OK | os.W_OK):
            raise LinkError(f"{name}: {why_not_opened(name, PermissionError(errno.EACCES, 'permission denied'))}")


def has_gone(name: str) -> bool:
    """Whether no device has that name now; False for addresses (``socket://...``), which must be opened to tell."""
    if "://" in name:
        return False
    return not os.path.exists(name) if POSIX else name not in serial_ports()


def refuse_terminal(name: str) -> None:
    """Raise LinkError if the pseudo-terminal ``name`` is somebody's terminal window.

    An emulator that died may leave a link to a pseudo-terminal whose number a terminal window has taken since.
    """
    device = os.path.realpath(name)
    if not device.startswith("/dev/pts/") or not os.path.exists(device):
        return
    number = os.stat(device).st_rdev
    for process in Path("/proc").glob("[0-9]*"):
        try:
            # The name in parentheses may contain anything; the fields after it begin with state, parent, group,
            # session and terminal.
            head, _, fields = (process / "stat").read_text(errors="replace").rpartition(")")
        except OSError:
            continue
        if int(fields.split()[4]) == number:
            who = f"process {process.name} ({head.partition('(')[2]})"
            raise LinkError(f"{name}: is the terminal of {who}, not a board")


def why_not_opened(name: str, error: Exception) -> str:
    """Message for an ``error`` on opening the port ``name``, with the ports that are there instead."""
    match getattr(error, "errno", None):
        case errno.ENOENT:
            emulated = f"; emulated boards: {', '.join(emulated_ports())}" if emulated_ports() else ""
            return f"no such port; serial ports present: {', '.join(serial_ports()) or 'none'}{emulated}"
        case errno.EACCES | errno.EPERM if POSIX:
            return f"permission denied; {_why_forbidden(name)}; `ohmskin doctor {name}` says what to do"
        case errno.EAGAIN | errno.EBUSY:
            return "in use by another program, or by another Skin of this one"
        case errno.EMFILE | errno.ENFILE:
            return f"cannot be opened: {reason_of(error)}"
    if os.path.isfile(name):
        return "is no serial port but a file; recordings of ohmskin end in .mcap"
    if os.path.exists(name) and not isinstance(error, ValueError):
        return f"is no serial port ({reason_of(error)})"
    return f"cannot be opened: {reason_of(error)}"


def _why_forbidden(name: str) -> str:
    status = os.stat(name)
    try:
        group = f"group '{Path(name).group()}'"
    except KeyError:
        group = f"group {status.st_gid}"
    group_may = status.st_mode & stat.S_IRGRP and status.st_mode & stat.S_IWGRP
    if group_may and status.st_gid not in (os.getegid(), *os.getgroups()):
        return f"the port belongs to {group}, which this user is not in"
    return f"the port belongs to {group}, and its mode {stat.filemode(status.st_mode)} keeps this user out"


def reason_of(error: Exception) -> str:
    """The operating system's text for an error."""
    return getattr(error, "strerror", None) or str(error)
