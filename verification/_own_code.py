"""Quantities of a design's own: functions of Python files beside it.

The file is a program of whoever made the design. It is read once; that text is compiled, without Python's import system
and its bytecode files, and its SHA-256 stands in the report. It runs only where the user has allowed it, in a process
of its own: whatever the function does to that process, the verdict is this process's.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import pickle
import signal
import subprocess
import symtable
import sys
import threading
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import Any

from ..circuits import Requirement
from ..common.files import read_bytes
from ..common.text import one_line, shortened
from ..errors import InputError
from ._dut import DesignUnderTest
from ._outcome import Measurement, NotRun

MOST_BYTES = 2**20
"""size limit of a file of Python"""
LONGEST_ANSWER = 2**16
"""bytes of what a function's process says"""
LONGEST_REASON = 1000
"""characters of an error, or of a place"""
_LEAVING_S = 5.0
"""that a process may take to end after its last word"""
_MODULE = "ohmskin_own_code"
_PROGRAM = f"from {__name__} import serve; serve()"
Allowing = bool | Callable[[Path, str], bool]
"""whether a design's own code may run: for all files, or asked once for each file, with its path and SHA-256"""


@dataclass(frozen=True)
class _Answer:
    """What a function found, or the reason why it found nothing."""

    value: float = math.nan
    where: str = ""
    reason: str = ""

    def __post_init__(self) -> None:
        if not (isinstance(self.value, float) and isinstance(self.where, str) and isinstance(self.reason, str)):
            raise TypeError("no answer of a function")


@dataclass(frozen=True)
class OwnFunction:
    """``FILE.py:FUNCTION``, as it was when the run began."""

    quantity: str
    path: Path
    text: bytes
    allowed: bool

    @property
    def name(self) -> str:
        return self.quantity.rpartition(":")[2]

    @cached_property
    def sha256(self) -> str:
        """Of the file, in hexadecimal."""
        return hashlib.sha256(self.text).hexdigest()

    def measure(self, dut: DesignUnderTest, unit: str) -> Measurement:
        """``function(design, cell)``: a number, or a number and a place. Raises NotRun."""
        if not self.allowed:
            known = f"{self.path.name} (SHA-256 {self.sha256})"
            raise NotRun(f"{known} is the design's own code; it runs with --allow-code (allow_code=True)")
        answer = self._answer(pickle.dumps((str(self.path), self.text, self.name, dut.design, dut.cell)))
        if answer.reason:
            raise NotRun(answer.reason)
        said = f"as {self.quantity} says (SHA-256 {self.sha256})"
        return Measurement(answer.value, unit, where=answer.where, confidence=said)

    def _answer(self, request: bytes) -> _Answer:
        # -P: a module of the working folder is not imported in place of Python's own.
        path = os.pathsep.join(part for part in sys.path if part)
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", _PROGRAM],
            env={**os.environ, "PYTHONPATH": path},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(OSError):  # the process has ended
                process.stdin.write(request)
                process.stdin.flush()
            said = process.stdout.read(LONGEST_ANSWER)
            with suppress(ValueError, TypeError):
                return _Answer(**json.loads(said))
            with suppress(subprocess.TimeoutExpired):
                process.wait(_LEAVING_S)
            process.kill()
            code = process.wait()
            raise NotRun(f"{self.path.name}: {self.name} ended its process (exit code {code}) and gave no number")
        finally:
            process.kill()
            process.wait()
            with suppress(OSError):
                process.stdin.close()
            process.stdout.close()


def is_own(requirement: Requirement) -> bool:
    """Whether a function of the design's own gives the quantity."""
    return ".py:" in requirement.quantity


def read_own_functions(
    requirements: Iterable[Requirement], folder: Path, allow: Allowing = False
) -> dict[str, OwnFunction]:
    """The functions that these requirements name, by "FILE.py:FUNCTION"; nothing of their files is run.

    Raises:
        InputError: a file that is not below ``folder`` or is no Python, or that has no such function.
    """
    texts: dict[Path, tuple[bytes, bool]] = {}
    found: dict[str, OwnFunction] = {}
    for requirement in filter(is_own, requirements):
        file, _, name = requirement.quantity.rpartition(":")
        try:
            path = _path_of(file, folder)
            if path not in texts:
                text = read_bytes(path, most_bytes=MOST_BYTES)
                allowed = allow if isinstance(allow, bool) else allow(path, hashlib.sha256(text).hexdigest())
                texts[path] = text, allowed
            _check_name(texts[path][0], name, path)
        except InputError as error:
            raise InputError(f"requirement {requirement.id}: {error}") from error
        found[requirement.quantity] = OwnFunction(requirement.quantity, path, *texts[path])
    return found


def _path_of(file: str, folder: Path) -> Path:
    path = folder / file
    if Path(file).is_absolute() or not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{file}: a function is loaded from beside the design only, not from outside its folder")
    if ".." in Path(file).parts:
        raise InputError(f"{file}: expected a path below the design's folder, without '..'")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    return path


def _check_name(text: bytes, name: str, path: Path) -> None:
    """InputError for a text that is no Python, or binds no such name. It is parsed, and not run."""
    try:
        names = symtable.symtable(text.decode("utf-8-sig"), str(path), "exec").get_identifiers()
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{path}: {type(error).__name__}: {shortened(one_line(str(error)), 200)}") from error
    if name not in names and b"import *" not in text:
        raise InputError(f"{path}: no function '{name}'")


def serve() -> None:
    """In the process of a function: take the request from standard input, answer it, and end."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C is for the parent to tell
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the function prints is no answer
    path, text, name, design, cell = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    out.write(json.dumps(asdict(_called(path, text, name, design, cell))).encode() + b"\n")
    out.flush()
    os._exit(0)


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


def _called(path: str, text: bytes, name: str, design: Any, cell: Any) -> _Answer:
    """What the function finds, or why it finds nothing."""
    module = ModuleType(_MODULE)
    module.__file__ = path
    sys.modules[_MODULE] = module  # where dataclasses look their own up
    try:
        exec(compile(text, path, "exec"), module.__dict__)
        function = getattr(module, name, None)
        if not callable(function):
            return _Answer(reason=f"{path}: no function '{name}'")
        found = function(design, cell)
        value, where = found if isinstance(found, tuple) else (found, "")
        return _Answer(float(value), shortened(str(where), LONGEST_REASON))
    except NotRun as missing:
        return _Answer(reason=shortened(str(missing), LONGEST_REASON) or "the function says so")
    except BaseException as error:  # it may raise SystemExit, too
        return _Answer(reason=shortened(_where_raised(error, path), LONGEST_REASON))


def _where_raised(error: BaseException, path: str) -> str:
    """The error in one line, with the last line of the user's file that it came through."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == path]
    place = f"{Path(path).name}, line {lines[-1]}" if lines else "function(design, cell), or the number that it returns"
    return " ".join(f"{place}: {type(error).__name__}: {error}".split())
