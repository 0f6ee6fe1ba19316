"""What identification finds: a model of one kind, its parameters with standard errors, and how well it predicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...arrays import FloatArray
from ..materials import M10Model, Model

Simulation = Callable[[np.random.Generator, FloatArray, float], FloatArray]
"""Cells like the identified one, jittered, under loads (n, m) at a time step: resistance (n, m) in ohm"""


@dataclass(frozen=True)
class Parameter:
    """One identified number."""

    name: str
    value: float
    std_error: float
    identified: bool
    """False where the recording does not say: a time constant beyond half of it, an error above half the value, or R0
    of a cell that it never shows at rest"""


@dataclass(frozen=True)
class Fit:
    """One kind of model fitted to a recording."""

    model: Model
    rest_resistance_ohm: float
    parameters: tuple[Parameter, ...]
    error: float
    """rms of the resistance it leaves, over the range of the resistance, on what was fitted"""
    fold_errors: tuple[float, ...]
    """the same on each fold, fitted on what comes before it"""
    simulate: Simulation
    """jittered cells like it"""
    simulate_folds: tuple[Simulation, ...]
    """the same as fitted before each fold"""
    before_folds: tuple[tuple[Model, float] | None, ...] = ()
    """model and R0 in ohm as fitted before each fold; None: what was found is no valid cell"""
    first_telling: int = 0
    """the first fold before which enough was pressed to fit a model at all"""
    drift: Drift | None = None
    """of R0, by the richest model; None: of the other kinds"""

    @property
    def label(self) -> str:
        """The kind, and whether its chains never break: m10 is fitted with and without such chains."""
        unbroken = isinstance(self.model, M10Model) and self.model.k == 0
        return "m10, k = 0" if unbroken else self.model.kind

    @property
    def held_out_error(self) -> float:
        """That of the worst of the folds that tell."""
        return max(self.fold_errors[self.first_telling :])


@dataclass(frozen=True)
class Drift:
    """A steady change of R0 from the begin of a recording to its end, fitted with all the rest of a model."""

    share: float
    """of R0 at the begin"""
    std_error: float
    unexplained: float
    """squared error beyond noise that the model with the drift leaves, over that of the model without; 1 where the
    latter leaves hardly more than noise"""
