"""From a target to a measurement: the box of a design under test, its worst cases, and what the report says of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Literal

import numpy as np

from ..circuits import Requirement
from ..common.arrays import FloatArray
from ..common.config import LEAST_SI
from ..errors import InputError, SolverError
from ._box import Box, Corners
from ._dut import DesignUnderTest, once
from ._montecarlo import CONFIDENCE, Sampler, blocks, blocks_beside, boards_needed, proportion_bounds
from ._outcome import Figure, Measurement, NotRun, drawn
from ._parameters import Factors
from ._pictures import value_map
from ._quantity import NOMINAL, SAMPLED, SHARE_UNITS
from ._readings import Excursion, ReadingErrorTarget
from ._record import BoundsRecord, CornerRecord
from ._scale import Scale
from ._search import Target, WorstCase, worst_case
from ._tuning import FEW, LEAST_RISE, MOST_CELLS_BY_PART
from ._units import engineering
from ._whole_board import MOST_SECONDS, FrameTimeTarget

Show = Callable[[float], float]


Parts = Literal["aged", "new", "nominal"]
"""which tolerances a search ranges over: those at the end of the parts' lives, the initial ones, or none"""
AT_LEAST = 99.0
"""% of the random boards beside a worst case that are no worse than the value that is shown"""


def box_of(dut: DesignUnderTest, parts: Parts = "aged", *, share: bool | None = None) -> Box:
    """What a worst-case search ranges over.

    Args:
        dut: the design under test.
        parts: whose tolerances; "nominal": only the places of presses.
        share: whether errors of readings are shares of full scale, or relative; None: as the cell has it.
    """
    scale = dut.scale if share is None else dut.share_scale if share else Scale()
    if parts == "nominal":
        return Box(dut.design, Factors.nominal(dut.design), dut.rest, dut.pressed, 0.0, scale)
    aged = parts == "aged"
    factors = dut.factors if aged else Factors.of(dut.design, aged=False)
    return Box(dut.design, factors, dut.rest, dut.pressed, dut.cell_spread_at(aged=aged), scale)


def excursion_of(dut: DesignUnderTest, what: str) -> Excursion | None:
    """How far a voltage goes beyond its limits, at the "output", the "converter" or by the circuit's "law".

    None where there are no limits. Of cells that are open at rest, readings may come as near to that end as they like.
    """
    design, side = dut.design, box_of(dut).side
    board = design.board
    at_converter = True
    if what == "output":
        low, high = board.supply
        at_converter = False
    elif what == "converter":
        low, high = (-inf, inf) if design.adc is None else design.adc.range
        step = 0.0 if design.adc is None else design.adc.step
        low, high = low + step, high - step
    else:
        low, high = sorted(board.circuit.domain(board))
    if dut.scale.open_is_rest and what != "output":
        low, high = (-inf, high) if side > 0 else (low, inf)
    return Excursion(what, (low, high), at_converter) if np.isfinite([low, high]).any() else None


@once
def worst_of(dut: DesignUnderTest, target: Target, parts: Parts = "aged", *, share: bool | None = None) -> WorstCase:
    """The worst case of a target, worked out once.

    Raises:
        NotRun: the design has no such analysis.
    """
    box = box_of(dut, parts, share=share)
    starts: list[Corners] = []
    if parts == "aged" and dut.design.ages:
        new = worst_of(dut, target, "new", share=share)
        starts += [new.corner] if new.box.size == box.size else []
    if isinstance(target, Excursion):
        box = replace(box, design=box.design.replace(readout={"supply": (-inf, inf)}))
    elif isinstance(target, ReadingErrorTarget):  # a corner that leaves a range is a lost reading, whatever leads to it
        for what in ("output", "converter", "law"):
            if (excursion := excursion_of(dut, what)) is None:
                continue
            found = worst_of(dut, excursion, parts)
            if found.value >= -box.half_step:
                starts.append(found.corner)
                box = replace(box, saturates=box.saturates or what == "output")
    try:
        if isinstance(target, FrameTimeTarget):
            return _longest_frame(dut, target, parts, box)
        return worst_case(target, box, starts)
    except (InputError, SolverError) as error:
        raise NotRun(f"no worst case: {error}") from error


def _longest_frame(dut: DesignUnderTest, target: FrameTimeTarget, parts: Parts, box: Box) -> WorstCase:
    """The longest of the shortest frame times, by searches for boards that have not settled at the longest so far."""
    starts = target.starts(box)
    times = target.evaluate(box, starts)
    longest, corner = float(times.max()), starts.some(np.array([int(times.argmax())]))
    for _ in range(FEW):
        found = worst_of(dut, target.at(box, min(max(longest, LEAST_SI), MOST_SECONDS)), parts)
        time = float(target.evaluate(box, found.corner)[0])
        if np.isinf(longest) or time <= longest * (1.0 + LEAST_RISE):
            break
        longest, corner = time, found.corner
    return replace(found, target=target, corner=corner, value=longest)


@once
def sampler_of(dut: DesignUnderTest, target: Target, share: bool | None) -> Sampler:
    """What judges random boards."""
    return Sampler.of(worst_of(dut, target, share=share))


@once
def block_of(dut: DesignUnderTest, target: Target, share: bool | None, number: int) -> FloatArray:
    """(boards,) the values of one block of the Monte Carlo analysis, as the target has them."""
    return sampler_of(dut, target, share).block(dut.seed, number)


def sampled(dut: DesignUnderTest, target: Target, share: bool | None, most: int | None = None) -> FloatArray:
    """(boards,) the values of all boards that are drawn, or of the first blocks of them."""
    count = blocks(dut.samples) if most is None else most
    return np.concatenate([block_of(dut, target, share, number) for number in range(count)])[: dut.samples]


def quantile_of(values: FloatArray, percent: float) -> float:
    """The value that so many % of the boards do not exceed."""
    return float(np.sort(values)[min(int(np.ceil(percent / 100 * len(values))) - 1, len(values) - 1)])


def bounds_of(dut: DesignUnderTest, target: Target, show: Show, share: bool | None = None) -> BoundsRecord:
    """A worst case beside the same quantity by other analyses, in the unit in which it is shown."""
    found = worst_of(dut, target, share=share)
    nominal, root_sum_square = found.statistical
    sampler = sampler_of(dut, target, share)
    values = sampled(dut, target, share, blocks_beside(target, sampler.box, sampler.tries, dut.samples))
    new = worst_of(dut, target, "new", share=share).value if dut.design.ages else None
    return BoundsRecord(
        nominal=show(nominal),
        initial=None if new is None else show(min(new, found.value)),
        root_sum_square=show(root_sum_square),
        quantile_99=show(quantile_of(values, AT_LEAST)),
        sampled=show(float(values.max())),
        boards=len(values),
    )


def measured(found: WorstCase, value: float, unit: str, *, where: str = "") -> Measurement:
    """A worst case for the report, its value in the unit of the quantity."""
    return Measurement(
        value,
        unit,
        where=where or found.where,
        confidence=found.search,
        incomplete=found.incomplete,
        corner=corner_of(found),
    )


def corner_of(found: WorstCase) -> CornerRecord:
    """What to solve to find a worst case again."""
    parts = found.box.factors.varied(found.factors)
    return CornerRecord(
        cell=found.cell,
        parts={key: values.tolist() for key, values in parts.items()},
        cells_ohm=[frame.tolist() for frame in found.frames],
    )


def maps(found: WorstCase, unit: str, limit: float | None) -> list[Figure]:
    """The worst value of each cell as a picture; none without matplotlib."""
    by_cell = 100 * found.by_cell
    known = by_cell[np.isfinite(by_cell)]
    top = max(float(known.max(initial=0.0)), 1.2 * (limit or 0.0)) or 1.0
    caption = (
        f"{found.target.name.capitalize()} of each cell at the worst corner that was solved for that cell. "
        "Outlined: cells beyond the limit. Empty: cells that first order ranks too low to be solved."
    )
    label = f"{found.target.name} / {unit}"
    return drawn(lambda: Figure(value_map(by_cell, label=label, top=top, limit=limit), caption))


def contributions(found: WorstCase, factor: float) -> dict[str, float]:
    """The worst value by kind of part alone, of arrays that are not too large."""
    if len(found.box.factors) == 0 or found.box.cells > MOST_CELLS_BY_PART or np.isinf(found.value):
        return {}
    return {kind: factor * value for kind, value in found.by_part.items()}


def in_both_units(dut: DesignUnderTest, found: WorstCase) -> str:
    """The error at the worst corner in the unit that was not judged, and in kPa where that is known."""
    relative = found.box.scale.unit == "%"
    other = replace(found.box, scale=box_of(dut, share=relative).scale)
    value = found.target.stated(other, found.corner)
    share = value if relative else found.value
    said = f"There: {engineering(100 * value, other.scale.unit)}"
    if dut.knows_pressure and np.isfinite(share):
        said += f"; {engineering(share * dut.full_scale_kpa, 'kPa')} of {engineering(dut.full_scale_kpa, 'kPa')}"
    return f"{said}."


def worst_cell(values: FloatArray | Mapping[str, FloatArray]) -> tuple[float, tuple[int, int], str]:
    """The largest value of any cell (N, M), of any state where there are several; its cell, and both in words."""
    states = dict(values) if isinstance(values, Mapping) else {"": values}
    each = np.stack(list(states.values()))
    number, row, column = (int(index) for index in np.unravel_index(int(np.argmax(each)), each.shape))
    state = [*states][number]
    return float(each[number, row, column]), (row, column), f"cell ({row}, {column})" + (state and f", {state}")


@dataclass(frozen=True)
class Searched:
    """A quantity that the worst-case search finds: by its worst case, of nominal parts, or by the yield of boards."""

    target: Callable[[DesignUnderTest, Requirement], Target | Measurement]
    """what is searched, or what is known without; raises NotRun or DoesNotApply"""
    unit: str = ""
    """empty: that of the errors of the cell at hand"""
    show: Show = float
    """from the target's value to that of the quantity; falling where the quantity should be large"""
    line: Callable[[Box, tuple[int, int]], str] | None = None
    """the line that a stress is stated for, by the worst cell"""
    detail: Callable[[DesignUnderTest, Requirement, WorstCase, Measurement], Measurement] | None = None
    """adds what only this quantity has to say about its worst case"""

    def __call__(
        self, dut: DesignUnderTest, requirement: Requirement, method: str, boards: FloatArray | None = None
    ) -> Measurement:
        target, share = self.target(dut, requirement), judged_by(requirement)
        if isinstance(target, Measurement):
            return target
        if method == SAMPLED:
            return self._yield(sampled(dut, target, share) if boards is None else boards, dut, requirement)
        parts: Parts = "nominal" if method == NOMINAL else "aged"
        found = worst_of(dut, target, parts, share=share)
        line = f"{self.line(found.box, found.cell)}; " if self.line else ""
        unit = self.unit or found.box.scale.unit
        result = measured(found, self.show(found.value), unit, where=f"{line}{found.where}")
        if self.detail is not None:
            result = self.detail(dut, requirement, found, result)
        if method == NOMINAL or not dut.compares:
            return result
        return replace(result, bounds=bounds_of(dut, target, self.show, share))

    def _yield(self, values: FloatArray, dut: DesignUnderTest, requirement: Requirement) -> Measurement:
        """How many boards (boards,) keep the limits."""
        unit = self.unit or box_of(dut, share=judged_by(requirement)).scale.unit
        shown = np.array([self.show(float(value)) for value in values])
        low, high = requirement.min, requirement.max
        kept = np.isfinite(shown)
        kept &= (shown >= low) if low is not None else True
        kept &= (shown <= high) if high is not None else True
        count, good = len(values), int(kept.sum())
        wanted = requirement.conditions.yield_percent
        bounds = proportion_bounds(good, count)
        worst = int(np.argmax(values))
        return Measurement(
            self.show(quantile_of(values, wanted)),
            unit,
            where=f"board {worst} of seed {dut.seed} is the worst: {engineering(float(shown[worst]), unit)}",
            confidence=(
                f"{good} of {count} boards keep the limit: yield {100 * good / count:.4g} %, "
                f"{100 * bounds[0]:.4g} to {100 * bounds[1]:.4g} % "
                f"({100 * CONFIDENCE:.0f} % confidence, Clopper-Pearson); wanted {wanted:.4g} %"
            ),
            text=[
                f"The value shown is the {wanted:.4g} % quantile of the boards.",
                "Each board is judged as the worst case is: its worst cell, with the presses that derivatives and the "
                "worst-case search name for it.",
            ],
            samples=tuple(shown.tolist()),
            proven=bounds[0] >= wanted / 100,
            undecided=_more_boards(good, count, wanted / 100) if bounds[0] < wanted / 100 <= good / count else "",
        )


def judged_by(requirement: Requirement) -> bool | None:
    """Whether a requirement asks for shares of full scale; None: as the cell has it."""
    return True if requirement.unit in SHARE_UNITS else None


def percent(value: float) -> float:
    """A number of 1 in %."""
    return 100.0 * value


def negative(value: float) -> float:
    """What should be large, of a target that should be small."""
    return -value


def _more_boards(good: int, count: int, wanted: float) -> str:
    """Why the yield is neither proven nor missed, and how many boards would decide."""
    needed = boards_needed(wanted, good / count)
    more = "no number of boards" if needed is None else f"--samples {max(needed, count + 1)}"
    return (
        f"{good} of {count} boards keep the limit, too few to prove a yield of {100 * wanted:.4g} %: "
        f"{more} would, if as large a share keeps it"
    )
