"""Exact step-by-step inverse of a cell model with asymmetric relaxation branches: no switch of models, no thresholds.

If the resistance at the end of a step rises with the load there, for every step (:func:`margin` positive), each reading
has exactly one load, and the inverse is as exact as the model. The margin is not positive for cells whose resistance
rises while they are unloaded, as real carbon-black silicone may; this inverse then refuses the model.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Loop
from ...errors import InputError
from ..estimation import (
    DOUBT,
    GAIN,
    LOADS,
    PRESSURE,
    USUAL,
    VARIANCE,
    WINDOW,
    Inversion,
    RecentReadings,
    credible_readings,
)
from ..materials import AsymmetricModel, ByStep, M10Model, as_m10, lag
from . import _chains as chains
from . import _inverse_loops as loops
from ._change_over import ACCURACY, EVALUATIONS, ChangeOver

LOAD, BRANCHES, BROKEN, ANCHOR, MOVED, BEFORE, ERRORS, MISSED, WENT_UP, FURTHEST, LATELY = (
    3,
    slice(4, 6),
    6,
    7,
    8,
    9,
    slice(10, 13),
    13,
    14,
    15,
    16,
)
"""rows of the memory, before those of :mod:`._chains`: the load; r of the branches and of the broken chains; the
anchor, which is the load behind a play (backlash) as wide as the noise; the last two steps of the load; variances in r
of the remembered branches and broken chains; r of chains that may have broken unseen; 1 if the load last left its play
upwards, else 0; the load up to which chains have broken since; and how far the load has gone of late"""
BETWEEN, AROUND, TO_AND_FRO = 0.58, 0.5, 0.6
"""error by the motion of the load between two frames. BETWEEN times the bend of the load (its second difference between
frames) times ramp (1 - ramp) is the standard deviation of a lag, since the load may go straight or by a step. AROUND
times the way of the load in the frame after a turn is the standard deviation of its way to and fro between two frames;
TO_AND_FRO times it is the expected way, which adds up, since all turns err to the same side. Taken from vibrations and
slips, whose drops are faster than a frame"""
STILL_SIGMAS = 3.0
"""half width of the play of the anchor, in standard deviations by noise; motion within it breaks no chains"""
HELD_STEPS, MOVING_STEPS = 3.3, 1.85
"""half width of the play in standard deviations by ADC steps, for a held load and for one that moves. A reading is off
by half a step at most, which is hardly less than the latter. Where readings of a held load flip between two codes, the
smoothing overshoots, and the branches relax until the readings flip back. A load that moves may go back by little more
than a step, as beside the place where a rubbing finger turns"""
MOVES, LATELY_S = 1.5, 0.12
"""a load moves if its recent way is more than MOVES times the half width of a held load's play by ADC steps; LATELY_S
is the time constant in seconds with which the recent way fades"""
AT_A_TURN = 4.0
"""standard deviation, in standard deviations by ADC steps, of the way to a turn and back that the steps hide. Two of
them are those of a single turn. Repeated loads turn at the same readings, so that their errors are alike"""
OVERSHOOT, TURNS_KNOWN = 0.5, 0.4
"""of the half width of the play by noise: how far noise takes the furthest load of a press beyond the turn; and the
standard deviation of that. The longer a load stays near its turn, the more readings reach beyond: the errors of the
turns of a tremor are alike"""


def margin(model: AsymmetricModel | M10Model, full_scale_kpa: float) -> float:
    """Least slope dr/ds of a fast step, over the slope at equilibrium; positive where the inverse is unique.

    The least slope is a + 2 b s - k: a fast unloading step leaves the branches unchanged and breaks chains.
    """
    m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
    settled = max(m.a + m.b + m.alpha1 + m.alpha2, 1e-9)
    return (m.a + min(0.0, 2 * m.b) - m.k) / settled


class _Equation(NamedTuple):
    """The quadratic equation for the step x of n loads, as long as no branch changes over.

    (slope + the sum of ``follows``) x + b x^2 = change.
    """

    target: FloatArray
    """(2, n) target alpha s of each branch at the start"""
    lead: FloatArray
    """(2, n) target less branch at the start"""
    free: FloatArray
    """(n,) r of the chains that were broken before and have not healed"""
    breaking: FloatArray | float
    """(n,) r of the chains that a unit of motion of the load breaks"""
    forgets: FloatArray
    """(2, n) share of the lead that the branch gains in the step"""
    kept: FloatArray
    """(2, n) branches at the end if the load stays"""
    follows: FloatArray
    """(2, n) change of that per unit step of the load"""
    slope: FloatArray
    """(n,) dr/ds of the static response and the breaking chains"""
    change: FloatArray
    """(n,) change of r that the step must explain"""
    width: FloatArray
    """(n,) half width of the play within which a load counts as still"""
    went_up: BoolArray
    """(n,) whether the load last left its play upwards"""
    turned_r: FloatArray | float
    """(n,) standard deviation of r by chains that ADC steps hide where the load has just turned; else 0"""
    missed: FloatArray | float
    """(n,) r of chains that noise hides there; this error is alike from turn to turn"""


class AsymmetricInversion(Inversion):
    """Solves each step of :class:`~.forward.M10Forward` for its load.

    As long as no branch changes between charging and discharging within the step, the load is the root of a quadratic
    equation. A branch that does change over is a convex function of the load if it rises faster than it falls,
    otherwise a concave one (see :class:`.ChangeOver`). Newton's method, begun at the root without change-over, then
    converges monotonically from one side. Where b or branches of opposite curvature prevent this, a bisection step is
    taken instead.
    """

    rows = (
        *("pressure", "gain", "variance", "load", "branch1", "branch2", "broken", "anchor", "moved", "moved_before"),
        *("error1", "error2", "broken_error", "missed", "went_up", "furthest", "lately"),
        *chains.NAMES,
    )

    def __init__(
        self,
        model: AsymmetricModel | M10Model,
        full_scale_kpa: float,
        *,
        exact: bool,
    ) -> None:
        found = margin(model, full_scale_kpa)
        if not found > 0:
            raise InputError(
                "the exact inverse of this cell has more than one answer: the resistance also rises while unloading "
                f"(a + 2 b s - k falls to {found:.2g} of the slope at equilibrium); use another estimator"
            )
        self.model = m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
        self._alpha, self._held_slope = np.array([[m.alpha1], [m.alpha2]]), m.a + m.alpha1 + m.alpha2
        self._rise_s, self._fall_s = np.array([[m.rise1_s], [m.rise2_s]]), np.array([[m.fall1_s], [m.fall2_s]])
        steepest = m.a + 2 * max(m.b, 0.0) * LOADS[1] + m.alpha1 + m.alpha2 + m.k
        credible = credible_readings(steepest)
        self._constants_s = np.concatenate([self._rise_s, self._fall_s, [[m.tau_s], [LATELY_S]]])
        full_r = m.a + m.b + m.alpha1 + m.alpha2
        # With b < 0 the inverse grows ever steeper towards the load at which a fast step has zero slope.
        self._highest = min(LOADS[1], max(1.0, 0.4 * (m.a - m.k) / -m.b)) if m.b < 0 else LOADS[1]
        super().__init__(full_scale_kpa, full_r, credible=credible, exact=exact)
        self._most_kpa = full_scale_kpa / 2
        """largest standard deviation stated, that of a load of which nothing is known"""
        self._reach = self._loads_within_reach()
        self._weights = ByStep(_weights, self.model)
        self._steps = 0.0
        self._model_numbers = self._numbers_of_inverse()
        of_full_scale = partial(chains.constants, full_scale_kpa=full_scale_kpa, full_scale_r=self.full_scale_r)
        self._chains = ByStep(of_full_scale, self.model)
        self._of, self._crossed = np.empty((loops.ROWS, 0)), np.empty(0, dtype=np.intp)
        self.seeming = WINDOW * self.model.k / full_scale_kpa
        self.recovers, self.recent = self.model.k > 0 and not exact, chains.READINGS

    def held_kpa(self, r: FloatArray) -> FloatArray:
        return self._held_load(r) * self.full_scale_kpa

    def _held_load(self, r: FloatArray) -> FloatArray:
        """(m,) load of cells whose reading has been ``r`` (m,) for ever."""
        return _root(self.model.b, np.full_like(r, self._held_slope), r)

    def begin(self, r: FloatArray) -> FloatArray:
        s = self._held_load(r)
        memory = np.zeros((len(self.rows), *r.shape))
        memory[PRESSURE], memory[LOAD], memory[BRANCHES] = s * self.full_scale_kpa, s, self._alpha * s
        memory[GAIN], memory[ANCHOR], memory[WENT_UP], memory[FURTHEST] = (
            self.full_scale_kpa / self._held_slope,
            s,
            1.0,
            s,
        )
        chains.begin(memory, r)
        return memory

    def advance(
        self, memory: FloatArray, dt_s: float, r: FloatArray, std: FloatArray, doubt: Callable[[], FloatArray]
    ) -> FloatArray:
        gone, ramp = lag.weights(dt_s, self._constants_s)  # (6, 1) or (6, n)
        of = self._equation(memory, r, std, gone, ramp)
        step, branches = self._step_of_load(memory, dt_s, of)
        m, new = self.model, memory.copy()
        new[LOAD], new[BRANCHES], new[BROKEN] = memory[LOAD] + step, branches, of.free + of.breaking * np.abs(step)
        if not self.exact:
            self._limit(new, r, std)
        if not self.exact and m.k:
            new[WENT_UP] = of.went_up
            breaks = of.breaking != 0.0
            new[FURTHEST] = np.where(breaks, new[LOAD], memory[FURTHEST])
            new[LATELY] = memory[LATELY] * (1.0 - gone[5]) + np.where(breaks, np.abs(step), 0.0)
        new[PRESSURE] = new[LOAD] * self.full_scale_kpa
        new[ANCHOR] = np.maximum(np.minimum(memory[ANCHOR], new[LOAD] + of.width), new[LOAD] - of.width)
        new[GAIN] = self.full_scale_kpa / np.maximum(m.a + 2 * m.b * new[LOAD] - m.k, 0.05 * self.full_scale_r)
        if not self.exact:
            self._err(new, of, gone[4], step, std)
        return new

    def _equation(
        self, memory: FloatArray, r: FloatArray, std: FloatArray, gone: FloatArray, ramp: FloatArray
    ) -> _Equation:
        """The equation for the step of the load at readings ``r`` (n,) known to ``std`` (n,).

        ``gone`` and ``ramp`` (6, 1 or n) are weights as in :func:`_weights`.
        """
        m, alpha, s0 = self.model, self._alpha, memory[LOAD]
        target = alpha * s0
        lead = target - memory[BRANCHES]
        free = memory[BROKEN] * (1 - gone[4])
        breaking: FloatArray | float = m.k * (1 - ramp[4])
        ahead = lead > 0
        forgets = np.where(ahead, gone[:2], gone[2:4])
        kept = memory[BRANCHES] + lead * forgets
        slope = m.a + 2 * m.b * s0
        change = r - (m.a + m.b * s0) * s0 - free - kept[0] - kept[1]
        up = change > 0  # r rises with the load, so that this is also the sign of the step
        charging = ahead | ((lead == 0) & up)
        follows = np.where(charging, alpha * ramp[:2], alpha * ramp[2:4])
        still = np.maximum(slope + follows[0] + follows[1], 1e-9)
        turned_r: FloatArray | float = 0.0
        missed: FloatArray | float = 0.0
        by_noise = width = std * (STILL_SIGMAS / self.full_scale_kpa) * memory[GAIN]
        if self._steps:
            scale = r + 1.0
            steps = np.minimum(scale * scale * self._steps, std)
            by_noise = np.sqrt(std * std - steps * steps) * (STILL_SIGMAS / self.full_scale_kpa) * memory[GAIN]
            held = HELD_STEPS * steps / still
            by_steps = np.where(memory[LATELY] > MOVES * held, MOVING_STEPS * steps / still, held)
            width = np.maximum(by_noise, by_steps)
        went_up = up
        if not self.exact and m.k:
            moves = np.abs(s0 + change / still - memory[ANCHOR]) > width
            breaking = np.where(moves, breaking, 0.0)
            # A load that has turned has crossed its play, and broken chains there. A load that goes on after noise took
            # it back has broken the chains up to its furthest point before.
            went_up = memory[WENT_UP] > 0
            gone_back = (memory[FURTHEST] - s0) * np.where(went_up, 1.0, -1.0) - OVERSHOOT * by_noise
            gone_back = np.clip(gone_back, 0.0, 2.0 * width)
            again = np.maximum((memory[FURTHEST] - s0) * np.where(up, 1.0, -1.0), 0.0)
            crossed_play = np.where(moves, np.where(up != went_up, m.k * gone_back, -(m.k * again)), 0.0)
            free += crossed_play
            change -= crossed_play
            turned = moves & (up != went_up)
            missed = np.where(turned, TURNS_KNOWN * m.k * by_noise, 0.0)
            if self._steps:
                turned_r = np.where(turned, AT_A_TURN * m.k * steps / still, 0.0)
            went_up = np.where(moves, up, went_up)
        slope = slope + np.where(up, breaking, -breaking)
        return _Equation(
            target, lead, free, breaking, forgets, kept, follows, slope, change, width, went_up, turned_r, missed
        )

    def _step_of_load(self, memory: FloatArray, dt_s: float, of: _Equation) -> tuple[FloatArray, FloatArray]:
        """Steps (n,) of the load that solve the equation, and branches (2, n) after them."""
        alpha, slope = self._alpha, of.slope
        step = _root(self.model.b, slope + of.follows[0] + of.follows[1], of.change)
        branches = of.kept + of.follows * step
        crossed = np.flatnonzero(((of.target + alpha * step - branches) * of.lead < 0).any(axis=0))
        if crossed.size:
            step[crossed], branches[:, crossed] = self._solve_crossed(memory, crossed, dt_s, of, step[crossed])
        return step, branches

    def _solve_crossed(
        self, memory: FloatArray, crossed: IntArray, dt_s: float, of: _Equation, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """:meth:`_step_of_load` for the cells ``crossed`` (k,), of which a branch changes over; begins at ``step``."""
        discharging = of.lead[:, crossed] < 0
        change_over = ChangeOver(
            lead=of.lead[:, crossed],
            target=of.target[:, crossed],
            alpha=self._alpha,
            first_s=np.where(discharging, self._fall_s, self._rise_s),
            second_s=np.where(discharging, self._rise_s, self._fall_s),
            dt_s=dt_s,
            kept=of.kept[:, crossed],
            follows=of.follows[:, crossed],
        )
        change, load = of.change[crossed], memory[LOAD, crossed]
        end = np.where(change > 0, np.maximum(self._reach[1] - load, 0.0), np.minimum(self._reach[0] - load, 0.0))
        return change_over.solved(change, of.slope[crossed], self.model.b, step, end)

    def take_steps(self, std: float, own: float) -> None:
        """As :meth:`.Inversion.take_steps`: a reading is off by no more than half of its own step."""
        self._steps = own
        self._model_numbers = self._numbers_of_inverse()

    def loops_used(self) -> tuple[Loop[..., Any], ...]:
        looks = chains.LOOPS if self.recovers else ()
        return *loops.ALL, *looks

    def _numbers_of_inverse(self) -> FloatArray:
        """The numbers that the loops take, by place."""
        m, full = self.model, self.full_scale_kpa
        numbers = {
            **{loops.A: m.a, loops.B: m.b, loops.K: m.k, loops.ALPHA: m.alpha1, loops.ALPHA + 1: m.alpha2},
            **{loops.RISE_S: m.rise1_s, loops.RISE_S + 1: m.rise2_s},
            **{loops.FALL_S: m.fall1_s, loops.FALL_S + 1: m.fall2_s},
            loops.FULL_KPA: full,
            loops.FULL_R: self.full_scale_r,
            loops.HIGHEST: self._highest,
            loops.IN_DOUBT: min(USUAL, self._highest),
            loops.DOUBT_KPA2: (DOUBT * full) ** 2,
            loops.MOST_KPA2: self._most_kpa**2,
            loops.LOWEST_END: self._reach[0],
            loops.HIGHEST_END: self._reach[1],
            loops.STILL: STILL_SIGMAS,
            loops.HELD_STEPS: HELD_STEPS,
            loops.MOVING_STEPS: MOVING_STEPS,
            loops.MOVES: MOVES,
            loops.OVERSHOOT: OVERSHOOT,
            loops.STEPS: self._steps,
            loops.AT_A_TURN: AT_A_TURN * m.k,
            loops.TURNS_KNOWN: TURNS_KNOWN * m.k,
            loops.BETWEEN: BETWEEN,
            loops.BY_TURNS: AROUND * m.k,
            loops.TO_AND_FRO: TO_AND_FRO * m.k,
            loops.ACCURACY: ACCURACY,
            loops.EVALUATIONS: EVALUATIONS,
        }
        return np.array([float(numbers[place]) for place in range(len(numbers))])

    def advance_compiled(self, memory: FloatArray, taken: FloatArray, line: FloatArray, dt_s: float) -> FloatArray:
        numbers, cells = self._model_numbers, memory.shape[1]
        if self._crossed.size != cells:
            self._of, self._crossed = np.empty((loops.ROWS, cells)), np.empty(cells, dtype=np.intp)
        of, crossed, (gone, ramp) = self._of, self._crossed, self._weights.of(dt_s)
        count = loops.solve.unchecked(memory, taken, gone, ramp, numbers, of, crossed)
        if count:
            loops.solve_crossed.unchecked(memory, crossed, count, dt_s, numbers, of)
        loops.finish.unchecked(memory, taken, float(gone[4]), float(gone[5]), numbers, of)
        return memory

    def _err(
        self,
        memory: FloatArray,
        of: _Equation,
        heals: FloatArray,
        step: FloatArray,
        std: FloatArray,
    ) -> None:
        """Update the variances of the remembered branches and chains; changes ``memory``.

        The motion of the load between two frames is not seen: it may go straight or by a step, and turn in between. The
        second difference of the load from frame to frame tells how much this may be. An error of the memory fades as
        the memory does.
        """
        still = STILL_SIGMAS * std * memory[GAIN] / self.full_scale_kpa
        bend = np.maximum(np.abs(step - memory[MOVED]) - still, 0.0)
        # Before it turned, the load may have gone on and come back by as much as it moves in a frame.
        turned = (-np.sign(step) * memory[[MOVED, BEFORE]] > still / STILL_SIGMAS).any(axis=0)
        way = np.maximum(np.abs(step) - still, 0.0) * turned
        errors = memory[ERRORS]
        errors[:2] *= (1 - of.forgets) ** 2
        errors[2] *= (1 - heals) ** 2
        errors[:2] += (BETWEEN * bend * of.follows * (1 - of.follows / np.maximum(self._alpha, 1e-9))) ** 2
        errors[2] += (AROUND * self.model.k * way) ** 2 + of.turned_r * of.turned_r
        memory[MISSED] *= 1 - heals
        memory[MISSED] += TO_AND_FRO * self.model.k * way + of.missed
        memory[BEFORE] = memory[MOVED]
        memory[MOVED] = step
        variance = (errors.sum(axis=0) + memory[MISSED] ** 2) * memory[GAIN] ** 2
        memory[VARIANCE] = np.minimum(variance, self._most_kpa**2)

    def miss(self, memory: FloatArray, rise_kpa: FloatArray) -> None:
        """Motion within the noise breaks chains, which looks like a load that rises."""
        memory[MISSED] += rise_kpa / memory[GAIN]

    def recover(self, memory: FloatArray, recent: RecentReadings) -> None:
        """Count chains that loads break unnoticed (:mod:`._chains`)."""
        chains.look(memory, recent.mean, recent.noise, recent.near, self._chains.of(recent.dt_s))

    def recover_compiled(self, memory: FloatArray, recent: RecentReadings) -> None:
        """The same by loops."""
        of, seen = self._chains.of(recent.dt_s), np.empty((chains.SEEN, recent.mean.size))
        chains.look_each.unchecked(memory, recent.mean, recent.noise, recent.near, of.row, of.way.rows, seen)

    def _limit(self, memory: FloatArray, r: FloatArray, std: FloatArray) -> None:
        """Keep loads within credible limits, and correct the memory to the reading ``r`` (n,) instead.

        Where the model needs a negative load, its branches and chains are reduced. Where it needs too large a load, it
        has missed broken chains. While the memory is uncertain, the upper limit is lower.
        """
        allowed = -(3 * std / self.full_scale_r + 0.01)
        load = memory[LOAD]
        in_doubt = min(USUAL, self._highest)
        highest = np.where(memory[VARIANCE] > (DOUBT * self.full_scale_kpa) ** 2, in_doubt, self._highest)
        pulled = load < allowed
        if pulled.any():
            s = np.broadcast_to(allowed, load.shape)[pulled]
            left = r[pulled] - (self.model.a + self.model.b * s) * s
            remembered = memory[4:7, pulled].sum(axis=0)
            share = np.clip(np.divide(left, remembered, out=np.zeros_like(left), where=remembered > 0), 0, 1)
            memory[4:7, pulled] *= share
            load[pulled] = s
        beyond = load >= highest
        if beyond.any():
            load[beyond] = s = highest[beyond]
            left = r[beyond] - (self.model.a + self.model.b * s) * s - memory[4:7, beyond].sum(axis=0)
            # No credible load explains so much r: chains have broken unseen.
            if self.model.k > 0:
                memory[BROKEN, beyond] += np.maximum(left, 0.0)

    def hold(self, memory: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        held = memory.copy()
        s = memory[LOAD]
        held[BRANCHES] = self._branches(memory, dt_s, s)
        held[BROKEN] *= np.exp(-dt_s / self.model.tau_s)
        held[LATELY] *= np.exp(-dt_s / LATELY_S)
        return held

    def left_over(self, memory: FloatArray) -> FloatArray:
        """r of the broken chains, and of the branches beyond their targets."""
        beyond = memory[BRANCHES] - self._alpha * memory[LOAD]
        np.maximum(beyond, 0.0, out=beyond)
        left: FloatArray = memory[BROKEN] + beyond[0]
        left += beyond[1]
        return left

    def settled(self, memory: FloatArray, band: float) -> BoolArray:
        found: BoolArray = np.abs(memory[4:7]).sum(axis=0) < band
        return found

    def _branches(self, memory: FloatArray, dt_s: float | FloatArray, s: FloatArray) -> FloatArray:
        """Branches (2, n) after a step to load ``s``, with any change-over."""
        before, after = self._alpha * memory[LOAD], self._alpha * s
        return lag.asymmetric(memory[BRANCHES], before, after, dt_s, self._rise_s, self._fall_s)

    def _loads_within_reach(self) -> tuple[float, float]:
        """Least and largest load that the solver looks for.

        With b, no load lies beyond the top or the bottom of the parabola. The other limits follow from credible
        readings, and from :data:`LOADS` unless readings are taken as exact.
        """
        m = self.model
        widest = self.credible[1] / max(m.a - m.k, 1e-9)
        bottom = -(m.a - m.k) / (2 * m.b) if m.b > 0 else -widest
        top = (m.a - m.k) / (-2 * m.b) if m.b < 0 else widest
        if self.exact:
            return bottom, top
        return max(bottom, LOADS[0]), min(top, self._highest)


def _weights(model: M10Model, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """(6,) shares that lags forget in ``dt_s``, and (6,) their responses to a ramp.

    The lags: the two branches as they rise, and as they fall; the broken chains; the recent way.
    """
    m = model
    return lag.weights(dt_s, np.array([m.rise1_s, m.rise2_s, m.fall1_s, m.fall2_s, m.tau_s, LATELY_S]))


def _root(b: float, slope: FloatArray, change: FloatArray) -> FloatArray:
    """The root of b x^2 + slope x = change nearer to zero; where there is none, the vertex of the parabola."""
    if b:
        change = np.minimum(change, slope**2 / (-4 * b)) if b < 0 else np.maximum(change, slope**2 / (-4 * b))
    root: FloatArray = 2 * change / (slope + np.sqrt(np.maximum(slope**2 + 4 * b * change, 0)))
    return root
