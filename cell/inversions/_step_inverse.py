"""Exact step-by-step inverse of a cell model with asymmetric relaxation branches: no switch of models, no thresholds.

If the resistance at the end of a step rises with the load there, for every step (:func:`margin` positive), each reading
has exactly one load, and the inverse is as exact as the model. The margin is not positive for cells whose resistance
rises while they are unloaded, as real carbon-black silicone may; this inverse then refuses the model.

As long as no branch changes between charging and discharging within the step, the load is the root of a quadratic
equation (:func:`equation`). A branch that does change over is a convex function of the load if it rises faster than it
falls, otherwise a concave one (:func:`branch_after`). Newton's method, begun at the root without change-over, then
converges monotonically from one side; a bisection step is taken where it would leave the bracket (:func:`change_over`).

Motion breaks conductive chains in proportion to the path of the load: noise must not count as motion. A load counts as
still within a play (backlash) about an anchor that is as wide as the noise; chains break once it leaves the play.
"""

from __future__ import annotations

import math

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...common.compiled import Places, Record, Records, Row, loop, record, zeros
from ...errors import InputError
from .._state import CellState, M10State, Pair
from ..estimation import DOUBT, LOADS, USUAL, WINDOW, Inversion, credible_readings
from ..materials import AsymmetricModel, ByStep, M10Model, as_m10, lag

BETWEEN, AROUND, TO_AND_FRO = 0.58, 0.5, 0.6
"""error by the motion of the load between two frames. BETWEEN times the bend of the load (its second difference between
frames) times ramp (1 - ramp) is the standard deviation of a lag, since the load may go straight or by a step. AROUND
times the path of the load in the frame after a turn is the standard deviation of its path to and fro between two
frames; TO_AND_FRO times it is the expected path, which adds up, since all turns err to the same side. Taken from
vibrations and slips, whose drops are faster than a frame"""
STILL_SIGMAS = 3.0
"""half width of the play of the anchor, in standard deviations by noise"""
OVERSHOOT, TURNS_KNOWN = 0.5, 0.4
"""of the half width of the play by noise: how far noise takes the furthest load of a press beyond the turn; and the
standard deviation of that. The longer a load stays near its turn, the more readings reach beyond: the errors of the
turns of a tremor are alike"""
ACCURACY = 1e-11
"""of full scale: accuracy of a step with a change-over"""
EVALUATIONS = 16
"""largest number of evaluations of the model in a step with a change-over, which bounds the cost of a frame. Newton's
method needs two or three at high sample rates, six where a step is many time constants long; otherwise bisection halves
the bracket"""


class M10Numbers(Record):
    """Constants of a model and its full scale; loads are of full scale."""

    a: float
    b: float
    k: float
    alpha: Pair
    rise_s: Pair
    fall_s: Pair
    full_kpa: float
    full_r: float
    highest: float
    """largest credible load"""
    in_doubt: float
    """the same while the memory is uncertain"""
    doubt_kpa2: float
    """variance from which the memory counts as uncertain"""
    most_kpa2: float
    """largest variance stated, that of a load of which nothing is known"""
    lowest_end: float
    """range of loads that the solver searches"""
    highest_end: float
    exact: float
    """1: readings are taken as free of noise"""


class M10Step(Record):
    """Weights of a time step (:func:`..materials.lag.weights`): branches that rise, that fall, and chains."""

    dt_s: float
    rise_gone: Pair
    rise_ramp: Pair
    fall_gone: Pair
    fall_ramp: Pair
    heals: float
    heals_ramp: float


def margin(model: AsymmetricModel | M10Model, full_scale_kpa: float) -> float:
    """Least slope dr/ds of a fast step, over the slope at equilibrium; positive where the inverse is unique.

    The least slope is a + 2 b s - k: a fast unloading step leaves the branches unchanged and breaks chains.
    """
    m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
    settled = max(m.a + m.b + m.alpha1 + m.alpha2, 1e-9)
    return (m.a + min(0.0, 2 * m.b) - m.k) / settled


class AsymmetricInversion(Inversion):
    """The inverse of ``asymmetric`` and ``m10`` cells."""

    memory = M10State

    def __init__(self, model: AsymmetricModel | M10Model, full_scale_kpa: float, *, exact: bool) -> None:
        found = margin(model, full_scale_kpa)
        if not found > 0:
            raise InputError(
                "the exact inverse of this cell has more than one answer: the resistance also rises while unloading "
                f"(a + 2 b s - k falls to {found:.2g} of the slope at equilibrium); use another estimator"
            )
        self.model = m = as_m10(model, full_scale_kpa) if isinstance(model, AsymmetricModel) else model
        steepest = m.a + 2 * max(m.b, 0.0) * LOADS[1] + m.alpha1 + m.alpha2 + m.k
        full_r = m.a + m.b + m.alpha1 + m.alpha2
        super().__init__(full_scale_kpa, full_r, credible=credible_readings(steepest), exact=exact)
        self.seeming = WINDOW * m.k / full_scale_kpa
        self._alpha, self._held_slope = np.array([m.alpha1, m.alpha2]), m.a + m.alpha1 + m.alpha2
        self._numbers = self._numbers_of()
        self._steps = ByStep(_step, m)

    def _numbers_of(self) -> M10Numbers:
        m, full = self.model, self.full_scale_kpa
        # With b < 0 the inverse grows ever steeper towards the load at which a fast step has zero slope.
        highest = min(LOADS[1], max(1.0, 0.4 * (m.a - m.k) / -m.b)) if m.b < 0 else LOADS[1]
        # With b, no load lies beyond the top or the bottom of the parabola.
        widest = self.credible[1] / max(m.a - m.k, 1e-9)
        bottom = -(m.a - m.k) / (2 * m.b) if m.b > 0 else -widest
        top = (m.a - m.k) / (-2 * m.b) if m.b < 0 else widest
        return record(
            M10Numbers,
            **{"a": m.a, "b": m.b, "k": m.k, "alpha": self._alpha},
            rise_s=np.array([m.rise1_s, m.rise2_s]),
            fall_s=np.array([m.fall1_s, m.fall2_s]),
            full_kpa=full,
            full_r=self.full_scale_r,
            highest=highest,
            in_doubt=min(USUAL, highest),
            doubt_kpa2=(DOUBT * full) ** 2,
            most_kpa2=(full / 2) ** 2,
            lowest_end=bottom if self.exact else max(bottom, LOADS[0]),
            highest_end=top if self.exact else min(top, highest),
            exact=float(self.exact),
        )

    def held_kpa(self, r: FloatArray) -> FloatArray:
        return self._held_load(r) * self.full_scale_kpa

    def _held_load(self, r: FloatArray) -> FloatArray:
        """(m,) load of cells whose reading has been ``r`` (m,) for ever."""
        b, slope = self.model.b, self._held_slope
        most = slope**2 / (-4 * b) if b else 0.0
        change = np.minimum(r, most) if b < 0 else np.maximum(r, most) if b > 0 else r
        return np.asarray(2 * change / (slope + np.sqrt(np.maximum(slope**2 + 4 * b * change, 0))))

    def begin(self, cells: Records[CellState], memory: Records[M10State], places: IntArray, r: FloatArray) -> None:
        load = self._held_load(r)
        begun = zeros(M10State, places.size)
        for name in ("load", "anchor", "furthest"):
            begun[name] = load
        begun["branch"], begun["went_up"] = load[:, None] * self._alpha, 1.0
        memory[places] = begun
        cells["pressure_kpa"][places] = load * self.full_scale_kpa
        cells["gain_kpa"][places], cells["variance_kpa2"][places] = self.full_scale_kpa / self._held_slope, 0.0

    def advance(self, cells: Records[CellState], memory: Records[M10State], awake: IntArray, dt_s: float) -> None:
        advance_each.unchecked(cells, memory, awake, self._numbers, self._steps.of(dt_s))

    def doubt_rises(
        self, cells: Records[CellState], memory: Records[M10State], places: IntArray, rise_kpa: FloatArray
    ) -> None:
        """Motion within the noise breaks chains, which looks like a load that rises."""
        memory["missed"][places] += rise_kpa / cells["gain_kpa"][places]

    def hold(self, cells: Records[CellState], memory: Records[M10State], places: IntArray, dt_s: FloatArray) -> None:
        hold_each.unchecked(memory, places, dt_s, self._numbers, self.model.tau_s)

    def left_over(self, cells: Records[CellState], memory: Records[M10State], places: IntArray) -> FloatArray:
        """r of the broken chains, and of the branches beyond their targets."""
        beyond = memory["branch"][places] - memory["load"][places, None] * self._alpha
        left: FloatArray = memory["broken"][places] + np.maximum(beyond, 0.0).sum(axis=1)
        return left

    def settled(self, cells: Records[CellState], memory: Records[M10State], places: IntArray, band: float) -> BoolArray:
        remembered = np.abs(memory["branch"][places]).sum(axis=1) + np.abs(memory["broken"][places])
        return np.asarray(remembered < band)


def _step(model: M10Model, dt_s: float) -> M10Step:
    m = model
    gone, ramp = lag.weights(dt_s, np.array([m.rise1_s, m.rise2_s, m.fall1_s, m.fall2_s, m.tau_s]))
    return record(
        M10Step,
        **{"rise_gone": gone[:2], "rise_ramp": ramp[:2], "fall_gone": gone[2:4], "fall_ramp": ramp[2:4]},
        **{"dt_s": dt_s, "heals": gone[4], "heals_ramp": ramp[4]},
    )


@loop
def root(b: float, slope: float, change: float) -> float:
    """The root of b x^2 + slope x = change nearer to zero; where there is none, the vertex of the parabola."""
    if b < 0.0:
        change = min(change, slope * slope / (-4.0 * b))
    elif b > 0.0:
        change = max(change, slope * slope / (-4.0 * b))
    return 2.0 * change / (slope + math.sqrt(max(slope * slope + 4.0 * b * change, 0.0)))


@loop
def advance_each(
    cells: Records[CellState], memory: Records[M10State], awake: Places, k: M10Numbers, s: M10Step
) -> None:
    """Take the smoothed readings of the cells that are ``awake`` (m,), one time step after the last ones."""
    for n in range(awake.size):
        cell, own = cells[awake[n]], memory[awake[n]]
        slope, change, width = equation(cell, own, k, s)
        step = root(k.b, slope + own.follows[0] + own.follows[1], change)
        crosses = False
        for j in range(2):
            target = k.alpha[j] * own.load
            own.after[j] = own.kept[j] + own.follows[j] * step
            crosses |= (target + k.alpha[j] * step - own.after[j]) * (target - own.branch[j]) < 0.0
        if crosses:
            step = change_over(own, change, slope, step, k, s.dt_s)
        finish(cell, own, step, width, k, s)


@loop
def equation(cell: CellState, own: M10State, k: M10Numbers, s: M10Step) -> tuple[float, float, float]:
    """The quadratic equation (slope + the sum of ``follows``) x + b x^2 = change for the step x of the load.

    Returns:
        slope: dr/ds of the static response and the breaking chains; change: of r that the step must explain; and the
        half width of the play within which a load counts as still.
    """
    load, free = own.load, own.broken * (1.0 - s.heals)
    slope = k.a + 2.0 * k.b * load
    for j in range(2):
        lead = k.alpha[j] * load - own.branch[j]
        own.forgets[j] = s.rise_gone[j] if lead > 0.0 else s.fall_gone[j]
        own.kept[j] = own.branch[j] + lead * own.forgets[j]
    change = cell.level - (k.a + k.b * load) * load - free - own.kept[0] - own.kept[1]
    up = change > 0.0  # r rises with the load, so that this is also the sign of the step
    for j in range(2):
        lead = k.alpha[j] * load - own.branch[j]
        charges = lead > 0.0 or (lead == 0.0 and up)
        own.follows[j] = k.alpha[j] * (s.rise_ramp[j] if charges else s.fall_ramp[j])
    still = max(slope + own.follows[0] + own.follows[1], 1e-9)
    width = STILL_SIGMAS * cell.level_std * cell.gain_kpa / k.full_kpa
    breaking, own.hidden_r = k.k * (1.0 - s.heals_ramp), 0.0
    if k.k != 0.0 and k.exact == 0.0:
        # A load that has turned has crossed its play, and broken chains there. A load that goes on after noise took it
        # back has broken the chains up to its furthest point before.
        went_up = own.went_up > 0.0
        beyond = (own.furthest - load) * (1.0 if went_up else -1.0)
        if not abs(load + change / still - own.anchor) > width:
            breaking = 0.0
        elif up != went_up:
            own.hidden_r = TURNS_KNOWN * k.k * width
            crossed = k.k * min(max(beyond - OVERSHOOT * width, 0.0), 2.0 * width)
            free, change, own.went_up = free + crossed, change - crossed, 1.0 if up else 0.0
        else:
            again = k.k * max(beyond, 0.0)
            free, change = free - again, change + again
    own.free, own.breaking = free, breaking
    return slope + (breaking if up else -breaking), change, width


@loop
def branch_after(own: M10State, j: int, step: float, k: M10Numbers, dt_s: float) -> tuple[float, float]:
    """Branch ``j`` after a ``step`` of the load within which it may change over, and its derivative by the step.

    With v = alpha step/dt and q = -lead/(v T1), the branch changes over after T1 log(1 + q). At the end it is behind
    its target by v T2 (1 - exp(-(time left)/T2)). The result and its first derivative are continuous. The second
    derivative is (1/T2 - 1/T1)/step times a factor between 0 and alpha dt.
    """
    alpha = k.alpha[j]
    target = alpha * own.load
    lead, speed = target - own.branch[j], alpha * step / dt_s
    if lead * speed < 0.0:
        first_s, second_s = k.rise_s[j], k.fall_s[j]
        if lead < 0.0:
            first_s, second_s = second_s, first_s
        since = lead / speed
        ratio = -since / first_s
        left = dt_s - first_s * math.log1p(ratio)
        if left > 0.0:
            done = -math.expm1(-left / second_s)
            lags = second_s * done
            rate = alpha * (1.0 - (lags - (1.0 - done) * since / (1.0 + ratio)) / dt_s)
            return target + alpha * step - speed * lags, rate
    return own.kept[j] + own.follows[j] * step, own.follows[j]


@loop
def change_over(own: M10State, change: float, slope: float, step: float, k: M10Numbers, dt_s: float) -> float:
    """Solve slope x + b x^2 + branches - kept = change by Newton's method in a bracket; writes the branches after it.

    The left side rises with the step and is zero at zero, so that the root lies between zero and the end of the range
    of loads. If the root lies beyond that end, the end is the answer.
    """
    low = min(k.lowest_end - own.load, 0.0) if change <= 0.0 else 0.0
    high = max(k.highest_end - own.load, 0.0) if change > 0.0 else 0.0
    end = high if change > 0.0 else low
    step = min(max(step, low), high)
    tried = step == end
    bend = 0.0  # bound of the sum of both branches' second derivatives by the step, times the step
    for j in range(2):
        bend += k.alpha[j] * dt_s * abs(1.0 / k.rise_s[j] - 1.0 / k.fall_s[j])
    kept = own.kept[0] + own.kept[1]
    for _ in range(EVALUATIONS - 1):
        one, of_one = branch_after(own, 0, step, k, dt_s)
        other, of_other = branch_after(own, 1, step, k, dt_s)
        rate = slope + 2.0 * k.b * step + of_one + of_other
        excess = (slope + k.b * step) * step + one + other - kept - change
        if excess > 0.0:
            high = step
        else:
            low = step
        rises = rate > 1e-6
        move = -excess / rate if rises else 0.0
        newton = min(max(step + move, low), high)
        # The error after a Newton step is the next term of the Taylor series.
        next_term = (bend + abs(k.b * step)) * (move * move)
        small = next_term <= ACCURACY * rate * abs(step) or abs(move) <= ACCURACY
        if (rises and small) or low == high:
            own.after[0], own.after[1] = one + of_one * (newton - step), other + of_other * (newton - step)
            return newton
        to_end = rises and newton == end and not tried
        tried |= to_end
        step = newton if to_end or (rises and low < newton and newton < high) else 0.5 * (low + high)
    for j in range(2):
        own.after[j], _ = branch_after(own, j, step, k, dt_s)
    return step


@loop
def finish(cell: CellState, own: M10State, step: float, width: float, k: M10Numbers, s: M10Step) -> None:
    """Write the memory after the ``step``: limited to credible loads, with its variances."""
    r, load, broken = cell.level, own.load + step, own.free + own.breaking * abs(step)
    one, other = own.after[0], own.after[1]
    if k.exact == 0.0:
        allowed = -(3.0 * cell.level_std / k.full_r + 0.01)
        if load < allowed:  # the branches and chains are reduced to what the reading leaves for them
            load = allowed
            left, remembered = r - (k.a + k.b * load) * load, one + other + broken
            share = min(max(left / remembered, 0.0), 1.0) if remembered > 0.0 else 0.0
            one, other, broken = one * share, other * share, broken * share
        highest = k.in_doubt if cell.variance_kpa2 > k.doubt_kpa2 else k.highest
        if load >= highest:
            load = highest
            left = r - (k.a + k.b * load) * load - (one + other + broken)
            if k.k > 0.0:  # no credible load explains so much r: chains have broken unseen
                broken += max(left, 0.0)
    if own.breaking != 0.0:
        own.furthest = load
    gain = k.full_kpa / max(k.a + 2.0 * k.b * load - k.k, 0.05 * k.full_r)
    own.load, own.branch[0], own.branch[1], own.broken = load, one, other, broken
    own.anchor = max(min(own.anchor, load + width), load - width)
    cell.pressure_kpa, cell.gain_kpa = load * k.full_kpa, gain
    if k.exact == 0.0:
        renew_variance(cell, own, step, k, s)


@loop
def renew_variance(cell: CellState, own: M10State, step: float, k: M10Numbers, s: M10Step) -> None:
    """Update the variances of the remembered branches and chains, which fade as the memory does.

    The motion of the load between two frames is not seen: it may go straight or by a step, and turn in between. The
    second difference of the load from frame to frame tells how much this may be.
    """
    still = STILL_SIGMAS * cell.level_std * cell.gain_kpa / k.full_kpa
    little = still / STILL_SIGMAS
    bend = max(abs(step - own.moved) - still, 0.0)
    # Before it turned, the load may have gone on and come back by as much as it moves in a frame.
    sign = 1.0 if step > 0.0 else (-1.0 if step < 0.0 else 0.0)
    turned = -sign * own.moved > little or -sign * own.moved_before > little
    path = max(abs(step) - still, 0.0) if turned else 0.0
    errors = 0.0
    for j in range(2):
        stays = 1.0 - own.forgets[j]
        error = BETWEEN * bend * own.follows[j] * (1.0 - own.follows[j] / max(k.alpha[j], 1e-9))
        own.branch_variance[j] = own.branch_variance[j] * (stays * stays) + error * error
        errors += own.branch_variance[j]
    by_turns, stays = AROUND * k.k * path, 1.0 - s.heals
    own.broken_variance = own.broken_variance * (stays * stays) + by_turns * by_turns
    own.missed = own.missed * stays + (TO_AND_FRO * k.k * path + own.hidden_r)
    own.moved_before, own.moved = own.moved, step
    errors += own.broken_variance
    cell.variance_kpa2 = min((errors + own.missed * own.missed) * (cell.gain_kpa * cell.gain_kpa), k.most_kpa2)


@loop
def hold_each(memory: Records[M10State], places: Places, dt_s: Row, k: M10Numbers, heals_s: float) -> None:
    """Let the memory of ``places`` (k,) relax for ``dt_s`` (k,) at constant load."""
    for n in range(places.size):
        own = memory[places[n]]
        for j in range(2):
            lead = k.alpha[j] * own.load - own.branch[j]
            own.branch[j] += lead * -math.expm1(-dt_s[n] / (k.rise_s[j] if lead > 0.0 else k.fall_s[j]))
        own.broken *= math.exp(-dt_s[n] / heals_s)
