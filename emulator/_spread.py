"""How a layer of silicone shares the pressure of a contact among the cells below it.

The layer is taken for the upper part of an elastic half-space: the vertical stress at its lower face is Boussinesq's,
integrated over the loaded cell in closed form (Newmark 1935), and averaged over each cell below. It depends on depth
over pitch alone, not on the modulus. Not modelled: a stiff base, slip, large deformation, and cuts in the layer.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.ndimage import convolve

from ..common.arrays import FloatArray, IntArray
from ._tuning import SPREAD_POINTS, SPREAD_REACH


def spread(pressure_kpa: FloatArray, depth_pitches: float) -> FloatArray:
    """Mean pressure (rows, columns) on each cell below a layer, given that on the surface above each.

    Args:
        pressure_kpa: (rows, columns), taken to be even above each cell and zero beside the array.
        depth_pitches: the layer's thickness over the pitch of the cells; 0 spreads nothing.

    """
    if depth_pitches == 0:
        return pressure_kpa
    felt: FloatArray = convolve(pressure_kpa, shares(depth_pitches), mode="constant")
    return felt


class Spreading:
    """:func:`spread` over time, for the few cells that are pressed."""

    def __init__(self, shape: tuple[int, int], depth_pitches: float) -> None:
        self._shape = shape
        self._shares = shares(depth_pitches) if depth_pitches else None

    def below(self, cells: IntArray, pressure_kpa: FloatArray) -> tuple[IntArray, FloatArray]:
        """The cells that feel what presses on ``cells``, and the pressure on them.

        Args:
            cells: (k,) indices into the flattened array.
            pressure_kpa: (frames, k), on the surface.

        Returns:
            (m,) indices in rising order, and (frames, m) kPa.

        """
        if self._shares is None or not len(cells):
            return cells, pressure_kpa
        rows, columns = self._shape
        row, column = np.divmod(cells, columns)
        near = np.zeros((rows + 2 * SPREAD_REACH, columns + 2 * SPREAD_REACH), dtype=np.bool_)
        for down in range(2 * SPREAD_REACH + 1):
            for along in range(2 * SPREAD_REACH + 1):
                near[row + down, column + along] = True
        felt = np.flatnonzero(near[SPREAD_REACH:-SPREAD_REACH, SPREAD_REACH:-SPREAD_REACH])
        apart_row = felt // columns - row[:, None]
        apart_column = felt % columns - column[:, None]
        within = (np.abs(apart_row) <= SPREAD_REACH) & (np.abs(apart_column) <= SPREAD_REACH)
        centre = np.where(within, apart_row, 0) + SPREAD_REACH, np.where(within, apart_column, 0) + SPREAD_REACH
        share = np.where(within, self._shares[centre], 0.0)
        # Not by BLAS, whose rounding differs from row to row: a load that is held must be held to the last bit, since
        # the paper's model takes any fall of the pressure for a release.
        return felt, np.einsum("fk,km->fm", pressure_kpa, share)


@lru_cache(maxsize=16)
def shares(depth_pitches: float) -> FloatArray:
    """(9, 9) share of one cell's pressure that each cell around it feels, itself in the middle. Their sum is just
    below 1: force is conserved, and a little goes further out.
    """
    points, weights = np.polynomial.legendre.leggauss(SPREAD_POINTS)
    centres = np.arange(-SPREAD_REACH, SPREAD_REACH + 1)
    along = (centres[:, None] + points / 2).ravel()  # of all points, in pitches from the loaded cell
    x, y = along[:, None], along[None, :]
    stress = sum(
        sign_x * sign_y * _corner(x + sign_x / 2, y + sign_y / 2, depth_pitches)
        for sign_x in (1, -1)
        for sign_y in (1, -1)
    )
    count = len(centres)
    tiles = np.reshape(stress, (count, SPREAD_POINTS, count, SPREAD_POINTS))
    result: FloatArray = np.einsum("ipjq,p,q->ij", tiles, weights / 2, weights / 2)
    return result


def _corner(x: FloatArray, y: FloatArray, depth: float) -> FloatArray:
    """Vertical stress below the corner of a rectangle x by y under unit pressure; odd in x and in y."""
    distance = np.sqrt(x**2 + y**2 + depth**2)
    bend = x * y * depth / distance * (1 / (x**2 + depth**2) + 1 / (y**2 + depth**2))
    stress: FloatArray = (bend + np.arctan(x * y / (depth * distance))) / (2 * np.pi)
    return stress
