"""Design exploration: variations of a design, their Pareto front, and what must change to keep a requirement.

Each variation is judged by three figures that pull in different directions: the worst-case reading error, the
worst-case crosstalk, and the pressure that one standard deviation of noise stands for. A variation is on the Pareto
front if no other one is at least as good in all three and better in one. Variations in which an output or the converter
leaves its range are kept in the table, and are not on the front.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import plots
from ..arrays import BoolArray
from ..cell import Percolation
from ..circuits import Design, Requirement
from ..errors import InputError, SolverError
from ..progress import Progress, silent
from ._corner import worst_case
from ._dynamic import pressure_resolution
from ._outcome import NotRun
from ._static import TARGETS, box_of
from ._subject import Subject
from ._units import engineering

KNOWN_FRACTION = 0.015
"""carbon black by mass of the cell of the design; the paper's choice"""
AXES: dict[str, tuple[float, ...]] = {
    "reference resistor": (0.25, 0.5, 2.0, 4.0),
    "drive voltage": (0.5, 0.8, 1.25, 2.0),
    "row switch": (0.1, 0.3, 3.0),
    "ADC bits": (-4.0, -2.0, 2.0, 4.0),
    "carbon black": (0.0125, 0.02, 0.03, 0.05),
}
"""Factors on the design's value; bits are added, the carbon-black fraction stands for itself."""
SCALED = {
    "array.row_lead": "down",
    "array.row_segment": "down",
    "array.column_lead": "down",
    "array.column_segment": "down",
    "readout.open_loop_gain": "up",
    "readout.offset_voltage": "down",
    "readout.bias_current": "down",
    "readout.reference_resistance": "up",
    "drive.voltage": "up",
}
"""Parts that could keep a requirement if they were changed, and in which direction."""
_FARTHEST = 1e3  # a change beyond a factor of that is no help to anybody
_STEPS = 7  # of the bisection, in the logarithm of the factor


@dataclass(frozen=True)
class Variation:
    """One varied design and its figures; NaN where there is none."""

    changes: dict[str, float]
    """by axis, as in :data:`AXES`; empty: the design itself"""
    reading_error_percent: float
    crosstalk_percent: float
    resolution_kpa: float
    front: bool = False

    @property
    def figures(self) -> tuple[float, float, float]:
        return self.reading_error_percent, self.crosstalk_percent, self.resolution_kpa

    @property
    def name(self) -> str:
        """For a reader."""
        return ", ".join(f"{axis} {_shown(axis, value)}" for axis, value in self.changes.items()) or "the design itself"


@dataclass(frozen=True)
class Remedy:
    """One part that, changed alone, keeps a requirement."""

    requirement: str
    part: str
    factor: float
    """on the part's value"""
    before: float
    after: float
    """the quantity, solved again with the changed part"""
    unit: str

    @property
    def line(self) -> str:
        """For a reader."""
        was, now = engineering(self.before, self.unit), engineering(self.after, self.unit)
        return f"{self.requirement}: {self.part} times {self.factor:.3g} brings {was} to {now}"


def explore(subject: Subject, *, points: int = 60, progress: Progress = silent) -> list[Variation]:
    """The design, each axis alone, and random combinations, ``points`` in all.

    Raises:
        InputError: the design has no sensitivities (a continuous sheet, more than 64 x 64 cells), or too few points.
    """
    if points < 1:
        raise InputError(f"points is {points}; expected at least 1")
    found = []
    wanted = list(_combinations(subject, points))
    for number, changes in enumerate(wanted, 1):
        found.append(_judged(subject, changes))
        progress(number, len(wanted), found[-1].name)
    front = pareto(np.array([variation.figures for variation in found]))
    return [Variation(v.changes, *v.figures, front=bool(best)) for v, best in zip(found, front, strict=True)]


def pareto(figures: np.ndarray) -> BoolArray:
    """Which rows (points, figures) no other row dominates; smaller is better. A row with NaN or inf is dominated."""
    finite = np.isfinite(figures).all(axis=1)
    front = finite.copy()
    for index in np.flatnonzero(finite):
        no_worse = (figures[finite] <= figures[index]).all(axis=1)
        better = (figures[finite] < figures[index]).any(axis=1)
        front[index] = not (no_worse & better).any()
    return np.asarray(front)


def remedies(subject: Subject, requirements: tuple[Requirement, ...]) -> list[Remedy]:
    """For each requirement on a reading that the worst case does not keep: the parts that would mend it alone.

    A part's factor is found by bisection; every step solves the worst case again.
    """
    found = []
    for requirement in requirements:
        if (
            requirement.quantity not in TARGETS
            or requirement.max is None
            or requirement.method not in (None, "worst-case")
        ):
            continue
        before = _value(subject, requirement.quantity)
        if before <= requirement.max:
            continue
        for key, direction in SCALED.items():
            remedy = _remedy(subject, requirement, key, direction, before)
            if remedy is not None:
                found.append(remedy)
    return found


def picture(variations: list[Variation]) -> str:
    """Reading error against pressure resolution, the crosstalk as colour, the front joined."""
    known = [v for v in variations if np.isfinite(v.figures).all()]
    with plots.drawing(1, 1, width=7.6, height=4.2) as (figure, ((panel,),)):
        if known:
            error, crosstalk, kpa = np.array([v.figures for v in known]).T
            drawn = panel.scatter(kpa, error, c=crosstalk, cmap="viridis_r", s=26)
            figure.colorbar(drawn, ax=panel, label="crosstalk / %")
            for v in known:
                if v.front:
                    panel.scatter(
                        v.resolution_kpa, v.reading_error_percent, s=90, facecolors="none", edgecolors=plots.RED
                    )
            own = next((v for v in known if not v.changes), None)
            if own is not None:
                panel.annotate("the design", (own.resolution_kpa, own.reading_error_percent), fontsize=8)
            panel.set(xscale="log", yscale="log")
        panel.set(xlabel="one standard deviation of pressure / kPa", ylabel="worst reading error / %")
        panel.set_title("Variations; circled: the Pareto front")
        return plots.svg(figure)


def _combinations(subject: Subject, points: int) -> Iterator[dict[str, float]]:
    axes = {axis: values for axis, values in AXES.items() if not (axis == "ADC bits" and subject.design.adc is None)}
    single = [{}, *({axis: value} for axis, values in axes.items() for value in values)]
    yield from single[:points]
    random = np.random.default_rng(subject.seed)
    for _ in range(points - len(single)):
        chosen = random.choice(list(axes), size=int(random.integers(2, 4)), replace=False)
        yield {str(axis): float(random.choice(axes[str(axis)])) for axis in chosen}


def varied(subject: Subject, changes: dict[str, float]) -> Subject:
    """The subject with some axes changed."""
    design, cells = subject.design, None
    for axis, value in changes.items():
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
            case "carbon black":
                law = Percolation(KNOWN_FRACTION, subject.rest, subject.pressed / subject.rest - 1)
                rest = float(law.rest_resistance(value))
                change = float(np.asarray(law.sensitivities(np.array([value])))[0])
                cells = {
                    "rest_resistance": rest,
                    "full_scale_resistance": rest * (1 + change),
                    "full_scale_kpa": subject.full_scale_kpa,
                }
    if cells is not None:
        spread = {} if design.cells is None else dict(design.cells.spread)
        design = design.replace(cells=cells | {"spread": spread})
        return Subject(design, None, subject.target, subject.seed, subject.samples)
    return Subject(design, subject.given_cell, subject.target, subject.seed, subject.samples)


def _judged(subject: Subject, changes: dict[str, float]) -> Variation:
    here = varied(subject, changes)
    error, crosstalk = (_value(here, quantity) for quantity in ("reading_error", "crosstalk"))
    try:
        asked = Requirement(id="explore", quantity="pressure_resolution")
        kpa = pressure_resolution(here, asked, "nominal").value
    except (NotRun, InputError, SolverError):
        kpa = np.nan
    return Variation(changes, error, crosstalk, kpa)


def _value(subject: Subject, quantity: str) -> float:
    """Worst case in %."""
    return 100 * abs(worst_case(TARGETS[quantity], box_of(subject)).value)


def _remedy(subject: Subject, requirement: Requirement, key: str, direction: str, before: float) -> Remedy | None:
    section, name = key.split(".")
    value = np.asarray(getattr(getattr(subject.design, section), name), dtype=np.float64)
    if not value.any() or not np.isfinite(value).all():
        return None
    limit = requirement.max
    assert limit is not None

    def at(factor: float) -> float:
        return _value(Subject(_scaled(subject.design, key, factor), subject.given_cell), requirement.quantity)

    far = 1 / _FARTHEST if direction == "down" else 3.0 if key != "readout.open_loop_gain" else _FARTHEST
    after = at(far)
    if not after <= limit:
        return None
    kept, missed = np.log(far), 0.0
    for _ in range(_STEPS):
        middle = (kept + missed) / 2
        value_there = at(float(np.exp(middle)))
        if value_there <= limit:
            kept, after = middle, value_there
        else:
            missed = middle
    return Remedy(requirement.id, key, float(np.exp(kept)), before, after, "%")


def _scaled(design: Design, key: str, factor: float) -> Design:
    section, name = key.split(".")
    value: Any = getattr(getattr(design, section), name)
    scaled = tuple(factor * part for part in value) if isinstance(value, tuple) else factor * value
    return design.replace(**{section: {name: scaled}})


def _shown(axis: str, value: float) -> str:
    if axis == "carbon black":
        return f"{100 * value:g} %"
    return f"{value:+g}" if axis == "ADC bits" else f"× {value:g}"
