"""Which fitted models teach the learned estimators: an ensemble of all kinds that a recording does not tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ._identify import Fit, Simulation
from ._models import AsymmetricModel, M10Model, PaperModel

TEACHES_WORSE = 0.7
"""share of the richer kind's error below which a simpler one teaches"""
FAR_BETTER = 0.5
"""share of a smooth kind's error below which the paper's two models teach"""
EXPLAINS_TOO = 2.0
"""times the least error of a fit, up to which another kind explains the recording as well"""
BREAKS = 0.5
"""share of the error of m10 without chains that break, below which a cell with such chains is believed to have them"""


@dataclass(frozen=True)
class Teacher:
    """What the learned estimators learn from beside the recording."""

    leading: Fit
    """the fit whose error says how far simulated cells are from the material"""
    simulate: Simulation
    """jittered cells of every kind that teaches"""
    simulate_folds: tuple[Simulation, ...]
    """the same as fitted before each fold"""


def find_teacher(fits: Sequence[Fit]) -> Teacher:
    """The leading fit, and with it every kind with one set of states that explains the recording about as well.

    Kinds that fit the same recording extrapolate differently to slower, longer or other presses. A map that learns from
    one of them believes its extrapolation. A map that learns from all trusts most what they agree upon.
    """
    leading = _leading(fits)
    also = [fit for fit in explaining(fits) if fit is not leading and not isinstance(fit.model, PaperModel)]
    together = [leading] if isinstance(leading.model, PaperModel) else [leading, *also]
    return Teacher(
        leading=leading,
        simulate=in_turns([fit.simulate for fit in together]),
        simulate_folds=tuple(map(in_turns, zip(*(fit.simulate_folds for fit in together), strict=True))),
    )


def explaining(fits: Sequence[Fit]) -> list[Fit]:
    """The fits that explain the recording about as well as the best one: the recording does not tell these apart."""
    least = min(fit.error for fit in fits)
    return [fit for fit in fits if fit.error <= EXPLAINS_TOO * least]


def in_turns(simulations: Sequence[Simulation]) -> Simulation:
    """Cells that take turns to be of each simulation."""
    count = len(simulations)

    def run(rng: np.random.Generator, load: FloatArray, dt_s: float) -> FloatArray:
        resistance = np.empty_like(load)
        for first, simulate in enumerate(simulations[: load.shape[1]]):
            resistance[:, first::count] = simulate(rng, load[:, first::count], dt_s)
        return resistance

    return simulations[0] if count == 1 else run


def chains_break(fits: Sequence[Fit]) -> bool:
    """Whether motion breaks conductive chains: without them, m10 leaves far more of the recording."""
    errors = {fit.label: fit.error for fit in fits}  # an m10 whose k is 0 has the label of the one without chains
    return errors.get("m10", np.inf) < BREAKS * errors.get("m10, k = 0", 0.0)


def _leading(fits: Sequence[Fit]) -> Fit:
    """The richest kind with one set of states, unless it explains clearly less.

    Which of two kinds predicts better is a close call on a short recording, and the poorer one, taught, misleads
    more than the richer one's spare parameters do. But what leaves much more of its worst fold unexplained than another
    kind does teaches its own mistakes. The paper's two models hand over at every change of direction, which a learned
    map of memories follows badly: it teaches only where it is far better.
    """
    smooth = next(fit for fit in fits if isinstance(fit.model, M10Model))
    plain = next(fit for fit in fits if isinstance(fit.model, AsymmetricModel))
    if plain.held_out_error < TEACHES_WORSE * smooth.held_out_error:
        smooth = plain
    best = min(fits, key=lambda fit: fit.held_out_error)
    return best if best.held_out_error < FAR_BETTER * smooth.held_out_error else smooth
