"""Regularised Gauss-Newton fit of a frame's cells, from the last frame's cells on, within the frame's budget."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray
from ._coupled_board import Compared, CoupledBoard, Frame, Known
from ._frame_budget import Budget
from ._linearised import Base, Linearised, Moved

NO_FIT = 3.0
"""half steps between readings and model beyond which a fit tells nothing yet"""
FITS = 0.8
"""half steps between readings and model by rounding alone"""
_CONVERGED = 0.2  # the same after converged steps
_SAME = 1e-3  # relative change of the misfit by a step without gain
_TOO_FAR = 1.0  # change of a logarithm beyond which derivatives do not tell what a misfit means for the cells
_SLOW = 0.2  # length of a step over the one before, above which the derivatives are to blame
_MOVED = 0.02  # change of a logarithm above which derivatives may be to blame: closer, new ones would be no better
_SETTLED = 0.3  # change of a cell by a further step that does not matter, in posterior standard deviations
_LEAST_CHANGE = 1e-6  # change of a logarithm that counts as none
_LOOSE = 0.1  # standard deviation above which the readings do not determine a cell: its position does not matter
_AT_REST = 0.3  # most change by a further step after a fresh start
_SHORTER = 0.4  # factor on a step that led away from the readings
_MOST_LEFT = 0.9  # share of a misfit left by a step, above which steps do not converge
_PATIENCE = 3  # frames that do not settle, after which steps that lead away from the readings are not taken
_MISFIT = 8.0  # half steps between readings and model beyond which no cells give these readings
_MOST_TRIED = 8  # frames in a row after which their starting cells are given up
_MOST_WITHOUT_FIT = 6  # frames in a row after which steps column by column are given up


class Fit(NamedTuple):
    """Cells fitted to the readings, and how good the fit is."""

    known: Known
    """the cells"""
    step: FloatArray
    """(n,) the next step, which was not taken"""
    misfit: float
    """half steps and noise between readings and model"""
    stalled: bool
    """whether the last step hardly changed the misfit"""
    proven: bool
    """whether, by derivatives from cells like these, no further step changes what matters"""
    lost: bool
    """whether the fit does not serve, and the derivatives are from too far away to give its uncertainty"""
    stale: float
    """possible length of the remaining steps over the next one, since the derivatives are from cells that were
    different"""
    steeper: FloatArray
    """(n,) present slopes over those at the base"""

    @property
    def none(self) -> bool:
        """Whether steps have come to an end, and no cells there give the readings."""
        return self.misfit > _MISFIT and self.stalled


@dataclass
class Convergence:
    """History of convergence over the frames."""

    fresh: bool = False
    """a frame has started from closed formulas, and no frame has reached a fit since"""
    failures: int = 0
    """frames in a row that ended with no cells giving the readings"""
    without_fit: int = 0
    """frames in a row that did not reach a fit"""
    astray_for: int = 0
    """frames in a row that did not settle"""
    tried_for: int = 0
    """frames in a row since the last start whose final cells do not give the readings"""
    starts: int = 0
    """number of starts given up since a frame last settled"""
    restarted: bool = False
    """the last frame has given up its start"""
    astray_before: int = 0
    """frames of :attr:`astray_for` up to that one"""

    @property
    def astray_since_start(self) -> int:
        """Frames in a row that did not settle, since the last frame that gave up its start."""
        return self.astray_for - self.astray_before

    @property
    def in_vain(self) -> bool:
        """Whether steps from the last start lead nowhere, and do not end."""
        return self.tried_for >= _MOST_TRIED

    def give_up_start(self) -> None:
        """Let the next frame start from elsewhere."""
        self.tried_for, self.restarted, self.astray_before = 0, True, self.astray_for + 1
        self.starts += 1

    @property
    def astray(self) -> bool:
        """Whether the last frame did not settle."""
        return self.astray_for > 0

    @property
    def stuck(self) -> bool:
        """Whether steps of the same kind lead to no fit."""
        return self.without_fit >= _MOST_WITHOUT_FIT

    def count(self, fit: Fit) -> None:
        """Count a frame with this fit."""
        self.restarted = False
        self.tried_for = 0 if fit.misfit <= _MISFIT else self.tried_for + 1
        self.without_fit = 0 if fit.misfit <= NO_FIT else self.without_fit + 1

    def settle(self, fit: Fit) -> None:
        """Decide whether the frame has settled.

        After a frame that did not settle, nothing is valid until derivatives from nearby confirm the cells.
        """
        doubted = self.astray or self.fresh
        astray = fit.misfit > NO_FIT or fit.lost or (doubted and not fit.proven)
        self.astray_for = self.astray_for + 1 if astray else 0
        if not astray:
            self.starts = self.astray_before = 0
        if fit.misfit <= NO_FIT:
            self.fresh, self.failures = False, 0


class GaussNewton:
    """Gauss-Newton steps for boards on which each reading depends on many cells.

    Unknowns are the logarithms x of the conductances, so that no conductance becomes negative. Residuals are in
    standard deviations of an ADC step's error: r = (measured - model) / (half step / sqrt 3). With J = dr/dx and the
    prior's standard deviation s, a step is (J'J + 1/s^2)^-1 J' r (Levenberg, Marquardt; the Bayesian update of a linear
    model with a broad prior about the last estimate). Components that the readings determine follow the readings; the
    others stay. The covariance (J'J + 1/s^2)^-1 tells the two apart.
    """

    def __init__(self, parts: CoupledBoard, linearised: Linearised, convergence: Convergence) -> None:
        """For a board, its linear model, and the convergence of earlier frames."""
        self._parts, self._linearised, self._convergence = parts, linearised, convergence
        self._tells = ~parts.gone
        self._damping = 1.0  # factor on steps
        # A base and a noise stay the same for many frames: both, and the results for them.
        self._least: tuple[Base | None, float, FloatArray, bool] = None, 0.0, np.empty(0), False

    def begin_anew(self) -> None:
        """Note that the next frame starts from closed formulas."""
        self._damping, self._convergence.fresh = 1.0, True

    def settle(self, fit: Fit) -> None:
        """Decide whether the frame has settled; if so, the next steps are full ones again."""
        self._convergence.settle(fit)
        if not self._convergence.astray:
            self._damping = 1.0

    def fit(self, frame: Frame, start: Compared, budget: Budget) -> Fit:
        """Fit the cells to a frame, starting from ``start``, as far as the frame's budget goes."""
        budget.spend(self._linearised.step_price)
        here = _Place(self._linearised.base, frame, start)
        # Over strong nonlinearities full steps are usually quick, but may overshoot, return, and so on for ever.
        damped = self._convergence.astray_since_start >= _PATIENCE
        stalled = False
        while True:
            log = here.base.advanced(here.known.log, self._damping * here.step)
            if not budget.evaluate(self._parts.price(log) + self._linearised.step_price):
                break
            ahead = frame.compared(self._parts.at(log))
            misfit, apart = ahead.half_steps / frame.coarser, ahead.apart
            stalled = abs(misfit - here.misfit) <= _SAME * misfit
            if damped and misfit > FITS and not stalled and apart @ apart > here.apart @ here.apart:
                self._step_back(here, budget)
                continue
            self._damping = min(self._damping / _SHORTER, 1.0)
            before = here.step
            left = misfit / here.misfit if misfit < here.misfit else 0.0
            here.go(ahead)
            here.serves = self._serves(here)
            base = here.base
            waits = self._renew_if_due(here, before, stalled, budget)
            here.left = left if here.base is base else 0.0
            if waits or (here.serves and (misfit <= _CONVERGED or here.confirmed or not self._doubted)):
                break
        return here.fit(stalled)

    @property
    def _doubted(self) -> bool:
        """Whether steps go on to their end, see :attr:`Fit.proven`."""
        return self._convergence.astray or self._convergence.fresh

    def _step_back(self, here: _Place, budget: Budget) -> None:
        """After a step from ``here`` that led away from the readings: make new derivatives, or shorten the step."""
        here.measure()
        blamed = not here.is_near and not self._linearised.under_way
        renewal = self._linearised.renewal(here.known) if blamed else None
        if renewal is not None and budget.renew(renewal.price) and self._linearised.renew(renewal):
            here.rebase(self._linearised.base)
        else:
            self._damping *= _SHORTER

    def _renew_if_due(self, here: _Place, before: FloatArray, stalled: bool, budget: Budget) -> bool:
        """Make new derivatives if those in use are from too far away, or to blame for slow convergence.

        Args:
            here: the cells, and the next step.
            before: (n,) the last step.
            stalled: whether the last step hardly changed the misfit.
            budget: of the frame.

        Returns:
            Whether the next step waits for derivatives of the next frame. After a fresh start, steps by old derivatives
            may lead away to where no later frame comes back.

        """
        moved, linearised = here.moved, self._linearised
        blamed = not (here.serves or here.is_near) and np.abs(here.step).max() > _SLOW * np.abs(before).max()
        if self._convergence.fresh and stalled and here.misfit > NO_FIT:
            linearised.give_up_columns()
        # In noise and beside open cells, which never come to rest, derivatives from nearby decide.
        undecided = here.serves and self._doubted and here.misfit > _CONVERGED and not here.is_near and here.determines
        due = linearised.upgrade_due or moved.far or blamed or undecided
        if not (due or here.base.coarse or linearised.under_way):
            return False
        if here.serves and not self._convergence.astray:
            budget.keep_instalments(1)  # no need to hurry
        while budget.renew((renewal := linearised.renewal(here.known)).price):
            if linearised.renew(renewal):
                here.rebase(linearised.base)
                here.serves = self._serves(here)
                return False
        return self._convergence.fresh and not linearised.under_way

    def _serves(self, here: _Place) -> bool:
        """Whether a further step would move no cell that the readings determine by more than its own uncertainty.

        After a fresh start the other cells must come to rest as well, since their currents shift all readings.
        """
        if here.misfit > FITS:
            return False
        length = np.abs(here.step)
        if self._convergence.fresh and length.max(where=self._tells, initial=0.0) > _AT_REST:
            return False
        least, here.determines = self._least_change(here)
        return bool(np.count_nonzero(length <= least) == len(length))

    def _least_change(self, here: _Place) -> tuple[FloatArray, bool]:
        """Change (n,) of each logarithm that does not matter, and whether the readings determine any cell.

        The change is inf for cells that they do not determine.
        """
        base, scale = here.base, here.frame.coarser
        if self._least[:2] != (base, scale):
            std = scale * base.std
            determined = (std <= _LOOSE) & (base.others <= _LOOSE)
            least = np.where(determined, np.maximum(_SETTLED * std, _LEAST_CHANGE), inf)
            self._least = base, scale, least, bool(determined.any())
        return self._least[2:]


class _Place:
    """The present cells of a frame's steps."""

    def __init__(self, base: Base, frame: Frame, start: Compared) -> None:
        self.frame, self.base = frame, base
        self.known, self.apart = start.known, start.apart
        self.misfit = start.half_steps / frame.coarser
        """in half steps and noise"""
        self._steeper = base.steeper(frame.slope)
        self.step = base.change(self.apart, self._steeper)
        """(n,) the next step"""
        self.serves = False
        """whether no further step is needed"""
        self.determines = False
        """whether the readings determine some cell; otherwise :attr:`serves` is vacuous"""
        self.left = 0.0
        """share of the misfit left by the last step; further steps by these derivatives shrink by the same factor"""
        self.moved = Moved(inf, inf)
        """distance from the cells at which the derivatives were made"""

    @property
    def is_near(self) -> bool:
        """Whether derivatives made here would be no better."""
        return self.moved.counted <= _MOVED

    @property
    def confirmed(self) -> bool:
        """Whether derivatives made here show that no further step moves what the readings determine."""
        return self.serves and self.determines and self.is_near

    def go(self, ahead: Compared) -> None:
        """Take a step."""
        self.known, self.apart = ahead.known, ahead.apart
        self.misfit = ahead.half_steps / self.frame.coarser
        self.step = self.base.change(ahead.apart, self._steeper)
        self.measure()

    def measure(self) -> None:
        """Compare the cells with those of the derivatives."""
        self.moved = self.base.moved(self.known.log, self.frame.coarser)

    def rebase(self, base: Base) -> None:
        """Continue with other derivatives."""
        self.base = base
        self._steeper = base.steeper(self.frame.slope)
        self.step = base.change(self.apart, self._steeper)
        self.measure()

    def fit(self, stalled: bool) -> Fit:
        """The cells as the frame's fit."""
        moved = self.moved
        settled = self.serves and self.misfit <= _CONVERGED and not moved.far
        return Fit(
            self.known,
            self.step,
            self.misfit,
            stalled,
            proven=settled or self.confirmed or (stalled and self.is_near),
            lost=not self.serves and moved.counted > _TOO_FAR,
            stale=max(exp(moved.largest), 1.0 / (1.0 - min(self.left, _MOST_LEFT))),
            steeper=self._steeper,
        )
