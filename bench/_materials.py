"""Materials and loads for judging a calibration: emulated specimens that belong to none of the fitted model classes.

A material turns normalised loads (n,) into normalised resistance r (n,). Its parameters are drawn from the random
generator that it is given. The kinds ``paper``, ``asymmetric`` and ``m10`` are the product's own models with random
parameters, for comparison.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import fftconvolve, lfilter

from ..cell import AsymmetricModel, Cell, M10Model, PaperModel
from ..common.arrays import FloatArray

Material = Callable[[FloatArray, float, np.random.Generator], FloatArray]
"""normalised load (n,), time step in s, random generator -> r (n,)"""
RELAYS = 400
"""of a Preisach material"""
Load = Callable[[np.random.Generator, float], tuple[FloatArray, float]]
"""random generator, time step in s -> normalised load (n,), and how many seconds of it are learned from"""


# -- materials ---------------------------------------------------------------------------------------------------------


def preisach(load: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Share (n,) of relays that are on under a load (n,): each switches on above one level, off below a lower one."""
    on = rng.uniform(0, 1, RELAYS)
    off = on - rng.exponential(0.12, RELAYS)
    state = np.zeros(RELAYS, dtype=bool)
    share = np.empty_like(load)
    for n, value in enumerate(load):
        state = (state & (value > off)) | (value >= on)
        share[n] = state.mean()
    return share


def fractional_creep(load: FloatArray, dt_s: float, *, order: float = 0.2) -> FloatArray:
    """Response (n,) to a load (n,) of a material that creeps as (t / 60 s)^``order`` under a unit step."""
    changes = np.diff(load, prepend=0.0)
    compliance = ((np.arange(len(load)) + 1) * dt_s / 60.0) ** order
    response: FloatArray = fftconvolve(changes, compliance)[: len(load)]
    return response


def presses(rng: np.random.Generator, seconds: float, dt_s: float, *, holds: bool) -> FloatArray:
    """A normalised load (n,): presses of random height and speed, with pauses and holds or without any."""
    times, levels = [0.0, 5.0], [0.0, 0.0]
    while times[-1] < seconds:
        level = rng.uniform(0.3, 1.0) if levels[-1] < 0.3 else rng.uniform(0.0, 0.25)
        times.append(times[-1] + rng.uniform(1.0, 12.0))
        levels.append(level)
        if holds:
            times.append(times[-1] + rng.exponential(15.0))
            levels.append(level)
    at = np.arange(0, seconds, dt_s)
    load: FloatArray = np.interp(at, times, levels)
    return load


def relays(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Preisach hysteresis and fractional creep in random proportion, saturating."""
    share, order = rng.uniform(0.3, 0.7), rng.uniform(0.12, 0.3)
    deformed = share * preisach(load, rng)
    deformed += (1 - share) * fractional_creep(load, dt_s, order=order)
    gain = rng.uniform(0.3, 1.2)
    r: FloatArray = gain * np.tanh(1.2 * deformed) / np.tanh(1.2)
    return r


def spiky(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Conductive chains that motion breaks: two populations that heal at different speeds, less the fewer are left.

    Resistance also rises while the load falls. Creep is a sum of three exponentials.
    """
    gain = rng.uniform(0.3, 1.2)
    r = gain * (0.6 * load**0.8 + _creep(load, dt_s, rng, gains=(0.12, 0.08, 0.06), times_s=(1.0, 12.0, 150.0)))
    moved = np.abs(np.diff(load, prepend=load[0]))
    for heals_s, amount in ((rng.uniform(1, 4), 0.15), (rng.uniform(15, 60), 0.12)):
        kept, broken = np.exp(-dt_s / heals_s), 0.0
        for n, change in enumerate(moved.tolist()):
            broken = broken * kept + change * (1 - broken)
            r[n] += gain * amount * broken
    return r


def maxwell(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """A generalised Maxwell body of six relaxation times from 0.3 to 1000 s behind a power law."""
    gain, power = rng.uniform(0.3, 1.2), rng.uniform(0.6, 1.3)
    times = tuple(np.geomspace(0.3, 1000.0, 6) * np.exp(rng.uniform(-0.5, 0.5, 6)))
    gains = tuple(rng.dirichlet(np.full(6, 2.0)) * rng.uniform(0.2, 0.6))
    pressed = np.maximum(load, 0) ** power
    return np.asarray(gain * ((1 - sum(gains)) * pressed + _creep(pressed, dt_s, rng, gains=gains, times_s=times)))


def _creep(
    load: FloatArray,
    dt_s: float,
    rng: np.random.Generator,
    *,
    gains: tuple[float, ...],
    times_s: tuple[float, ...],
) -> FloatArray:
    """Sum of first-order lags, each gain and time constant varied by up to 30 %."""
    total = np.zeros_like(load)
    for gain, seconds in zip(gains, times_s, strict=True):
        keep = np.exp(-dt_s / (seconds * rng.uniform(0.7, 1.3)))
        total += gain * rng.uniform(0.7, 1.3) * lfilter([1 - keep], [1, -keep], load)
    return total


def paper(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """The paper's two models with random gains and times."""
    e1, e2, e3 = (1 / (rng.uniform(0.3, 1.2) * rng.dirichlet((4, 3, 2)))).tolist()
    eu1 = 1 / (1 / e1 + 1 / e2 + 1 / e3)
    etau2 = eu1 / rng.uniform(0.1, 0.5)
    model = PaperModel(
        e1_kpa=e1,
        e2_kpa=e2,
        e3_kpa=e3,
        eta2_kpa_s=e2 * rng.uniform(2, 10),
        eta3_kpa_s=e3 * rng.uniform(40, 200),
        eu1_kpa=eu1,
        etau2_kpa=etau2,
        eu2_kpa_per_s=etau2 / rng.uniform(2, 10),
    )
    return _of(model, load, dt_s)


def asymmetric(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Branches that charge at once and discharge slowly, with random gains and times."""
    e1, e2, e3 = (1 / (rng.uniform(0.3, 1.2) * rng.dirichlet((4, 3, 2)))).tolist()
    model = AsymmetricModel(
        e1_kpa=e1,
        e2_kpa=e2,
        e3_kpa=e3,
        eta2_kpa_s=e2 * rng.uniform(2, 10),
        eta3_kpa_s=e3 * rng.uniform(40, 200),
        rise_s=rng.uniform(0.05, 0.5),
    )
    return _of(model, load, dt_s)


def m10(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """The richest of the fitted kinds, with random gains and times; its exact inverse is often not safe."""
    a, alpha1, alpha2 = (rng.uniform(0.3, 1.2) * rng.dirichlet((3, 4, 2))).tolist()
    model = M10Model(
        a=a,
        b=rng.uniform(-0.6, 0.3) * (a + alpha1) / 2,
        alpha1=alpha1,
        rise1_s=rng.uniform(0.1, 1.5),
        fall1_s=rng.uniform(2, 10),
        alpha2=alpha2,
        fall2_s=rng.uniform(40, 400),
        k=rng.uniform(0.0, 0.3) * (a + alpha1),
        tau_s=rng.uniform(5, 60),
    )
    return _of(model, load, dt_s)


def contact(load: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Electrodes that touch: a power law with random exponent and range, without memory."""
    exponent, rest = rng.uniform(0.6, 1.6), np.exp(rng.uniform(np.log(5.0), np.log(300.0)))
    return np.asarray(1.0 / (1.0 / rest + np.maximum(load, 0.0) ** exponent) / rest - 1.0)


def _of(model: PaperModel | AsymmetricModel | M10Model, load: FloatArray, dt_s: float) -> FloatArray:
    """A forward model of the product with a full scale of 1 kPa."""
    cell = Cell(rest_resistance_ohm=1.0, full_scale_kpa=1.0, model=model)
    return np.asarray(cell.forward((1,)).run(np.full(len(load), dt_s), load[:, None])[:, 0] - 1.0)


MATERIALS: dict[str, Material] = {
    "relays": relays,
    "spiky": spiky,
    "maxwell": maxwell,
    "asymmetric": asymmetric,
    "m10": m10,
    "paper": paper,
    "contact": contact,
}


# -- loads -------------------------------------------------------------------------------------------------------------


def _along(points: list[tuple[float, float]], dt_s: float) -> FloatArray:
    """Straight lines between (seconds since the last point, level)."""
    seconds, levels = np.array(points).T
    at = np.cumsum(seconds)
    return np.asarray(np.interp(np.arange(0, at[-1], dt_s), at, levels))


def cyclic(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """20 s of rest, then equal presses without pause; 40 % of them are learned from."""
    rise, held, fall, pause = rng.uniform(3, 12), rng.uniform(0, 4), rng.uniform(3, 12), rng.uniform(0, 4)
    one = rise + held + fall + pause
    points = [(0.0, 0.0), (20.0, 0.0)]
    for _ in range(round(300 / one)):
        points += [(rise, 1.0), (held + 1e-6, 1.0), (fall, 0.0), (pause + 1e-6, 0.0)]
    return _along(points, dt_s), 20 + 0.4 * round(300 / one) * one


def random(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """Presses of random height and speed; those learned from have holds, half of the later ones have none."""
    load = np.concatenate([presses(rng, 240, dt_s, holds=holds) for holds in (True, True, False)])
    return np.clip(load, 0, None), 240.0


def new_speeds(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """Velocity profile of a displacement-controlled press: ten times slower, usual, ten times faster, or backwards.

    The specimen is pushed by a distance, and its force relaxes by up to 30 % while the distance is held. Only the usual
    speed and a few presses of the first other one are learned from.
    """
    order = [0.1, 10.0] if rng.random() < 0.5 else [10.0, 0.1]
    pieces, head_s = [], 0.0
    for place, factor in enumerate([1.0, *order]):
        points = [(0.0, 0.0), (4.0, 0.0)]
        for _ in range(14 if factor >= 1 else 6):
            level, seconds = rng.uniform(0.4, 1.0), 2.0 / factor
            points += [(seconds, level), (rng.uniform(0, 8), level), (seconds, 0.0), (rng.uniform(1, 8), 0.0)]
        pieces.append(_along(points, dt_s))
        if place == 0:
            head_s = len(pieces[0]) * dt_s
        elif place == 1:
            head_s += 0.25 * len(pieces[1]) * dt_s
    distance = np.concatenate(pieces)
    relaxing, keep = rng.uniform(0.1, 0.3), np.exp(-dt_s / rng.uniform(3, 15))
    force = distance - relaxing * lfilter([1 - keep], [1, -keep], distance)
    return np.clip(force / force.max(), 0, None), head_s


def mostly_rest(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """A press or two, then half a minute to a minute and a half of rest, again and again."""
    points = [(0.0, 0.0), (40.0, 0.0)]
    for _ in range(12):
        for _ in range(rng.integers(1, 3)):
            level = rng.uniform(0.4, 1.0)
            points += [(rng.uniform(1, 4), level), (rng.uniform(0.5, 6), level), (rng.uniform(1, 4), 0.0), (1.0, 0.0)]
        points += [(rng.uniform(30, 90), 0.0)]
    load = _along(points, dt_s)
    return load, 0.5 * len(load) * dt_s


def gripping(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """Presses of random height and length that waver, with short rests between."""
    points = [(0.0, 0.0), (4.0, 0.0)]
    while sum(seconds for seconds, _ in points) < 300.0:
        level, wavers = rng.uniform(0.1, 1.0), rng.random() < 0.4
        points.append((rng.uniform(0.05, 1.5), level))
        for _ in range(rng.integers(2, 20) if wavers else 1):
            points.append((rng.uniform(0.3, 1.0), level * (rng.uniform(0.7, 1.0) if wavers else 1.0)))
        points += [(rng.uniform(0.05, 1.5), 0.0), (rng.exponential(1.5) + dt_s, 0.0)]
    return _half(_along(points, dt_s), dt_s)


def taps(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """Series of short taps, half a second apart, and rests of some seconds."""
    points = [(0.0, 0.0), (5.0, 0.0)]
    while sum(seconds for seconds, _ in points) < 240.0:
        for _ in range(rng.integers(1, 8)):
            points += [(0.1, rng.uniform(0.2, 1.0)), (rng.uniform(0.05, 0.2), points[-1][1]), (0.1, 0.0), (0.4, 0.0)]
        points.append((rng.uniform(2, 12), 0.0))
    return _half(_along(points, dt_s), dt_s)


def walking(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """Steps of a foot, about one in 1.2 s with two humps each, and pauses of standing between."""
    points = [(0.0, 0.0), (5.0, 0.0)]
    while sum(seconds for seconds, _ in points) < 240.0:
        for _ in range(rng.integers(6, 20)):
            weight = rng.uniform(0.8, 1.0)
            points += [
                (0.15, weight),
                (0.2, 0.75 * weight),
                (0.2, 0.95 * weight),
                (0.15, 0.0),
                (rng.uniform(0.4, 0.6), 0.0),
            ]
        points += [(0.3, 0.5), (rng.uniform(2, 10), 0.5), (0.3, 0.0), (rng.uniform(1, 6), 0.0)]
    return _half(_along(points, dt_s), dt_s)


def steps(rng: np.random.Generator, dt_s: float) -> tuple[FloatArray, float]:
    """Stairs of random levels that are held for 2 to 20 s."""
    points = [(0.0, 0.0), (5.0, 0.0)]
    while sum(seconds for seconds, _ in points) < 400.0:
        level = 0.0 if rng.random() < 0.3 else rng.uniform(0.1, 1.0)
        points += [(0.2, level), (rng.uniform(2, 20), level)]
    return _half(_along(points, dt_s), dt_s)


def _half(load: FloatArray, dt_s: float) -> tuple[FloatArray, float]:
    """A load of which the first half is learned from."""
    return load, 0.5 * len(load) * dt_s


LOADS: dict[str, Load] = {
    "cyclic": cyclic,
    "random": random,
    "new speeds": new_speeds,
    "mostly rest": mostly_rest,
    "gripping": gripping,
    "taps": taps,
    "walking": walking,
    "steps": steps,
}
