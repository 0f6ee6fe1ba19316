"""Speed against error: the solvers of :mod:`ohmskin.circuits` and, where installed, their peers on the same arrays.

``measure(sizes=[8, 64], segments=[1.0])`` measures everything, row by row; :func:`table` and :func:`picture` show it.

:func:`live_estimators` and :func:`freshness` measure the live path of the driver, from bytes to kPa.
"""

from ._driver import live_estimators, live_picture
from ._estimators import INDEPENDENT, NOISE, estimators, noisy
from ._freshness import Freshness, freshness
from ._measurement import Row, board, cells, measure
from ._show import picture, table

__all__ = [
    "INDEPENDENT",
    "NOISE",
    "Freshness",
    "Row",
    "board",
    "cells",
    "estimators",
    "freshness",
    "live_estimators",
    "live_picture",
    "measure",
    "noisy",
    "picture",
    "table",
]
