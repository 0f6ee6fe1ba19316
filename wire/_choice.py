"""Protocol objects by the name of a family of boards."""

from __future__ import annotations

import dataclasses
import difflib

from ..common.checks import of_kind
from ..errors import InputError
from ._protocol import BoardProtocol, Family, HostProtocol, Layout
from .boards import BOARDS


def board_family(name: str | Family) -> Family:
    """The family called ``name``; InputError with the nearest known name where there is none. A family is itself."""
    if isinstance(name, Family):
        return name
    if of_kind("board", name, str, "the name of a family") not in BOARDS:
        (near,) = difflib.get_close_matches(name, BOARDS, n=1, cutoff=0.0)
        raise InputError(f"no family of boards '{name}'; the nearest is '{near}', all are {', '.join(BOARDS)}")
    return BOARDS[name]


def host_protocol(
    name: str | Family, *, shape: tuple[int, int] | None = None, adc_bits: int | None = None
) -> HostProtocol:
    """A new host end of the line to a board.

    Args:
        name: family of the board: a key of ``BOARDS``, or the family itself.
        shape: (rows, columns) of the board's array, where its packets do not say it; None: the usual ones.
        adc_bits: of the board's converter, likewise.

    Raises:
        InputError: there is no such family, or it has no such array.

    """
    family = board_family(name)
    return family.host(family, _layout(family, shape, adc_bits))


def board_protocol(
    name: str | Family, *, shape: tuple[int, int] | None = None, adc_bits: int | None = None
) -> BoardProtocol:
    """A new board end of the line, for an emulator; arguments and errors as for :func:`host_protocol`."""
    family = board_family(name)
    return family.board(family, _layout(family, shape, adc_bits))


def _layout(family: Family, shape: tuple[int, int] | None, adc_bits: int | None) -> Layout:
    layout = family.layout
    if shape is not None:
        layout = dataclasses.replace(layout, rows=shape[0], columns=shape[1])
    if adc_bits is not None:
        layout = dataclasses.replace(layout, adc_bits=adc_bits)
    return layout
