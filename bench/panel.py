"""Judge calibrations with defaults on a panel of recordings: a head is learned from, the rest is held out.

    python -m ohmskin.bench.panel --seed 0 --seed 1
    python -m ohmskin.bench.panel --load speeds --material relays --material maxwell --seed 3
    python -m ohmskin.bench.panel recording.csv other.csv --head 0.5

The recordings come from emulated materials outside the fitted model classes (:mod:`._materials`), under each kind of
load, and with each kind of disturbance. Every load is combined with some of the materials, which rotate with the seed;
``--material`` chooses them instead. CSV files with the columns ``time_s,pressure_kpa,resistance_ohm`` are judged
instead.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from time import process_time
from typing import Any

import click
import numpy as np
from scipy.optimize import isotonic_regression

from ..cell import CalibrationResult, Cell, calibrate, checked_recording, estimate_recording, load_recording
from ..cell.materials import white_noise
from ..common.arrays import FloatArray
from ..errors import InputError
from ._materials import LOADS, MATERIALS
from .harness import column, interval_score, table

DT_S = 0.1
FULL_SCALE_KPA = 15.5
REST_OHM = 10000.0
NOISE = 0.002
"""standard deviation of a reading, relative to it, unless the disturbance says otherwise"""
RESTING, RESTING_S = 0.01, 5.0
"""a cell is at rest that has had less than this share of full scale for that long"""
DISTURBANCES = ("thinned", "noisy", "outliers", "R0 3 % low")
"""what happens to random presses"""
PER_LOAD = 2
"""materials that each kind of load is combined with, unless they are chosen"""


@dataclass(frozen=True)
class Scene:
    """One recording, of which the part before ``head_s`` is learned from."""

    load: str
    material: str
    seed: int
    time_s: FloatArray
    pressure_kpa: FloatArray
    resistance_ohm: FloatArray
    head_s: float
    full_scale_kpa: float | None = None
    rest_factor: float = 1.0
    """by which R0 is wrong when the estimator is used"""

    def thinned(self, every: int, load: str) -> Scene:
        """Every ``every``-th sample."""
        return replace(
            self,
            load=load,
            time_s=self.time_s[::every],
            pressure_kpa=self.pressure_kpa[::every],
            resistance_ohm=self.resistance_ohm[::every],
        )


@dataclass(frozen=True)
class Verdict:
    """How the chosen estimator does on what it has not seen. Percentages are of full scale."""

    load: str = field(metadata=column("load", "{:.13}", width=13))
    material: str = field(metadata=column("material", "{:.24}", width=11))
    seed: int = field(metadata=column("seed", "{}"))
    estimator: str = field(metadata=column("chosen", "{}", width=9))
    model: str = field(metadata=column("kind", "{}", width=10))
    rmse_percent: float = field(metadata=column("RMSE", "{:.1f}", width=5))
    cubic_percent: float = field(metadata=column("cubic", "{:.1f}", width=5))
    """RMSE of the cubic of log R that fits the head"""
    static_percent: float = field(metadata=column("best static", "{:.1f}"))
    """RMSE of the best static curve (:func:`static_curves`), chosen after the fact"""
    interval_percent: float = field(metadata=column("score", "{:.1f}", width=5))
    """interval score of the stated deviations (:func:`.harness.interval_score`)"""
    within_two_std: float = field(metadata=column("in 2 sd", "{:.0f}", unit=0.01))
    """share of the samples whose truth lies within two stated standard deviations"""
    std_percent: float = field(metadata=column("sd", "{:.1f}", width=4))
    """median standard deviation"""
    std_ratio: float = field(metadata=column("sd/RMSE", "{:.2f}"))
    worst_percent: float = field(metadata=column("worst", "{:.0f}"))
    rest_kpa: float = field(metadata=column("rest", "{:.2f}"))
    """mean size of what is shown at rest; NaN if the cell never rests"""
    left: float = field(metadata=column("left", "{:.2f}"))
    """error of the best fit over the noise of the readings"""
    seconds: float = field(metadata=column("CPU s", "{:.1f}", width=5))
    """processor time of the calibration"""
    folds: tuple[float, ...]
    """error of the chosen estimator on each fold of the calibration"""


def scene(load: str, material: str, seed: int) -> Scene:
    """A recording of the panel; the same for the same arguments."""
    rng = np.random.default_rng([seed, zlib.crc32(f"{load}, {material}".encode())])
    disturbance = load if load in DISTURBANCES else None
    loads, head_s = LOADS["random" if disturbance else load](rng, DT_S)
    r = MATERIALS[material](loads, DT_S, rng)
    noise = 0.01 if disturbance == "noisy" else NOISE
    read = REST_OHM * (1 + r) * (1 + noise * rng.standard_normal(len(r)))
    if disturbance == "outliers":
        read[rng.random(len(read)) < 0.005] *= 1.3
    found = Scene(
        load=load,
        material=material,
        seed=seed,
        time_s=DT_S * np.arange(float(len(read))),
        pressure_kpa=FULL_SCALE_KPA * loads,
        resistance_ohm=read,
        head_s=head_s,
        full_scale_kpa=FULL_SCALE_KPA,
        rest_factor=0.97 if disturbance == "R0 3 % low" else 1.0,
    )
    return found.thinned(3, load) if disturbance == "thinned" else found


def recorded(path: Path, head: float) -> Scene:
    """A recorded file, of which the share ``head`` is learned from."""
    of = load_recording([path])
    time = of.time_s - of.time_s[0]
    return Scene("as it is", path.stem, 0, time, of.pressure_kpa, of.resistance_ohm, head * float(time[-1]))


def calibrated(of: Scene) -> CalibrationResult:
    """The calibration with defaults on the head of a scene."""
    head = of.time_s < of.head_s
    name = f"{of.load}, {of.material}, seed {of.seed}"
    recording = checked_recording(of.time_s[head], of.pressure_kpa[head], of.resistance_ohm[head], name=name)
    return calibrate(recording, full_scale_kpa=of.full_scale_kpa)


def judge(
    of: Scene,
    found: CalibrationResult,
    make: Callable[[Cell, tuple[int, ...]], Any] | None = None,
    seconds: float = np.nan,
) -> Verdict:
    """Run the calibrated estimators over the whole recording; what follows the head counts.

    ``make`` makes the estimator that is judged from a cell and a shape; None: the default of the calibrated cell.
    ``seconds`` is the processor time of the calibration.
    """
    cell = found.cell
    assert cell.estimators is not None
    full, later = cell.full_scale_kpa, of.time_s >= of.head_s
    rest = None if of.rest_factor == 1.0 else of.rest_factor * cell.rest_resistance_ohm
    believed = cell if rest is None else cell.replace(rest_resistance_ohm=rest)
    estimator = cell.estimator((), rest_resistance_ohm=rest) if make is None else make(believed, ())
    pressure, stated = estimate_recording(estimator, of.time_s, of.resistance_ohm)
    error = (pressure - of.pressure_kpa)[later] / full
    std = np.full(error.shape, np.nan) if stated is None else stated[later] / full
    curves = static_curves(of, full)
    resting = at_rest(of.time_s, of.pressure_kpa / full)[later]
    rmse = _percent(error)
    ohm = of.resistance_ohm[~later]
    noise = max(NOISE if of.load != "as it is" else white_noise(np.log(ohm)), 1e-9)
    return Verdict(
        load=of.load,
        material=of.material,
        seed=of.seed,
        estimator=cell.default_estimator,
        model=cell.model.kind,
        rmse_percent=rmse,
        cubic_percent=curves["cubic"],
        static_percent=min(curves.values()),
        interval_percent=100 * interval_score(error, std),
        within_two_std=float(np.mean(np.abs(error) <= 2 * std)),
        std_percent=float(100 * np.median(std)),
        std_ratio=float(100 * np.median(std) / rmse),
        worst_percent=float(100 * np.abs(error).max()),
        rest_kpa=float(full * np.mean(np.abs(error)[resting])) if resting.any() else np.nan,
        left=min(fit.error for fit in found.fits) * float(np.ptp(ohm)) / (noise * float(np.mean(ohm))),
        seconds=seconds,
        folds=cell.estimators.fold_percent.get(cell.estimators.default, ()),
    )


def _percent(error: FloatArray) -> float:
    return float(100 * np.sqrt(np.mean(error**2)))


def static_curves(of: Scene, full_scale_kpa: float) -> dict[str, float]:
    """RMSE in % of full scale, after the head, of curves without memory that were fitted to the head."""
    head = of.time_s < of.head_s
    load, log_ohm = of.pressure_kpa / full_scale_kpa, np.log(of.resistance_ohm)
    found = {}
    for name, x in (("cubic", log_ohm), ("cubic of R", of.resistance_ohm / np.median(of.resistance_ohm))):
        curve, _ = np.polynomial.Polynomial.fit(x[head], load[head], 3, full=True)
        inside = np.clip(x, x[head].min(), x[head].max())
        found[name] = _percent((np.clip(curve(inside), load[head].min(), 1.2) - load)[~head])
    order = np.argsort(log_ohm[head])
    rises = bool(np.corrcoef(log_ohm[head], load[head])[0, 1] > 0)
    monotone = isotonic_regression(load[head][order], increasing=rises).x
    found["monotone"] = _percent((np.interp(log_ohm, log_ohm[head][order], monotone) - load)[~head])
    return found


def at_rest(time_s: FloatArray, load: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """(n,) whether the cell has been without load for :data:`RESTING_S`."""
    loaded = np.abs(load) > RESTING
    last = np.maximum.accumulate(np.where(loaded, time_s, -np.inf))
    return np.asarray(time_s - last > RESTING_S)


def scenes(
    seeds: Sequence[int], loads: Sequence[str] = (), materials: Sequence[str] = ()
) -> Iterator[tuple[str, str, int]]:
    """Which recordings make up the panel: load, material and seed."""
    names = list(MATERIALS)
    for seed in seeds:
        for place, load in enumerate(loads or [*LOADS, *DISTURBANCES]):
            turn = place + 2 * seed
            chosen = materials or [names[(turn + 3 * k) % len(names)] for k in range(PER_LOAD)]
            for material in chosen:
                yield load, material, seed


@dataclass(frozen=True)
class Summary:
    """Geometric means and extremes of a kind of load."""

    load: str = field(metadata=column("load", "{}", width=13))
    recordings: int = field(metadata=column("recordings", "{}"))
    rmse: float = field(metadata=column("RMSE", "{:.1f}"))
    cubic: float = field(metadata=column("cubic", "{:.1f}"))
    static: float = field(metadata=column("best static", "{:.1f}"))
    score: float = field(metadata=column("score", "{:.1f}"))
    times_cubic: float = field(metadata=column("worst ratio to cubic", "{:.2f}"))
    within: dict[str, float] = field(metadata=column("in 2 sd, {}", "{:.0f}", unit=0.01))
    std_ratio: float = field(metadata=column("median sd/RMSE", "{:.2f}"))
    seconds: float = field(metadata=column("most CPU s", "{:.1f}"))


def summary(verdicts: Sequence[Verdict]) -> Iterator[Summary]:
    """One row for each kind of load, and one for all."""
    loads = dict.fromkeys(of.load for of in verdicts)
    groups = {load: [of for of in verdicts if of.load == load] for load in loads}
    if len(groups) > 1:
        groups["all"] = list(verdicts)
    for load, some in groups.items():
        yield Summary(
            load=load,
            recordings=len(some),
            rmse=_geometric_mean([of.rmse_percent for of in some]),
            cubic=_geometric_mean([of.cubic_percent for of in some]),
            static=_geometric_mean([of.static_percent for of in some]),
            score=_geometric_mean([of.interval_percent for of in some]),
            times_cubic=max(of.rmse_percent / of.cubic_percent for of in some),
            within={
                "least": min(of.within_two_std for of in some),
                "mean": float(np.mean([of.within_two_std for of in some])),
            },
            std_ratio=float(np.median([of.std_ratio for of in some])),
            seconds=max(of.seconds for of in some),
        )


def _geometric_mean(values: Sequence[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


@click.command()
@click.argument("files", nargs=-1, metavar="[CSV]...", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--seed", "seeds", type=int, multiple=True, default=(0,), show_default=True, help="May be repeated.")
@click.option("--load", "loads", multiple=True, type=click.Choice([*LOADS, *DISTURBANCES]), help="May be repeated.")
@click.option("--material", "materials", multiple=True, type=click.Choice(list(MATERIALS)), help="May be repeated.")
@click.option("--head", type=click.FloatRange(0.05, 0.95), default=0.5, show_default=True, help="Share of a CSV.")
def main(
    files: tuple[Path, ...], seeds: tuple[int, ...], loads: tuple[str, ...], materials: tuple[str, ...], head: float
) -> None:
    """Calibrate with defaults on the head of each recording and judge the rest; errors are % of full scale.

    Rest is what is shown without load in kPa. Left is the error of the best fit over the noise of the readings.
    """
    made = (scene(*names) for names in scenes(seeds, loads, materials))
    given = (recorded(path, head) for path in files)
    verdicts: list[Verdict] = []

    def judged() -> Iterator[Verdict]:
        for of in given if files else made:
            start = process_time()
            try:
                found = calibrated(of)
            except InputError as error:
                click.echo(f"{of.load}  {of.material}  refused: {error}")
                continue
            verdicts.append(judge(of, found, seconds=process_time() - start))
            yield verdicts[-1]

    for text in chain(table(judged()), [""], table(summary(verdicts))):
        click.echo(text)


if __name__ == "__main__":
    main()
