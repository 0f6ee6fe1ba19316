"""Interacting multiple model filter (IMM; Blom & Bar-Shalom 1988) of the load on a cell: its state, and one kernel.

Every mode of :mod:`._modes` has a Gaussian estimate of (s, r, v), the load, the normalised resistance and the speed,
and a mean of the slow branch x3. A frame goes through these steps:

1. **Mixing.** Estimates that leave their modes are pooled by phase, with their moments. Each mode then has two
   candidates: its own estimate, and what comes to it from the pools. At a change of phase within the frame some of the
   way has gone unseen, and always raises r: its mean and variance are added.
2. **Prediction** and **update**. A reading is an interval, by its quantisation step or by a limit of the converter: the
   predicted reading is conditioned on lying within it (Curry 1970). A narrow interval is the Kalman update.
3. Bounds (the sign of the speed, loads from none to an overload) are factors of the likelihood and truncate moments.
4. The candidates of a mode are merged. Evidence is forgotten within seconds, as no cell is exactly the model.

**Bad contacts.** When a reading leaves every slow mode, the estimates from before are kept for a while without
readings. The odds of a bad contact are followed; a reading that returns to them is far likelier than a load that does.
"""

from __future__ import annotations

import math
from typing import Annotated

from ...common.arrays import FloatArray
from ...common.compiled import PlaceRows, Record, Records, Row, Rows, loop
from ._modes import (
    DOWN,
    EACH,
    HOLD_DOWN,
    HOLD_UP,
    MODES,
    REST,
    SHAKE,
    TWICE,
    Step,
)
from ._neighbours import BELIEVED, LOAD, VARIANCE, agreement, prior


class Estimates(Record):
    """Gaussian estimates of the modes of one cell: weight, means, covariances."""

    w: EACH
    s: EACH
    r: EACH
    v: EACH
    x3: EACH
    ss: EACH
    sr: EACH
    sv: EACH
    rr: EACH
    rv: EACH
    vv: EACH


class Candidates(Record):
    """Scratch of a frame: candidates of the modes, first their own, then the comers; and what they are judged by."""

    w: TWICE
    s: TWICE
    r: TWICE
    v: TWICE
    x3: TWICE
    ss: TWICE
    sr: TWICE
    sv: TWICE
    rr: TWICE
    rv: TWICE
    vv: TWICE
    likelihood: TWICE
    distance: TWICE
    from_down: EACH
    """weights of what comes to each mode from the pools"""
    from_up: EACH
    from_rest: EACH
    from_shake: EACH


FOUR = Annotated[FloatArray, 4]
AFTER_DOWN, AFTER_UP, AFTER_REST, AFTER_SHAKE = range(4)
"""pools, by what is left"""


class Pools(Record):
    """Scratch of a frame: estimates that leave their modes, pooled."""

    w: FOUR
    s: FOUR
    r: FOUR
    v: FOUR
    x3: FOUR
    ss: FOUR
    sr: FOUR
    sv: FOUR
    rr: FOUR
    rv: FOUR
    vv: FOUR


TAIL = 0.03
"""probability of explanations that an interval of 95 % need not cover"""
NEGLIGIBLE = 1e-9
"""probability below which an estimate is dropped"""
DEEP = 8.0
FAR = 4.0
"""standard deviations from a bound at which the bound is not felt"""
NARROW = 0.7
"""width of an interval over the standard deviation, up to which it counts as part of the noise"""
OVERLOADS = 1e-3
"""density of loads beyond an overload, over that of others"""
LEAST = 1e-300
"""a number to divide by in place of 0"""
LEAST_VAR = 1e-18
"""of a load or a speed"""
RESTING, REMAINS = 0.7, 0.1
"""probability that a cell begins at rest; and mean of what is left of earlier loads then, over r at full scale"""
DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
ENTERS, ENTERS_VAR = 0.8, 0.36
"""mean and variance of the speed of a motion that begins, over its usual speed: of a half-normal variable"""


@loop
def decay(x: float) -> float:
    """exp(x) of x <= 0, to 1e-9 down to -10 and 2e-6 down to -32; at least exp(-88).

    The series of exp(x/256), whose terms are summed in pairs, so that none waits for all others.
    """
    y = max(x, -88.0) * (1.0 / 256.0)
    square = y * y
    y = (1.0 + y) + square * ((0.5 + y * (1.0 / 6.0)) + square * (1.0 / 24.0 + y * (1.0 / 120.0)))
    y = y * y
    y = y * y
    y = y * y
    y = y * y
    y = y * y
    y = y * y
    y = y * y
    return y * y


@loop
def mass(z: float, bell: float) -> float:
    """Probability that a standard normal variable exceeds -z, with ``bell`` = exp(-z^2/2).

    Mills' ratio as a rational function, fitted for z from -8 to 8 with a relative error of 1.3e-9. The error function
    takes several times as long, by exponentials of its own.
    """
    x = abs(z)
    square = x * x
    above = 0.5000000006490767 + 0.41788844846365136 * x
    above += square * ((0.1684901690573697 + 0.03575450193849128 * x) + square * 0.0034137124178799327)
    below = (1.0 + 1.6336615620685102 * x) + square * (1.140452334970459 + 0.43059581096618055 * x)
    tail = bell * above / (below + square * square * (0.08963991248159844 + 0.008556492980906077 * x))
    return 1.0 - tail if z > 0.0 else tail


@loop
def above(z: float) -> float:
    """Probability that a standard normal variable exceeds -z; at least that of z = -8."""
    z = max(z, -DEEP)
    return mass(z, decay(-0.5 * z * z))


@loop
def pool(p: Pools, k: int, e: Estimates, first: int, last: int, t: Step) -> None:
    """Pool what leaves every second mode from ``first`` to before ``last``: moments of the mixture."""
    w = s = r = v = x3 = 0.0
    for j in range(first, last, 2):
        part = above_negligible(e.w[j] * t.leaves[j])
        w += part
        s += part * e.s[j]
        r += part * e.r[j]
        v += part * e.v[j]
        x3 += part * e.x3[j]
    per_w = 1.0 / max(w, LEAST)
    s, r, v = s * per_w, r * per_w, v * per_w
    p.w[k], p.s[k], p.r[k], p.v[k], p.x3[k] = w, s, r, v, x3 * per_w
    ss = sr = sv = rr = rv = vv = 0.0
    for j in range(first, last, 2):
        part = above_negligible(e.w[j] * t.leaves[j]) * per_w
        by_s, by_r, by_v = e.s[j] - s, e.r[j] - r, e.v[j] - v
        ss += part * (e.ss[j] + by_s * by_s)
        sr += part * (e.sr[j] + by_s * by_r)
        sv += part * (e.sv[j] + by_s * by_v)
        rr += part * (e.rr[j] + by_r * by_r)
        rv += part * (e.rv[j] + by_r * by_v)
        vv += part * (e.vv[j] + by_v * by_v)
    p.ss[k], p.sr[k], p.sv[k], p.rr[k], p.rv[k], p.vv[k] = ss, sr, sv, rr, rv, vv


@loop
def comes(c: Candidates, p: Pools, t: Step) -> None:
    """Merge what comes to each mode from the pools: moments of the mixture, but for the speed, which begins anew.

    Where the phase changes within the frame, ``bend`` times the way before the turn is added to r. What comes to rest
    may remember something else.
    """
    bend = t.bend * t.dt_s
    unseen = bend * bend * t.unseen_std * t.unseen_std
    s_0, s_1, s_2, s_3 = p.s[AFTER_DOWN], p.s[AFTER_UP], p.s[AFTER_REST], p.s[AFTER_SHAKE]
    r_0, r_1, r_2, r_3 = p.r[AFTER_DOWN], p.r[AFTER_UP], p.r[AFTER_REST], p.r[AFTER_SHAKE]
    x3_0, x3_1, x3_2, x3_3 = p.x3[AFTER_DOWN], p.x3[AFTER_UP], p.x3[AFTER_REST], p.x3[AFTER_SHAKE]
    ss_0, ss_1, ss_2, ss_3 = p.ss[AFTER_DOWN], p.ss[AFTER_UP], p.ss[AFTER_REST], p.ss[AFTER_SHAKE]
    sr_0, sr_1, sr_2, sr_3 = p.sr[AFTER_DOWN], p.sr[AFTER_UP], p.sr[AFTER_REST], p.sr[AFTER_SHAKE]
    rr_0, rr_1, rr_2, rr_3 = p.rr[AFTER_DOWN], p.rr[AFTER_UP], p.rr[AFTER_REST], p.rr[AFTER_SHAKE]
    way_0, way_1 = t.unseen * bend * abs(p.v[AFTER_DOWN]), t.unseen * bend * abs(p.v[AFTER_UP])
    way_var_0 = unseen * (p.v[AFTER_DOWN] * p.v[AFTER_DOWN] + p.vv[AFTER_DOWN])
    way_var_1 = unseen * (p.v[AFTER_UP] * p.v[AFTER_UP] + p.vv[AFTER_UP])
    memory_0, memory_1 = t.memory * max(r_0, 0.0), t.memory * max(r_1, 0.0)
    for j in range(MODES):
        n = MODES + j
        w_0, w_1, w_2, w_3 = c.from_down[j], c.from_up[j], c.from_rest[j], c.from_shake[j]
        w = w_0 + w_1 + w_2 + w_3
        scale = 1.0 / max(w, LEAST)
        w_0, w_1, w_2, w_3 = w_0 * scale, w_1 * scale, w_2 * scale, w_3 * scale
        rises, falls = 1.0 if j % 2 == 1 and j != SHAKE else 0.0, 1.0 if j % 2 == 0 else 0.0
        rests = 1.0 if j == REST else 0.0
        bent_0, bent_1 = r_0 + rises * way_0, r_1 + falls * way_1
        bent_var_0 = rr_0 + rises * way_var_0 + rests * memory_0 * memory_0
        bent_var_1 = rr_1 + falls * way_var_1 + rests * memory_1 * memory_1
        s = w_0 * s_0 + w_1 * s_1 + w_2 * s_2 + w_3 * s_3
        r = w_0 * bent_0 + w_1 * bent_1 + w_2 * r_2 + w_3 * r_3
        c.w[n], c.s[n], c.r[n] = w, s, r
        c.x3[n] = w_0 * x3_0 + w_1 * x3_1 + w_2 * x3_2 + w_3 * x3_3
        off_0, off_1, off_2, off_3 = s_0 - s, s_1 - s, s_2 - s, s_3 - s
        by_r_0, by_r_1, by_r_2, by_r_3 = bent_0 - r, bent_1 - r, r_2 - r, r_3 - r
        c.ss[n] = (
            w_0 * (ss_0 + off_0 * off_0)
            + w_1 * (ss_1 + off_1 * off_1)
            + w_2 * (ss_2 + off_2 * off_2)
            + w_3 * (ss_3 + off_3 * off_3)
        )
        c.sr[n] = (
            w_0 * (sr_0 + off_0 * by_r_0)
            + w_1 * (sr_1 + off_1 * by_r_1)
            + w_2 * (sr_2 + off_2 * by_r_2)
            + w_3 * (sr_3 + off_3 * by_r_3)
        )
        c.rr[n] = (
            w_0 * (bent_var_0 + by_r_0 * by_r_0)
            + w_1 * (bent_var_1 + by_r_1 * by_r_1)
            + w_2 * (rr_2 + by_r_2 * by_r_2)
            + w_3 * (rr_3 + by_r_3 * by_r_3)
        )


@loop
def released(p: Pools, t: Step) -> float:
    """Probability that a fall that ends does so at no load.

    A share of the falls ends there, the others at a plateau of any height: a mass against a density. The mass counts as
    far as the load may have come to zero in this frame. Now and then the estimate says nothing of the load.
    """
    k = AFTER_DOWN
    of_memory = t.memory * p.r[k] / t.by_move[DOWN]
    var = p.ss[k] + (p.v[k] * p.v[k] + p.vv[k]) * t.dt_s * t.dt_s + of_memory * of_memory + t.floor * t.floor
    at_zero = DENSITY / math.sqrt(max(var, 1e-6)) * math.exp(-0.5 * p.s[k] * p.s[k] / max(var, 1e-6))
    odds = t.release / (1.0 - t.release) * (t.mistake + (1.0 - t.mistake) * at_zero)
    return odds / (1.0 + odds)


@loop
def mix(e: Estimates, c: Candidates, p: Pools, t: Step) -> None:
    """The candidates of every mode: its own estimate, and what comes to it."""
    pool(p, AFTER_REST, e, REST, REST + 1, t)
    pool(p, AFTER_UP, e, HOLD_UP, SHAKE, t)
    pool(p, AFTER_DOWN, e, HOLD_DOWN, SHAKE, t)
    pool(p, AFTER_SHAKE, e, SHAKE, MODES, t)
    shaking = 0.0
    for j in range(SHAKE):
        shaking += e.w[j]
    rests = released(p, t) if p.w[AFTER_DOWN] > 0.0 else 0.0
    for j in range(MODES):
        own, n = e.w[j] * (1.0 - t.leaves[j]), MODES + j
        c.w[j] = above_negligible(own)
        c.s[j], c.r[j], c.v[j], c.x3[j] = e.s[j], e.r[j], e.v[j], e.x3[j]
        c.ss[j], c.sr[j], c.sv[j] = e.ss[j], e.sr[j], e.sv[j]
        c.rr[j], c.rv[j], c.vv[j] = e.rr[j], e.rv[j], e.vv[j]
        falls = p.w[AFTER_DOWN] * t.after_down[j]
        if j == REST:
            falls *= rests / t.release
        elif j in (HOLD_UP, HOLD_DOWN):
            falls *= (1.0 - rests) / (1.0 - t.release)
        c.from_down[j] = above_negligible(falls)
        c.from_up[j] = above_negligible(p.w[AFTER_UP] * t.after_up[j])
        c.from_rest[j] = above_negligible(p.w[AFTER_REST] * t.after_rest[j])
        c.from_shake[j] = above_negligible(p.w[AFTER_SHAKE] * t.after_shake[j])
        c.v[n], c.vv[n] = ENTERS * t.speed[j] * t.sign[j], ENTERS_VAR * t.speed[j] * t.speed[j]
        c.sv[n] = c.rv[n] = 0.0
    changing = p.w[AFTER_DOWN] + p.w[AFTER_UP] + p.w[AFTER_REST]
    if shaking > 0.0 and changing > 0.0:  # any load may, from the pooled estimate of all that has begun to change
        begin_s = shaking * t.shakes / changing
        c.from_down[SHAKE] += begin_s * p.w[AFTER_DOWN]
        c.from_up[SHAKE] += begin_s * p.w[AFTER_UP]
        c.from_rest[SHAKE] += begin_s * p.w[AFTER_REST]
    comes(c, p, t)


@loop
def above_negligible(w: float) -> float:
    """A weight, or 0 of what is dropped."""
    return w if w > NEGLIGIBLE else 0.0


@loop
def predict(c: Candidates, t: Step) -> None:
    """Every candidate after a time step, before its reading: a linear step with noise."""
    for n in range(2 * MODES):
        s, r, v, x3 = c.s[n], c.r[n], c.v[n], c.x3[n]
        ss, sr, sv, rr, rv, vv = c.ss[n], c.sr[n], c.sv[n], c.rr[n], c.rv[n], c.vv[n]
        stays, way, kept = t.stays[n], t.way_s[n], t.kept[n]
        by_s, by_r, by_v = t.by_s[n], t.by_r[n], t.by_v[n]
        c.s[n] = stays * s + way * v
        c.r[n] = by_s * s + by_r * r + by_v * v + t.by_x3[n] * x3
        c.v[n] = kept * v
        c.x3[n] = t.x3_kept * x3 + t.x3_by_s[n] * s + t.x3_by_v[n] * v
        s_s, s_r, s_v = stays * ss + way * sv, stays * sr + way * rv, stays * sv + way * vv
        r_s, r_r = by_s * ss + by_r * sr + by_v * sv, by_s * sr + by_r * rr + by_v * rv
        r_v = by_s * sv + by_r * rv + by_v * vv
        c.ss[n] = stays * s_s + way * s_v + t.noise_ss[n]
        c.sr[n] = by_s * s_s + by_r * s_r + by_v * s_v + t.noise_sr[n]
        c.sv[n] = kept * s_v + t.noise_sv[n]
        c.rr[n] = by_s * r_s + by_r * r_r + by_v * r_v + t.noise_rr[n]
        c.rv[n] = kept * r_v + t.noise_rv[n]
        c.vv[n] = kept * kept * vv + t.noise_vv[n]


@loop
def expect(c: Candidates, t: Step) -> None:
    """Begin the likelihood of every candidate: what lies within the bounds already counts for all of it."""
    for n in range(2 * MODES):
        per_std = 1.0 / math.sqrt(max(c.ss[n], LEAST_VAR))
        to_turn, to_zero = t.sign[n] * c.v[n] / math.sqrt(max(c.vv[n], LEAST_VAR)), c.s[n] * per_std
        to_overload = (t.overload - c.s[n]) * per_std
        goes_on, loaded, usual = above(to_turn), above(to_zero), above(to_overload)
        prior = goes_on if t.sign[n] != 0.0 and abs(to_turn) < FAR else 1.0
        of_load = max(loaded, 0.5) if abs(to_zero) < FAR else 1.0
        of_load *= OVERLOADS + (1.0 - OVERLOADS) * usual if to_overload < FAR else 1.0
        c.likelihood[n], c.distance[n] = 1.0 / (prior * (of_load if t.stays[n] != 0.0 else 1.0)), 0.0
    for n in range(2 * MODES):
        if c.s[n] > 1.0:
            c.likelihood[n] /= rarity(c.s[n], t)


@loop
def rarity(s: float, t: Step) -> float:
    """Density of a load, over that of loads up to full scale."""
    return decay((1.0 - s) / t.scarce) if s > 1.0 else 1.0


@loop
def move(c: Candidates, n: int, s: float, r: float, v: float, off: float, less: float) -> None:
    """Move a candidate by ``off`` along (s, r, v), and take ``less`` of its variance there: an update of rank one."""
    c.s[n] += s * off
    c.r[n] += r * off
    c.v[n] += v * off
    c.ss[n] -= s * s * less
    c.sr[n] -= s * r * less
    c.sv[n] -= s * v * less
    c.rr[n] -= r * r * less
    c.rv[n] -= r * v * less
    c.vv[n] -= v * v * less


@loop
def truncated(z: float, rare: float) -> tuple[float, float, float]:
    """A standard normal density that counts above -z, and by ``rare`` below: its mass, mean, and loss of variance."""
    near = max(z, -DEEP)
    bell = decay(-0.5 * near * near)
    inside = rare + (1.0 - rare) * mass(near, bell)
    hazard = (1.0 - rare) * DENSITY * bell / inside
    less = min(hazard * (hazard + z), 0.98)
    return inside, hazard if z >= -DEEP or rare > 0.0 else -z, less if z >= -DEEP or rare > 0.0 else 0.0


@loop
def take_exact(c: Candidates, low: float, high: float, var: float, t: Step) -> None:
    """Condition every candidate on a reading of noise ``var`` in an interval that is narrow beside it.

    A Kalman update. Its density is a factor of the likelihood, and an exponent.
    """
    middle, of_width = 0.5 * (low + high), (high - low) * (high - low) * (1.0 / 12.0)
    for n in range(2 * MODES):
        expected = max(c.rr[n] + var + t.swings[n] * (c.v[n] * c.v[n] + c.vv[n]), LEAST_VAR)
        wide, off = expected + of_width, middle - c.r[n]
        c.likelihood[n] *= DENSITY / math.sqrt(wide)
        c.distance[n] = 0.5 * off * off / wide
        gain, less = off / wide, 1.0 / wide
        move(c, n, c.sr[n], c.rr[n], c.rv[n], gain, less)


@loop
def take_interval(c: Candidates, low: float, high: float, var: float, t: Step) -> None:
    """Condition every candidate on a reading of noise ``var`` between ``low`` and ``high`` (Curry 1970).

    Moments of the truncated normal distribution, or of its tail; a narrow interval is a Kalman update. The density of
    the reading, per r, is a factor of the likelihood, and an exponent.
    """
    middle, width = 0.5 * (low + high), high - low
    of_width = width * width * (1.0 / 12.0)
    for n in range(2 * MODES):
        expected = max(c.rr[n] + var + t.swings[n] * (c.v[n] * c.v[n] + c.vv[n]), LEAST_VAR)
        wide, off, std = expected + of_width, middle - c.r[n], math.sqrt(expected)
        per_wide, per_std = 1.0 / wide, 1.0 / std
        to_low, to_high = (low - c.r[n]) * per_std, (high - c.r[n]) * per_std
        bell_low, bell_high = decay(-0.5 * to_low * to_low), decay(-0.5 * to_high * to_high)
        inside = max(mass(to_high, bell_high) - mass(to_low, bell_low), 1e-12)
        shift = DENSITY * (bell_low - bell_high) / inside
        spread = max(1.0 - shift * shift + DENSITY * (to_low * bell_low - to_high * bell_high) / inside, 1e-3)
        near = to_low if to_low > 5.0 else to_high
        narrow, far = width < NARROW * std, to_low > 5.0 or to_high < -5.0
        truncated = inside / min(width, 1.0)
        factor = DENSITY * math.sqrt(per_wide) if narrow else DENSITY / (abs(near) * width) if far else truncated
        c.likelihood[n] *= factor
        c.distance[n] = 0.5 * off * off * per_wide if narrow else 0.5 * near * near if far else 0.0
        gain = off * per_wide if narrow else (near if far else shift) * per_std
        less = per_wide if narrow else (1.0 - (0.02 if far else spread)) * per_std * per_std
        move(c, n, c.sr[n], c.rr[n], c.rv[n], gain, less)


@loop
def bound_speed(c: Candidates, t: Step) -> None:
    """Truncate every candidate whose mode fixes the sign of its speed; what is left is a factor of its likelihood."""
    for n in range(2 * MODES):
        side, var = t.sign[n], max(c.vv[n], LEAST_VAR)
        per_std = 1.0 / math.sqrt(var)
        z = side * c.v[n] * per_std
        inside, hazard, less = truncated(z, 0.0)
        felt, deep = side != 0.0 and z <= FAR, z < -DEEP
        gain, less = side * hazard * per_std if felt else 0.0, less * per_std * per_std if felt else 0.0
        c.likelihood[n] *= inside if felt else 1.0
        move(c, n, c.sv[n], c.rv[n], c.vv[n], gain, less)
        beyond = 0.0 if felt and deep else 1.0  # the moments of so little are those of the bound itself
        c.v[n] *= beyond
        c.sv[n] *= beyond
        c.rv[n] *= beyond
        c.vv[n] *= beyond


@loop
def bound_load(c: Candidates, t: Step) -> None:
    """Truncate every candidate at no load, but for those at rest, likewise."""
    for n in range(2 * MODES):
        var = max(c.ss[n], LEAST_VAR)
        per_std = 1.0 / math.sqrt(var)
        z = c.s[n] * per_std
        inside, hazard, less = truncated(z, 0.0)
        felt, deep = t.stays[n] != 0.0 and z <= FAR, z < -DEEP
        gain, less = hazard * per_std if felt else 0.0, less * per_std * per_std if felt else 0.0
        c.likelihood[n] *= inside if felt else 1.0
        move(c, n, c.ss[n], c.sr[n], c.sv[n], gain, less)
        beyond = 0.0 if felt and deep else 1.0
        c.s[n] *= beyond
        c.ss[n] *= beyond
        c.sr[n] *= beyond
        c.sv[n] *= beyond


@loop
def bound_overload(c: Candidates, t: Step) -> None:
    """Make loads beyond the heaviest usual one rare, and those beyond full scale scarce."""
    for n in range(2 * MODES):
        over, var = t.overload - c.s[n], max(c.ss[n], LEAST_VAR)
        if t.stays[n] == 0.0 or c.w[n] == 0.0:
            continue
        if over <= 0.0 or over * over <= FAR * FAR * var:
            per_std = 1.0 / math.sqrt(var)
            z = over * per_std
            inside, hazard, less = truncated(z, OVERLOADS)
            gain, less = -hazard * per_std, less * per_std * per_std
            c.likelihood[n] *= inside
            move(c, n, c.ss[n], c.sr[n], c.sv[n], gain, less)
        c.likelihood[n] *= rarity(c.s[n], t)


@loop
def advance(
    e: Estimates, c: Candidates, p: Pools, t: Step, known: bool, low: float, high: float, var: float, forget: float
) -> float:
    """Take one reading between ``low`` and ``high`` with noise ``var``; returns the logarithm of its density.

    ``forget``: share of the evidence for the modes that is kept; 1: all.
    """
    mix(e, c, p, t)
    predict(c, t)
    expect(c, t)
    if known and high - low < NARROW * math.sqrt(var):
        take_exact(c, low, high, var, t)
    elif known:
        take_interval(c, low, high, var, t)
    bound_speed(c, t)
    bound_load(c, t)
    bound_overload(c, t)
    nearest, total = 1e300, 0.0
    for n in range(2 * MODES):
        if c.w[n] > 0.0:
            nearest = min(nearest, c.distance[n])
    for n in range(2 * MODES):
        w = c.w[n] * c.likelihood[n] * decay(min(nearest - c.distance[n], 0.0))
        c.w[n] = w if c.w[n] > 0.0 else 0.0
    for n in range(2 * MODES):
        total += c.w[n]
    merge(e, c, 1.0 / total, t, forget)
    return math.log(total) - nearest


@loop
def merge(e: Estimates, c: Candidates, scale: float, t: Step, forget: float) -> None:
    """Merge the two candidates of every mode; weights become probabilities."""
    for j in range(MODES):
        n = MODES + j
        own, come = c.w[j], c.w[n]
        w = own + come
        per_w = 1.0 / max(w, LEAST)
        part = come * per_w
        both, alive = part * own * per_w, w > 0.0
        s, r, v = c.s[n] - c.s[j], c.r[n] - c.r[j], c.v[n] - c.v[j]
        c.w[j] = w * scale
        # An estimate that has no weight is none, so that it never becomes something that is no number.
        c.s[j] = c.s[j] + part * s if alive else 0.0
        c.r[j] = c.r[j] + part * r if alive else 0.0
        c.v[j] = c.v[j] + part * v if alive else 0.0
        c.x3[j] = c.x3[j] + part * (c.x3[n] - c.x3[j]) if alive else 0.0
        c.ss[j] = c.ss[j] + part * (c.ss[n] - c.ss[j]) + both * s * s if alive else 0.0
        c.sr[j] = c.sr[j] + part * (c.sr[n] - c.sr[j]) + both * s * r if alive else 0.0
        c.sv[j] = c.sv[j] + part * (c.sv[n] - c.sv[j]) + both * s * v if alive else 0.0
        c.rr[j] = c.rr[j] + part * (c.rr[n] - c.rr[j]) + both * r * r if alive else 0.0
        c.rv[j] = c.rv[j] + part * (c.rv[n] - c.rv[j]) + both * r * v if alive else 0.0
        c.vv[j] = c.vv[j] + part * (c.vv[n] - c.vv[j]) + both * v * v if alive else 0.0
    total = 0.0
    for j in range(MODES):
        w = c.w[j]
        if forget < 1.0 and w > 0.0:
            w = t.usual[j] * math.pow(max(w, 1e-12) / t.usual[j], forget)
        e.w[j] = w
        total += w
    for j in range(MODES):
        e.w[j] /= total
        e.s[j], e.r[j], e.v[j], e.x3[j] = c.s[j], c.r[j], c.v[j], c.x3[j]
        e.ss[j], e.sr[j], e.sv[j] = c.ss[j], c.sr[j], c.sv[j]
        e.rr[j], e.rv[j], e.vv[j] = c.rr[j], c.rv[j], c.vv[j]


@loop
def mean_of(e: Estimates) -> float:
    """Mean load."""
    mean = 0.0
    for j in range(MODES):
        mean += e.w[j] * e.s[j]
    return mean


@loop
def variance_of(e: Estimates, mean: float, t: Step) -> float:
    """Variance of the load about ``mean``, swings within the frame included."""
    var = total = 0.0
    for j in range(MODES):
        off = e.s[j] - mean
        w = e.w[j] * e.w[j] / (e.w[j] + TAIL)
        swing = t.swing_s * e.v[SHAKE] if j == SHAKE else 0.0
        var += w * (e.ss[j] + off * off + swing * swing)
        total += w
    return var / total


@loop
def begin(e: Estimates, r: float, geq: float, gu: float, g3: float) -> None:
    """A cell whose first reading is ``r``: at rest, or pressed for a time that is not known.

    A load that has just risen gives ``gu`` times the load, one that has been held for long ``geq`` times; in the
    recovery phase as much may remain of a load that was heavier. At rest an exponential share may remain.
    """
    up, down = 2.0 * max(r, 0.0) / (geq + gu), max(r, 0.0) / gu
    spread = max(r, 0.0) * (1.0 / geq - 1.0 / gu) / math.sqrt(12.0)
    for j in range(MODES):
        s = 0.0 if j == REST else up if j % 2 == 1 else down
        e.w[j] = 0.0
        e.s[j], e.r[j], e.v[j], e.x3[j] = s, r, 0.0, max(r, 0.0) / geq * g3
        e.ss[j], e.rr[j] = 0.0 if j == REST else spread * spread * (1.0 if j % 2 == 1 else 4.0) + 1e-4, 1e-6
        e.sr[j] = e.sv[j] = e.rv[j] = e.vv[j] = 0.0
    rests = RESTING * math.exp(-max(r, 0.0) / (REMAINS * geq)) / REMAINS
    held = 1.0 - RESTING
    e.w[REST], e.w[1], e.w[2] = rests / (rests + held), 0.8 * held / (rests + held), 0.2 * held / (rests + held)


class Reading(Record):
    """What a frame says of a cell, and what the filter makes of it; scratch of a frame."""

    known: float
    """1: it was read; 0: not; -1: never"""
    low: float
    """the reading lies between these r"""
    high: float
    variance: float
    """of its noise"""
    slope: float
    """dr/dG"""
    shared: float
    """signed standard deviation of the quantisation that its column shares, and the most of it that lasts"""
    held: float
    lasting: float
    """variance of what else no average lessens"""
    off: float
    """scratch of :func:`.share_each`"""
    spread: float
    load: float
    """mean, and its variance"""
    load_variance: float
    believed: float
    """0: it seems to be of a bad contact, and the load is that of before"""


class Watch(Record):
    """What is known of a cell beside its :class:`Estimates`."""

    odds: float
    """logarithm of the odds that the contact is bad since ``since_s``; 0 and no time: it is good"""
    since_s: float
    asleep: float
    """1 while the cell is at rest and only watched"""
    offset: float
    """r by drift of the rest resistance, as the cell last slept; never changes under a load"""
    left: float
    """r that is left of earlier loads while the cell sleeps, and the slow branch of it"""
    left_x3: float
    cusum: float
    """Page's cumulative sum of its departures towards loads, in standard deviations"""


@loop
def copy(e: Estimates, of: Estimates) -> None:
    """Make ``e`` the same as ``of``."""
    for j in range(MODES):
        e.w[j], e.s[j], e.r[j], e.v[j], e.x3[j] = of.w[j], of.s[j], of.r[j], of.v[j], of.x3[j]
        e.ss[j], e.sr[j], e.sv[j], e.rr[j], e.rv[j], e.vv[j] = (
            of.ss[j],
            of.sr[j],
            of.sv[j],
            of.rr[j],
            of.rv[j],
            of.vv[j],
        )


@loop
def jumps(e: Estimates, low: float, high: float, var: float) -> bool:
    """Whether a reading is far from all that was expected."""
    mean = spread = 0.0
    for j in range(MODES):
        mean += e.w[j] * e.r[j]
    for j in range(MODES):
        off = e.r[j] - mean
        spread += e.w[j] * (e.rr[j] + off * off)
    off = max(low - mean, mean - high)
    return off > 0.0 and off * off > SURPRISE * SURPRISE * (var + spread)


@loop
def follow(
    e: Estimates,
    before: Estimates,
    watch: Watch,
    c: Candidates,
    p: Pools,
    trial: Estimates,
    t: Step,
    known: bool,
    low: float,
    high: float,
    var: float,
    forget: float,
) -> None:
    """Take a reading of a cell whose contact may be bad."""
    suspected = watch.since_s > 0.0
    # A load that is taken for one may lose its contact, too.
    anew = known and (not suspected or watch.odds < 0.0) and jumps(e, low, high, var)
    if anew:
        copy(trial, e)
    density = advance(e, c, p, t, known, low, high, var, forget)
    if suspected:
        advance(before, c, p, t, False, low, high, var, 1.0)
        watch.since_s += t.dt_s
        if known and not jumps(before, low, high, var):
            if not anew:
                copy(trial, before)
            returns = before if anew else trial
            returned = advance(returns, c, p, t, known, low, high, var, 1.0)
            if watch.odds + t.bad_ends + returned - density > 0.0:
                copy(e, returns)
                watch.odds, watch.since_s = 0.0, 0.0
                return
        if known:
            watch.odds -= t.dt_s / t.bad_s
    if anew:
        copy(before, trial)
        watch.odds, watch.since_s = t.bad_prior - density, t.dt_s
    if watch.odds < HOPELESS or watch.since_s > LASTING * t.bad_s:
        watch.odds, watch.since_s = 0.0, 0.0


@loop
def expects(e: Estimates, watch: Watch, t: Step) -> tuple[float, float]:
    """Mean and variance of the next r of a cell, to first order in the step."""
    if watch.asleep > 0.0:
        return watch.offset + watch.left, 0.0
    mean = spread = 0.0
    for j in range(MODES):
        mean += e.w[j] * e.r[j]
    for j in range(MODES):
        off = e.r[j] - mean
        way = t.by_move[j] * t.way_s[j]
        spread += e.w[j] * (e.rr[j] + off * off + way * way * (e.v[j] * e.v[j] + e.vv[j]))
    return mean + watch.offset, spread


@loop
def step_each(
    cells: Records[Estimates],
    befores: Records[Estimates],
    watches: Records[Watch],
    scratch: Records[Candidates],
    pools: Records[Pools],
    trial: Records[Estimates],
    steps: Records[Step],
    readings: Records[Reading],
    sleeps: Row,
    beside: PlaceRows,
    loads: Rows,
    sudden: float,
    forget: float,
) -> None:
    """Take a frame of n cells; writes loads.

    Args:
        cells: (n,) estimates; before a bad contact, if it is one, in ``befores``; and the rest of their states.
        befores: see ``cells``.
        watches: see ``cells``.
        scratch: (1,) of the kernel; ``pools`` and ``trial`` likewise.
        pools: see ``scratch``.
        trial: see ``scratch``.
        steps: (1,) weights of the time step.
        readings: (n,)
        sleeps: (n,) 1 where a cell may sleep.
        beside: (n, most) cells beside each; n: none.
        loads: (3, n) scratch: loads that readings tell, for :mod:`._neighbours`.
        sudden: see :class:`~._modes.Tuning`.
        forget: share of the evidence for modes that is kept.

    """
    t, c, p = steps[0], scratch[0], pools[0]
    for i in range(cells.size):
        reading = readings[i]
        known, width, var = reading.known > 0.0, reading.high - reading.low, reading.variance
        loads[LOAD, i], loads[VARIANCE, i], loads[BELIEVED, i] = 0.0, 0.0, max(reading.known, 0.0)
        if reading.known < 0.0:
            continue
        e, before, watch = cells[i], befores[i], watches[i]
        if watch.asleep > 0.0:
            if known and rests(watch, t, reading.low, reading.high, var):
                loads[VARIANCE, i] = (var + width * width * (1.0 / 12.0)) / (t.gain * t.gain)
                continue
            watch.asleep, e.r[REST], e.x3[REST] = 0.0, watch.left, watch.left_x3
        low, high = reading.low - watch.offset, reading.high - watch.offset
        follow(e, before, watch, c, p, trial[0], t, known, low, high, var, forget)
        mean = mean_of(e)
        loads[LOAD, i], loads[VARIANCE, i] = mean, variance_of(e, mean, t)
        if watch.since_s == 0.0 and sleeps[i] > 0.0 and forget < 1.0 and known and settled(e, var, width):
            watch.asleep, watch.left, watch.left_x3, watch.cusum = 1.0, e.r[REST], e.x3[REST], 0.0
    for i in range(cells.size):
        watch, reading = watches[i], readings[i]
        if reading.known < 0.0:
            continue
        mean, spread, reading.believed = loads[LOAD, i], loads[VARIANCE, i], 1.0
        if watch.since_s > 0.0:
            other = mean_of(befores[i])
            other_spread, odds = variance_of(befores[i], other, t), watch.odds
            usual, about = prior(i, beside, loads)
            if about >= 0.0:
                odds += math.log(
                    agreement(other, other_spread, usual, about, sudden) / agreement(mean, spread, usual, about, sudden)
                )
            bad = 1.0 / (1.0 + math.exp(-odds))
            bad = bad * bad / (bad + TAIL)
            off = other - mean
            spread += bad * (other_spread - spread)
            if watch.odds > 0.0:
                mean, reading.believed, spread = other, 0.0, spread + (1.0 - bad) * off * off
            else:  # what a cell reads is shown at once; neighbours tell how far it is to be believed
                spread += bad * off * off
        beyond = max(mean - 1.0, 0.0) * t.extrapolated
        reading.load = mean
        reading.load_variance = spread + t.floor * t.floor + t.relative * t.relative * mean * mean + beyond * beyond


@loop
def settled(e: Estimates, var: float, width: float) -> bool:
    """Whether a cell is at rest: for sure, or with no memory that the noise does not hide."""
    noise = var + width * width * (1.0 / 12.0)
    return bool(e.w[REST] > SURE or (e.w[REST] > RESTS and e.r[REST] * e.r[REST] < 1e-6 + 0.3 * noise))


@loop
def rests(watch: Watch, t: Step, low: float, high: float, var: float) -> bool:
    """Whether a sleeping cell goes on sleeping (Page 1954): reads what is left of earlier loads, which fades."""
    std = math.sqrt(var + (high - low) * (high - low) * (1.0 / 12.0))
    left = t.by_r[REST] * watch.left + t.by_x3[REST] * watch.left_x3
    off = (0.5 * (low + high) - watch.offset - left) / std
    watch.cusum = max(watch.cusum + off - 0.5, 0.0)
    sleeps = abs(off) < WAKES and watch.cusum < WAKES
    if sleeps:
        watch.left, watch.left_x3 = left, watch.left_x3 * t.x3_kept
        if t.drift_var > 0.0:  # of readings at rest alone, and where the rest resistance drifts at all
            watch.offset += (off * std) * min(t.dt_s / DRIFTS_S, 1.0)
    return bool(sleeps)


SURPRISE = 6.0
"""standard deviations from what was expected, from which a bad contact is suspected"""
HOPELESS = -12.0
"""logarithm of the odds at which no contact is suspected any more"""
LASTING = 5.0
"""usual times of a bad contact, after which what is read counts as a load"""
RESTS, SURE = 0.5, 0.998
"""probabilities of rest from which a cell sleeps that remembers nothing, or that fades as the model says"""
WAKES, DRIFTS_S = 4.0, 3.0
"""standard deviations, and their sum, at which a cell wakes; and s, in which the offset of a sleeping cell follows"""
