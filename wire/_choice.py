"""Protocol objects by the name of a family of boards, or from the file that describes a board."""

from __future__ import annotations

import dataclasses
import difflib
import os
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from ..common.checks import of_kind
from ..errors import InputError
from ._board_file import load_family
from ._protocol import BoardProtocol, Family, HostProtocol, Layout
from .boards import BOARDS

GROUP = "ohmskin.boards"
"""entry points of packages that bring a family: its name = "module:FAMILY\""""


def board_family(board: str | os.PathLike[str] | Family) -> Family:
    """The family of a board.

    Args:
        board: a family, which is returned as it is; its name, one of ``BOARDS`` or of an installed package; or the path
            of a BOARD.toml.

    Raises:
        InputError: there is none, with the nearest known name; or the file is not valid.

    """
    if isinstance(board, Family):
        return board
    if isinstance(board, os.PathLike):
        return load_family(Path(board))
    name = of_kind("board", board, str, "the name of a family, a BOARD.toml, or a Family")
    return load_family(name) if name.endswith(".toml") else known_family(name)


def known_family(name: str) -> Family:
    """The family of this name, one of ``BOARDS`` or of an installed package: what a recording may name, but no file.

    Raises:
        InputError: there is none, with the nearest known name.

    """
    if name in BOARDS:
        return BOARDS[name]
    brought = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name in brought:
        return _loaded(brought[name])
    known = [*BOARDS, *brought]
    (near,) = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    raise InputError(
        f"no family of boards '{name}'; the nearest is '{near}', all are {', '.join(known)}; "
        "or give the path of a BOARD.toml (docs/boards.md)"
    )


def _loaded(entry: EntryPoint) -> Family:
    """The family of an installed package. Raises InputError."""
    source = f"family '{entry.name}' of the package {entry.dist.name if entry.dist else '?'}"
    try:
        family = entry.load()
    except Exception as error:  # the other package's own code
        raise InputError(f"{source} cannot be imported: {error!r}") from error
    return of_kind(source, family, Family, "an ohmskin.wire.Family")


def host_protocol(
    board: str | os.PathLike[str] | Family, *, shape: tuple[int, int] | None = None, adc_bits: int | None = None
) -> HostProtocol:
    """A new host end of the line to a board.

    Args:
        board: as for :func:`board_family`.
        shape: (rows, columns) of the board's array, where its packets do not say it; None: the usual ones.
        adc_bits: of the board's converter, likewise.

    Raises:
        InputError: there is no such family, or it has no such array.

    """
    family = board_family(board)
    return family.host(family, _layout(family, shape, adc_bits))


def board_protocol(
    board: str | os.PathLike[str] | Family, *, shape: tuple[int, int] | None = None, adc_bits: int | None = None
) -> BoardProtocol:
    """A new board end of the line, for an emulator; arguments and errors as for :func:`host_protocol`."""
    family = board_family(board)
    return family.board(family, _layout(family, shape, adc_bits))


def _layout(family: Family, shape: tuple[int, int] | None, adc_bits: int | None) -> Layout:
    layout = family.layout
    if shape is not None:
        layout = dataclasses.replace(layout, rows=shape[0], columns=shape[1])
    if adc_bits is not None:
        layout = dataclasses.replace(layout, adc_bits=adc_bits)
    if layout != family.layout and family.tables is not None and family.design is None:
        of, given = (f"{one.rows} x {one.columns} cells of {one.adc_bits} bits" for one in (family.layout, layout))
        raise InputError(f"board '{family.name}' has {of} in its BOARD.toml; the design has {given}")
    return layout
