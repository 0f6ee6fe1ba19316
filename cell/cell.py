"""CELL.toml: one identified cell, and the doors to its forward model and its estimators."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..config import Section, load
from .estimators import Estimator, make_estimator
from .forward import Forward, make_forward
from .lag import FloatArray
from .models import Model, Positive


class Cell(Section):
    """A piezoresistive cell. ``Cell.load("cell.toml")``, or ``Cell.example()`` for the shipped one."""

    rest_resistance_ohm: Positive
    """R0, unloaded; a skin whose cells differ passes an array to :meth:`forward` and :meth:`estimator`"""
    full_scale_kpa: Positive
    """the largest pressure the cell is meant for, and the unit of the normalised load"""
    model: Model

    @classmethod
    def load(cls, path: str | Path) -> Cell:
        """Read CELL.toml; InputError with one located message if it is not a valid cell."""
        return load(path, cls)

    @classmethod
    def example(cls) -> Cell:
        """The shipped example: the paper's model with the project's own values, which meet P7."""
        with importlib.resources.as_file(importlib.resources.files(__package__) / "example.toml") as path:
            return cls.load(path)

    def forward(self, shape: tuple[int, ...], *, rest_resistance_ohm: ArrayLike | None = None) -> Forward:
        """Cells of ``shape`` at rest, to be stepped through a pressure history.

        ``rest_resistance_ohm`` (broadcast to ``shape``) replaces R0, cell by cell; InputError unless it
        fits.
        """
        return make_forward(self.model, self.full_scale_kpa, shape, self._rest(rest_resistance_ohm))

    def estimator(
        self, shape: tuple[int, ...], name: str | None = None, *, rest_resistance_ohm: ArrayLike | None = None
    ) -> Estimator:
        """A causal estimator for cells of ``shape``; ``name`` is one of ``ESTIMATORS``, None the default.

        Raises:
            InputError: no such estimator, or not one for this kind of cell; R0 does not fit ``shape``.
        """
        return make_estimator(name, self.model, self.full_scale_kpa, shape, self._rest(rest_resistance_ohm))

    def _rest(self, given: ArrayLike | None) -> FloatArray:
        return np.asarray(self.rest_resistance_ohm if given is None else given, dtype=np.float64)
