"""Regression scenarios of ``scenarios.toml``: how well an estimator does on each scene, and whether its gate is met.

``ohmskin bench --scenarios`` prints the table. It takes anything that is stepped as an
:class:`ohmskin.cell.Estimator` is and states ``std_kpa``: by the name of one of the project's estimators, or by
``module:function``, where the function takes a cell and the shape of its frames.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, astuple, dataclass, field, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..cell import ESTIMATORS, Cell, estimate_recording
from ..common import config
from ..common.arrays import FloatArray
from ..common.config import NotNegative, Positive, Section
from ..common.measurement import Measurement
from ..errors import InputError
from . import recordings
from .harness import column, interval_score
from .scenes import COLUMN_NOISE, MOST_VOLTS, Fault, Played, Scene, cells, play

TABLE = Path(__file__).with_name("scenarios.toml")
JUDGED_FROM_S, JUDGED_FROM_FRAMES = 0.5, 10.0
"""nothing is judged earlier: the noise is not known yet"""
REST_AFTER_S = 1.0
"""without load, from when on what is shown counts as shown at rest"""
RECORDING_S = 120.0
"""of a recording before and after the moment up to which is learned"""
QUICK_EVERY = 12
"""of the scenes, one is in the quick selection"""


class Judged(Protocol):
    """What can be judged. Where it has it, ``resolve(...)`` is called as a skin calls it."""

    def step(self, elapsed_s: float, resistance: ArrayLike, /) -> FloatArray:
        """Take a frame in ohm; returns kPa."""

    @property
    def std_kpa(self) -> FloatArray:
        """Standard deviation of the last step's pressure."""


Maker = Callable[[Cell, tuple[int, ...]], Judged]


class Gate(Section):
    """Limits of the figures of a row; a limit that is absent is none."""

    rmse_percent: NotNegative = 0.0
    """is added to what the next two allow"""
    rmse_times_today: NotNegative | None = None
    rmse_times_static: NotNegative | None = None
    within_percent: NotNegative | None = None
    interval_times_today: NotNegative | None = None
    rest_percent: NotNegative | None = None


class Block(Section):
    """Scenes: the product of the lists."""

    gate: str
    loads: list[str]
    cells: list[str]
    rates_hz: list[Positive] = Field(default_factory=lambda: [100.0])
    bits: list[int] = Field(default_factory=lambda: [12])
    noises_mv: list[NotNegative] = Field(default_factory=lambda: [1.0])
    faults: list[Fault] = Field(default_factory=lambda: list[Fault]([""]))


class Recordings(Section):
    """Calibrations with defaults, on some of the :mod:`.recordings`."""

    gate: str
    names: list[str]


class Table(Section):
    """``scenarios.toml``."""

    gates: dict[str, Gate]
    block: list[Block]
    recordings: Recordings
    today: dict[str, list[float]] = Field(default_factory=dict)
    """figures of each row, as in :class:`Figures`, of the estimator that was frozen"""


@dataclass(frozen=True)
class Figures:
    """How an estimator does on one row."""

    rmse: float
    """% of full scale"""
    within: float
    """% of the errors within two stated deviations"""
    interval: float
    """mean interval score (Gneiting & Raftery 2007, equation 43) of the 95 % interval of two deviations to both sides,
    % of full scale: its width, and 40 times the distance of a truth that lies outside"""
    sd: float
    """median stated deviation, % of full scale"""
    rest: float = np.nan
    """largest pressure shown a second after a release or later, % of full scale; NaN where no cell is released"""
    static: float = np.nan
    """RMSE of the static curve on the same recording"""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    gate: str
    limits: Gate
    today: Figures | None
    scene: Scene | None
    """None: a recording"""
    quick: bool


@dataclass(frozen=True)
class Verdict:
    """A row with what was measured."""

    row: Row
    found: Figures
    misses: tuple[str, ...]
    """names of the figures that miss their limits"""
    seconds: float
    """processor time of the estimator"""
    cell_frames: int


def rows(only: str = "", *, quick: bool = False) -> list[Row]:
    """Rows of the table whose name or gate contains ``only``, which may have the wildcards of a shell.

    Any other recording becomes a row by its name (:mod:`.recordings`).

    Raises:
        InputError: the table is not valid, or there is no such row.

    """
    table = config.load(TABLE, Table)
    scenes = [
        (Scene(load, cell, rate, bits, noise, fault), block.gate)
        for block in table.block
        for cell, rate, bits, noise, load, fault in product(
            block.cells, block.rates_hz, block.bits, block.noises_mv, block.loads, block.faults
        )
    ]
    found: list[tuple[str, str, Scene | None]] = [(scene.name, gate, scene) for scene, gate in scenes]
    found += [(name, table.recordings.gate, None) for name in table.recordings.names]
    every = []
    for place, (name, gate, scene) in enumerate(found):
        frozen = table.today.get(name)
        quickly = scene is not None and place % QUICK_EVERY == 0
        every.append(Row(name, gate, table.gates[gate], Figures(*frozen) if frozen else None, scene, quickly))
    pattern = f"*{only}*"
    chosen = [row for row in every if any(fnmatchcase(part, pattern) for part in (row.name, row.gate))]
    chosen = [row for row in chosen if row.quick or not quick]
    if not chosen and recordings.is_name(only):
        recordings.specimen(only)  # which says what is wrong with a name
        gate = table.recordings.gate
        return [Row(only, gate, table.gates[gate], None, None, quick=False)]
    if not chosen:
        raise InputError(
            f"no row of {TABLE.name} contains '{only}'; a row is called '{every[0].name}', and * stands for any text"
        )
    return chosen


def maker(name: str | None) -> Maker:
    """What makes the estimator of a cell.

    Args:
        name: of an estimator, or ``module:function``, where the module may be a file in the working directory; None:
            each cell's default.

    Raises:
        InputError: there is no such function.

    """
    if name is None or ":" not in name:
        return lambda cell, shape: cell.estimator(shape, name)
    module, _, function = name.partition(":")
    if "" not in sys.path:  # an installed command does not look in the working directory, as ``python -m`` does
        sys.path.append("")
    try:
        made: Maker = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise InputError(f"no estimator '{name}': {error}") from error
    return made


def judge(chosen: Iterable[Row], make: Maker) -> Iterator[Verdict]:
    """Play the rows. Rows for whose cell there is no such estimator are left out."""
    for row in chosen:
        try:
            found, seconds, cell_frames = _recorded(row.name, make) if row.scene is None else _played(row.scene, make)
        except InputError as error:
            if "estimator" in str(error):
                continue
            raise
        yield Verdict(row, found, misses(row, found), seconds, cell_frames)


def estimated(played: Played, estimator: Judged) -> tuple[FloatArray, FloatArray, float]:
    """Pressure and standard deviation (n, *cells) in kPa, NaN in lost frames; and the processor time in s.

    An estimator that has ``update`` gets what a circuit's inverse knows of the errors, where columns share some.
    """
    ohms, update = played.ohms, getattr(estimator, "update", None) if played.shares_columns else None
    if update is None and (resolve := getattr(estimator, "resolve", None)) is not None:
        at_rest = np.where(np.isfinite(ohms[0]), ohms[0], np.nan)
        resolve(played.step_siemens / np.sqrt(12.0) * at_rest, at_rest)
    pressure, std = np.full((2, *ohms.shape), np.nan)
    last, spent = -1, 0.0
    for n in np.flatnonzero(played.arrives).tolist():
        elapsed_s = (n - last) * played.frame_s
        measured = None if update is None else _measured(played, n)
        start = process_time()
        pressure[n] = estimator.step(elapsed_s, ohms[n]) if update is None else update(elapsed_s, measured)
        std[n] = estimator.std_kpa
        spent += process_time() - start
        last = n
    return pressure, std, spent


def _measured(played: Played, n: int) -> Measurement:
    """Frame ``n`` as a skin hands it over: its noise is that of the board."""
    siemens, own = played.siemens[n], np.hypot(played.noise_siemens, played.step_siemens / np.sqrt(12.0))
    column_std = COLUMN_NOISE * own * played.volts_per_siemens * np.nan_to_num(siemens) / MOST_VOLTS
    known = np.ones_like(siemens)
    noise, half = played.noise_siemens**2 * known, 0.5 * played.step_siemens * known
    return Measurement.of(conductance=siemens, noise_variance=noise, column_std=column_std, half_step=half)


def figures(played: Played, pressure: FloatArray, std: FloatArray, full_scale_kpa: float) -> Figures:
    """Of pressures and deviations (n, *cells) in kPa."""
    time_s = played.time_s
    kept = played.arrives & (time_s > max(JUDGED_FROM_S, JUDGED_FROM_FRAMES * played.frame_s))
    error = np.abs(pressure - played.pressure_kpa)[kept]
    loaded = played.pressure_kpa > 0.0
    last_s = np.maximum.accumulate(np.where(loaded, time_s.reshape(-1, *[1] * (loaded.ndim - 1)), -np.inf), axis=0)
    since_s = time_s.reshape(-1, *[1] * (loaded.ndim - 1)) - last_s
    resting = (np.isfinite(since_s) & (since_s > REST_AFTER_S))[kept]
    return Figures(
        rmse=100.0 * float(np.sqrt(np.mean(error**2))) / full_scale_kpa,
        within=100.0 * float(np.mean(error <= 2.0 * std[kept])),
        interval=100.0 * interval_score(error, std[kept]) / full_scale_kpa,
        sd=100.0 * float(np.median(std[kept])) / full_scale_kpa,
        rest=100.0 * float(error[resting].max()) / full_scale_kpa if resting.any() else np.nan,
    )


def _played(scene: Scene, make: Maker) -> tuple[Figures, float, int]:
    cell, played = cells()[scene.cell], play(scene)
    estimator = make(cell, played.pressure_kpa.shape[1:])
    pressure, std, seconds = estimated(played, estimator)
    return figures(played, pressure, std, cell.full_scale_kpa), seconds, pressure.size


@lru_cache(maxsize=8)
def _calibrated(name: str) -> tuple[recordings.Specimen, Cell]:
    """A recording, and the cell that its head is calibrated to."""
    of = recordings.specimen(name).near_head(RECORDING_S)
    return of, of.calibrated().cell


def _recorded(name: str, make: Maker) -> tuple[Figures, float, int]:
    of, cell = _calibrated(name)
    later = ~of.is_head
    estimator: Any = make(cell.replace(rest_resistance_ohm=of.rest_factor * cell.rest_resistance_ohm), ())
    start = process_time()
    pressure, stated = estimate_recording(estimator, of.time_s, of.resistance_ohm)
    spent = process_time() - start
    full = cell.full_scale_kpa
    error = np.abs(pressure - of.pressure_kpa)[later] / full
    std = np.full(error.shape, np.nan) if stated is None else stated[later] / full
    found = Figures(
        rmse=100.0 * float(np.sqrt(np.mean(error**2))),
        within=100.0 * float(np.mean(error <= 2.0 * std)),
        interval=100.0 * interval_score(error, std),
        sd=100.0 * float(np.median(std)),
        static=of.best_static_percent(full),
    )
    return found, spent, 0


# -- verdicts ----------------------------------------------------------------------------------------------------------

FIGURES = "rmse", "within", "interval", "sd", "rest"
"""that are shown; all but the deviation may have limits"""
_ROUNDING = 1.005
"""figures of the table are rounded to three digits"""


def limit_of(row: Row, figure: str, found: Figures | None = None) -> float:
    """The limit of one figure; NaN where there is none. A limit may depend on what was ``found``."""
    gate, today = row.limits, row.today
    if figure == "rmse":
        limits = [] if gate.rmse_times_today is None or today is None else [gate.rmse_times_today * today.rmse]
        if found is not None and gate.rmse_times_static is not None:
            limits.append(gate.rmse_times_static * found.static)
        return min(limits, default=np.nan) + gate.rmse_percent
    if figure == "interval":
        times = gate.interval_times_today
        return np.nan if times is None or today is None else times * today.interval
    own = {"within": gate.within_percent, "rest": gate.rest_percent}.get(figure)
    return np.nan if own is None else own


def misses(row: Row, found: Figures) -> tuple[str, ...]:
    """The figures that miss their limits. One that is not a number misses, unless nothing could be measured (rest)."""
    missed = []
    for figure in FIGURES:
        limit, value = limit_of(row, figure, found), getattr(found, figure)
        if np.isnan(limit) or (figure == "rest" and np.isnan(value)):
            continue
        met = value >= limit / _ROUNDING if figure == "within" else value <= limit * _ROUNDING
        if not met:
            missed.append(figure)
    return tuple(missed)


# -- the tables --------------------------------------------------------------------------------------------------------

TITLES = dict(
    zip(
        FIGURES,
        ("RMSE, % FS: today, now (most)", "within 2 sd, %", "interval, % FS", "sd, % FS", "rest, % FS"),
        strict=True,
    )
)


@dataclass(frozen=True)
class Line:
    """A row as text: frozen figures, measured ones, and limits where there are any."""

    row: str = field(metadata=column("row", "{}", width=64))
    gate: str = field(metadata=column("gate", "{}", width=13))
    figures: dict[str, str] = field(metadata=column("{}", "{}", width=18))
    misses: str = field(metadata=column("misses", "{}"))


def line(verdict: Verdict) -> Line:
    """A row of the table that :func:`.harness.table` prints."""
    row, found = verdict.row, verdict.found
    today = row.today or Figures(*[np.nan] * 4)

    def shown(figure: str) -> str:
        limit = limit_of(row, figure, found)
        values = [getattr(today, figure), getattr(found, figure)]
        before, now = ("-" if np.isnan(value) else f"{value:.3g}" for value in values)
        return f"{before} {now}" + ("" if np.isnan(limit) else f" ({limit:.3g})")

    return Line(row.name, row.gate, {TITLES[one]: shown(one) for one in FIGURES}, ", ".join(verdict.misses))


def record(verdict: Verdict) -> dict[str, Any]:
    """A row as JSON has it: name, gate, limits, today's figures and the measured ones, and which miss."""
    row = verdict.row
    return {
        "name": row.name,
        "gate": row.gate,
        "limits": {figure: limit_of(row, figure, verdict.found) for figure in FIGURES},
        "today": None if row.today is None else asdict(row.today),
        "found": asdict(verdict.found),
        "misses": verdict.misses,
        "seconds": verdict.seconds,
        "cell_frames": verdict.cell_frames,
    }


@dataclass(frozen=True)
class Summary:
    """A gate, and in how many of its rows it holds: now, and for the figures that were frozen."""

    gate: str = field(metadata=column("gate", "{}", width=14))
    """or estimator"""
    rows: int = field(metadata=column("rows", "{}", width=4))
    hold: int = field(metadata=column("hold", "{}", width=4))
    held: int = field(metadata=column("held", "{}", width=4))
    rmse: float = field(metadata=column("RMSE, median", "{:.2f}"))
    rmse_today: float = field(metadata=column("today", "{:.2f}", width=6))
    within: float = field(metadata=column("in 2 sd, mean", "{:.1f}"))
    within_today: float = field(metadata=column("today", "{:.1f}", width=6))
    interval_ratio: float = field(metadata=column("interval / today", "{:.3f}"))
    """geometric mean over the rows"""
    microseconds: float = field(metadata=column("us per cell and frame", "{:.2f}"))
    """processor time of the estimator"""


def summary(verdicts: Iterable[Verdict]) -> Iterator[Summary]:
    """Each gate of the verdicts, then all."""
    every = list(verdicts)
    for gate in [*dict.fromkeys(one.row.gate for one in every), "all"]:
        some = [one for one in every if gate in (one.row.gate, "all")]
        pairs = [(one.row, one.row.today) for one in some if one.row.today is not None]
        ratios = [one.found.interval / one.row.today.interval for one in some if one.row.today is not None]
        timed = [one for one in some if one.cell_frames]
        yield Summary(
            gate=gate,
            rows=len(some),
            hold=sum(not one.misses for one in some),
            held=sum(not misses(row, today) for row, today in pairs),
            rmse=float(np.median([one.found.rmse for one in some])),
            rmse_today=float(np.median([today.rmse for _, today in pairs])) if pairs else np.nan,
            within=float(np.mean([one.found.within for one in some])),
            within_today=float(np.mean([today.within for _, today in pairs])) if pairs else np.nan,
            interval_ratio=float(np.exp(np.mean(np.log(ratios)))) if ratios else np.nan,
            microseconds=1e6 * sum(one.seconds for one in timed) / max(sum(one.cell_frames for one in timed), 1),
        )


def by_estimator() -> Iterator[Summary]:
    """How all estimators of a cell do on random presses, which have specimens of no model among them."""
    for name in ESTIMATORS:
        if verdicts := list(judge(rows("random"), maker(name))):
            *_, of_all = summary(verdicts)
            yield replace(of_all, gate=name)


def freeze(verdicts: Iterable[Verdict]) -> None:
    """Write what was measured into the table, as today's figures of these rows."""
    today = dict(config.load(TABLE, Table).today)
    for one in verdicts:
        found = list(astuple(one.found))
        while np.isnan(found[-1]):
            found.pop()
        today[one.row.name] = [float(f"{value:.3g}") for value in found]
    known = [row.name for row in rows()]
    design = TABLE.read_text(encoding="utf-8").partition("\n[today]")[0].rstrip()
    heading = (
        "# RMSE, within, interval, sd, rest, RMSE of the static curve: `ohmskin bench --scenarios --freeze` writes them"
    )
    lines = [f'"{name}" = {today[name]}' for name in known if name in today]
    TABLE.write_text("\n".join([design, "", "[today]", heading, *lines, ""]), encoding="utf-8")
