"""Options with which a command opens a skin: family, design, cell, calibration, tare and estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import click

from ..cell import Cell
from ..circuits import Design
from ..driver import Skin, Tare
from ..wire import BOARDS


@dataclass(frozen=True)
class Opening:
    """What the command line says of a skin, with its files read; None: as the board or the driver says."""

    board: str
    design: Design | None
    cell: Cell | None
    calibration: Path | None
    tare: Tare | None
    estimator: str | None

    def open(self, port: str, **more: Any) -> Skin:
        """The skin at a port or in a recording, tared; ``more`` goes to ``Skin.open``."""
        skin = Skin.open(
            port,
            board=self.board,
            design=self.design,
            cell=self.cell,
            calibration=self.calibration,
            estimator=self.estimator,
            **more,
        )
        if self.tare is not None:
            try:
                skin.use_tare(self.tare)
            except BaseException:
                skin.close()
                raise
        return skin


_file = click.Path(path_type=Path)
_OPTIONS = (
    click.option(
        "--board",
        default="ohmskin",
        show_default=True,
        metavar="NAME",
        help=f"Family of the board: {', '.join(BOARDS)}.",
    ),
    click.option("--design", type=_file, metavar="DESIGN.toml", help="Of the readout."),
    click.option("--cell", type=_file, metavar="CELL.toml", help="Of the skin."),
    click.option(
        "--calibration",
        type=_file,
        metavar="FILE",
        help="Rest resistance and gain of each cell, as `ohmskin calibrate` writes them.",
    ),
    click.option("--tare", type=_file, metavar="FILE.npz", help="A saved tare."),
    click.option("--estimator", metavar="NAME", help="static, paper, inverse, play or distilled [the cell's choice]."),
)


def opening_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command these options, and its function an argument ``opening`` in their place."""

    @wraps(command)
    def with_opening(
        *,
        board: str,
        design: Path | None,
        cell: Path | None,
        calibration: Path | None,
        tare: Path | None,
        estimator: str | None,
        **others: Any,
    ) -> Any:
        opening = Opening(
            board=board,
            design=None if design is None else Design.load(design),
            cell=None if cell is None else Cell.load(cell),
            calibration=calibration,
            tare=None if tare is None else Tare.load(tare),
            estimator=estimator,
        )
        return command(opening=opening, **others)

    for option in reversed(_OPTIONS):
        with_opening = option(with_opening)
    return with_opening
