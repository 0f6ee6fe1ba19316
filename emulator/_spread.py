"""How a layer of silicone shares the pressure of a contact among the cells below it.

The layer is taken for the upper part of an elastic half-space: the vertical stress at its lower face is Boussinesq's,
integrated over the loaded cell in closed form (Newmark 1935), and averaged over each cell below. It depends on depth
over pitch alone, not on the modulus. Not modelled: a stiff base, slip, large deformation, and cuts in the layer.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.ndimage import convolve

from ..arrays import FloatArray

_REACH = 4  # cells on each side
_POINTS = 16  # Gauss-Legendre points along a cell's side


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


@lru_cache(maxsize=16)
def shares(depth_pitches: float) -> FloatArray:
    """(9, 9) share of one cell's pressure that each cell around it feels, itself in the middle. Their sum is just
    below 1: force is conserved, and a little goes further out.
    """
    points, weights = np.polynomial.legendre.leggauss(_POINTS)
    centres = np.arange(-_REACH, _REACH + 1)
    along = (centres[:, None] + points / 2).ravel()  # of all points, in pitches from the loaded cell
    x, y = along[:, None], along[None, :]
    stress = sum(
        sign_x * sign_y * _corner(x + sign_x / 2, y + sign_y / 2, depth_pitches)
        for sign_x in (1, -1)
        for sign_y in (1, -1)
    )
    count = len(centres)
    tiles = np.reshape(stress, (count, _POINTS, count, _POINTS))
    result: FloatArray = np.einsum("ipjq,p,q->ij", tiles, weights / 2, weights / 2)
    return result


def _corner(x: FloatArray, y: FloatArray, depth: float) -> FloatArray:
    """Vertical stress below the corner of a rectangle x by y under unit pressure; odd in x and in y."""
    distance = np.sqrt(x**2 + y**2 + depth**2)
    bend = x * y * depth / distance * (1 / (x**2 + depth**2) + 1 / (y**2 + depth**2))
    stress: FloatArray = (bend + np.arctan(x * y / (depth * distance))) / (2 * np.pi)
    return stress
