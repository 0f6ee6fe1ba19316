"""Immutable dataclasses that are quick to make: they behave as ``dataclass(frozen=True)``."""

from __future__ import annotations

import copy
import inspect
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace

import pytest

from ohmskin.common.frozen import frozen


@dataclass(frozen=True, slots=True)
class Reference:
    """A place."""

    row: int
    column: int = 0
    name: str = field(default="", compare=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.row < 0:
            raise ValueError("row")


@frozen
@dataclass(slots=True, unsafe_hash=True)
class Quick:
    """A place."""

    row: int
    column: int = 0
    name: str = field(default="", compare=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.row < 0:
            raise ValueError("row")


@pytest.mark.parametrize("kind", [Reference, Quick])
def test_instances_are_values(kind: type[Quick]) -> None:
    one, same, other = kind(1, 2, name="a"), kind(1, column=2, name="b"), replace(kind(1, 2), row=3)
    assert one == same != other
    assert hash(one) == hash(same)
    assert type(one) is type(other) is kind
    assert repr(one) == f"{kind.__name__}(row=1, column=2, name='a')"
    assert [item.name for item in fields(one)] == ["row", "column", "name"]
    assert str(inspect.signature(kind)) == str(inspect.signature(Reference))
    assert kind.__doc__ == "A place."
    match one:
        case kind(row, column):
            assert (row, column) == (1, 2)
    for again in (copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert type(again) is kind
        assert (again, again.name) == (one, "a")


@pytest.mark.parametrize("kind", [Reference, Quick])
def test_instances_cannot_be_changed(kind: type[Quick]) -> None:
    one = kind(1)
    with pytest.raises(FrozenInstanceError, match="row"):
        one.row = 2
    with pytest.raises(FrozenInstanceError, match="row"):
        del one.row
    with pytest.raises((FrozenInstanceError, TypeError)):
        one.more = 2  # type: ignore[attr-defined]  # the point of the test
    assert one.row == 1
    with pytest.raises(ValueError, match="row"):
        kind(-1)
    with pytest.raises(TypeError):
        kind()  # type: ignore[call-arg]  # the point of the test
