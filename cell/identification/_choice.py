"""Choice of a cell's default estimator: best worst fold, with the static curve as the floor that has to be beaten.

An estimator replaces the static curve if two tests say so.

1. A paired comparison on the held-out folds: its errors are smaller by more than chance explains.
2. Presses that nobody applied, unless the recording has many presses: on simulated cells of every kind that explains
   the recording, under random loads, its errors are no larger by more than a tenth. A recording of a single press has
   folds that are all alike, and several kinds of cells explain it; what one of them taught may fail on another. Where
   all estimators fail alike under such loads, the folds decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .._cell import Cell, EstimatorName
from ..materials import simulate
from ._fitted import Fit
from ._folds import Strokes
from ._judged import Judged, rms_by_press, standard_errors_better
from ._training import NormalisedRecording, disturbed

EXACT = 0.005
"""held-out error of a model beyond noise, over the range of r, below which its inverse is trusted with any load"""
INVERSE_SLACK = 0.25
"""% of full scale by which such an inverse may be worse than a learned estimator on its worst fold"""
NEARLY, INVERSE_BETTER = 0.025, 0.7
"""held-out error below which an inverse is trusted that has less than this share of a learned estimator's error"""
STIFF = 0.25
"""least slope of a fast step over that at equilibrium, below which the small errors of such an inverse may add up: it
must then err no more than a learned estimator on simulated cells, too"""
SURE = 1.28
"""standard errors by which an estimator must be better than the static curve: one-sided 90 % of a normal variable"""
NO_WORSE = 1.1
"""times the static curve's error on simulated cells that a learned estimator must stay below"""
MANY_PRESSES = 3.0
"""full presses from which the folds of a recording are taken to differ from each other"""
ALIKE = 0.25
"""scatter of the static curve's error from one press to the next, over its mean, of presses that are alike"""
EXPLAINS_TOO = 2.0
"""times the least error of a fit, up to which another kind explains the recording as well"""
ELSEWHERE_CELLS, ELSEWHERE_STEP_S, ELSEWHERE_STEPS = 12, 0.25, 640
"""of the simulated cells: how many of each kind, time step, and steps"""


@dataclass(frozen=True)
class Evidence:
    """What the choice rests on."""

    judged: Mapping[EstimatorName, Sequence[Judged]]
    """of each estimator, one fold after the other"""
    elsewhere: Mapping[EstimatorName, float]
    """rms error on simulated cells under random loads, of the kind of cell where that is largest, normalised load"""
    presses: float
    """to full scale, that the path of the recorded load amounts to"""
    strokes: Strokes
    """of that load"""
    unexplained: float
    """error of the model on its worst fold beyond noise, over the range of r"""
    least_slope: float
    """of a fast step over that at equilibrium; the inverse amplifies errors by up to 1 over it"""

    @property
    def varied(self) -> bool:
        """Whether the recording has many presses, which are not all alike: then its folds speak for other presses.

        The loads may say so themselves. Otherwise presses differ where the static curve's errors do. These errors may
        also be the same under loads that differ, as on a cell with little memory.
        """
        if self.presses < MANY_PRESSES or self.strokes.vary:
            return self.presses >= MANY_PRESSES
        errors = rms_by_press(self.judged["static"], self.strokes.press)
        return errors.size > 1 and float(np.std(errors)) > ALIKE * float(np.mean(errors))

    def percent(self, name: EstimatorName) -> list[float]:
        """Rms error on each fold, % of full scale."""
        return [100 * part.rms for part in self.judged[name]]

    def worst(self, name: EstimatorName) -> float:
        """That on the worst fold; infinite for an estimator that the cell does not have."""
        return max(self.percent(name)) if name in self.judged else np.inf

    def beats_static(self, name: EstimatorName) -> bool:
        """Whether an estimator passes both tests."""
        if standard_errors_better(self.judged[name], self.judged["static"]) < SURE:
            return False
        return self.presses >= MANY_PRESSES or self.elsewhere_ratio(name) < NO_WORSE

    def elsewhere_ratio(self, name: EstimatorName) -> float:
        """Error on simulated cells, over that of the static curve; 0 for an estimator that was not tried on them."""
        return self.elsewhere.get(name, 0.0) / self.elsewhere["static"]


def choose(evidence: Evidence) -> tuple[EstimatorName, str]:
    """The default estimator and why; the paper's is never chosen.

    A learned estimator is chosen by its worst fold. The exact inverse follows the model wherever that leads. It comes
    first where the model explains all there is, since it carries over to loads that nobody applied. It has to be far
    better where the model explains nearly all, and is not chosen where the model leaves more.
    """
    worst = {name: evidence.worst(name) for name in evidence.judged}
    learned: list[EstimatorName] = ["distilled", "play"]
    if worst["distilled"] > 1.1 * worst["play"]:
        learned.reverse()
    candidates, why = learned, ""
    inverse, rival = worst.get("inverse", np.inf), worst[learned[0]]
    exact = evidence.unexplained < EXACT and inverse <= rival + INVERSE_SLACK
    tame = evidence.least_slope > STIFF or evidence.elsewhere_ratio("inverse") <= evidence.elsewhere_ratio(learned[0])
    stiff = evidence.unexplained < NEARLY and tame
    if exact or (stiff and inverse < INVERSE_BETTER * rival):
        candidates = ["inverse", *learned]
    chosen = next((name for name in candidates if evidence.beats_static(name)), None)
    if chosen is None:
        chosen, why = "static", f"nothing beats the static curve surely enough ({_doubts(evidence, candidates[0])}); "
    elif chosen == "inverse" and exact:
        unexplained = 100 * evidence.unexplained
        why = f"the model explains the resistance but for {unexplained:.1f} % of its range and noise; "
    percent = evidence.percent(chosen)
    fold = int(np.argmax(percent)) + 1
    others = ", ".join(f"{name} {value:.1f} %" for name, value in worst.items() if name != chosen)
    return chosen, (
        f"{why}{max(percent):.1f} % of full scale on the worst of {len(percent)} folds, number {fold} ({others})"
    )


def _doubts(evidence: Evidence, name: EstimatorName) -> str:
    """What speaks against an estimator."""
    better = standard_errors_better(evidence.judged[name], evidence.judged["static"])
    if better >= SURE:
        ratio = evidence.elsewhere_ratio(name)
        return (
            f"{name} has {ratio:.2f} of its error under simulated loads that were not recorded; below {NO_WORSE} needed"
        )
    side = "better" if better > 0 else "worse"
    return f"{name} is {side} by {abs(better):.1f} standard errors over the folds; {SURE} better needed"


def errors_elsewhere(
    cell: Cell, fits: Sequence[Fit], names: Sequence[EstimatorName], calibration: NormalisedRecording
) -> dict[EstimatorName, float]:
    """Rms errors of estimators on simulated cells under random ramps and holds, in shares of full scale.

    Cells of every kind are simulated that explains the recording about as well as the best one, since the recording
    does not tell these kinds apart. An estimator's error is given as that of the first one on the kind where this errs
    most, times the worst ratio to the first one's error on the same kind.

    Args:
        cell: calibrated.
        fits: of all kinds.
        names: of estimators that the cell has; the first is what the others are compared with.
        calibration: the recording, which says how large the noise is and what models leave unexplained.
    """
    load = simulate.random_loads(np.random.default_rng(0), ELSEWHERE_STEPS, ELSEWHERE_CELLS, ELSEWHERE_STEP_S)
    least = min(fit.error for fit in fits)
    kinds = [fit for fit in fits if fit.error <= EXPLAINS_TOO * least]
    rms = np.empty((len(kinds), len(names)))
    for row, fit in enumerate(kinds):
        rng = np.random.default_rng(1)
        r = fit.simulate(rng, load, ELSEWHERE_STEP_S) / cell.rest_resistance_ohm - 1
        r = disturbed(calibration, rng, load, r, ELSEWHERE_STEP_S)
        resistance = cell.rest_resistance_ohm * (1 + r)
        for column, name in enumerate(names):
            estimator = cell.estimator((ELSEWHERE_CELLS,), name)
            estimator.compile()
            pressure = np.array([estimator.step(ELSEWHERE_STEP_S, frame) for frame in resistance])
            rms[row, column] = np.sqrt(np.mean((pressure / cell.full_scale_kpa - load) ** 2))
    rms = np.maximum(rms, 1e-9)
    reference = float(rms[:, 0].max())
    worst = (rms / rms[:, :1]).max(axis=0)
    return {name: reference * float(ratio) for name, ratio in zip(names, worst, strict=True)}
