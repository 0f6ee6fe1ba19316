"""Scenes that estimators are judged by: loads on cells, and how a board reads them (noise, an ADC, faults).

A load is simulated in steps shorter than a frame, so that it may turn, begin and end between two frames. No estimator
is informed of that. Every scene is a skin of its own and reproducible: its noise is drawn from its name.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from ..cell import AsymmetricModel, Cell, ContactModel, M10Model, PaperModel
from ..common.arrays import BoolArray, FloatArray
from ..errors import InputError

CELLS = 8
"""of a scene, unless its load has a shape of its own"""
SUBSTEPS = 4
"""in which a frame is simulated"""
MOST_FRAMES = 6000
"""of scenes of usual length: fast boards are judged for less time"""
USUAL_S = 16.0
MOST_VOLTS = 2.0
"""of the amplifier, for the lesser of the resistances at rest and at full scale"""
RANGE_V = 3.3
"""of the ADC"""
Fault = Literal["", "sparks", "lost frames", "opens", "intermittent", "degrading", "divider", "mismatched"]
MISMATCH = 0.05
"""largest relative error of each parameter of a mismatched cell, of which the estimator knows the exact one"""
COLUMN_NOISE = 4.0
"""standard deviation of the conductances by noise and steps that a column of a divider shares, over that by own ones"""


@cache
def cells() -> dict[str, Cell]:
    """The shipped example, and a cell of every kind that differs from it in R0, full scale and time constants.

    ``fsr`` is a contact that the board cannot tell from an open one at rest.
    """
    paper = PaperModel(
        eu1_kpa=100.0,
        etau2_kpa=500.0,
        eu2_kpa_per_s=250.0,
        e1_kpa=150.0,
        e2_kpa=400.0,
        e3_kpa=1200.0,
        eta2_kpa_s=2000.0,
        eta3_kpa_s=50000.0,
    )
    asymmetric = AsymmetricModel(e1_kpa=90.0, e2_kpa=200.0, e3_kpa=900.0, eta2_kpa_s=700.0, eta3_kpa_s=40000.0)
    m10 = M10Model(a=0.5, b=-0.1, alpha1=0.3, rise1_s=0.3, fall1_s=4.0, alpha2=0.1, fall2_s=90.0, k=0.1, tau_s=20.0)
    contact = ContactModel(exponent=1.1, full_scale_resistance_ohm=900.0)
    return {
        "example": Cell.example(),
        "paper": Cell(rest_resistance_ohm=2200.0, full_scale_kpa=60.0, model=paper),
        "asymmetric": Cell(rest_resistance_ohm=47e3, full_scale_kpa=35.0, model=asymmetric),
        "m10": Cell(rest_resistance_ohm=5600.0, full_scale_kpa=150.0, model=m10),
        "contact": Cell(rest_resistance_ohm=3300.0, full_scale_kpa=20.0, model=contact),
        "fsr": Cell(rest_resistance_ohm=1e7, full_scale_kpa=50.0, model=contact),
    }


# -- loads -------------------------------------------------------------------------------------------------------------

Single = Callable[[FloatArray, float], FloatArray]
"""times in s of any shape and seconds of a frame -> shares of the largest load, of the same shape"""


@dataclass(frozen=True)
class Load:
    """What presses the cells of a scene."""

    share: Callable[[FloatArray, float], FloatArray]
    """times (n,) in s and seconds of a frame -> shares of full scale (n, *cells)"""
    seconds: float = USUAL_S


_PRESS = [0.0, 1.0, 1.0, 0.0]


def _along(at_s: list[float], shares: list[float]) -> Single:
    return lambda t, _: np.interp(t, at_s, shares)


def _train(t: FloatArray, period_s: float, rise_s: float, hold_s: float) -> FloatArray:
    """Taps from 1 s to 8 s, one each period."""
    shape = np.interp((t - 1.0) % period_s, [0.0, rise_s, rise_s + hold_s, 2.0 * rise_s + hold_s], _PRESS)
    return np.asarray(shape * ((t > 1.0) & (t < 8.0)))


def _held(t: FloatArray) -> FloatArray:
    return np.asarray(np.interp(t, [1.0, 1.2, 9.0, 9.1], [0.0, 0.7, 0.7, 0.0]))


@cache
def _presses_at_random() -> tuple[FloatArray, FloatArray]:
    """Corners (120,) in s, in order, and loads there. A press that begins within the last one goes on from there."""
    starts_s = 0.7 + np.cumsum(np.random.default_rng(5).exponential(0.5, 60))
    levels, rise_s = np.random.default_rng(6).choice([0.0, 0.0, 0.3, 0.6, 1.0], 60), 0.04
    ends_s = np.minimum(starts_s + rise_s, np.append(starts_s[1:], np.inf))
    load, loads = 0.0, []
    for start_s, end_s, level in zip(starts_s, ends_s, levels, strict=True):
        loads.append(load)
        part = (end_s - start_s) / rise_s
        load = level if part > 1 - 1e-9 else load + part * (level - load)  # a rounded load would be a turn
        loads.append(load)
    return np.stack([starts_s, ends_s], axis=1).ravel(), np.array(loads)


def _step_of_a_foot(t: FloatArray, _: float) -> FloatArray:
    """Vertical force under a walking foot: stances of 0.62 s with two peaks, every 1.05 s, each a little different."""
    step = np.floor((t - 1.0) / 1.05).astype(int)
    height = np.random.default_rng(8).uniform(0.85, 1.0, 64)[np.clip(step, 0, 63)]
    shape = np.interp((t - 1.0) % 1.05, [0.0, 0.1, 0.3, 0.5, 0.62], [0.0, 1.0, 0.72, 0.95, 0.0])
    return np.asarray(height * shape * ((t > 1.0) & (t < 13.0)))


_SINGLES: dict[str, Single] = {
    "rest": lambda t, _: 0.0 * t,
    "hold": _along([0.5, 0.6], [0.0, 1.0]),
    "edge": _along([2.0, 2.02], [0.0, 1.0]),
    "press": _along([2.0, 2.2, 5.0, 5.2], _PRESS),
    "slow ramp": _along([1.0, 7.0, 9.0, 13.0], _PRESS),
    "fast ramp": lambda t, _: np.interp((t - 1.0) % 3.0, [0.0, 0.3, 1.5, 2.0], _PRESS) * (t > 1.0),
    "sine": lambda t, _: 0.5 * (1.0 - np.cos(2.0 * np.pi * 0.7 * (t - 1.0))) * (t > 1.0),
    "taps": lambda t, _: np.interp((t - 1.0) % 1.0, [0.0, 0.03, 0.5, 0.53], _PRESS) * ((t > 1.0) & (t < 13.0)),
    "stairs": _along([1, 1.05, 3, 3.05, 5, 5.05, 7, 7.05, 9, 9.05], [0, 0.4, 0.4, 1, 1, 0.6, 0.6, 0.8, 0.8, 0]),
    "quick taps": lambda t, frame_s: _train(t, 40 * frame_s, 1.2 * frame_s, 5 * frame_s),
    "short taps": lambda t, frame_s: _train(t, 20 * frame_s, 0.5 * frame_s, 2 * frame_s),
    "drumming": lambda t, frame_s: _train(t, 4 * frame_s, 0.5 * frame_s, 1.5 * frame_s) * ((t - 1.0) % 1.0 < 0.4),
    "vibration": lambda t, frame_s: (
        _held(t) + 0.15 * np.sin(2.0 * np.pi * 0.28 / frame_s * t) * ((t > 3.0) & (t < 8.0))
    ),
    "slip": lambda t, frame_s: _held(t) + 0.3 * (0.12 / frame_s * (t - 2.0) % 1.0) * ((t > 2.0) & (t < 6.0)),
    "random": lambda t, _: np.interp(t, *_presses_at_random()),
    "walking": _step_of_a_foot,
}
"""Quick and short taps last for six and three frames; drumming and vibration have about four frames in a period, slip
has eight."""


def _on_each(single: Single) -> Callable[[FloatArray, float], FloatArray]:
    """Each cell another strength, every fourth one none; up to 0.4 s apart, so that edges are not in step."""

    def share(t: FloatArray, frame_s: float) -> FloatArray:
        strength = np.linspace(0.25, 0.9, CELLS)
        strength[::4] = 0.0
        return np.asarray(strength * single(t[:, None] - np.linspace(0.0, 0.37, CELLS), frame_s))

    return share


def _finger(t: FloatArray, _: float) -> FloatArray:
    """Rolls to and fro over all cells."""
    place = -2.0 + (CELLS + 4.0) * (0.5 - 0.5 * np.cos(2.0 * np.pi * 0.15 * t))
    share: FloatArray = 0.8 * np.exp(-((place[:, None] - np.arange(CELLS)) ** 2) / 1.5)
    share[share < 0.005] = 0.0
    return share


def _rub(t: FloatArray, _: float) -> FloatArray:
    """A third of full scale for 90 ms (half of the height), every 0.4 s."""
    since = (t[:, None] - np.linspace(2.3, 2.7, CELLS) + 0.2) % 0.4 - 0.2
    during = (t[:, None] > 2.1) & (t[:, None] < 12.0)
    return np.asarray(0.35 * np.exp(-0.5 * (since / 0.0382) ** 2) * during)


def _twelve_taps(t: FloatArray, _: float) -> FloatArray:
    """Of 58 % of full scale on all cells, which is 9 kPa on the example cell."""
    shape = np.interp((t - 1.0) % 1.0, [0.0, 0.03, 0.5, 0.53], _PRESS) * ((t >= 1.0) & (t < 13.0))
    return np.repeat(0.58 * shape[:, None], CELLS, axis=1)


def _light_taps(taps_hz: float) -> Callable[[FloatArray, float], FloatArray]:
    """Of 1, 2, 4 and 8 % of full scale."""

    def share(t: FloatArray, _: float) -> FloatArray:
        phase = (t[:, None] - 1.0 - np.linspace(0.0, 0.37, CELLS)) * taps_hz
        shape = np.interp(phase % 1.0, [0.0, 0.06, 0.4, 0.46], _PRESS) * (phase > 0.0)
        return np.asarray(np.repeat([0.01, 0.02, 0.04, 0.08], CELLS // 4) * shape)

    return share


def _after_taps(rise_s: tuple[float, ...]) -> Callable[[FloatArray, float], FloatArray]:
    """Presses to 10 to 60 % of full scale, 0.1 to 1.9 s after the last of eight taps, held for 4 s."""

    def share(t: FloatArray, _: float) -> FloatArray:
        level, after_s = (part.ravel() for part in np.meshgrid(np.linspace(0.1, 0.6, 6), np.linspace(0.1, 1.9, 4)))
        rise = np.resize(rise_s, level.size)
        begin = 4.7 + after_s
        taps = np.interp((t - 1.0) % 0.5, [0.0, 0.03, 0.18, 0.21], _PRESS) * ((t >= 1.0) & (t < 5.0))
        time = t[:, None]
        press = np.clip((time - begin) / rise, 0, 1) * np.clip(1 - (time - begin - rise - 4.0) / 0.05, 0, 1)
        return np.asarray(0.8 * taps[:, None] + level * press)

    return share


def _taps_on_a_hold(t: FloatArray, _: float) -> FloatArray:
    """Fourteen taps on top of holds of 3 to 10 % of full scale."""
    time = t[:, None]
    taps = np.interp((time - 6) % 1.1, [0, 0.03, 0.18, 0.21], _PRESS) * ((time >= 6) & (time < 6 + 14 * 1.1))
    return np.asarray(0.7 * taps + np.linspace(0.03, 0.1, CELLS) * np.interp(time, [3, 3.3, 26, 26.3], _PRESS))


def _sags(period_s: float, at_s: list[float], sag: float) -> Callable[[FloatArray, float], FloatArray]:
    """Presses whose load falls by a share ``sag`` while they are held."""

    def share(t: FloatArray, _: float) -> FloatArray:
        press = np.interp((t - 1.0) % period_s, at_s, [0.0, 1.0, 1.0 - sag, 0.0]) * (t >= 1.0)
        return np.asarray(press[:, None] * np.linspace(0.15, 0.7, CELLS))

    return share


def _relaxing(t: FloatArray, _: float) -> FloatArray:
    """A press, and then a grip that relaxes by 5 to 25 % within six seconds."""
    before = np.interp(t, [0.5, 0.55, 1.0, 1.05], _PRESS)[:, None] * 0.65
    left = 1.0 - np.linspace(0.05, 0.25, CELLS) * np.clip((t[:, None] - 2.1) / 6.0, 0, 1)
    grip = np.interp(t, [2.0, 2.1, 8.1, 8.2], _PRESS)[:, None] * left
    return np.asarray(before + grip * np.resize([0.35, 0.5, 0.7, 0.85], CELLS))


def _growing(t: FloatArray, _: float) -> FloatArray:
    """Loads that have fallen to 30 % of full scale, and grow by 0.2 to 5 % of it a second."""
    held = np.interp(t, [0.5, 0.6, 3.0, 3.1], [0.0, 0.85, 0.85, 0.3])
    per_s = np.array([0.002, 0.005, 0.01, 0.015, 0.02, 0.025, 0.03, 0.05])
    return np.asarray(held[:, None] + per_s * np.clip(t - 3.1, 0.0, 9.0)[:, None])


def _wavering(t: FloatArray, _: float) -> FloatArray:
    """Holds that waver by 1 to 3 %: an Ornstein-Uhlenbeck process of 1 s, smoothed over 0.2 s."""
    step_s, random = 0.01, np.random.default_rng(3)
    at = np.arange(0.0, float(t[-1]) + 1.0, step_s)
    steps = random.standard_normal((len(at), CELLS))
    wavers = np.zeros_like(steps)
    for before, now, step in zip(wavers[:-1], wavers[1:], steps[1:], strict=True):
        now[:] = before * np.exp(-step_s) + step * np.sqrt(-np.expm1(-2.0 * step_s))
    smooth = np.apply_along_axis(np.convolve, 0, wavers, np.ones(20) / 20, "same")
    here = np.stack([np.interp(t, at, column) for column in smooth.T], axis=1)
    held = np.interp(t, [1.0, 1.1, 13.0, 13.1], _PRESS)[:, None]
    return np.asarray(0.6 * held * (1.0 + np.resize([0.01, 0.02, 0.03], CELLS) * here))


def _tremor(t: FloatArray, _: float) -> FloatArray:
    """Holds of 40 % of full scale that tremble at 1.5 to 8 Hz by 2 % of the load (rms)."""
    hertz = np.geomspace(1.5, 8.0, CELLS)
    wave = 0.02 * np.sqrt(2) * np.sin(2 * np.pi * hertz * t[:, None] + hertz) * (t > 1.5)[:, None]
    return np.asarray(0.4 * np.interp(t, [1.0, 1.3, 10.0, 10.2], _PRESS)[:, None] * (1.0 + wave))


def _grip_that_trembles(t: FloatArray, _: float) -> FloatArray:
    """A contact of 4 x 4 cells in an array of 6 x 6, all of which tremble together by 4 % (rms) at 3.3 Hz."""
    profile = np.zeros((6, 6))
    profile[1:5, 1:5] = np.outer([0.5, 1.0, 1.0, 0.6], [0.4, 1.0, 0.9, 0.5])
    wave = 0.04 * np.sqrt(2) * np.sin(2 * np.pi * 3.3 * t) * (t > 1.5)
    held = 0.4 * np.interp(t, [1.0, 1.3, 25.0, 25.2], _PRESS) * (1.0 + wave)
    return np.asarray(held[:, None, None] * profile)


def _fingers_on_an_array(t: FloatArray, _: float) -> FloatArray:
    """A finger taps on an array of 8 x 6 cells, twice a second, while another one holds two cells."""
    rows, columns = np.mgrid[:8, :6]
    tapped = 0.9 * np.exp(-0.6 * ((rows - 2.3) ** 2 + (columns - 3.1) ** 2))
    tapped[tapped < 0.01] = 0.0
    taps = np.interp((t - 1.0) % 0.5, [0.0, 0.02, 0.15, 0.17], _PRESS) * (t > 1.0)
    share = tapped * taps[:, None, None]
    share[:, 6:8, 1] += (0.5 * np.interp(t, [0.6, 0.7, 5.5, 5.6], _PRESS))[:, None]
    return np.asarray(share)


def _finger_across_an_array(t: FloatArray, _: float) -> FloatArray:
    """A finger moves to and fro over an array of 6 x 6 cells, and away from it."""
    rows, columns = np.mgrid[:6, :6]
    row, column = 2.5 + 0.8 * np.sin(1.46 * t), -1.5 + 8.0 * (0.5 - 0.5 * np.cos(1.05 * t))
    square = (rows - row[:, None, None]) ** 2 + (columns - column[:, None, None]) ** 2
    share: FloatArray = 0.7 * np.exp(-square / 2.0)
    share[share < 0.01] = 0.0
    return share


def _finger_that_vibrates(t: FloatArray, _: float) -> FloatArray:
    """39 % of full scale, 19 % to and fro at 12 Hz (6 and 3 kPa on the example cell); cells beside get less."""
    held = np.interp(t, [1.0, 1.2, 9.0, 9.1], _PRESS)
    wave = 0.39 * held + 0.19 * np.sin(2 * np.pi * 12.0 * t) * np.interp(t, [1.5, 2.0, 8.5, 9.0], _PRESS)
    return np.asarray(wave[:, None] * np.array([0.0, 0.5, 0.8, 1.0, 1.0, 0.7, 0.4, 0.0]))


def _ten_minutes(t: FloatArray, _: float) -> FloatArray:
    return np.asarray(np.interp(t, [2.0, 2.2, 602.0, 602.2], _PRESS)[:, None] * np.linspace(0.3, 0.9, CELLS))


LOADS: dict[str, Load] = {
    **{name: Load(_on_each(single)) for name, single in _SINGLES.items()},
    "finger": Load(_finger),
    "rubbing": Load(_rub),
    "twelve taps": Load(_twelve_taps, 15.0),
    "light taps, 1 Hz": Load(_light_taps(1.0)),
    "light taps, 3 Hz": Load(_light_taps(3.0)),
    "press after taps": Load(_after_taps((0.2,)), 11.5),
    "slow press after taps": Load(_after_taps((0.5, 1.0, 1.5, 2.0, 2.5, 3.0)), 14.5),
    "taps on a light hold": Load(_taps_on_a_hold, 30.0),
    "taps that sag by 10 %": Load(_sags(1.0, [0.0, 0.03, 0.5, 0.53], 0.1), 21.0),
    "taps that sag by 20 %": Load(_sags(1.0, [0.0, 0.03, 0.5, 0.53], 0.2), 21.0),
    "grips that sag": Load(_sags(3.0, [0.0, 0.15, 2.0, 2.15], 0.1), 31.0),
    "relaxing": Load(_relaxing, 14.0),
    "growing after a fall": Load(_growing, 12.5),
    "wavering": Load(_wavering),
    "tremor of 2 %": Load(_tremor, 12.0),
    "grip that trembles": Load(_grip_that_trembles, 27.0),
    "fingers on an array": Load(_fingers_on_an_array, 7.0),
    "finger across an array": Load(_finger_across_an_array),
    "finger that vibrates": Load(_finger_that_vibrates, 12.0),
    "hold of ten minutes": Load(_ten_minutes, 620.0),
}


# -- what a board reads ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """One load on one cell type, read by one board."""

    load: str
    cell: str
    rate_hz: float = 100.0
    bits: int = 12
    noise_mv: float = 1.0
    fault: Fault = ""

    @property
    def name(self) -> str:
        fault = f", {self.fault}" if self.fault else ""
        return f"{self.load}{fault} | {self.cell}, {self.rate_hz:g} Hz, {self.bits} bits, {self.noise_mv:g} mV"


@dataclass(frozen=True)
class Played:
    """Frames of a scene; arrays are (n, *cells)."""

    frame_s: float
    pressure_kpa: FloatArray
    siemens: FloatArray
    """NaN where the converter is at a limit, or nothing is read"""
    counts: FloatArray
    """NaN where nothing is read"""
    arrives: BoolArray
    """(n,) which frames do"""
    step_siemens: float
    noise_siemens: float
    """standard deviation of the noise of a cell's own reading"""
    volts_per_siemens: float
    shares_columns: bool = False
    """whether noise scales all conductances of a column alike"""

    @property
    def time_s(self) -> FloatArray:
        return self.frame_s * np.arange(1.0, len(self.pressure_kpa) + 1)

    @property
    def ohms(self) -> FloatArray:
        """Readings as an estimator of resistances gets them: infinite where the converter shows nothing."""
        limit = np.where(self.counts == 0.0, np.inf, np.nan)
        return np.where(np.isnan(self.siemens), limit, 1.0 / self.siemens)


def play(scene: Scene) -> Played:
    """The frames of a scene.

    Raises:
        InputError: no such load or cell.

    """
    if scene.load not in LOADS:
        raise InputError(f"no load '{scene.load}'; expected one of {', '.join(LOADS)}")
    if scene.cell not in cells():
        raise InputError(f"no cell '{scene.cell}'; expected one of {', '.join(cells())}")
    load, cell, frame_s = LOADS[scene.load], cells()[scene.cell], 1.0 / scene.rate_hz
    frames = round(load.seconds * scene.rate_hz)
    if load.seconds <= USUAL_S:
        frames = min(frames, MOST_FRAMES)
    random = np.random.default_rng(zlib.crc32(scene.name.encode()))
    fine = load.share(frame_s / SUBSTEPS * np.arange(1.0, frames * SUBSTEPS + 1), frame_s)
    return read(cell, fine, frame_s, scene.noise_mv, random, scene.bits, scene.fault)


def read(
    cell: Cell,
    share: FloatArray,
    frame_s: float,
    noise_mv: float,
    random: np.random.Generator,
    bits: int = 12,
    fault: Fault = "",
) -> Played:
    """Frames of a board under loads ``share`` (n SUBSTEPS, *cells) of full scale: white noise of volts, and an ADC."""
    steps = np.full(len(share), frame_s / SUBSTEPS)
    if fault == "mismatched":
        each = [
            mismatched(cell, seed).forward((1,)).run(steps, one)
            for seed, one in enumerate(np.moveaxis(share.reshape(len(share), -1, 1) * cell.full_scale_kpa, 1, 0))
        ]
        ohm = np.concatenate(each, axis=1).reshape(share.shape)[SUBSTEPS - 1 :: SUBSTEPS]
    else:
        ohm = cell.forward(share.shape[1:]).run(steps, share * cell.full_scale_kpa)[SUBSTEPS - 1 :: SUBSTEPS]
    if fault == "degrading":
        ohm = _degraded(ohm, cell.rest_resistance_ohm)
    full_scale_ohm = float(cell.forward(()).step(1.0, np.asarray(cell.full_scale_kpa)))
    volts_per_siemens = MOST_VOLTS * min(cell.rest_resistance_ohm, full_scale_ohm)
    step_v = RANGE_V / 2**bits
    volts = volts_per_siemens / ohm + 1e-3 * noise_mv * random.standard_normal(ohm.shape)
    if fault == "divider":
        of_column = COLUMN_NOISE * np.hypot(1e-3 * noise_mv, step_v / 12**0.5) / MOST_VOLTS
        volts *= 1.0 + of_column * random.standard_normal((len(volts), 1, *volts.shape[2:]))
    counts, arrives = _faulty(np.round(volts / step_v), fault, frame_s, volts_per_siemens / step_v)
    counts = np.clip(counts, 0.0, 2**bits - 1)
    inside = (counts > 0) & (counts < 2**bits - 1)
    step_siemens = step_v / volts_per_siemens
    return Played(
        frame_s=frame_s,
        pressure_kpa=share[SUBSTEPS - 1 :: SUBSTEPS] * cell.full_scale_kpa,
        siemens=np.where(inside, counts * step_siemens, np.nan),
        counts=counts,
        arrives=arrives,
        step_siemens=step_siemens,
        noise_siemens=1e-3 * noise_mv / volts_per_siemens,
        volts_per_siemens=volts_per_siemens,
        shares_columns=fault == "divider",
    )


def mismatched(cell: Cell, seed: int) -> Cell:
    """The cell with each parameter off by up to :data:`MISMATCH`; both phases of a ``paper`` cell share their rest."""
    model, random = cell.model, np.random.default_rng(seed)
    off = {
        name: value * random.uniform(1.0 - MISMATCH, 1.0 + MISMATCH)
        for name, value in model.model_dump().items()
        if isinstance(value, float)
    }
    if isinstance(model, PaperModel):
        off["eu1_kpa"] = 1.0 / (1.0 / off["e1_kpa"] + 1.0 / off["e2_kpa"] + 1.0 / off["e3_kpa"])
    return cell.replace(model=model.replace(**off))


def _degraded(ohm: FloatArray, rest_ohm: float) -> FloatArray:
    """A cell whose rest rises to 1.3 times and whose gain falls to 0.6 times what it was."""
    share = np.linspace(0.0, 1.0, len(ohm)).reshape(-1, *[1] * (ohm.ndim - 1))
    return np.asarray(rest_ohm * (1.0 + 0.3 * share) * (1.0 + (ohm / rest_ohm - 1.0) * (1.0 - 0.4 * share)))


def _faulty(counts: FloatArray, fault: Fault, frame_s: float, counts_ohm: float) -> tuple[FloatArray, BoolArray]:
    """Counts with faults in them, and (n,) which frames arrive.

    A bad contact reads 2.5 times the resistance for 60 ms, every 2.9 s; three of ten frames are lost in the middle;
    cells open for half a second, and read some megohms as they do. Intermittent contacts of every cell are bad twice a
    second, for 60 ms in the mean, and then read 1.4 times the resistance, 2.5 times, or nothing.
    """
    found, arrives = counts.copy(), np.ones(len(counts), dtype=np.bool_)
    seconds = len(counts) * frame_s
    if fault == "sparks":
        for start in np.arange(2.6, seconds, 2.9):
            part = slice(round(start / frame_s), round((start + 0.06) / frame_s))
            found[part] = np.round(found[part] / 2.5)
    elif fault == "lost frames":
        middle = slice(round(0.3 * len(counts)), round(0.6 * len(counts)))
        arrives[middle] = np.random.default_rng(0).random(len(counts[middle])) > 0.3
    elif fault == "intermittent":
        random = np.random.default_rng(0)
        changes = 1.0 - np.exp(-frame_s / np.array([0.5, 0.06]))
        reads, cells = np.ones(counts.shape[1:]), counts.shape[1:]
        for n in range(round(0.6 / frame_s), len(counts)):
            change = random.random(cells) < changes[(reads < 1.0).astype(int)]
            reads[change] = np.where(reads < 1.0, 1.0, random.choice([0.0, 1 / 2.5, 1 / 1.4], cells))[change]
            found[n] = np.round(found[n] * reads)
    elif fault == "opens":
        for cell, start in enumerate(seconds * np.linspace(0.19, 0.81, counts.shape[1])):
            first, last = round(start / frame_s), round((start + 0.5) / frame_s)
            found[first, cell] = np.round(counts_ohm / 4e6)
            found[first + 1 : last, cell] = 0.0 if cell % 2 else np.nan
    return found, arrives
