"""Speed against error: the solvers of :mod:`ohmskin.circuits` and, where installed, their peers on the same arrays.

``measure(sizes=[8, 64], segments=[1.0])`` measures everything, row by row; :func:`table` and :func:`picture` show it.

:func:`live_estimators` and :func:`freshness` measure the live path of the driver, from bytes to kPa.

Solvers: :mod:`._measurement` beside :mod:`._peers`, with :mod:`._memory` in a process of its own; :mod:`._show` prints.

Estimators: :mod:`._estimators` on a material of nobody's (:mod:`._independent`); :mod:`._honesty` of their standard
deviations; :mod:`._hard_cases`, taps and sparks. ``python -m ohmskin.bench.panel`` judges calibrations on the specimens
of :mod:`._materials`.

The live path: :mod:`._driver`, the age of frames (:mod:`._freshness`, over a :mod:`._paced_port`) and
:mod:`._worst_frames`; contacts of short taps, and false ones of electrical faults (:mod:`._taps`);
contacts of fingers that move, hold or cross a dead row, and false ones of drift (:mod:`._fingers`).
The emulator: :mod:`._emulator`. The page: :mod:`._view`.

Searches for faults, each a program: ``python -m ohmskin.bench.hunt`` holds readings against exact rational arithmetic
(:mod:`._reference`), with ``--live`` streams against the cells behind them (:mod:`._live_hunt`);
``python -m ohmskin.bench.boards`` counts the valid cells of boards that people build, and ``python -m
ohmskin.bench.knowable`` states how well one frame can tell them at all.
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
