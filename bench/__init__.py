"""Measurements: speed against error of solvers, boards and estimators, beside peers on the same work in one run.

``ohmskin bench`` prints them. What a measurement has to say are the columns of its dataclass (:mod:`.harness`).

Estimators: :mod:`.scenarios` plays the scenes of ``scenarios.toml`` (:mod:`.scenes`) and compares any estimator with
gates, and with the figures that were frozen; also after calibrations on :mod:`.recordings` of other materials.

Solvers: :mod:`._measurement` beside :mod:`._peers`.

The live path: :mod:`._driver` (over a :mod:`._paced_port`) and :mod:`._worst_frames`; contacts of fingers and taps, and
false ones of drift and electrical faults (:mod:`.contacts`).

Searches for faults, each a program: ``python -m ohmskin.bench.search`` holds readings against exact rational arithmetic
(:mod:`._reference`), with ``--live`` streams against the cells behind them (:mod:`._live_search`);
``python -m ohmskin.bench.soak`` is an endurance test of emulator, driver, recorder and page;
``python -m ohmskin.bench.boards`` counts the valid cells of boards that people build, beside how well one frame can
tell them at all.
"""

from ._driver import freshness, live_estimators
from ._measurement import board, cells, measure, picture

__all__ = [
    "board",
    "cells",
    "freshness",
    "live_estimators",
    "measure",
    "picture",
]
