"""Design exploration: variations of a design, their Pareto front, and what must change to keep a requirement.

Each variation is judged by figures that pull in different directions: the worst-case reading error, the worst-case
crosstalk, the pressure that one standard deviation of noise stands for, and, where the design states a frame rate, that
rate and the settling error that it leaves. A variation is on the Pareto front if no other one is at least as good in
all of them and better in one. Variations in which an output or the converter leaves its range, or whose frames the line
does not carry, are kept in the table and are not on the front.

A remedy is one part that, changed alone, keeps a requirement. It is found by solving the requirement's quantity again
with the changed part, never by extrapolation. Of crosstalk and reading errors the first remedies are other idle lines
and another circuit (:func:`wirings`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from math import inf, isnan, nan
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..cell import Percolation
from ..circuits import Design, Requirement
from ..common import plots
from ..common.arrays import BoolArray, FloatArray
from ..common.progress import Progress, silent
from ..common.workers import in_processes
from ..errors import InputError, SolverError
from ._catalogue import CATALOGUE
from ._dut import DesignUnderTest
from ._judging import worst_of
from ._outcome import DoesNotApply, NotRun, attempted
from ._quantity import AVERAGING, DOWN, NOMINAL, UP, WORST
from ._record import Outcome
from ._requirements import evaluate
from ._tuning import FARTHEST, FARTHEST_READING, FRACTIONS_BETWEEN, HALVINGS, MOST_AVERAGED, STRIDES, TRIES
from ._units import LEAST_SHOWN, UNITS, conversion, engineering
from .quantities.reading_errors import Crosstalk, ReadingError

KNOWN_FRACTION = 0.015
"""carbon black by mass of the cell of the design; the paper's choice"""
WIRING = "wiring"
"""axis of :func:`wirings`"""
AXES: dict[str, tuple[float, ...]] = {
    "reference resistor": (0.25, 0.5, 2.0, 4.0),
    "drive voltage": (0.5, 0.8, 1.25, 2.0),
    "row switch": (0.1, 0.3, 3.0),
    "ADC bits": (-4.0, -2.0, 2.0, 4.0),
    "carbon black": (0.0125, 0.02, 0.03, 0.05),
    "frame rate": (0.5, 2.0, 10.0, 100.0),
}
"""Factors on the design's value; bits are added, the carbon-black fraction stands for itself."""
FRACTIONS = np.geomspace(0.009, 0.06, 25)
"""carbon black by mass; below, full-scale pressure breaks the last path of many cells"""
FASTEST_STATED_HZ = 1e6
"""the largest frame rate that a design may state"""
MOST_BITS, _BITS = 24, "adc.bits"


@dataclass(frozen=True)
class Variation:
    """One varied design and its figures; NaN where the design does not say enough."""

    HEAD: ClassVar[str]
    """of a table whose rows are :attr:`line`"""

    changes: dict[str, float | str]
    """by axis, as in :data:`AXES` and :func:`wirings`; empty: the design itself"""
    reading_error_percent: float
    crosstalk_percent: float
    resolution_kpa: float
    settling_error_percent: float = nan
    frame_rate_hz: float = inf
    """inf where none is stated"""
    front: bool = False
    unknown: tuple[str, ...] = ()
    """which figures are not known, and why"""

    @property
    def figures(self) -> tuple[float, ...]:
        """Smaller is better."""
        judged = self.reading_error_percent, self.crosstalk_percent, self.resolution_kpa
        # Nobody would pay for a settling error that is smaller than what can be distinguished from none.
        return (*judged, max(self.settling_error_percent, LEAST_SHOWN), 1.0 / self.frame_rate_hz)

    @property
    def name(self) -> str:
        """For a reader."""
        each = (value if axis == WIRING else f"{axis} {_shown(axis, value)}" for axis, value in self.changes.items())
        return ", ".join(map(str, each)) or "the design itself"

    @property
    def line(self) -> str:
        """The figures and the changes in a row of a table; a star marks the Pareto front."""
        cells = []
        for name, (_, unit, width) in _COLUMNS.items():
            value = getattr(self, name)
            unknown = isnan(value) or (name == "frame_rate_hz" and value == inf)
            cells.append(f"{'not known' if unknown else engineering(value, unit, digits=3):>{width}}")
        return f"{' '.join(cells)} {'*' if self.front else ' '} {self.name}"


_COLUMNS = {
    "reading_error_percent": ("reading error", "%", 14),
    "crosstalk_percent": ("crosstalk", "%", 10),
    "resolution_kpa": ("resolution", "kPa", 13),
    "settling_error_percent": ("settling", "%", 11),
    "frame_rate_hz": ("rate", "Hz", 10),
}
"""figures of a variation: head, unit and width of the column"""
Variation.HEAD = " ".join(f"{head:>{width}}" for head, _, width in _COLUMNS.values()) + "  the Pareto front"


@dataclass(frozen=True)
class Remedy:
    """One part that, changed alone, keeps a requirement."""

    requirement: str
    part: str
    factor: float
    """on the part's value; for "adc.bits" and "frames averaged", on 1: the number itself; 0 for another wiring"""
    before: float
    after: float
    """the quantity, solved again with the changed part"""
    unit: str
    value: str = ""
    """of the changed part, with its unit; empty where lines differ"""
    kept: bool = True
    """whether the requirement is kept; another wiring that halves the quantity is named even so"""

    @property
    def line(self) -> str:
        """For a reader."""
        was, now = engineering(self.before, self.unit), engineering(self.after, self.unit)
        if not self.factor:
            enough = "" if self.kept else ", which is not enough"
            return f"{self.requirement}: {was} becomes {now} with {self.part}{enough}"
        if self.part in (_BITS, AVERAGING):
            return f"{self.requirement}: {self.factor:.0f} {self.part} in place of {self.value} bring {was} to {now}"
        to = f" ({self.value})" if self.value else ""
        return f"{self.requirement}: {self.part} times {self.factor:.3g}{to} brings {was} to {now}"


def explore(
    dut: DesignUnderTest,
    *,
    points: int = 60,
    jobs: int = 1,
    executor: Executor | None = None,
    tell: Callable[[int, int, Variation], None] = lambda done, total, found: None,
) -> list[Variation]:
    """The design, each axis alone, and random combinations, ``points`` in all.

    Args:
        dut: the design and its cell.
        points: how many variations.
        jobs: processes side by side.
        executor: of a cluster's workers, in their place.
        tell: called with each variation as it is found: its number, the number of all, and the variation without its
            place on the front.

    Raises:
        InputError: the design has no sensitivities (a continuous sheet, more than 64 x 64 cells), or too few points.
    """
    if points < 1:
        raise InputError(f"points is {points}; expected at least 1")
    dut = replace(dut, compares=False)
    wanted = list(_combinations(dut, points))
    number = 0

    def done(variation: Variation) -> None:
        nonlocal number
        number += 1
        tell(number, len(wanted), variation)

    return with_front(in_processes(partial(_judged, dut), wanted, jobs=jobs, executor=executor, done=done))


def with_front(variations: list[Variation]) -> list[Variation]:
    """The variations, each with its place on or behind the Pareto front of all."""
    return [replace(v, front=bool(best)) for v, best in zip(variations, pareto(_compared(variations)), strict=True)]


def _compared(variations: list[Variation]) -> FloatArray:
    """Figures (variations, figures) by which the front is found: those that are known of any variation."""
    figures = np.array([variation.figures for variation in variations])
    return figures[:, ~np.isnan(figures).all(axis=0)]


def best_carbon_black(dut: DesignUnderTest) -> Variation | None:
    """The carbon-black fraction with the best pressure resolution through this readout, all else as it is.

    Searched on a grid of :data:`FRACTIONS` and then between the neighbours of the best one. Fractions whose readings
    leave the range of an output or of the converter at some corner are no candidates.

    Returns:
        None where the percolation law does not apply (cells that conduct better when pressed), or where the pressure
        resolution of no fraction is known.
    """
    if dut.pressed < dut.rest:
        return None
    dut = replace(dut, compares=False)
    sigma = {float(fraction): resolution_kpa(dut, {"carbon black": float(fraction)}) for fraction in FRACTIONS}
    best = min(sigma, key=lambda fraction: sigma[fraction])
    if not np.isfinite(sigma[best]):
        return None
    place = list(sigma).index(best)
    low, high = FRACTIONS[max(place - 1, 0)], FRACTIONS[min(place + 1, len(FRACTIONS) - 1)]
    for fraction in np.linspace(low, high, FRACTIONS_BETWEEN).tolist():
        sigma[fraction] = resolution_kpa(dut, {"carbon black": fraction})
    for fraction in sorted((f for f in sigma if np.isfinite(sigma[f])), key=lambda fraction: sigma[fraction]):
        found = _judged(dut, {"carbon black": fraction})
        if np.isfinite(found.reading_error_percent) and np.isfinite(found.crosstalk_percent):
            return found
    return None


def carbon_black_line(best: Variation, own: Variation) -> str:
    """The best fraction beside the design's own, for a reader."""
    fraction = best.name.removeprefix("carbon black ")
    return (
        f"carbon black: {fraction} by mass has the best pressure resolution through this readout, "
        f"{engineering(best.resolution_kpa, 'kPa')}; the design's cell ({100 * KNOWN_FRACTION:g} %) has "
        f"{engineering(own.resolution_kpa, 'kPa')}"
    )


def resolution_kpa(dut: DesignUnderTest, changes: Mapping[str, float | str], method: str = WORST) -> float:
    """One standard deviation of pressure, kPa; inf where it is not known, or where cells open or leave a range.

    Ranges are judged by ``method``.
    """
    try:
        here = varied(dut, changes)
    except InputError:  # no path is left through the mixture under full-scale pressure
        return inf
    asked = Requirement(id="explore", quantity="pressure_resolution")
    for headroom in ("output_headroom", "adc_headroom"):
        with suppress(NotRun, DoesNotApply):
            if not CATALOGUE[headroom].compute(here, asked, method).value >= 0:
                return inf
    try:
        return CATALOGUE["pressure_resolution"].compute(here, asked, NOMINAL).value
    except (NotRun, InputError, SolverError):
        return inf


def pareto(figures: np.ndarray) -> BoolArray:
    """Which rows (points, figures) no other row dominates; smaller is better.

    A figure that is not known (NaN) of either of two rows is left out of their comparison; a row with an infinite
    figure, or with none, is behind the front.
    """
    front = np.isfinite(figures).any(axis=1) & ~np.isinf(figures).any(axis=1)
    for index in np.flatnonzero(front):
        no_worse = ((figures <= figures[index]) | np.isnan(figures) | np.isnan(figures[index])).all(axis=1)
        better = (figures < figures[index]).any(axis=1)
        front[index] = not (no_worse & better).any()
    return np.asarray(front)


def remedies(
    dut: DesignUnderTest, requirements: tuple[Requirement, ...], *, progress: Progress = silent
) -> Iterator[Remedy]:
    """For each requirement that nominal parts or the worst case do not keep: the parts that would mend it alone.

    Requirements on quantities that no part mends, on the yield, and on a real board have none. Each remedy is
    yielded as soon as it is found.
    """
    dut = replace(dut, compares=False)
    mendable = [requirement for requirement in requirements if may_be_mended(requirement)]
    for number, requirement in enumerate(mendable):
        progress(number, len(mendable), f"{requirement.id} {requirement.quantity}")
        if (missed := _judge(dut, requirement)) is None or missed.kept:
            continue
        if CATALOGUE[requirement.quantity].rewired:
            for name, design in wirings(dut).items():
                there = _judge(dut.with_design(design), requirement)
                if there is not None and (there.kept or there.value < missed.value / 2):
                    values = missed.value, there.value, missed.unit
                    yield Remedy(requirement.id, name, 0.0, *values, kept=there.kept)
        ways = CATALOGUE[requirement.quantity].mended_by
        for key in dict.fromkeys(key for key, _ in ways):
            # The usual direction first; a part may be beyond its best value, so that the other one helps.
            usual = [direction for named, direction in ways if named == key]
            for direction in dict.fromkeys((*usual, UP, DOWN)):
                remedy = _remedy(dut, requirement, key, direction, missed)
                if remedy is not None:
                    yield remedy
                    break


def wirings(dut: DesignUnderTest) -> dict[str, Design]:
    """The same array and converter with other idle lines or another circuit, by what is different.

    Amplifiers in place of a divider have the reference at the middle of the converter's range, are driven by half of
    it, and have a reference resistor with which the least resistance of a cell reaches its end.
    """
    design, found = dut.design, dict[str, Design]()
    circuit, readout = design.board.circuit, design.readout
    if design.drive.idle_rows != "ground":
        drive = {"idle_rows": "ground", "idle_row_resistance": inf}
        found[f"idle {design.board.line_kinds[0]}s at the reference"] = design.replace(drive=drive)
    if readout.columns == "multiplexed" and readout.idle_columns != "ground":
        found["idle columns at the reference"] = design.replace(readout={"idle_columns": "ground"})
    if circuit.virtual_ground and readout.columns == "multiplexed":
        found["an amplifier for each line"] = design.replace(readout={"columns": "parallel", "idle_columns": "float"})
    if not circuit.mixes_cells:
        return found
    found["a follower that drives idle lines (voltage-feedback)"] = design.with_circuit("voltage-feedback")
    if design.adc is not None:
        low, high = design.adc.range
        half = (high - low) / 2
        ohm = min(dut.rest, dut.pressed)
        grounded = design.with_circuit("inverting-amplifier").replace(
            drive={"idle_rows": "ground", "idle_row_resistance": inf, "voltage": -half},
            readout={
                "columns": "parallel",
                "idle_columns": "float",
                "reference_voltage": low + half,
                "reference_resistance": ohm,
            },
        )
        found[f"inverting amplifiers (Rref {engineering(ohm, 'ohm', 3)}, drive {-half:g} V)"] = grounded
    return found


def may_be_mended(requirement: Requirement) -> bool:
    """Whether :func:`remedies` looks for parts that keep the requirement."""
    quantity = CATALOGUE.get(requirement.quantity)
    return quantity is not None and bool(quantity.mended_by) and requirement.method in (None, "worst-case", "nominal")


def picture(variations: list[Variation]) -> str:
    """Reading error against pressure resolution, or against crosstalk if that is not known; the front is circled."""
    resolved = any(np.isfinite(v.resolution_kpa) for v in variations)
    label = "one standard deviation of pressure / kPa" if resolved else "worst crosstalk / %"
    known = [v for v, figures in zip(variations, _compared(variations), strict=True) if np.isfinite(figures).all()]
    with plots.drawing(1, 1, width=7.6, height=4.2) as (figure, ((panel,),)):
        if known:
            error, crosstalk, kpa = np.array([v.figures[:3] for v in known]).T
            across = kpa if resolved else crosstalk
            drawn = panel.scatter(across, error, c=crosstalk, cmap="viridis_r", s=26)
            figure.colorbar(drawn, ax=panel, label="crosstalk / %")
            front = np.array([v.front for v in known])
            panel.scatter(across[front], error[front], s=90, facecolors="none", edgecolors=plots.RED)
            for v, x, y in zip(known, across, error, strict=True):
                if not v.changes:
                    panel.annotate("the design", (x, y), fontsize=8)
            panel.set(xscale="log", yscale="log")
        panel.set(xlabel=label, ylabel="worst reading error / %")
        panel.set_title("Variations; circled: the Pareto front")
        return plots.svg(figure)


def _combinations(dut: DesignUnderTest, points: int) -> Iterator[dict[str, float | str]]:
    absent: dict[str, Any] = {"ADC bits": dut.design.adc, "frame rate": dut.design.operation.frame_rate}
    if dut.pressed < dut.rest:  # percolation says nothing of cells whose contacts decide
        absent["carbon black"] = None
    axes = {axis: values for axis, values in AXES.items() if absent.get(axis, axis) is not None}
    single: list[dict[str, float | str]] = [{}]
    single += [{WIRING: name} for name in wirings(dut)]
    single += [{"reference resistor": factor} for factor in _widest_swing(dut)]
    single += [{axis: value} for axis, values in axes.items() for value in values]
    yield from single[:points]
    random = np.random.default_rng(dut.seed)
    seen: list[dict[str, float | str]] = []
    for _ in range(TRIES * points):  # a design with few axes may have fewer combinations than points
        if len(single) + len(seen) >= points:
            return
        chosen = random.choice(list(axes), size=min(int(random.integers(2, 4)), len(axes)), replace=False)
        changes: dict[str, float | str] = {axis: float(random.choice(axes[axis])) for axis in axes if axis in chosen}
        if changes not in seen:
            seen.append(changes)
            yield changes


def _widest_swing(dut: DesignUnderTest) -> list[float]:
    """Factor on a divider's load at which its output changes most from rest to full scale.

    That is the load sqrt(Rmin Rmax): the derivative of Rmax / (Rmax + R) - Rmin / (Rmin + R) by R is zero there.
    """
    load = dut.design.readout.reference_resistance
    if not dut.design.board.circuit.mixes_cells or isinstance(load, tuple):
        return []
    factor = float(f"{(dut.rest * dut.pressed) ** 0.5 / load:.3g}")
    return [factor] if factor != 1.0 else []


def mixtures(dut: DesignUnderTest) -> Percolation:
    """The family of mixtures that the design's cell belongs to."""
    return Percolation(KNOWN_FRACTION, dut.rest, dut.pressed / dut.rest - 1)


def varied(dut: DesignUnderTest, changes: Mapping[str, float | str]) -> DesignUnderTest:
    """The design under test with some axes changed."""
    design, cells = dut.design, None
    for axis, value in changes.items():
        if isinstance(value, str):
            design = wirings(dut)[value]
            continue
        match axis:
            case "reference resistor":
                design = _scaled(design, "readout.reference_resistance", value)
            case "drive voltage":
                design = _scaled(design, "drive.voltage", value)
            case "row switch":
                design = _scaled(design, "array.row_lead", value)
            case "ADC bits":
                assert design.adc is not None
                design = design.replace(adc={"bits": int(np.clip(design.adc.bits + value, 4, 24))})
            case "frame rate":
                assert design.operation.frame_rate is not None
                rate = min(design.operation.frame_rate * value, FASTEST_STATED_HZ)
                design = design.replace(operation={"frame_rate": rate})
            case "carbon black":
                law = mixtures(dut)
                rest = float(law.rest_resistance(value))
                change = float(np.asarray(law.sensitivities(np.array([value])))[0])
                cells = {
                    "rest_resistance": rest,
                    "full_scale_resistance": rest * (1 + change),
                    "full_scale_kpa": dut.full_scale_kpa,
                }
    if cells is not None:
        spread = {} if design.cells is None else dict(design.cells.spread)
        design = design.replace(cells=cells | {"spread": spread})
        return replace(dut, design=design, given_cell=None)
    return dut.with_design(design)


def _judged(dut: DesignUnderTest, changes: dict[str, float | str]) -> Variation:
    here = varied(dut, changes)
    error, crosstalk = (100 * worst_of(here, target).value for target in (ReadingError(), Crosstalk()))
    unknown: list[str] = []

    def known(quantity: str, name: str = "", method: str = NOMINAL) -> float:
        """NaN, and a line in ``unknown``, where the design does not say enough."""
        asked = Requirement(id="explore", quantity=quantity)
        found = attempted(lambda: CATALOGUE[quantity].compute(here, asked, method))
        if found.found is None and name:
            unknown.append(f"{name}: not known, {found.reason}")
        return nan if found.found is None else found.found.value

    kpa, settling = known("pressure_resolution", "resolution"), known("settling_error", "settling", WORST)
    rate = here.design.operation.frame_rate
    if rate is not None and known("lost_frames") > 0:
        settling = inf
    return Variation(changes, error, crosstalk, kpa, settling, rate or inf, unknown=tuple(unknown))


class _Judged(NamedTuple):
    value: float
    unit: str
    kept: bool


def _judge(dut: DesignUnderTest, requirement: Requirement) -> _Judged | None:
    """The quantity of a requirement, and whether it keeps the limits; None where it has no value."""
    result = evaluate(dut, requirement, {})
    if result.measurement is None:
        return None
    return _Judged(result.measurement.value, result.unit, result.outcome is Outcome.PASS)


def _remedy(dut: DesignUnderTest, requirement: Requirement, key: str, direction: str, missed: _Judged) -> Remedy | None:
    if key == AVERAGING:
        return _averaged(requirement, missed)
    section, name = key.split(".")
    value = np.asarray(getattr(getattr(dut.design, section), name, None), dtype=np.float64)
    if not value.any() or not np.isfinite(value).all() or (key == _BITS and direction == DOWN):
        return None
    reading = CATALOGUE[requirement.quantity].rewired

    @cache
    def at(step: float) -> _Judged | None:
        """With so many more bits, or the part times the exponential of so much, up or down."""
        try:
            if key == _BITS:
                changed = dut.design.replace(adc={"bits": int(value + step)})
            else:
                changed = _scaled(dut.design, key, float(np.exp(step if direction == UP else -step)))
        except InputError:  # beyond what a design may say
            return None
        there = _judge(dut.with_design(changed), requirement)
        return there if there is not None and there.kept else None

    if key == _BITS:
        more = range(1, MOST_BITS + 1 - int(value))
        # Each look at a reading is a search for a corner; a coarser converter does not help where the finest does not.
        steps = [float(step) for step in more] if more and (not reading or at(float(more[-1]))) else []
    elif reading:
        narrow = direction == UP and key != "readout.open_loop_gain"
        steps = [float(np.log(FARTHEST_READING if narrow else FARTHEST))]
    else:
        steps = np.log(STRIDES).tolist()
    kept = next((step for step in steps if at(step)), None)
    if kept is None:
        return None
    if key == _BITS:
        factor, shown = float(value) + kept, f"{value:.0f}"
    else:
        missed_at = max((step for step in steps if step < kept), default=0.0)
        for _ in range(HALVINGS):
            middle = (kept + missed_at) / 2
            kept, missed_at = (middle, missed_at) if at(middle) else (kept, middle)
        factor = float(np.exp(kept if direction == UP else -kept))
        unit = UNITS.get(section, {}).get(name, "")
        shown = engineering(factor * float(value.flat[0]), unit, 3) if (value == value.flat[0]).all() else ""
    after = at(kept)
    assert after is not None
    return Remedy(requirement.id, key, factor, missed.value, after.value, missed.unit, shown)


def _averaged(requirement: Requirement, missed: _Judged) -> Remedy | None:
    """The mean of n independent readings has the standard deviation of one, over the square root of n."""
    if requirement.max is None or not np.isfinite(missed.value):
        return None
    limit = requirement.max * conversion(requirement.unit, missed.unit)
    frames = int(np.ceil((missed.value / limit) ** 2 - 1e-9)) if limit > 0 else MOST_AVERAGED + 1
    if frames > MOST_AVERAGED:
        return None
    after = missed.value / frames**0.5
    return Remedy(requirement.id, AVERAGING, frames, missed.value, after, missed.unit, "1")


def _scaled(design: Design, key: str, factor: float) -> Design:
    section, name = key.split(".")
    value: Any = getattr(getattr(design, section), name)
    scaled = tuple(factor * part for part in value) if isinstance(value, tuple) else factor * value
    return design.replace(**{section: {name: scaled}})


def _shown(axis: str, value: float | str) -> str:
    if axis == "carbon black":
        return f"{100 * value:.3g} %"
    return f"{value:+g}" if axis == "ADC bits" else f"× {value:g}"
