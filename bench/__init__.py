"""Speed against error: the solvers of :mod:`ohmskin.circuits` and, where installed, their peers on the same arrays.

``measure(sizes=[8, 64], segments=[1.0])`` measures everything, row by row; :func:`table` and :func:`picture` show it.
"""

from ._estimators import INDEPENDENT, NOISE, estimators, noisy
from ._measurement import Row, board, cells, measure
from ._show import picture, table

__all__ = ["INDEPENDENT", "NOISE", "Row", "board", "cells", "estimators", "measure", "noisy", "picture", "table"]
