"""Argument checks of the Python interface: an argument of the wrong type is an InputError, as a wrong value is.

Tables of configuration files are checked by :mod:`ohmskin.common.config`. These functions check the arguments
of a call, and return them with their type.
"""

from __future__ import annotations

import ipaddress
import math
import os
from collections.abc import Callable
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

from ..errors import InputError
from .text import shown


class Readable(Protocol):
    """A class whose objects can be read from a file."""

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """The object that a file holds."""


_REAL = float, int, Real
"""float and int first: to ask the abstract class alone takes ten times as long"""

T = TypeVar("T")
R = TypeVar("R", bound=Readable)


def number(name: str, value: object, unit: str = "") -> float:
    """A real number as a float. InputError for a NaN, for True and False, and for what is no number."""
    if isinstance(value, _REAL) and not isinstance(value, bool) and not math.isnan(value):
        return float(value)
    raise InputError(f"{name} is {shown(value)}; expected a number{unit and f', in {unit}'}")


def positive(name: str, value: object, unit: str = "") -> float:
    """A real number above 0 as a float; InputError."""
    given = number(name, value, unit)
    if not given > 0:
        raise InputError(f"{name} is {value}{unit and f' {unit}'}; expected more than 0")
    return given


def count(name: str, value: object) -> int:
    """A whole number from 1 on; InputError."""
    if isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1:
        return int(value)
    raise InputError(f"{name} is {shown(value)}; expected a whole number, at least 1")


def of_kind(name: str, value: object, kind: type[T], expected: str) -> T:
    """An object of the class ``kind``; InputError that says what was expected."""
    if isinstance(value, kind):
        return value
    raise InputError(f"{name} is {shown(value)}; expected {expected}")


def path_text(name: str, value: object, expected: str = "the path of a file") -> str:
    """A path, given as text or as a :class:`pathlib.Path`, as text; InputError."""
    if isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        if isinstance(text, str):
            return text
    raise InputError(f"{name} is {shown(value)}; expected {expected}")


def function(name: str, value: Callable[..., Any]) -> None:
    """InputError unless ``value`` can be called."""
    if not callable(value):
        raise InputError(f"{name} is {shown(value)}; expected a function")


def loaded(name: str, value: R | str | Path, kind: type[R]) -> R:
    """An object of the class ``kind``, as it was given or read from the file that was given; InputError."""
    if isinstance(value, kind):
        return value
    return kind.load(path_text(name, value, f"a {kind.__name__} or the path of its file"))


def is_loopback(host: str) -> bool:
    """Whether a name or address is this machine's own, and can be no other."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
