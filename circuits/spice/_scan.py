"""A frame by ngspice, as an independent judge of the solvers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...errors import MissingExtra
from .._design import Design
from ..ends import GROUND
from ._netlist import frame_decks
from ._ngspice import Vectors, command_available, run_command
from ._pyspice import library_available, run_library


def spice_scan(design: Design, resistance: ArrayLike, run: Callable[[str], Vectors] | None = None) -> FloatArray:
    """The outputs of one frame in V, (rows, columns), by the operating point of each of its steps.

    Args:
        run: :func:`run_library` or :func:`run_command`; None: the library if PySpice is installed, else the command.

    Raises:
        InputError: cells that do not fit the design.
        MissingExtra: what ``run`` needs is not installed; of None, neither of both.
        SolverError: contradictory ideal parts, or no convergence.
    """
    run = run or _first_installed()
    board = design.board
    volts = np.empty(board.shape)
    for places, deck in frame_decks(design, resistance):
        vectors = {GROUND: np.zeros(1)} | run(deck.batch_text())
        volts.flat[places] = [vectors[node][0] for node in deck.outputs]
    return board.transpose(volts)


def _first_installed() -> Callable[[str], Vectors]:
    if (no_library := library_available()) is None:
        return run_library
    if (no_command := command_available()) is None:
        return run_command
    raise MissingExtra(f"{no_library}; {no_command}")
