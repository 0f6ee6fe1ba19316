"""Modes of the switching filter: how a load may move and for how long, and the cell's response in one time step.

A mode is a phase of the material together with a kind of motion (:data:`KINDS`): a jump Markov linear system
(Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, chapter 11). Every tuned
number of the filter is in :class:`Tuning`, with its unit.

**Dynamics.** s is the load over full scale, r the normalised resistance, v = s'. With gains g = full scale / modulus,

    rising phase    r' = gu v - (r - geq s)/Tu,                      gu = geq + full scale/etau2   (equation 3)
    recovery phase  r' = g1 v + (g2 s - x2)/T2 + (g3 s - x3)/T3,     x2 = r - g1 s - x3            (equation 8)
    always          s' = v,  x3' = (g3 s - x3)/T3

s, r and x3 are continuous where the phase changes, so that a turn hands nothing over. All parts are first-order lags,
discretised exactly for loads that are linear within a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import numpy as np

from ...common.arrays import FloatArray
from ...common.compiled import Record, record
from ..materials import PaperModel, lag

MODES = 12
REST, HOLD_UP, HOLD_DOWN, CREEP_UP, CREEP_DOWN, LINE_UP, LINE_DOWN, MOVE_UP, MOVE_DOWN, EDGE_UP, EDGE_DOWN, SHAKE = (
    range(MODES)
)
"""no load; held loads and motions at four scales of speed, of both phases; and motion within the frames"""
DOWN, UP, EITHER = range(3)
"""phases: recovery, rising, and both in turn within a frame"""
STILL, HELD, MOVING, JUMPING, SHAKING = range(5)
"""kinds of motion: none, by chance only, at a speed that persists, by increments, and to and fro"""
PHASES = (DOWN, UP, DOWN, UP, DOWN, UP, DOWN, UP, DOWN, UP, DOWN, EITHER)
KINDS = (STILL, HELD, HELD, MOVING, MOVING, MOVING, MOVING, MOVING, MOVING, JUMPING, JUMPING, SHAKING)
_MODE_KINDS = tuple(zip(PHASES, KINDS, strict=True))
EACH = Annotated[FloatArray, MODES]
TWICE = Annotated[FloatArray, 2 * MODES]
"""of each mode for its own estimate, and again for what comes to it"""


@dataclass(frozen=True)
class Tuning:
    """What the filter assumes of loads and contacts. FS is full scale. Chosen by ``ohmskin bench --scenarios``."""

    creep_per_s: float = 0.015
    """FS/s, usual speed of loads that creep or sag; the next two: of slow and of fast motion"""
    line_per_s: float = 0.3
    """also excess of rises over falls of the path of a load that moves within the frames"""
    move_per_s: float = 0.5
    edge: float = 0.6
    """FS, usual size of a change within one frame"""
    creep_s: float = 0.8
    """s, for which such a motion lasts"""
    line_s: float = 3.0
    move_s: float = 0.1
    brief_s: float = 0.06
    """changes within one frame, and bad contacts"""
    hold_s: float = 0.55
    """s, after which a held load begins to move"""
    rest_s: float = 5.0
    """s, after which a cell at rest is pressed"""
    other: float = 0.3
    """share of the motions that end in a hold, and of those that turn; the others go on at another scale of speed. And
    share of the holds that the other phase of the material explains"""
    release: float = 0.6
    """share of the falls with an end after them that end at no load; the others at plateaus of any height"""
    mistake: float = 0.2
    """share of the falls at whose end the load is not known, whatever its estimate"""
    calm_s: float = 20.0
    """s from one motion within the frames to the next"""
    swing_s: float = 0.04
    """s, time of a swing: swings are that path long"""
    waver: float = 5e-4
    """FS per sqrt(s), by which a held load wavers"""
    unseen: float = 0.2
    """mean share of the way of a frame that goes unseen at a turn; its standard deviation is three quarters of it"""
    memory: float = 0.05
    """share of r by which the memory of a cell may be wrong when it comes to rest"""
    drift: float = 0.0006
    """r per sqrt(s), discrepancy of the model (Kennedy & O'Hagan 2001)"""
    forget_s: float = 2.0
    """s, for which evidence for a mode lasts, since no cell is exactly the model; and motion within the frames"""
    bad_hz: float = 0.02
    """1/s, bad contacts of a cell"""
    alone: float = 0.1
    """share of the contacts that cover a single cell"""
    sudden: float = 0.005
    """share of the jumps within a frame among untouched cells that are presses of a single cell"""
    overload: float = 1.3
    """FS, heaviest usual load; in a third of what it exceeds full scale, loads there become rarer by a factor of e"""
    floor: float = 0.001
    """FS, least standard deviation that is stated; and shares of the load, and of what exceeds full scale, that are
    added: there the cell is not known"""
    relative: float = 0.012
    extrapolated: float = 0.25


TUNING = Tuning()
AT_ONCE_S = 1e-6
"""s, time constants of a cell without memory"""


@dataclass(frozen=True)
class Material:
    """The two phases of a cell, in full scales; ``geq`` is r at full scale in equilibrium."""

    geq: float
    gu: float
    g1: float
    g2: float
    g3: float
    tu_s: float
    t2_s: float
    t3_s: float

    @classmethod
    def of(cls, model: PaperModel, full_scale_kpa: float) -> Material:
        """Of a cell of the paper."""
        m, full = model, full_scale_kpa
        rising = full / m.eu1_kpa
        branches = full / m.e1_kpa, full / m.e2_kpa, full / m.e3_kpa
        return cls(rising, rising + full / m.etau2_kpa, *branches, m.tu_s, m.t2_s, m.t3_s)

    @classmethod
    def without_memory(cls) -> Material:
        """Of readings that are loads already, up to their noise."""
        return cls(1.0, 1.0, 1.0, 0.0, 0.0, *(AT_ONCE_S,) * 3)


class Step(Record):
    """Weights of a time step, for every mode (:data:`MODES`,) or for its two candidates (:data:`TWICE`,).

    After a step s = stays s + way_s v, r = by_s s + by_r r + by_x3 x3 + by_v v, x3 = x3_kept x3 + x3_by_s s + x3_by_v v
    and v = kept v, of the states before it.
    """

    dt_s: float
    stays: TWICE
    """0 of rest, which what was left of a load leaves within the step; of others 1"""
    way_s: TWICE
    """seconds: the mean way of a motion over its speed"""
    by_s: TWICE
    by_r: TWICE
    by_x3: TWICE
    by_v: TWICE
    by_move: TWICE
    """r by a change of the load within the step"""
    x3_kept: float
    x3_by_s: TWICE
    x3_by_v: TWICE
    kept: TWICE
    """share of the speed that is left"""
    noise_ss: TWICE
    """covariances of what moves by chance"""
    noise_sr: TWICE
    noise_sv: TWICE
    noise_rr: TWICE
    noise_rv: TWICE
    noise_vv: TWICE
    sign: TWICE
    """of the speed; 0 where it does not move"""
    swings: TWICE
    """variance of r over the mean square of the speed, by swings within a frame"""
    bend: float
    """r by an unseen way to and fro: the gain of rises beyond that of falls"""
    speed: EACH
    """usual speed"""
    leaves: EACH
    """probability that a mode ends"""
    after_down: EACH
    """and shares of the modes that follow: on a mode of that phase, on rest, and on shaking"""
    after_up: EACH
    after_rest: EACH
    after_shake: EACH
    shakes: float
    """probability that a cell begins to shake"""
    release: float
    """as in :class:`Tuning`"""
    mistake: float
    usual: EACH
    """probability of each mode when nothing is known"""
    unseen: float
    unseen_std: float
    swing_s: float
    memory: float
    drift_var: float
    forget_s: float
    bad_prior: float
    """logarithm of the probability that a contact gets bad in a step, per r; of that it gets good; and s, as above"""
    bad_ends: float
    bad_s: float
    gain: float
    """r at full scale of a slow load"""
    overload: float
    scarce: float
    floor: float
    relative: float
    extrapolated: float


def discretise(material: Material, dt_s: float, tuning: Tuning = TUNING) -> Step:
    """The weights of a step of ``dt_s``."""
    m, t, mean = material, tuning, 0.5 * (material.gu + material.g1)
    (gone_u, gone_2, gone_3), (ramp_u, ramp_2, ramp_3) = lag.weights(dt_s, np.array([m.tu_s, m.t2_s, m.t3_s]))
    rising = np.array([m.geq * gone_u, 1.0 - gone_u, 0.0, m.gu - (m.gu - m.geq) * ramp_u])
    recovery = np.array(
        [
            (m.g1 + m.g2) * gone_2 + m.g3 * gone_3,
            1.0 - gone_2,
            gone_2 - gone_3,
            m.g1 + m.g2 * ramp_2 + m.g3 * ramp_3,
        ]
    )
    by_s, by_r, by_x3, by_move = np.stack([recovery, rising, 0.5 * (rising + recovery)], axis=1)[:, PHASES]
    # Equal in r for both phases: otherwise the phase with less noise would win every hold.
    even = mean / m.g1, mean / m.gu, 1.0
    each = [_motion(mode, kind, dt_s, even[phase], t) for mode, (phase, kind) in enumerate(_MODE_KINDS)]
    way_s, kept, way_var, way_speed, speed_var, speed = np.array(each).T
    rests, shakes_of, bend = _ONLY_REST, _ONLY_SHAKE, m.gu - m.g1
    each_mode = {
        "stays": 1.0 - rests,
        "way_s": way_s,
        "by_s": by_s - rests * by_move,  # what was left of the load has gone within the step
        "by_r": by_r,
        "by_x3": by_x3,
        "by_v": by_move * way_s + shakes_of * (0.5 * bend * dt_s),
        "by_move": by_move,
        "x3_by_s": m.g3 * gone_3 - rests * (m.g3 * ramp_3),
        "x3_by_v": m.g3 * ramp_3 * way_s,
        "kept": kept,
        "noise_ss": way_var,
        "noise_sr": by_move * way_var,
        "noise_sv": way_speed,
        "noise_rr": by_move * by_move * way_var + t.drift**2 * dt_s,
        "noise_rv": by_move * way_speed,
        "noise_vv": speed_var,
        "sign": _SIGNS,
        "swings": shakes_of * (mean * t.swing_s) ** 2,
    }
    after, lasts_s = _chain(t)
    leaves, shakes = -np.expm1(-dt_s / lasts_s), -math.expm1(-dt_s / t.calm_s)
    return record(
        Step,
        dt_s=dt_s,
        **{name: np.tile(row, 2) for name, row in each_mode.items()},
        **{"x3_kept": 1.0 - gone_3, "bend": bend, "speed": speed},
        **{"leaves": leaves, "after_down": after[0], "after_up": after[1], "after_rest": after[2]},
        **{
            "after_shake": after[3],
            "shakes": shakes,
            "mistake": t.mistake,
            "release": t.release,
            "usual": _usual(after, leaves, shakes),
        },
        **{"unseen": t.unseen, "unseen_std": 0.75 * t.unseen, "swing_s": t.swing_s},
        **{"memory": t.memory, "drift_var": t.drift**2 * dt_s, "forget_s": t.forget_s},
        **{
            "bad_prior": math.log(max(t.bad_hz * dt_s / (3.0 * m.geq), 1e-300)),
            "bad_ends": math.log(-math.expm1(-dt_s / t.brief_s)),
        },
        **{
            "bad_s": t.brief_s,
            "gain": m.gu,
            "overload": t.overload,
            "scarce": (t.overload - 1.0) / 3.0,
            "floor": t.floor,
            "relative": t.relative,
        },
        **{"extrapolated": t.extrapolated},
    )


def _motion(mode: int, kind: int, dt_s: float, even: float, t: Tuning) -> tuple[float, ...]:
    """Of one mode: way over speed, kept speed, variances of way, of both and of speed, usual speed.

    The speed of a :data:`MOVING` load is an Ornstein-Uhlenbeck process, whose sign the mode fixes.
    """
    if kind == MOVING:
        scale = (mode - CREEP_UP) // 2
        speed = even * (t.creep_per_s, t.line_per_s, t.move_per_s)[scale]
        lasts_s = (t.creep_s, t.line_s, t.move_s)[scale]
        gone, _ = lag.weights_of(dt_s, lasts_s)
        z, power = dt_s / lasts_s, speed * speed
        # Integrals of the covariance; the first one cancels to z^3 2/3 in short steps.
        way = 2.0 * z - 2.0 * gone - gone * gone if z > 1e-3 else z**3 * (2.0 / 3.0)
        ways = lasts_s * gone, 1.0 - gone
        return *ways, power * lasts_s**2 * way, power * lasts_s * gone**2, power * gone * (2.0 - gone), speed
    if kind == JUMPING:
        way = (even * t.edge) ** 2
        return 0.0, 0.0, way, way / dt_s, way / dt_s**2, 0.0
    if kind == SHAKING:
        kept = math.exp(-dt_s / t.forget_s)
        return 0.0, kept, t.waver**2 * dt_s, 0.0, t.line_per_s**2 * (1.0 - kept**2), t.line_per_s
    if kind == HELD:
        return 0.0, 0.0, (t.waver * even) ** 2 * dt_s, 0.0, 0.0, 0.0
    return (0.0,) * 6


@lru_cache(maxsize=8)
def _chain(t: Tuning) -> tuple[FloatArray, FloatArray]:
    """Shares (4, modes) of what follows on recovery, rising, rest and shaking; s (modes,), which modes last."""
    up, down = np.array([CREEP_UP, LINE_UP, MOVE_UP, EDGE_UP]), np.array([CREEP_DOWN, LINE_DOWN, MOVE_DOWN, EDGE_DOWN])
    on, after = 1.0 - 2.0 * t.other, np.zeros((4, MODES))
    held = t.other * (1.0 - t.release)
    after[DOWN, [REST, HOLD_DOWN, HOLD_UP]] = t.other * t.release, held * (1.0 - t.other), held * t.other
    after[DOWN, down], after[DOWN, up] = on / 4, t.other / 4
    after[UP, [HOLD_UP, HOLD_DOWN]] = t.other * (1.0 - t.other), t.other * t.other
    after[UP, up], after[UP, down] = on / 4, t.other / 4
    after[2, up] = 0.1, 0.3, 0.3, 0.3  # few touches begin as creep
    after[3, [HOLD_UP, HOLD_DOWN]], after[3, up], after[3, down] = 0.2, 0.3 / 4, 0.3 / 4
    return after, np.array([t.rest_s, *np.repeat([t.hold_s, t.creep_s, t.line_s, t.move_s, t.brief_s], 2), t.forget_s])


def _usual(after: FloatArray, leaves: FloatArray, shakes: float) -> FloatArray:
    """(modes,) stationary distribution of the Markov chain."""
    chain = after[_POOLS] * leaves[:, None]
    chain.flat[:: MODES + 1] += 1.0 - leaves
    chain[:SHAKE] *= 1.0 - shakes
    chain[:SHAKE, SHAKE] += shakes
    chain.flat[:: MODES + 1] -= 1.0
    chain[:, -1] = 1.0  # one of the equations follows from the others; that all probabilities make 1 replaces it
    return np.linalg.solve(chain.T, _ONE)


_ONLY_REST, _ONLY_SHAKE = np.eye(MODES)[[REST, SHAKE]]
_SIGNS = np.array([0.0 if kind in (STILL, HELD) else -1.0 if phase == DOWN else 1.0 for phase, kind in _MODE_KINDS])
_POOLS = np.array([2, *[UP, DOWN] * 5, 3])
"""row of :func:`_chain` of what follows on each mode"""
_ONE = np.append(np.zeros(MODES - 1), 1.0)
