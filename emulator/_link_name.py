"""A symbolic link that one living process owns: a lock file (flock) beside it says who, and where the link leads.

The kernel drops the lock when its owner dies, however it dies. A link that a killed emulator left behind is therefore
recognised and taken over, even if the number of its pseudo-terminal is in use again, and of two emulators that want
the same name at the same time exactly one gets it. A link that no emulator has made is left alone if it leads to
something.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from ..errors import InputError


class LinkName:
    """The right to a name for a symbolic link, from now on until :meth:`release`.

    Raises:
        InputError: another process has the name, something else is there, or the directory cannot be written.

    """

    def __init__(self, path: Path) -> None:
        if not path.name:
            raise InputError(f"'{path}' is no name for a link; expected the name of a file")
        self.path = path
        self._lock_path = path.with_name(f".{path.name}.lock")
        self._device: str | None = None
        self._lock = self._acquire()
        try:
            self._check_free()
        except BaseException:
            self.release()
            raise

    def point_to(self, device: str) -> None:
        """Let the link lead to ``device``; replaces an earlier link in one step."""
        partial = self.path.with_name(f".{self.path.name}.partial-{os.getpid()}")
        try:
            os.ftruncate(self._lock, 0)
            os.pwrite(self._lock, device.encode(), 0)
            partial.symlink_to(device)
            partial.replace(self.path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise InputError(f"{self.path}: cannot be linked: {error.strerror}") from error
        self._device = device

    def remove(self) -> None:
        """Take the link away and keep the right to the name; a link that leads elsewhere by now is left alone."""
        if self._device is not None and _target(self.path) == self._device:
            with contextlib.suppress(OSError):
                self.path.unlink()
        self._device = None

    def release(self) -> None:
        """Take the link away and give up the name; a second time does nothing."""
        if self._lock < 0:
            return
        self.remove()
        # Removed before it is unlocked: who waits for the lock finds that its file is no longer there.
        with contextlib.suppress(OSError):
            self._lock_path.unlink()
        os.close(self._lock)
        self._lock = -1

    def _acquire(self) -> int:
        while True:
            try:
                lock = os.open(self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
            except OSError as error:
                raise InputError(f"{self.path}: cannot be linked: {error.strerror}") from error
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                os.close(lock)
                raise InputError(f"{self.path}: in use by another emulator; expected a free name") from error
            except OSError as error:
                os.close(lock)
                raise InputError(f"{self._lock_path}: cannot be locked: {error.strerror}") from error
            if self._is_lock_file(lock):
                if os.fstat(lock).st_uid != os.getuid():  # its content would say which link may be replaced
                    os.close(lock)
                    raise InputError(f"{self._lock_path}: belongs to another user; expected a free name")
                return lock
            os.close(lock)  # its owner removed the file in between

    def _is_lock_file(self, lock: int) -> bool:
        try:
            there = os.stat(self._lock_path)
        except FileNotFoundError:
            return False
        return os.path.samestat(there, os.fstat(lock))

    def _check_free(self) -> None:
        if not os.path.lexists(self.path):
            return
        target = _target(self.path)
        if target is None:
            raise InputError(f"{self.path}: exists and is no symbolic link; expected a free name")
        left_behind = os.pread(self._lock, 4096, 0).decode(errors="replace")
        stale = target == left_behind or (target.startswith("/dev/") and not self.path.exists())
        if not stale:
            raise InputError(f"{self.path}: leads to {target}, which no emulator left there; expected a free name")


def _target(link: Path) -> str | None:
    """Where a symbolic link leads; None where there is none."""
    try:
        return os.readlink(link)
    except OSError:
        return None
