"""A frame by ngspice, as an independent judge of the solvers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...errors import MissingExtra, SolverError
from .._design import Design
from ..readouts import REFERENCE
from ._netlist import Deck, frame_deck, step_deck
from ._ngspice import Vectors, command_available, run_command
from ._pyspice import library_available, run_library


def spice_scan(design: Design, resistance: ArrayLike, run: Callable[[str], Vectors] | None = None) -> FloatArray:
    """The outputs of one frame in V, (rows, columns): one ``.dc`` sweep, or a few extreme circuits row by row.

    Args:
        run: :func:`run_library` or :func:`run_command`; None: the library if PySpice is installed, else the command.

    Raises:
        InputError: cells that do not fit the design.
        MissingExtra: what ``run`` needs is not installed; of None, neither of both.
        SolverError: contradictory ideal parts, or no convergence.
    """
    if run is None:
        run = _first_installed()
    try:
        deck = frame_deck(design, resistance)
    except SolverError:  # ideal parts that only the netlist of a single row can express
        decks = [step_deck(design, resistance, row) for row in range(design.array.rows)]
        return np.vstack([_volts(deck, run(deck.batch_text()))[0] for deck in decks])
    return design.board.turn(_volts(deck, run(deck.batch_text())).reshape(design.board.shape))


def _first_installed() -> Callable[[str], Vectors]:
    if (no_library := library_available()) is None:
        return run_library
    if (no_command := command_available()) is None:
        return run_command
    raise MissingExtra(f"{no_library}; {no_command}")


def _volts(deck: Deck, vectors: Vectors) -> FloatArray:
    """The outputs of a deck against board ground, (points of the row sweep, columns)."""
    points = len(next(iter(vectors.values())))
    potential = {REFERENCE: np.zeros(points)} | vectors
    volts = np.column_stack([potential[node] for node in deck.outputs]) - potential[deck.ground][:, None]
    if not deck.one_by_one:
        return volts
    columns = len(deck.outputs)
    return volts.reshape(-1, columns, columns).diagonal(axis1=1, axis2=2)
