"""Immutable dataclasses that are as quick to make as mutable ones.

``dataclass(frozen=True)`` sets each field by ``object.__setattr__``, which makes the nineteen fields of a frame cost as
much as ten operations on the array of a small skin. :func:`frozen` refuses changes, too, but sets fields as usual.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields
from typing import Any, NoReturn, TypeVar, cast

T = TypeVar("T")


def frozen(plain: type[T]) -> type[T]:
    """Make a dataclass immutable: a decorator above ``@dataclass(slots=True)``.

    The class that is returned refuses changes. Its instances are made as those of ``plain`` and then change class,
    which Python allows because both have the same slots.
    """

    def make(cls: type[T], *values: Any, **named: Any) -> T:
        made = plain(*values, **named)
        made.__class__ = cls
        return made

    body: dict[str, Any] = {
        "__slots__": (),
        "__new__": make,
        "__init__": object.__init__,  # which does nothing where there is a __new__
        "__setattr__": _refuse,
        "__delattr__": _refuse,
        "__doc__": plain.__doc__,
        "__module__": plain.__module__,
        "__qualname__": plain.__qualname__,
        "__signature__": inspect.signature(plain),
    }
    if plain.__reduce__ is object.__reduce__:
        body["__reduce__"] = _reduced
    return cast(type[T], type(plain.__name__, (plain,), body))


def _refuse(instance: object, name: str, value: object = None) -> NoReturn:
    raise FrozenInstanceError(f"cannot change field '{name}' of {type(instance).__name__}")


def _reduced(instance: Any) -> tuple[Callable[..., Any], tuple[type, dict[str, Any]]]:
    """For pickle and copy, which would otherwise set the fields of an empty instance one by one."""
    return _restored, (type(instance), {item.name: getattr(instance, item.name) for item in fields(instance)})


def _restored(kind: type[T], values: dict[str, Any]) -> T:
    return kind(**values)
