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
from ...common.compiled import Record, Records, Row, loop
from ._modes import (
    CREEP_DOWN,
    DOWN,
    EACH,
    HOLD_DOWN,
    HOLD_UP,
    MODES,
    REST,
    SHAKE,
    UP,
    Step,
)

TWICE = Annotated[FloatArray, 2 * MODES]


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
    reading_var: TWICE
    distance: TWICE


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
OVERLOADS = 1e-3
"""density of loads beyond an overload, over that of others"""
LEAST_LOG = -300.0
"""of a density"""
RESTING, REMAINS = 0.7, 0.1
"""probability that a cell begins at rest; and mean of what is left of earlier loads then, over r at full scale"""
DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
ENTERS, ENTERS_VAR = 0.8, 0.36
"""mean and variance of the speed of a motion that begins, over its usual speed: of a half-normal variable"""


@loop
def mass(z: float, bell: float) -> float:
    """Probability that a standard normal variable exceeds -z, with ``bell`` = exp(-z^2/2).

    Mills' ratio as a rational function, fitted for z from -8 to 8 with a relative error of 1.3e-9. The error function
    takes several times as long, by exponentials of its own.
    """
    x = abs(z)
    above = ((0.0034137124178799327 * x + 0.03575450193849128) * x + 0.1684901690573697) * x + 0.41788844846365136
    below = ((0.008556492980906077 * x + 0.08963991248159844) * x + 0.43059581096618055) * x + 1.140452334970459
    tail = bell * (above * x + 0.5000000006490767) / ((below * x + 1.6336615620685102) * x + 1.0)
    return 1.0 - tail if z > 0.0 else tail


@loop
def above(z: float) -> float:
    """Probability that a standard normal variable exceeds -z; at least that of z = -8."""
    z = max(z, -DEEP)
    return mass(z, math.exp(-0.5 * z * z))


@loop
def pool(p: Pools, k: int, w: float, e: Estimates, j: int) -> None:
    """Merge the estimate of mode ``j`` with weight ``w`` into pool ``k``: moments of the mixture."""
    total = p.w[k] + w
    own, part = p.w[k] / total, w / total
    both = own * part
    s, r, v = e.s[j] - p.s[k], e.r[j] - p.r[k], e.v[j] - p.v[k]
    p.w[k] = total
    p.s[k] += part * s
    p.r[k] += part * r
    p.v[k] += part * v
    p.x3[k] += part * (e.x3[j] - p.x3[k])
    p.ss[k] += part * (e.ss[j] - p.ss[k]) + both * s * s
    p.sr[k] += part * (e.sr[j] - p.sr[k]) + both * s * r
    p.sv[k] += part * (e.sv[j] - p.sv[k]) + both * s * v
    p.rr[k] += part * (e.rr[j] - p.rr[k]) + both * r * r
    p.rv[k] += part * (e.rv[j] - p.rv[k]) + both * r * v
    p.vv[k] += part * (e.vv[j] - p.vv[k]) + both * v * v


@loop
def comes(c: Candidates, n: int, w: float, p: Pools, k: int, turns: bool, rests: bool, speed: float, t: Step) -> None:
    """Merge what comes from pool ``k`` with weight ``w`` into candidate ``n``, which begins to move with ``speed``.

    Where the phase changes within the frame, ``bend`` times the way before the turn is added to r.
    """
    r, rr = p.r[k], p.rr[k]
    if turns:
        bend = t.bend * t.dt_s
        r += t.unseen * bend * abs(p.v[k])
        bend *= t.unseen_std
        rr += bend * bend * (p.v[k] * p.v[k] + p.vv[k])
    if rests:
        off = t.memory * max(p.r[k], 0.0)
        rr += off * off
    total = c.w[n] + w
    own, part = c.w[n] / total, w / total
    both = own * part
    off_s, off_r = p.s[k] - c.s[n], r - c.r[n]
    c.w[n] = total
    c.s[n] += part * off_s
    c.r[n] += part * off_r
    c.v[n] = ENTERS * speed
    c.x3[n] += part * (p.x3[k] - c.x3[n])
    c.ss[n] += part * (p.ss[k] - c.ss[n]) + both * off_s * off_s
    c.sr[n] += part * (p.sr[k] - c.sr[n]) + both * off_s * off_r
    c.rr[n] += part * (rr - c.rr[n]) + both * off_r * off_r
    c.sv[n], c.rv[n], c.vv[n] = 0.0, 0.0, ENTERS_VAR * speed * speed


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
    for k in range(4):
        p.w[k] = p.s[k] = p.r[k] = p.v[k] = p.x3[k] = 0.0
        p.ss[k] = p.sr[k] = p.sv[k] = p.rr[k] = p.rv[k] = p.vv[k] = 0.0
    shaking = 0.0
    for j in range(MODES):
        w = e.w[j] * t.leaves[j]
        if w > NEGLIGIBLE:
            pool(p, AFTER_REST if j == REST else AFTER_SHAKE if j == SHAKE else phase_of(j), w, e, j)
        if j != SHAKE:
            shaking += e.w[j]
    rests = released(p, t) if p.w[AFTER_DOWN] > 0.0 else 0.0
    for j in range(MODES):
        own, n = e.w[j] * (1.0 - t.leaves[j]), MODES + j
        c.w[j] = own
        if own > NEGLIGIBLE:
            c.s[j], c.r[j], c.v[j], c.x3[j] = e.s[j], e.r[j], e.v[j], e.x3[j]
            c.ss[j], c.sr[j], c.sv[j] = e.ss[j], e.sr[j], e.sv[j]
            c.rr[j], c.rv[j], c.vv[j] = e.rr[j], e.rv[j], e.vv[j]
        c.w[n] = c.s[n] = c.r[n] = c.x3[n] = c.ss[n] = c.sr[n] = c.rr[n] = 0.0
        speed = t.speed[j] * sign_of(j)
        falls = p.w[AFTER_DOWN] * t.after_down[j]
        if j == REST:
            falls *= rests / t.release
        elif j in (HOLD_UP, HOLD_DOWN):
            falls *= (1.0 - rests) / (1.0 - t.release)
        if falls > NEGLIGIBLE:
            comes(c, n, falls, p, AFTER_DOWN, phase_of(j) == UP, j == REST, speed, t)
        if p.w[AFTER_UP] * t.after_up[j] > NEGLIGIBLE:
            comes(c, n, p.w[AFTER_UP] * t.after_up[j], p, AFTER_UP, phase_of(j) == DOWN, j == REST, speed, t)
        if p.w[AFTER_REST] * t.after_rest[j] > NEGLIGIBLE:
            comes(c, n, p.w[AFTER_REST] * t.after_rest[j], p, AFTER_REST, False, False, speed, t)
        if p.w[AFTER_SHAKE] * t.after_shake[j] > NEGLIGIBLE:
            comes(c, n, p.w[AFTER_SHAKE] * t.after_shake[j], p, AFTER_SHAKE, False, False, speed, t)
    if shaking > 0.0:  # any load may begin to shake, from the pooled estimate of all that has begun to change
        for k in range(3):
            w = p.w[k]
            if w > NEGLIGIBLE:
                part = w / (p.w[0] + p.w[1] + p.w[2])
                comes(c, MODES + SHAKE, shaking * t.shakes * part, p, k, False, False, t.speed[SHAKE], t)


@loop
def phase_of(j: int) -> int:
    """Phase of a mode: even ones recover, odd ones rise."""
    return 2 if j == SHAKE else UP if j % 2 == 1 else DOWN


@loop
def sign_of(j: int) -> float:
    """Sign of the speed in a mode; 0: it does not move."""
    if j == SHAKE:
        return 1.0
    if j < CREEP_DOWN - 1:
        return 0.0
    return 1.0 if j % 2 == 1 else -1.0


@loop
def predict(c: Candidates, n: int, j: int, t: Step) -> None:
    """Candidate ``n`` of mode ``j`` after a time step, before its reading."""
    phase = phase_of(j)
    s, r, v, x3 = c.s[n], c.r[n], c.v[n], c.x3[n]
    ss, sr, sv, rr, rv, vv = c.ss[n], c.sr[n], c.sv[n], c.rr[n], c.rv[n], c.vv[n]
    by_s, by_r, move = t.by_s[phase], t.by_r[phase], t.by_move[phase]
    if j == REST:  # what was left of the load has gone within the step
        by_s -= move
        c.s[n] = c.v[n] = c.ss[n] = c.sr[n] = c.sv[n] = c.rv[n] = c.vv[n] = 0.0
        c.r[n] = by_s * s + by_r * r + t.by_x3[phase] * x3
        c.rr[n] = by_s * by_s * ss + 2.0 * by_s * by_r * sr + by_r * by_r * rr + t.drift_var
        c.x3[n] = t.x3_kept * x3 + (t.x3_by_s - t.x3_by_move) * s
        return
    way, by_v = t.way_s[j], move * t.way_s[j]
    if j == SHAKE:
        by_v = 0.5 * t.bend * t.dt_s
    c.s[n] = s + way * v
    c.r[n] = by_s * s + by_r * r + t.by_x3[phase] * x3 + by_v * v
    c.v[n] = t.kept[j] * v
    c.x3[n] = t.x3_kept * x3 + t.x3_by_s * s + t.x3_by_move * way * v
    s_s, s_r, s_v = ss + way * sv, sr + way * rv, sv + way * vv
    r_s, r_r, r_v = (
        by_s * ss + by_r * sr + by_v * sv,
        by_s * sr + by_r * rr + by_v * rv,
        by_s * sv + by_r * rv + by_v * vv,
    )
    c.ss[n] = s_s + way * s_v + t.way_var[j]
    c.sr[n] = by_s * s_s + by_r * s_r + by_v * s_v + move * t.way_var[j]
    c.sv[n] = t.kept[j] * s_v + t.way_speed[j]
    c.rr[n] = by_s * r_s + by_r * r_r + by_v * r_v + move * move * t.way_var[j] + t.drift_var
    c.rv[n] = t.kept[j] * r_v + move * t.way_speed[j]
    c.vv[n] = t.kept[j] * t.kept[j] * vv + t.speed_var[j]


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
def bound(c: Candidates, n: int, of_speed: bool, at: float, side: float, rare: float) -> float:
    """Weigh what is beyond a bound of the load, or of the speed, by ``rare``; returns the weight that is left.

    The density is multiplied by 1 on the ``side`` of the bound and by ``rare`` beyond it. 0 truncates; a small number
    leaves an estimate alone that is beyond for sure.
    """
    mean, var = (c.v[n], c.vv[n]) if of_speed else (c.s[n], c.ss[n])
    off = side * (mean - at)
    if off > 0.0 and off * off > FAR * FAR * var:
        return 1.0
    std = math.sqrt(max(var, 1e-18))
    z = off / std
    bell = math.exp(-0.5 * z * z)
    s, r, v = (c.sv[n], c.rv[n], c.vv[n]) if of_speed else (c.ss[n], c.sr[n], c.sv[n])
    inside = rare + (1.0 - rare) * (mass(z, bell) if z > -DEEP else above(-DEEP))
    if z < -DEEP and rare == 0.0:  # the moments of so little are those of the bound itself
        gain = (at - mean) / (std * std)
        move(c, n, s, r, v, gain, 0.0)
        if of_speed:
            c.v[n], c.sv[n], c.rv[n], c.vv[n] = at, 0.0, 0.0, 0.0
        else:
            c.s[n], c.ss[n], c.sr[n], c.sv[n] = at, 0.0, 0.0, 0.0
        return inside
    hazard = (1.0 - rare) * DENSITY * bell / inside
    left = max(1.0 - hazard * (hazard + z), 0.02)
    gain, less = side * hazard / std, (1.0 - left) / (std * std)
    move(c, n, s, r, v, gain, less)
    return inside


@loop
def within(c: Candidates, n: int, var: float, low: float, high: float) -> None:
    """Condition a candidate on a reading of variance ``var`` between ``low`` and ``high``."""
    width, std, centre = high - low, math.sqrt(var), c.r[n]
    if width < 0.7 * std:
        wide = var + width * width * (1.0 / 12.0)
        off, left = var / wide * (0.5 * (low + high) - centre), var - var * var / wide
    else:
        to_low, to_high = (low - centre) / std, (high - centre) / std
        if to_low > 5.0 or to_high < -5.0:
            off, left = (to_low if to_low > 5.0 else to_high) * std, 0.02 * var
        else:
            below = DENSITY * math.exp(-0.5 * to_low * to_low) if to_low > -30.0 else 0.0
            beyond = DENSITY * math.exp(-0.5 * to_high * to_high) if to_high < 30.0 else 0.0
            inside = max(above(to_high) - above(to_low), 1e-12)
            shift = (below - beyond) / inside
            spread = 1.0 - shift * shift
            spread += (to_low * below if to_low > -30.0 else 0.0) / inside
            spread -= (to_high * beyond if to_high < 30.0 else 0.0) / inside
            off, left = shift * std, max(spread, 1e-3) * var
    s, r, v = c.sr[n] / var, c.rr[n] / var, c.rv[n] / var
    less = var - left
    move(c, n, s, r, v, off, less)


@loop
def judge(centre: float, var: float, low: float, high: float) -> tuple[float, float]:
    """Density of a reading between ``low`` and ``high``, per r, as a factor and a negative exponent."""
    width, std = high - low, math.sqrt(var)
    if width < 0.7 * std:
        wide = var + width * width * (1.0 / 12.0)
        off = 0.5 * (low + high) - centre
        return DENSITY / math.sqrt(wide), 0.5 * off * off / wide
    to_low, to_high = (low - centre) / std, (high - centre) / std
    if to_low > 5.0 or to_high < -5.0:
        z = to_low if to_low > 5.0 else to_high
        return DENSITY / (abs(z) * width), 0.5 * z * z
    inside = max(above(to_high) - above(to_low), 1e-12)
    return inside / min(width, 1.0), 0.0


@loop
def advance(
    e: Estimates, c: Candidates, p: Pools, t: Step, known: bool, low: float, high: float, var: float, forget: float
) -> float:
    """Take one reading between ``low`` and ``high`` with noise ``var``; returns the logarithm of its density.

    ``forget``: share of the evidence for the modes that is kept; 1: all.
    """
    mix(e, c, p, t)
    for n in range(2 * MODES):
        j = n % MODES
        if c.w[n] <= NEGLIGIBLE:
            c.w[n] = 0.0
            continue
        predict(c, n, j, t)
        prior = 1.0
        sign = sign_of(j)
        if sign != 0.0 and c.v[n] * c.v[n] < FAR * FAR * c.vv[n]:
            prior = above(sign * c.v[n] / math.sqrt(c.vv[n]))
        if j != REST:
            if c.s[n] * c.s[n] < FAR * FAR * c.ss[n]:
                prior *= max(above(c.s[n] / math.sqrt(c.ss[n])), 0.5)
            over = t.overload - c.s[n]
            if over < 0.0 or over * over < FAR * FAR * c.ss[n]:
                prior *= OVERLOADS + (1.0 - OVERLOADS) * above(over / math.sqrt(max(c.ss[n], 1e-18)))
            if c.s[n] > 1.0:
                prior *= math.exp(max((1.0 - c.s[n]) / t.scarce, LEAST_LOG))
        c.likelihood[n] = 1.0 / prior
        c.distance[n] = 0.0
        if known:
            of_reading = c.rr[n] + var
            if j == SHAKE:
                of_reading += t.swing * t.swing * (c.v[n] * c.v[n] + c.vv[n])
            c.reading_var[n] = of_reading
    nearest = 1e300
    for n in range(2 * MODES):
        if c.w[n] == 0.0:
            continue
        j = n % MODES
        if known:
            factor, distance = judge(c.r[n], c.reading_var[n], low, high)
            c.likelihood[n] *= factor
            c.distance[n] = distance
            within(c, n, c.reading_var[n], low, high)
        sign = sign_of(j)
        if sign != 0.0:
            c.likelihood[n] *= bound(c, n, True, 0.0, sign, 0.0)
        if j != REST:
            c.likelihood[n] *= bound(c, n, False, 0.0, 1.0, 0.0) * bound(c, n, False, t.overload, -1.0, OVERLOADS)
            if c.s[n] > 1.0:
                c.likelihood[n] *= math.exp(max((1.0 - c.s[n]) / t.scarce, LEAST_LOG))
        nearest = min(nearest, c.distance[n])
    total = 0.0
    for n in range(2 * MODES):
        if c.w[n] != 0.0:
            c.w[n] *= c.likelihood[n] * math.exp(nearest - c.distance[n])
            total += c.w[n]
    merge(e, c, 1.0 / total, t, forget)
    return math.log(total) - nearest


@loop
def merge(e: Estimates, c: Candidates, scale: float, t: Step, forget: float) -> None:
    """Merge the two candidates of every mode; weights become probabilities."""
    total = 0.0
    for j in range(MODES):
        n = MODES + j
        own, come = c.w[j] * scale, c.w[n] * scale
        w = own + come
        if w <= 0.0:
            e.w[j] = 0.0
            continue
        if own < NEGLIGIBLE * come or come < NEGLIGIBLE * own:
            k = j if own > come else n
            e.s[j], e.r[j], e.v[j], e.x3[j] = c.s[k], c.r[k], c.v[k], c.x3[k]
            e.ss[j], e.sr[j], e.sv[j] = c.ss[k], c.sr[k], c.sv[k]
            e.rr[j], e.rv[j], e.vv[j] = c.rr[k], c.rv[k], c.vv[k]
        else:
            part = come / w
            both = part * own / w
            s, r, v = c.s[n] - c.s[j], c.r[n] - c.r[j], c.v[n] - c.v[j]
            e.s[j], e.r[j], e.v[j] = c.s[j] + part * s, c.r[j] + part * r, c.v[j] + part * v
            e.x3[j] = c.x3[j] + part * (c.x3[n] - c.x3[j])
            e.ss[j] = c.ss[j] + part * (c.ss[n] - c.ss[j]) + both * s * s
            e.sr[j] = c.sr[j] + part * (c.sr[n] - c.sr[j]) + both * s * r
            e.sv[j] = c.sv[j] + part * (c.sv[n] - c.sv[j]) + both * s * v
            e.rr[j] = c.rr[j] + part * (c.rr[n] - c.rr[j]) + both * r * r
            e.rv[j] = c.rv[j] + part * (c.rv[n] - c.rv[j]) + both * r * v
            e.vv[j] = c.vv[j] + part * (c.vv[n] - c.vv[j]) + both * v * v
        if forget < 1.0:
            w = math.pow(max(w, 1e-12), forget) * math.pow(t.usual[j], 1.0 - forget)
        e.w[j] = w
        total += w
    for j in range(MODES):
        e.w[j] /= total


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


class Watch(Record):
    """What is known of a cell beside its :class:`Estimates`."""

    odds: float
    """logarithm of the odds that the contact is bad since ``since_s``; 0 and no time: it is good"""
    since_s: float
    asleep: float
    """1 while the cell is at rest and only watched"""
    offset: float
    """r by drift of the rest resistance, as the cell last slept; never changes under a load"""
    centre: float
    """mean reading of a sleeping cell"""
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
        return watch.centre, 0.0
    mean = spread = 0.0
    for j in range(MODES):
        mean += e.w[j] * e.r[j]
    for j in range(MODES):
        off = e.r[j] - mean
        way = t.by_move[phase_of(j)] * t.way_s[j]
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
    low: Row,
    high: Row,
    var: Row,
    known: Row,
    sleeps: Row,
    forget: float,
    load: Row,
    variance: Row,
) -> None:
    """Take a frame of n cells; writes mean ``load`` (n,) and its ``variance`` (n,).

    Args:
        cells: (n,) estimates; before a bad contact, if it is one, in ``befores``; and the rest of their states.
        befores: see ``cells``.
        watches: see ``cells``.
        scratch: (1,) of the kernel; ``pools`` and ``trial`` likewise.
        pools: see ``scratch``.
        trial: see ``scratch``.
        steps: (1,) weights of the time step.
        low: (n,) readings lie between ``low`` and ``high``.
        high: see ``low``.
        var: (n,) variance of their noise.
        known: (n,) 1 where a cell is read, 0 where it is not, -1 where it has never been.
        sleeps: (n,) 1 where a cell may sleep.
        forget: share of the evidence for modes that is kept.
        load: written.
        variance: written.
    """
    t, c, p = steps[0], scratch[0], pools[0]
    for i in range(cells.size):
        if known[i] < 0.0:
            continue
        e, before, watch = cells[i], befores[i], watches[i]
        if watch.asleep > 0.0:
            if known[i] > 0.0 and rests(watch, t, low[i], high[i], var[i]):
                load[i] = 0.0
                width = high[i] - low[i]
                variance[i] = t.floor * t.floor + (var[i] + width * width * (1.0 / 12.0)) / (t.gain * t.gain)
                continue
            watch.asleep, watch.offset = 0.0, watch.centre - e.r[REST]
        least, most = low[i] - watch.offset, high[i] - watch.offset
        follow(e, before, watch, c, p, trial[0], t, known[i] > 0.0, least, most, var[i], forget)
        mean = mean_of(e)
        spread = variance_of(e, mean, t)
        if watch.since_s > 0.0:
            bad = 1.0 / (1.0 + math.exp(-watch.odds))
            bad = bad * bad / (bad + TAIL)
            other = mean_of(before)
            off = other - mean
            spread += bad * (variance_of(before, other, t) - spread) + bad * (1.0 - bad) * off * off
            if watch.odds > 0.0:
                mean = other
        elif sleeps[i] > 0.0 and forget < 1.0 and known[i] > 0.0 and settled(e, var[i], high[i] - low[i]):
            watch.asleep, watch.centre, watch.cusum = 1.0, watch.offset + e.r[REST], 0.0
        load[i] = mean
        beyond = max(mean - 1.0, 0.0) * t.extrapolated
        variance[i] = spread + t.floor * t.floor + t.relative * t.relative * mean * mean + beyond * beyond


@loop
def settled(e: Estimates, var: float, width: float) -> bool:
    """Whether a cell is at rest, and remembers nothing that the noise does not hide."""
    return bool(e.w[REST] > RESTS and e.r[REST] * e.r[REST] < 1e-6 + 0.3 * (var + width * width * (1.0 / 12.0)))


@loop
def rests(watch: Watch, t: Step, low: float, high: float, var: float) -> bool:
    """Whether a sleeping cell goes on sleeping (Page 1954)."""
    std = math.sqrt(var + (high - low) * (high - low) * (1.0 / 12.0))
    off = (0.5 * (low + high) - watch.centre) / std
    watch.cusum = max(watch.cusum + off - 0.5, 0.0)
    sleeps = abs(off) < WAKES and watch.cusum < WAKES
    if sleeps and t.drift_var > 0.0:  # of readings at rest alone, and where the rest resistance drifts at all
        watch.centre += (off * std) * min(t.dt_s / DRIFTS_S, 1.0)
    return bool(sleeps)


SURPRISE = 6.0
"""standard deviations from what was expected, from which a bad contact is suspected"""
HOPELESS = -12.0
"""logarithm of the odds at which no contact is suspected any more"""
LASTING = 5.0
"""usual times of a bad contact, after which what is read counts as a load"""
RESTS = 0.5
"""probability of rest from which a cell may sleep"""
WAKES, DRIFTS_S = 4.0, 3.0
"""standard deviations, and their sum, at which a cell wakes; and s, in which the mean of a sleeping cell follows"""
