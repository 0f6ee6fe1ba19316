"""Condition of the inverse problem: how errors of readings propagate to the recovered cells, to first order."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from ...errors import InputError
from .._design import Design
from .._exact import read_exactly
from .._sensitivity import board_sensitivity


@dataclass(frozen=True)
class Conditioning:
    """Error propagation from the readings to the recovered resistances, to first order."""

    inverse: FloatArray
    """(NM, NM): relative change of each cell's resistance per relative change of each apparent resistance"""
    volts_to_relative: FloatArray
    """(N, M) 1/V: magnitude of the relative change of an apparent resistance per volt of its reading"""
    resistance: FloatArray
    """(N, M) ohm of the cells at which the derivatives hold; cells that are NaN or inf were left out"""

    @property
    def amplification(self) -> FloatArray:
        """(N, M): standard deviation of each cell if all readings have independent errors of relative size 1.

        An ideal board has 1 everywhere. Cells that were left out are NaN.
        """
        total = np.sqrt((self.inverse**2).sum(axis=1)).reshape(self.resistance.shape)
        return np.where(np.isfinite(self.resistance), total, np.nan)

    def resistance_std(self, volts_std: ArrayLike) -> FloatArray:
        """Standard deviation (N, M) of the resistances in ohm.

        Args:
            volts_std: standard deviation of the readings in V, a number or (N, M). Errors are independent.

        """
        relative = self.volts_to_relative * np.asarray(volts_std, dtype=np.float64)
        variance = self.inverse**2 @ relative.ravel() ** 2
        std: FloatArray = self.resistance * np.sqrt(variance).reshape(self.resistance.shape)
        return std


def conditioning(design: Design, resistance: ArrayLike) -> Conditioning:
    """Error propagation from readings to recovered cells: the inverse of the Jacobian in relative units.

    Args:
        design: with a sliced sheet, of at most 64 x 64 cells.
        resistance: (rows, columns) ohm, such as :attr:`Recovery.resistance`; cells that are NaN or inf are left out.

    Raises:
        InputError: as :func:`.sensitivity`, or a cell is shorted.

    """
    cells = np.asarray(resistance, dtype=np.float64)
    left_out = np.isnan(cells)
    cells = design.resistance(np.where(left_out, inf, cells))
    unlimited = design.replace(readout={"supply": (-inf, inf)})
    board = unlimited.board
    transpose = board.transpose
    cells = transpose(cells)
    if (cells == 0.0).any():
        raise InputError("a shorted cell (0 ohm) has no relative error; leave it out as nan")
    found = board_sensitivity(board, cells)
    if board.line_ends is not None:
        signal = found.volts - board.level
    else:  # the part of a reading that turns with the drive; the reference and offsets make the rest
        other = unlimited.replace(drive={"voltage": -design.drive.voltage}).board
        signal = (found.volts - read_exactly(other, cells)[0].volts) / 2.0
    live = np.isfinite(cells) & (signal != 0)
    slope = np.where(live, board.circuit.log_conductance_slope(board, signal), 0.0)
    some = live.ravel()
    jacobian = (found.cell_conductance / cells * slope[..., None, None]).reshape(some.size, some.size)
    inverse = np.eye(some.size)
    try:
        inverse[np.ix_(some, some)] = np.linalg.inv(jacobian[np.ix_(some, some)])
    except np.linalg.LinAlgError:
        inverse[np.ix_(some, some)] = inf
    place = transpose(np.arange(cells.size).reshape(board.shape)).ravel()  # of each of the array's cells
    return Conditioning(
        inverse=inverse[np.ix_(place, place)],
        volts_to_relative=transpose(np.abs(slope)),
        resistance=np.where(transpose(live), transpose(cells), np.where(left_out, np.nan, transpose(cells))),
    )
