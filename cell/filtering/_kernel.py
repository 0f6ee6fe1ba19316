"""One frame of the switching Kalman filter (interacting multiple model), cell by cell."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

REST, HELD_UP, HELD_DOWN, CREEP_UP, CREEP_DOWN, MOVE_UP, MOVE_DOWN, EDGE_UP, EDGE_DOWN, SHAKE = range(10)
MODES = 10
# of a mode: weight, load s, reading r, slow branch x, speed v, and covariances of s, r and v
W, S, R, X, V, SS, SR, SV, RR, RV, VV = range(11)
PARTS = 11


class Table(NamedTuple):
    dt: float
    phi: np.ndarray  # (3, 3, 3) of s, r, x by phase
    gamma: np.ndarray  # (3, 3)
    phase: np.ndarray  # (MODES,)
    change: np.ndarray  # (2, MODES, MODES) per frame, and per so many frames; diagonal: stay
    speed: np.ndarray
    keep: np.ndarray
    wander: np.ndarray
    drift: np.ndarray
    waver: np.ndarray
    edge: float
    shake: float
    equilibrium: float
    slow: float
    most: float
    lost: float
    apart: float
    loose: float
    trust: float
    doubt: float
    floor: float
    every: int
    least: float
    alert: float
    noisy: float
    coherent: float
    unseen: float


@njit(cache=True, inline="always")
def cdf(z):
    return 0.5 * math.erfc(-z * 0.7071067811865476)


@njit(cache=True, inline="always")
def pdf(z):
    return 0.3989422804014327 * math.exp(-0.5 * z * z)


@njit(cache=True)
def add(t, c, j, w, s, r, x, v, ss, sr, sv, rr, rv, vv):
    """Merge an estimate into that of mode j; of two that are far apart, keep the likelier one."""
    old = c[j, W]
    both = old + w
    if old == 0.0:
        c[j, S], c[j, R], c[j, X], c[j, V] = s, r, x, v
        c[j, SS], c[j, SR], c[j, SV], c[j, RR], c[j, RV], c[j, VV] = ss, sr, sv, rr, rv, vv
    else:
        u = w / both
        ds = s - c[j, S]
        if ds * ds > t.apart * (ss + c[j, SS]) + 1e-8:
            u = 1.0 if w > old else 0.0
        if u > 0.0:
            dr, dv = r - c[j, R], v - c[j, V]
            q = 1.0 - u
            c[j, SS] += u * (ss - c[j, SS] + q * ds * ds)
            c[j, SR] += u * (sr - c[j, SR] + q * ds * dr)
            c[j, SV] += u * (sv - c[j, SV] + q * ds * dv)
            c[j, RR] += u * (rr - c[j, RR] + q * dr * dr)
            c[j, RV] += u * (rv - c[j, RV] + q * dr * dv)
            c[j, VV] += u * (vv - c[j, VV] + q * dv * dv)
            c[j, S] += u * ds
            c[j, R] += u * dr
            c[j, X] += u * (x - c[j, X])
            c[j, V] += u * dv
    c[j, W] = both


@njit(cache=True)
def enter(t, c, i, j, w, p):
    """Mode j begins after mode i, whose estimate is ``p``, with probability ``w``."""
    s, r, x, v = p[S], p[R], p[X], p[V]
    ss, sr, rr = p[SS], p[SR], p[RR]
    if i >= MOVE_UP and i <= EDGE_DOWN:
        # the old motion goes on for a uniform share of the frame
        g = t.gamma[1 if i == MOVE_UP or i == EDGE_UP else 0, 1]
        half = 0.5 * t.dt
        s2 = t.dt * t.dt / 12.0 * (v * v + p[VV])
        s += half * v
        r += half * g * v
        ss += 2.0 * half * p[SV] + half * half * p[VV] + s2
        sr += half * g * p[SV] + half * p[RV] + half * half * g * p[VV] + s2 * g
        rr += 2.0 * half * g * p[RV] + (half * g) ** 2 * p[VV] + s2 * g * g
        if j >= CREEP_UP and j <= EDGE_DOWN:
            ss += 0.75 * s2  # to and fro between frames
            if t.phase[j] != t.phase[i]:  # errors of turns add up to one side
                ss += 2.0 * t.coherent * math.sqrt(ss * s2)
    u = t.speed[j]
    v = vv = 0.0
    if u > 0.0:
        v = -0.8 * u if j == CREEP_DOWN or j == MOVE_DOWN else 0.8 * u
        vv = 0.363 * u * u
    add(t, c, j, w, s, r, x, v, ss, sr, 0.0, rr, 0.0, vv)


@njit(cache=True)
def turn(t, c, i, j, w, p):
    """The speed of mode i has the sign of mode j: that share of it is of mode j, the truncated normal."""
    one = 1.0 if j == CREEP_UP or j == MOVE_UP else -1.0
    sd = math.sqrt(p[VV]) + 1e-12
    z = one * p[V] / sd
    s, r, v = p[S], p[R], p[V]
    ss, sr, sv, rr, rv, vv = p[SS], p[SR], p[SV], p[RR], p[RV], p[VV]
    if z < 5.0:
        share = cdf(z)
        w *= share
        if w < t.least:
            return
        h = pdf(z) / share
        shift, shrink = one * h * sd, h * (h + z)
        g = 1.0 / (vv + 1e-300)
        a, b = sv * g, rv * g
        s += a * shift
        r += b * shift
        v += shift
        k = vv * shrink
        ss -= a * a * k
        sr -= a * b * k
        rr -= b * b * k
        sv *= 1.0 - shrink
        rv *= 1.0 - shrink
        vv -= k
    if i != j and one < 0.0:
        # to and fro within the frame: what the faster answer keeps
        v0 = abs(p[V])
        hidden = (t.gamma[1, 1] - t.gamma[0, 1]) * 0.5 * t.dt * v0 * v0 / (v0 + abs(v) + 1e-9)
        r += hidden
        rr += 0.25 * hidden * hidden
        if t.unseen > 0.0 and i >= MOVE_UP:
            e = t.unseen * math.sqrt(max(p[RR], 0.0))
            ss += e * e + 2.0 * e * math.sqrt(max(ss, 0.0))
    add(t, c, j, w, s, r, p[X], v, ss, sr, sv, rr, rv, vv)


@njit(cache=True, error_model="numpy")
def step_cells(t, memory, out, readings, noises, low_gap, high_gap, frame):
    """One frame of all cells.

    memory (n, MODES, PARTS); out (n, 4): load, std, peak, last r; readings (n,) r; noises (n,) variance of r; low_gap,
    high_gap (n,) half steps of r.
    """
    c = np.zeros((MODES, PARTS))
    p = np.zeros(PARTS)
    for k in range(memory.shape[0]):
        y, noise = readings[k], noises[k]
        m = memory[k]
        total = 0.0
        best = 0
        for j in range(MODES):
            total += m[j, W]
            if m[j, W] > m[best, W]:
                best = j
        width = low_gap[k] + high_gap[k]
        if total == 0.0:
            begin(t, m, y, noise + width * width / 12.0)
            out[k, 3] = y
            best = REST
        same = abs(y - out[k, 3]) < 0.1 * (1.0 + y)
        # does what is likeliest explain the reading?
        ph = t.phase[best]
        ahead = t.phi[ph, 1, 0] * m[best, S] + t.phi[ph, 1, 1] * m[best, R] + t.phi[ph, 1, 2] * m[best, X]
        if best >= CREEP_UP:
            ahead += t.gamma[ph, 1] * t.dt * m[best, V]
        off = y - ahead
        due = (frame + k) % t.every == 0
        full = due or best >= EDGE_UP or off * off > t.alert * (m[best, RR] + noise + width * width / 12.0)
        change = t.change[1 if due else 0]
        for j in range(MODES):
            for e in range(PARTS):
                c[j, e] = 0.0
        for i in range(MODES):
            wi = m[i, W]
            if wi < t.least:
                continue
            for e in range(PARTS):
                p[e] = m[i, e]
            stay = change[i, i]
            line = i >= CREEP_UP and i <= MOVE_DOWN
            if not full:
                if line:
                    turn(t, c, i, i, wi, p)
                else:
                    add(t, c, i, wi, p[S], p[R], p[X], p[V], p[SS], p[SR], p[SV], p[RR], p[RV], p[VV])
                continue
            if line:
                turn(t, c, i, i, wi * stay, p)
                other = i + 1 if i == CREEP_UP or i == MOVE_UP else i - 1
                turn(t, c, i, other, wi * stay, p)
            elif i >= EDGE_UP and i <= EDGE_DOWN:
                add(t, c, i, wi * stay, p[S], p[R], p[X], 0.0, p[SS], p[SR], 0.0, p[RR], 0.0, 0.0)
            else:
                add(t, c, i, wi * stay, p[S], p[R], p[X], p[V], p[SS], p[SR], p[SV], p[RR], p[RV], p[VV])
            for j in range(MODES):
                w = wi * change[i, j]
                if j != i and w >= t.least:
                    enter(t, c, i, j, w, p)
        total = 0.0
        for j in range(MODES):
            w = c[j, W]
            if w < t.least:
                c[j, W] = 0.0
                continue
            ph = t.phase[j]
            f10, f11, f12 = t.phi[ph, 1, 0], t.phi[ph, 1, 1], t.phi[ph, 1, 2]
            s, r, x, v = c[j, S], c[j, R], c[j, X], c[j, V]
            ss, sr, sv, rr, rv, vv = c[j, SS], c[j, SR], c[j, SV], c[j, RR], c[j, RV], c[j, VV]
            before = 1.0
            if j != REST and s * s < 9.0 * ss:
                before = max(cdf(s / math.sqrt(ss)), 1e-3)
            # s1 = s + h v; r1 = f10 s + f11 r + f12 x + g v
            h = g = 0.0
            if t.speed[j] > 0.0:
                if j == SHAKE:
                    g = 0.5 * (t.gamma[1, 1] - t.gamma[0, 1]) * t.dt
                else:
                    h = t.dt
                    g = t.gamma[ph, 1] * t.dt
            s1 = s + h * v
            r1 = f10 * s + f11 * r + f12 * x + g * v
            x1 = t.phi[ph, 2, 0] * s + t.phi[ph, 2, 2] * x + t.gamma[ph, 2] * h * v
            if t.speed[j] > 0.0:
                a, b, d = ss + h * sv, sr + h * rv, sv + h * vv
                rs = f10 * ss + f11 * sr + g * sv
                r_r = f10 * sr + f11 * rr + g * rv
                r_v = f10 * sv + f11 * rv + g * vv
                nss = a + h * d
                nsr = f10 * a + f11 * b + g * d
                nrr = f10 * rs + f11 * r_r + g * r_v
                kv = t.keep[j]
                v1 = kv * v
                sv, rv = kv * d, kv * r_v
                ss, sr, rr = nss, nsr, nrr
                vv = kv * kv * vv + t.wander[j] + (t.drift[j] * v) ** 2
            else:
                rs = f10 * ss + f11 * sr
                rr = f10 * rs + f11 * (f10 * sr + f11 * rr)
                sr = rs
                v1 = vv = sv = rv = 0.0
            gr = t.gamma[ph, 1]
            spread = t.waver[j]
            edge = j == EDGE_UP or j == EDGE_DOWN
            if edge:
                spread = t.edge * t.edge
            ss += spread
            sr += spread * gr
            rr += spread * gr * gr + t.noisy
            if j == REST:
                gd = t.gamma[0, 1]
                if s1 > 2.0 * t.floor:
                    ss += (t.loose * out[k, 2]) ** 2
                r1 -= gd * s1
                rr += gd * (gd * ss - 2.0 * sr)
                s1 = ss = sr = 0.0
            # the reading
            var = rr + noise
            if j == SHAKE:
                var += (t.shake * v1) ** 2
            e1 = y - r1
            root = math.sqrt(var)
            plain = width < root
            like = shift = left = 0.0
            if not plain:
                al, be = (e1 - low_gap[k]) / root, (e1 + high_gap[k]) / root
                z = cdf(be) - cdf(al)
                if z < 1e-10:
                    plain = True
                else:
                    pa, pb = pdf(al), pdf(be)
                    dz = (pa - pb) / z
                    shift = root * dz
                    left = var * max(1.0 + (al * pa - be * pb) / z - dz * dz, 0.0)
                    like = z / width
            if plain:
                whole = var + width * width / 12.0
                z2 = e1 * e1 / whole
                if z2 > 80.0:
                    c[j, W] = 0.0
                    continue
                like = 0.3989422804014327 * math.exp(-0.5 * z2) / math.sqrt(whole)
                shift = e1 * var / whole
                left = var - var * var / whole
            if t.trust == 1.0:
                w *= like
            else:
                w *= like**t.trust
            gain = shift / var
            fall = (var - left) / (var * var)
            if edge:
                e2 = t.edge * t.edge
                m1 = e2 * gr * gain
                s2 = math.sqrt(max(e2 - (e2 * gr) ** 2 * fall, 1e-14))
                w *= 2.0 * cdf(m1 / s2 if j == EDGE_UP else -m1 / s2)
                v1 = m1 / t.dt
            if not w > 1e-30:
                c[j, W] = 0.0
                continue
            s1 += sr * gain
            r1 += rr * gain
            if vv > 0.0:
                v1 += rv * gain
                sv -= sr * rv * fall
                vv -= rv * rv * fall
                rv -= rr * rv * fall
            ss -= sr * sr * fall
            sr -= sr * rr * fall
            rr -= rr * rr * fall
            if j != REST:
                sd = math.sqrt(max(ss, 0.0))
                if s1 < 3.0 * sd or before < 1.0:
                    w *= cdf(s1 / (sd + 1e-6)) / before
                if s1 + 3.0 * (sd + 0.03) > t.most:
                    w *= cdf((t.most - s1) / (sd + 0.03))
                    if s1 + sd > t.most and ss > 0.0:
                        z = max((t.most - s1) / sd, -6.0)
                        hz = pdf(z) / cdf(z)
                        shift, shrink = -sd * hz, hz * (hz + z)
                        a, b = sr / ss, sv / ss
                        s1 += shift
                        r1 += a * shift
                        v1 += b * shift
                        kk = ss * shrink
                        rr -= a * a * kk
                        rv -= a * b * kk
                        vv -= b * b * kk
                        ss -= kk
                        sr *= 1.0 - shrink
                        sv *= 1.0 - shrink
                if not w > 1e-30:
                    c[j, W] = 0.0
                    continue
            c[j, W], c[j, S], c[j, R], c[j, X], c[j, V] = w, s1, r1, x1, v1
            c[j, SS], c[j, SR], c[j, SV], c[j, RR], c[j, RV], c[j, VV] = ss, sr, sv, rr, rv, vv
            total += w
        if not total > 1e-28:
            begin(t, m, y, noise + width * width / 12.0)
        else:
            for j in range(MODES):
                for e in range(PARTS):
                    m[j, e] = c[j, e]
                m[j, W] = c[j, W] / total
            if same and full:
                lost = t.lost * 0.1
                if total < lost * 1e4:
                    fail(t, m, y, noise + width * width / 12.0, lost / (lost + total))
        out[k, 3] = y
        show(t, m, out[k])


@njit(cache=True)
def begin(t, m, y, var):
    """At rest, or under a load held for long."""
    m[:] = 0.0
    m[REST, W], m[REST, R], m[REST, RR] = 0.5, y, var
    s = max(y / t.equilibrium, 0.0)
    for j in (HELD_UP, HELD_DOWN):
        m[j, W] = 0.25
        m[j, S], m[j, R], m[j, X] = s, y, t.slow * s
        m[j, SS] = (0.25 * s) ** 2 + var / t.equilibrium**2
        m[j, RR] = var
        m[j, SR] = var / t.equilibrium


@njit(cache=True)
def fail(t, m, y, var, share):
    """Mix in that the model has failed: the memory is whatever explains the reading."""
    for j in range(MODES):
        m[j, W] *= 1.0 - share
    part = share / 3.0
    add(t, m, REST, part, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0, var, 0.0, 0.0)
    for j in (HELD_UP, HELD_DOWN):
        add(t, m, j, part, 0.45, y, 0.5 * t.slow * 0.45, 0.0, 0.09, 0.0, 0.0, var, 0.0, 0.0)


@njit(cache=True)
def show(t, m, out):
    """Mean and deviation of the load over the modes: no load pulls."""
    first = square = weights = 0.0
    dm = ds = 0.0
    for j in range(1, MODES):
        w = m[j, W]
        if w > 0.0:
            m1, v1 = m[j, S], m[j, SS] + 1e-18
            if m1 * m1 < 16.0 * v1:
                s1 = math.sqrt(v1)
                z = max(m1 / s1, -6.0)
                h = pdf(z) / cdf(z)
                m1 = s1 * (z + h)
                v1 *= max(1.0 - h * (h + z), 0.0)
            first += w * m1
            square += w * (v1 + m1 * m1)
            if t.doubt < 1.0:
                u = w**t.doubt
                weights += u
                dm += u * m1
                ds += u * (v1 + m1 * m1)
    var = max(square - first * first, 0.0)
    if t.doubt < 1.0:
        weights += m[REST, W] ** t.doubt
        var = ds / weights - 2.0 * first * dm / weights + first * first
    out[0] = first
    out[1] = math.sqrt(max(var, 0.0) + t.floor * t.floor)
    out[2] = max(first, out[2] * (1.0 - t.dt))
