"""The modes of a load, with hazards per second, and the tables of a cell for one time between frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from . import _kernel as k


@dataclass(frozen=True)
class Prior:
    touch_hz: float = 0.5
    change_hz: float = 1.0
    fast_fs_per_s: float = 40.0
    fast_s: float = 0.03
    move_fs_per_s: float = 0.6
    move_s: float = 0.25
    move_end: float = 2.0
    creep_fs_per_s: float = 0.05
    creep_s: float = 20.0
    creep_end: float = 0.3
    drift: float = 0.0
    waver_fs: float = 5e-5
    tremor_hz: float = 4.0
    flip_hz: float = 1.0
    flip_back_hz: float = 0.3
    open_hz: float = 0.01
    open_s: float = 0.04
    lost_hz: float = 0.001
    most_fs: float = 1.15
    trust: float = 1.0
    doubt: float = 1.0
    apart: float = 4.0
    loose: float = 0.1
    creep_wander: float = -1.0
    every: int = 1
    least: float = 1e-6
    alert: float = 4.0
    noisy: float = 1e-12
    coherent: float = 0.0
    unseen: float = 0.0
    shake_fs_per_s: float = 0.2
    shake_s: float = 1.0
    shake_end: float = 0.5
    hold_shake: float = 0.05
    move_shake: float = 0.05
    edge_shake: float = 0.0
    shake_waver: float = 5e-5
    hold_rest: float = 0.15
    cd_rest: float = 0.2
    eu_cu: float = 0.05
    edge_turn: float = 0.15
    floor_fs: float = 0.005
    eu_hold: float = 0.3
    eu_sag: float = 0.25
    ed_rest: float = 0.3
    ed_hold: float = 0.25
    md_rest: float = 0.3
    md_hold: float = 0.3


def paper_table(m, fs, dt, p: Prior) -> k.Table:
    gu, geq = fs * (1 / m.eu1_kpa + 1 / m.etau2_kpa), fs / m.eu1_kpa
    gd, g2, g3 = fs / m.e1_kpa, fs / m.e2_kpa, fs / m.e3_kpa
    tu, t2, t3 = m.tu_s, m.t2_s, m.t3_s
    # (s, r, x3, u): u is the constant speed
    up, dn = np.zeros((4, 4)), np.zeros((4, 4))
    up[0, 3] = dn[0, 3] = 1.0
    up[1] = [geq / tu, -1 / tu, 0.0, gu]
    up[2] = dn[2] = [g3 / t3, 0.0, -1 / t3, 0.0]
    dn[1] = [g2 / t2 + gd / t2 + g3 / t3, -1 / t2, 1 / t2 - 1 / t3, gd]
    phi, gamma = np.zeros((3, 3, 3)), np.zeros((3, 3))
    for ph, a in enumerate((dn, up, 0.5 * (up + dn))):
        e = expm(a * dt)
        phi[ph] = e[:3, :3]
        gamma[ph] = e[:3, 3] / dt
    mean_g = 0.5 * (gu + gd)
    even = {0: mean_g / gd, 1: mean_g / gu, 2: 1.0}
    return table(p, dt, phi, gamma, even, geq, g3, 0.5 * (gu + gd))


def table(p, dt, phi, gamma, even, geq, slow, mid):
    phase = np.array([0, 1, 0, 1, 0, 1, 0, 1, 0, 2])
    speed, keep, wander, drift, waver = (np.zeros(k.MODES) for _ in range(5))
    for j, (v, tau) in {
        k.CREEP_UP: (p.creep_fs_per_s, p.creep_s), k.CREEP_DOWN: (p.creep_fs_per_s, p.creep_s),
        k.MOVE_UP: (p.move_fs_per_s, p.move_s), k.MOVE_DOWN: (p.move_fs_per_s, p.move_s), k.SHAKE: (p.shake_fs_per_s, p.shake_s),
    }.items():
        sv = v * even[phase[j]]
        speed[j], keep[j], wander[j] = sv, math.exp(-dt / tau), sv * sv * (1 - math.exp(-2 * dt / tau))
        if j in (k.CREEP_UP, k.CREEP_DOWN) and p.creep_wander >= 0:
            keep[j], wander[j], drift[j] = 1.0, (p.creep_wander * even[phase[j]]) ** 2 * dt, p.drift * math.sqrt(dt)
    for j in (k.HELD_UP, k.HELD_DOWN, k.SHAKE):
        waver[j] = (even[phase[j]] * (p.shake_waver if j == k.SHAKE else p.waver_fs)) ** 2 * dt

    def ch(hz: float) -> float:
        return -math.expm1(-hz * dt)

    c = np.zeros((k.MODES, k.MODES))

    def go(i: int, hazard: float, **to: float) -> None:
        for name, share in to.items():
            c[i, getattr(k, name)] += hazard * share

    move, touch = ch(p.change_hz), ch(p.touch_hz)
    go(k.REST, touch, EDGE_UP=0.5, MOVE_UP=0.3, CREEP_UP=0.18, SHAKE=0.02)
    for h in (k.HELD_UP, k.HELD_DOWN):
        go(h, move, EDGE_UP=0.15, EDGE_DOWN=0.15, MOVE_UP=0.15, MOVE_DOWN=0.15, CREEP_UP=0.1, CREEP_DOWN=0.1, REST=p.hold_rest, SHAKE=p.hold_shake)
    go(k.HELD_UP, ch(p.flip_hz), HELD_DOWN=1.0)
    go(k.HELD_DOWN, ch(p.flip_back_hz), HELD_UP=1.0)
    end_c, end_m, end_e = ch(p.creep_end), ch(p.move_end), ch(1 / p.fast_s)
    go(k.CREEP_UP, end_c, HELD_UP=0.6, MOVE_UP=0.2, MOVE_DOWN=0.2)
    go(k.CREEP_DOWN, end_c, HELD_DOWN=0.4, MOVE_UP=0.2, MOVE_DOWN=0.2, REST=p.cd_rest)
    go(k.MOVE_UP, end_m, HELD_UP=0.6, CREEP_UP=0.2, CREEP_DOWN=0.2)
    rest = 1 - p.md_rest - p.md_hold
    go(k.MOVE_DOWN, end_m, HELD_DOWN=p.md_hold, CREEP_DOWN=rest / 2, CREEP_UP=rest / 2, REST=p.md_rest)
    for one in (k.CREEP_UP, k.CREEP_DOWN, k.MOVE_UP, k.MOVE_DOWN):
        go(one, move, EDGE_UP=0.2, EDGE_DOWN=0.2, REST=0.1, SHAKE=p.move_shake)
    go(k.EDGE_UP, end_e, HELD_UP=p.eu_hold, CREEP_DOWN=p.eu_sag, MOVE_UP=0.1, MOVE_DOWN=0.1, CREEP_UP=p.eu_cu, EDGE_DOWN=p.edge_turn, REST=0.05, SHAKE=p.edge_shake)
    go(k.EDGE_DOWN, end_e, HELD_DOWN=p.ed_hold, MOVE_DOWN=0.15, MOVE_UP=0.1, CREEP_DOWN=0.05, EDGE_UP=p.edge_turn, REST=p.ed_rest, SHAKE=p.edge_shake)
    go(k.SHAKE, ch(p.shake_end), HELD_UP=0.15, HELD_DOWN=0.15, MOVE_UP=0.15, MOVE_DOWN=0.15, EDGE_UP=0.15, EDGE_DOWN=0.15, REST=0.1)
    np.fill_diagonal(c, 0.0)
    many = np.minimum(c * p.every, 1.0)
    many /= np.maximum(many.sum(axis=1, keepdims=True) / 0.9, 1.0)
    for a in (c, many):
        np.fill_diagonal(a, 1.0 - a.sum(axis=1))
    c = np.stack([c, many])
    return k.Table(
        dt=dt, phi=phi, gamma=gamma, phase=phase, change=c, speed=speed, keep=keep,
        wander=wander, drift=drift, waver=waver, edge=min(p.fast_fs_per_s * dt, 1.0), shake=0.177 / p.tremor_hz * mid,
        equilibrium=geq, slow=slow, most=p.most_fs, lost=p.lost_hz * dt, apart=p.apart, loose=p.loose, trust=p.trust,
        doubt=p.doubt, floor=p.floor_fs, every=p.every, least=p.least, alert=p.alert, noisy=p.noisy, coherent=p.coherent, unseen=p.unseen,
    )
