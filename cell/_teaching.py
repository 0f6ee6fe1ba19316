"""Which fitted model teaches the learned estimators: it is simulated under loads that the recording does not have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ._fitted import Fit
from ._models import AsymmetricModel, M10Model

TEACHES_WORSE = 0.7
"""share of the richer kind's error below which a simpler one teaches"""
FAR_BETTER = 0.5
"""share of a smooth kind's error below which the paper's two models teach"""
EXPLAINS_TOO = 2.0
"""times the least error of a fit, up to which another kind explains the recording as well"""
BREAKS = 0.5
"""share of the error of m10 without chains that break, below which a cell with such chains is believed to have them"""


def find_teacher(fits: Sequence[Fit]) -> Fit:
    """The fit that is varied for learning: the richest with one set of states, unless it explains clearly less.

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


def explaining(fits: Sequence[Fit]) -> list[Fit]:
    """The fits that explain the recording about as well as the best one: the recording does not tell these apart."""
    least = min(fit.error for fit in fits)
    return [fit for fit in fits if fit.error <= EXPLAINS_TOO * least]


def chains_break(fits: Sequence[Fit]) -> bool:
    """Whether motion breaks conductive chains: without them, m10 leaves far more of the recording."""
    errors = {fit.label: fit.error for fit in fits}  # an m10 whose k is 0 has the label of the one without chains
    return errors.get("m10", np.inf) < BREAKS * errors.get("m10, k = 0", 0.0)
