"""The families of boards that ohmskin ships: a BOARD.toml each, or a module for formats that one cannot describe.

A new family is one more file here, with its name and the supply of its converter in ``_DESCRIBED``, or one more module
in ``_MODULES``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import resources

from .._board_file import BoardFile
from .._protocol import Family
from ._actionsense import ACTIONSENSE
from ._circuits import divider
from ._fsr_array import FSR_ARRAY
from ._ohmskin import OHMSKIN
from ._wiresens import WIRESENS

_MODULES = {family.name: family for family in (OHMSKIN, WIRESENS, ACTIONSENSE, FSR_ARRAY)}
_DESCRIBED = {"flexitac": 5.0, "vitac": 5.0, "capstone": 3.3, "m1616": 3.3, "snowboard": 5.0}
"""name of a file -> V, supply of the usual dividers and of the converter"""


@cache
def _described(name: str) -> Family:
    text = resources.files(__name__).joinpath(f"{name}.toml").read_text(encoding="utf-8")
    file = BoardFile.parse(tomllib.loads(text), f"{name}.toml")
    board = file.board
    return file.family(design=divider(board.rows, board.columns, board.bits, _DESCRIBED[name]))


class _Families(Mapping[str, Family]):
    """The families by name; a file is read when its family is asked for."""

    def __getitem__(self, name: str) -> Family:
        return _described(name) if name in _DESCRIBED else _MODULES[name]

    def __iter__(self) -> Iterator[str]:
        return iter((*_MODULES, *_DESCRIBED))

    def __len__(self) -> int:
        return len(_MODULES) + len(_DESCRIBED)


BOARDS: Mapping[str, Family] = _Families()
"""families by name"""

__all__ = ["BOARDS"]
