"""Model selection: the default estimator of a cell is the one with the best worst fold (minimax cross-validation).

The static curve is the baseline. Another estimator replaces it only if it passes two tests.

1. On the folds its errors are smaller than those of the curve by more than chance explains (paired t test).
2. Unless the recording has many presses: on simulated cells under random loads its errors are no larger than those of
   the curve by more than a tenth. Every kind of cell that explains the recording is simulated. The reason: a recording
   of a single press has folds that are all alike, and several kinds of cells explain it. An estimator trained on one
   kind may fail on another. Where all estimators fail alike under such loads, the folds decide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .._cell import Cell, EstimatorName
from ..materials import simulate
from ._fitted import Fit
from ._fold_errors import FoldErrors, rms_by_press, standard_errors_better
from ._folds import Strokes
from ._training import NormalisedRecording, disturbed

MODEL_EXACT = 0.005
"""held-out error of a model beyond noise, over the range of r, below which its inverse is trusted under any load"""
INVERSE_SLACK = 0.25
"""% of full scale by which such an inverse may be worse than a learned estimator on its worst fold"""
MODEL_NEARLY_EXACT, INVERSE_BETTER = 0.025, 0.7
"""an inverse is also trusted if the model's held-out error is below the first number, and the inverse's error is below
the second fraction of a learned estimator's error"""
LEAST_SLOPE = 0.25
"""least slope of a fast step over that at equilibrium. Below, small errors of such an inverse may add up; it must then
be no worse than a learned estimator on simulated cells, too"""
SURE_STANDARD_ERRORS = 1.28
"""standard errors by which an estimator must be better than the static curve: one-sided 90 % of a normal variable"""
NO_WORSE = 1.1
"""largest error of a learned estimator on simulated cells, over that of the static curve"""
MANY_PRESSES = 3.0
"""least number of full presses for which the folds of a recording may differ from each other"""
ALIKE = 0.25
"""coefficient of variation of the static curve's error from press to press; below, the presses are alike"""
EXPLAINS_TOO = 2.0
"""a kind explains the recording as well as the best if its error is at most this multiple of the least error"""
SIMULATED_CELLS, SIMULATED_STEP_S, SIMULATED_STEPS = 12, 0.25, 640
"""simulated cells of each kind, their time step in seconds, and number of steps"""


@dataclass(frozen=True)
class Evidence:
    """The data on which the choice is based."""

    judged: Mapping[EstimatorName, Sequence[FoldErrors]]
    """held-out errors of each estimator, fold by fold"""
    simulated_error: Mapping[EstimatorName, float]
    """error on simulated cells under random loads, normalised load, see :func:`errors_on_simulated_cells`"""
    presses: float
    """path of the recorded load, in presses to full scale"""
    strokes: Strokes
    """rises and falls of the recorded load"""
    unexplained: float
    """error of the model on its worst fold beyond noise, over the range of r"""
    least_slope: float
    """least slope of a fast step over that at equilibrium; the inverse amplifies errors by up to its reciprocal"""
    held_out: bool = True
    """whether the errors are held out. Without folds they are those on all of the recording, which was learned from"""

    @property
    def varied(self) -> bool:
        """Whether the recording has many presses that are not all alike, so that its folds represent other presses.

        The loads themselves may differ. If they do not, presses count as different if the static curve's errors differ.
        (The reverse does not hold: on a cell with little memory, errors may be equal under different loads.)
        """
        if self.presses < MANY_PRESSES or self.strokes.vary:
            return self.presses >= MANY_PRESSES
        errors = rms_by_press(self.judged["static"], self.strokes.press)
        return errors.size > 1 and float(np.std(errors)) > ALIKE * float(np.mean(errors))

    def percent(self, name: EstimatorName) -> list[float]:
        """Rms error on each fold, % of full scale."""
        return [100 * part.rms for part in self.judged[name]]

    def worst(self, name: EstimatorName) -> float:
        """Rms error on the worst fold, % of full scale; infinite for an estimator that the cell does not have."""
        return max(self.percent(name)) if name in self.judged else np.inf

    def expected_percent(self, name: EstimatorName) -> float:
        """Rms error to expect of other presses, % of full scale: that of the worst fold.

        Without folds it is the error on what was learned, or that on simulated cells if this is larger.
        """
        return self.worst(name) if self.held_out else max(self.worst(name), 100 * self.simulated_error.get(name, 0.0))

    def beats_static(self, name: EstimatorName) -> bool:
        """Whether an estimator passes both tests."""
        if standard_errors_better(self.judged[name], self.judged["static"]) < SURE_STANDARD_ERRORS:
            return False
        return self.presses >= MANY_PRESSES or self.simulated_ratio(name) < NO_WORSE

    def simulated_ratio(self, name: EstimatorName) -> float:
        """Error on simulated cells, over that of the static curve; 0 for an estimator without such a test."""
        return self.simulated_error.get(name, 0.0) / self.simulated_error["static"]


def choose(evidence: Evidence) -> tuple[EstimatorName, str]:
    """The default estimator and the reason; the paper's estimator is never chosen.

    Learned estimators are ranked by their worst fold. The exact inverse trusts the model completely. It comes first if
    the model explains everything but noise, since it then extrapolates to loads that were not recorded. If the model
    explains nearly everything, the inverse must be far better than the learned estimators. Else it is not chosen.
    """
    worst = {name: evidence.worst(name) for name in evidence.judged}
    learned: list[EstimatorName] = ["distilled", "play"]
    if worst["distilled"] > 1.1 * worst["play"]:
        learned.reverse()
    candidates, why = learned, ""
    inverse, rival = worst.get("inverse", np.inf), worst[learned[0]]
    exact = evidence.unexplained < MODEL_EXACT and inverse <= rival + INVERSE_SLACK
    best_learned = evidence.simulated_ratio(learned[0])
    stable = evidence.least_slope > LEAST_SLOPE or evidence.simulated_ratio("inverse") <= best_learned
    nearly = evidence.unexplained < MODEL_NEARLY_EXACT and stable
    if exact or (nearly and inverse < INVERSE_BETTER * rival):
        candidates = ["inverse", *learned]
    chosen = next((name for name in candidates if evidence.beats_static(name)), None)
    if chosen is None:
        chosen, why = "static", f"nothing beats the static curve surely enough ({_doubts(evidence, candidates[0])}); "
    elif chosen == "inverse" and exact:
        unexplained = 100 * evidence.unexplained
        why = f"the model explains the resistance but for {unexplained:.1f} % of its range and noise; "
    percent = evidence.percent(chosen)
    others = ", ".join(f"{name} {value:.1f} %" for name, value in worst.items() if name != chosen)
    where = f"on the worst of {len(percent)} folds, number {int(np.argmax(percent)) + 1}"
    if not evidence.held_out:
        where = "on what it was learned from, as no whole press is left to judge by"
    return chosen, f"{why}{max(percent):.1f} % of full scale {where} ({others})"


def _doubts(evidence: Evidence, name: EstimatorName) -> str:
    """The test that an estimator fails, in words."""
    better = standard_errors_better(evidence.judged[name], evidence.judged["static"])
    if better >= SURE_STANDARD_ERRORS:
        ratio = evidence.simulated_ratio(name)
        return (
            f"{name} has {ratio:.2f} of its error under simulated loads that were not recorded; below {NO_WORSE} needed"
        )
    side = "better" if better > 0 else "worse"
    return f"{name} is {side} by {abs(better):.1f} standard errors over the folds; {SURE_STANDARD_ERRORS} better needed"


def errors_on_simulated_cells(
    cell: Cell, fits: Sequence[Fit], names: Sequence[EstimatorName], calibration: NormalisedRecording
) -> dict[EstimatorName, float]:
    """Rms errors of estimators on simulated cells under random ramps and holds, over full scale.

    All kinds of cells are simulated that explain the recording about as well as the best one, since the recording
    cannot distinguish these kinds. The first estimator is the reference: its error is the largest over the kinds. The
    error of another estimator is that reference error times its largest ratio to the reference on the same kind.

    Args:
        cell: the calibrated cell.
        fits: fits of all kinds.
        names: estimators of the cell; the first is the reference.
        calibration: the recording, which determines the noise and the model error of the simulations.
    """
    load = simulate.random_loads(np.random.default_rng(0), SIMULATED_STEPS, SIMULATED_CELLS, SIMULATED_STEP_S)
    least = min(fit.error for fit in fits)
    kinds = [fit for fit in fits if fit.error <= EXPLAINS_TOO * least]
    rms = np.empty((len(kinds), len(names)))
    for row, fit in enumerate(kinds):
        rng = np.random.default_rng(1)
        r = fit.simulate(rng, load, SIMULATED_STEP_S) / cell.rest_resistance_ohm - 1
        r = disturbed(calibration, rng, load, r, SIMULATED_STEP_S)
        resistance = cell.rest_resistance_ohm * (1 + r)
        for column, name in enumerate(names):
            estimator = cell.estimator((SIMULATED_CELLS,), name)
            pressure = np.array([estimator.step(SIMULATED_STEP_S, frame) for frame in resistance])
            rms[row, column] = np.sqrt(np.mean((pressure / cell.full_scale_kpa - load) ** 2))
    rms = np.maximum(rms, 1e-9)
    reference = float(rms[:, 0].max())
    worst = (rms / rms[:, :1]).max(axis=0)
    return {name: reference * float(ratio) for name, ratio in zip(names, worst, strict=True)}
