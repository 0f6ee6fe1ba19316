"""From a target to a measurement: the box of a design under test, its worst cases, and what the report says of them."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from ..errors import InputError, SolverError
from ._box import Box, Corners
from ._dut import DesignUnderTest, once
from ._maps import value_map
from ._outcome import Figure, Measurement, NotRun, drawn
from ._parameters import Factors
from ._readings import Excursion, ReadingErrorTarget
from ._record import CornerRecord, number
from ._scale import Scale
from ._search import Target, WorstCase, worst_case
from ._units import engineering

MOST_CELLS_BY_PART = 16 * 16
"""cells of an array up to which each kind of part is searched alone"""


def box_of(dut: DesignUnderTest, *, spread: bool = True, share: bool | None = None) -> Box:
    """What a worst-case search ranges over.

    Args:
        dut: the design under test.
        spread: False: only the places of presses.
        share: whether errors of readings are shares of full scale, or relative; None: as the cell has it.
    """
    factors = dut.factors if spread else Factors.nominal(dut.design)
    scale = dut.scale if share is None else dut.share_scale if share else Scale()
    return Box(dut.design, factors, dut.rest, dut.pressed, dut.cell_spread if spread else 0.0, scale)


def excursion_of(dut: DesignUnderTest, what: str) -> Excursion | None:
    """How far a voltage goes beyond its limits, at the "output", the "converter" or by the circuit's "law".

    None where there are no limits. Of cells that are open at rest, readings may come as near to that end as they like.
    """
    design, side = dut.design, box_of(dut).side
    board = design.board
    at_converter = True
    if what == "output":
        low, high = design.readout.supply if board.circuit.has_amplifiers else (-inf, inf)
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
def worst_of(dut: DesignUnderTest, target: Target, *, spread: bool = True, share: bool | None = None) -> WorstCase:
    """The worst case of a target, worked out once.

    Raises:
        NotRun: the design has no such analysis.
    """
    box = box_of(dut, spread=spread, share=share)
    starts: list[Corners] = []
    if isinstance(target, Excursion):
        box = replace(box, design=box.design.replace(readout={"supply": (-inf, inf)}))
    elif isinstance(target, ReadingErrorTarget):  # a corner that leaves a range is a lost reading, whatever leads to it
        for what in ("output", "converter", "law"):
            if (excursion := excursion_of(dut, what)) is None:
                continue
            found = worst_of(dut, excursion, spread=spread)
            if found.value >= -box.half_step:
                starts.append(found.corner)
                box = replace(box, saturates=box.saturates or what == "output")
    try:
        return worst_case(target, box, starts)
    except (InputError, SolverError) as error:
        raise NotRun(f"no worst case: {error}") from error


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
        parts={key: [number(value) for value in values.tolist()] for key, values in parts.items()},
        cells_ohm=[[[number(ohms) for ohms in row] for row in frame.tolist()] for frame in found.frames],
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


def headroom(dut: DesignUnderTest, excursion: Excursion, what: str, allowed: str) -> Measurement:
    """Smallest distance in V of the lowest and the highest voltage from their limits."""
    found = worst_of(dut, excursion)
    low, high = excursion.limits
    beyond, below = np.nan_to_num(found.by_sign.max(axis=(1, 2)))
    limited = np.isfinite([low, high])
    ends = [
        engineering(end, "V") if known else "not limited"
        for end, known in zip((low - below, high + beyond), limited, strict=True)
    ]
    limits = [engineering(end, "V") if known else "any" for end, known in zip((low, high), limited, strict=True)]
    volts = high + found.value if found.corner.sign[0] > 0 else low - found.value
    cell, _, rest = found.where.partition("; ")
    return replace(
        measured(found, -found.value, "V", where=f"{cell}: {engineering(volts, 'V')}; {rest}"),
        text=[f"{what} from {ends[0]} to {ends[1]}; {allowed} {limits[0]} to {limits[1]}."],
    )
