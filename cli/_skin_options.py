"""Options with which a command opens a skin: board, baud rate, design, cell, calibration, tare and estimator."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any
from urllib.parse import quote

import click

from ..cell import Cell
from ..circuits import Design, Shape
from ..driver import Skin, Tare
from ..emulator import load_scenes
from ..errors import LinkTimeout, OhmskinError, ProtocolError
from ..wire import BOARDS
from . import arguments
from ._bar import progress_bar

NATIVE = "ohmskin"
"""the family of boards that describe themselves"""
QUEUE = 4096
"""frames that may wait for a command that takes all of them"""


@dataclass(frozen=True)
class SkinOptions:
    """What the command line says of a skin, with its files read; None: as the board or the driver says."""

    board: str = NATIVE
    baud: int | None = None
    design: Design | None = None
    cell: Cell | None = None
    shape: Shape | None = None
    calibration: Path | None = None
    tare: Tare | None = None
    estimator: str | None = None

    def open(self, what: str | Sequence[str], **more: Any) -> Skin:
        """The skin at a port, in a recording or emulated from a scene, tared; ``more`` goes to ``Skin.open``.

        Several ports, several recordings and the boards of a scene are one skin. Where the board at a port is not
        understood, a person at a terminal is asked whether to find out what it is.
        """
        given = [what] if isinstance(what, str) else list(what)
        try:
            return self._opened(given, **more)
        except (ProtocolError, LinkTimeout) as error:
            if self.board != NATIVE or len(given) > 1 or not _may_find_out(given[0], error):
                raise
            from .doctor import understood  # which loads what only it needs

            board = understood(given[0], self.baud)
            if board is None or board == NATIVE:
                raise
            return replace(self, board=board)._opened(given, **more)

    def _opened(self, given: Sequence[str], **more: Any) -> Skin:
        ports = [port for one in given for port in self._ports(one)]
        with progress_bar("reading") as tell:
            skin = Skin.open(
                ports[0] if len(ports) == 1 else ports,
                board=self.board,
                baudrate=self.baud,
                design=self.design,
                cell=self.cell,
                shape=self.shape,
                calibration=self.calibration,
                estimator=self.estimator,
                progress=tell,
                **more,
            )
        if self.tare is not None:
            try:
                skin.use_tare(self.tare)
            except BaseException:
                skin.close()
                raise
        return skin

    def _ports(self, what: str) -> list[str]:
        """What to open: ``what``, or the addresses of the boards that this process emulates from a scene."""
        if not _is_scene(what):
            return [what]
        address = f"ohmskin://{quote(str(Path(what).resolve()))}?clock=real&board={quote(self.board)}"
        return [f"{address}&part={k}" for k, _ in enumerate(load_scenes(what), start=1)]


def is_emulated_here(what: str) -> bool:
    """Whether :meth:`SkinOptions.open` would emulate the board in this process."""
    return what.startswith("ohmskin://") or _is_scene(what)


def _is_scene(what: str) -> bool:
    return what.endswith(".toml") and "://" not in what


def _may_find_out(what: str, error: OhmskinError) -> bool:
    """Whether a person at the terminal wants to know what board is at a port; without one it is no."""
    if is_emulated_here(what) or what.endswith(".mcap") or not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    arguments.note(str(error))
    return click.confirm("Listen to the port and draft a description of the board?", default=True, err=True)


BOARD_HELP = f"Family of the board ({', '.join(BOARDS)}), or BOARD.toml that describes it, as `doctor` drafts it."

_file = click.Path(path_type=Path)
_OPTIONS = {
    "board": click.option("--board", default=NATIVE, show_default=True, metavar="NAME|FILE.toml", help=BOARD_HELP),
    "baud": click.option(
        "--baud", type=click.IntRange(min=1), metavar="N", help="Baud rate of the UART [the board's usual one]."
    ),
    "design": click.option("--design", type=_file, metavar="DESIGN.toml", help="Of the readout."),
    "cell": click.option("--cell", type=_file, metavar="CELL.toml", help="Of the skin."),
    "shape": click.option("--shape", type=_file, metavar="SHAPE.csv", help="Places of the cells (docs/shape.md)."),
    "calibration": click.option(
        "--calibration",
        type=_file,
        metavar="FILE",
        help="Rest resistance and gain of each cell, as `ohmskin calibrate` writes them.",
    ),
    "tare": click.option("--tare", type=_file, metavar="FILE.npz", help="A saved tare."),
    "estimator": click.option(
        "--estimator", metavar="NAME", help="static, paper, inverse, play or distilled [the cell's choice]."
    ),
}
_READ: dict[str, Callable[[Path], Any]] = {
    "design": Design.load,
    "cell": Cell.load,
    "shape": Shape.load,
    "tare": Tare.load,
}
"""how the file of an option is read; other options are passed on as they are"""


def skin_options(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Give a command the named options, and its function an argument ``options`` in their place.

    Args:
        names: fields of :class:`SkinOptions`, in the order of the help text; none: all of them.

    """
    chosen = names or tuple(_OPTIONS)

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_options(**arguments: Any) -> Any:
            given = {name: value for name in chosen if (value := arguments.pop(name)) is not None}
            read = {name: _READ[name](value) if name in _READ else value for name, value in given.items()}
            return command(options=SkinOptions(**read), **arguments)

        for name in reversed(chosen):
            with_options = _OPTIONS[name](with_options)
        return with_options

    return decorate
