"""Result of identification: a model of one kind, its parameters with standard errors, and its prediction errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...common.arrays import FloatArray
from ..materials import Model

Simulation = Callable[[np.random.Generator, FloatArray, float], FloatArray]
"""(rng, load, dt_s) to resistance (n, m) in ohm: cells like the identified one, with random deviations of the
parameters, under loads (n, m)"""


@dataclass(frozen=True)
class Parameter:
    """One identified parameter."""

    name: str
    value: float
    std_error: float
    identified: bool
    """False if the recording does not determine the parameter: a time constant longer than half of the recording, a
    standard error above half the value, or R0 of a cell that the recording never shows at rest"""


@dataclass(frozen=True)
class Fit:
    """One kind of model fitted to a recording."""

    model: Model
    rest_resistance_ohm: float
    parameters: tuple[Parameter, ...]
    error: float
    """rms residual of the resistance over its range, on the fitted data"""
    fold_errors: tuple[float, ...] = ()
    """rms prediction error over the same range on each fold, after fitting the part before the fold"""
    simulate: Simulation | None = None
    """simulates cells like the identified one; None: a contact, from which nothing is learned by simulation"""
    simulate_folds: tuple[Simulation, ...] = ()
    """the same for the fit before each fold"""
    before_folds: tuple[tuple[Model, float] | None, ...] = ()
    """model and R0 in ohm as fitted before each fold; None: the parameters make no valid cell"""
    penalty: float = 1.0
    """factor on :attr:`error` by which an information criterion (BIC) counts the parameters"""

    @property
    def judged_error(self) -> float:
        """By which kinds are compared: the rms held-out error, or without folds the error on the fit, penalised."""
        if not self.fold_errors:
            return self.error * self.penalty
        return float(np.sqrt(np.mean(np.square(self.fold_errors))))


@dataclass(frozen=True)
class Drift:
    """A linear drift of R0 over a recording, fitted together with all parameters of a model."""

    share: float
    """change of R0 over the recording, over the initial R0"""
    std_error: float
    unexplained: float
    """mean squared error beyond noise of the model with drift, over that of the model without; 1 if the latter is
    hardly more than 0"""
