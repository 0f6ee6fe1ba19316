"""Quantities of settled readings: errors, crosstalk, and the ranges of outputs and converter that are used."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from ..circuits import Boards, Design, Requirement, apparent_resistance, scan_population
from ..common.arrays import FloatArray
from ..errors import InputError
from ._corner import Box, Crosstalk, GainError, ReadingError, Target, WorstCase, named_corners, worst_case
from ._maps import value_map
from ._montecarlo import CONFIDENCE, Samples, blocks, boards_needed, proportion_bounds, sample_block
from ._outcome import Corner, DoesNotApply, Figure, Measurement, NotRun
from ._parameters import Factors
from ._subject import Subject
from ._units import engineering

TARGETS: dict[str, Target] = {"crosstalk": Crosstalk(), "reading_error": ReadingError(), "gain_error": GainError()}


def box_of(subject: Subject, *, spread: bool = True) -> Box:
    """What a worst-case search of the subject ranges over; without ``spread``, only the places of presses."""
    factors = subject.factors if spread else Factors.nominal(subject.design)
    return Box(subject.design, factors, subject.rest, subject.pressed, subject.cell_spread if spread else 0.0)


def worst_of(subject: Subject, quantity: str, *, spread: bool = True) -> WorstCase:
    """The worst case of one of :data:`TARGETS`, worked out once."""
    key = f"worst case of {quantity}, spread {spread}"
    if key not in subject.memo:
        subject.memo[key] = worst_case(TARGETS[quantity], box_of(subject, spread=spread))
    found: WorstCase = subject.memo[key]
    return found


def samples_of(subject: Subject) -> Samples:
    """The boards of the Monte Carlo analysis, drawn once."""
    if "samples" not in subject.memo:
        box, patterns = box_of(subject), patterns_of(subject)
        parts = [sample_block(box, patterns, subject.seed, block) for block in range(blocks(subject.samples))]
        joined = Samples.joined(parts)
        subject.memo["samples"] = Samples(*(getattr(joined, name)[: subject.samples] for name in vars(joined)))
    found: Samples = subject.memo["samples"]
    return found


def patterns_of(subject: Subject) -> list[np.ndarray]:
    """The press that the worst-case search of the crosstalk names."""
    return [worst_of(subject, "crosstalk").pattern]


def reading_quantity(quantity: str, subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Crosstalk, reading error or gain error, in %."""
    if quantity == "crosstalk" and subject.design.array.rows * subject.design.array.columns == 1:
        raise DoesNotApply("a single cell has no neighbours")
    if method == "monte-carlo":
        return _yield(quantity, subject, requirement)
    spread = method == "worst-case"
    try:
        found = worst_of(subject, quantity, spread=spread)
    except InputError as error:
        raise NotRun(f"no worst case: {error}") from error
    magnitude = 100 * abs(found.value)
    where = f"cell {found.cell}; {found.pressed_cells}"
    if spread and len(subject.factors):
        where += f"; {subject.factors.describe(found.corner.factors[0])}"
    if not np.isfinite(magnitude):
        beyond = f"{where}: beyond the converter's range, or an output at its limit"
        return Measurement(inf, "%", where=beyond, corner=_corner_of(found))
    contributions = {key: 100 * value for key, value in found.contributions.items()} if spread else {}
    return Measurement(
        magnitude,
        "%",
        where=where,
        confidence=found.search,
        contributions=contributions,
        figures=_maps(found, requirement),
        corner=_corner_of(found),
    )


def _corner_of(found: WorstCase) -> Corner:
    parts = found.box.factors.varied(found.corner.factors[0])
    return Corner(
        cell=found.cell,
        parts={key: values.tolist() for key, values in parts.items()},
        cells_ohm=[frame.tolist() for frame in found.frames],
    )


def _maps(found: WorstCase, requirement: Requirement) -> list[Figure]:
    by_cell = 100 * found.by_cell
    limit = requirement.max
    known = by_cell[np.isfinite(by_cell)]
    top = max([float(known.max())] if known.size else [0.0], default=0.0)
    picture = value_map(
        by_cell, label=f"{found.target.name} / %", top=max(top, 1.2 * (limit or 0.0)) or 1.0, limit=limit
    )
    return [
        Figure(
            picture,
            f"{found.target.name.capitalize()} of each cell at the worst corner that was solved for that cell. "
            "Outlined: cells beyond the limit. Empty: cells that first order ranks too low to be solved.",
        )
    ]


def _yield(quantity: str, subject: Subject, requirement: Requirement) -> Measurement:
    """How many boards keep the limits."""
    values = 100 * getattr(samples_of(subject), quantity)
    low, high = requirement.min, requirement.max
    kept = np.isfinite(values)
    kept &= (values >= low) if low is not None else True
    kept &= (values <= high) if high is not None else True
    count, good = len(values), int(kept.sum())
    wanted = requirement.conditions.yield_percent / 100
    bounds = proportion_bounds(good, count)
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    quantile = float(ordered[min(int(np.ceil(wanted * count)) - 1, count - 1)])
    worst = int(np.argmax(np.where(np.isfinite(values), values, np.inf)))
    return Measurement(
        quantile,
        "%",
        where=f"board {worst} of seed {subject.seed} is the worst: {engineering(float(values[worst]), '%')}",
        confidence=(
            f"{good} of {count} boards keep the limit: yield {100 * good / count:.4g} %, "
            f"at least {100 * bounds[0]:.4g} % "
            f"({100 * CONFIDENCE:.0f} % confidence, Clopper-Pearson); wanted {100 * wanted:.4g} %"
        ),
        text=[f"The value shown is the {100 * wanted:.4g} % quantile of the boards."],
        samples=tuple(values.tolist()),
        proven=bounds[0] >= wanted,
        undecided=_more_boards(good, count, wanted) if bounds[0] < wanted <= good / count else "",
    )


def _more_boards(good: int, count: int, wanted: float) -> str:
    """Why the yield is neither proven nor missed, and how many boards would decide."""
    needed = boards_needed(wanted, good / count)
    more = "no number of boards" if needed is None else f"--samples {max(needed, count + 1)}"
    return (
        f"{good} of {count} boards keep the limit, too few to prove a yield of {100 * wanted:.4g} %: "
        f"{more} would, if as large a share keeps it"
    )


def output_extremes(subject: Subject) -> tuple[tuple[float, str], tuple[float, str]]:
    """Lowest and highest output in V with the cell it is at, over all presses, parts and cells; no supply limits it."""
    if "extremes" not in subject.memo:
        free = subject.design.replace(readout={"supply": (-inf, inf)})
        box = replace(box_of(subject), design=free)
        lowest, highest = (inf, ""), (-inf, "")
        for pressed in (0.0, 1.0):
            for sign in (1.0, -1.0):
                corners = named_corners(ReadingError(), box, pressed, sign)
                population = box.factors.population(corners.factors)
                cells = box.resistance(corners.pattern, corners.scale)
                volts = scan_population(free, population.boards, cells).volts
                own = volts[np.arange(len(volts)), corners.row, corners.column]
                low, high = int(np.argmin(own)), int(np.argmax(own))
                places = [f"cell ({corners.row[k]}, {corners.column[k]})" for k in (low, high)]
                lowest = min(lowest, (float(own[low]), places[0]))
                highest = max(highest, (float(own[high]), places[1]))
        subject.memo["extremes"] = lowest, highest
    found: tuple[tuple[float, str], tuple[float, str]] = subject.memo["extremes"]
    return found


def output_headroom(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Smallest distance of an output from its supply limits, V; negative: it would go beyond."""
    design = subject.design
    if not design.board.circuit.has_amplifiers:
        raise DoesNotApply("a divider has no amplifier that could saturate")
    if not np.isfinite(design.readout.supply).any():
        raise NotRun("missing: readout.supply")
    (low, at_low), (high, at_high) = _extremes(subject)
    first, last = design.readout.supply
    return _headroom(
        (low, at_low),
        (high, at_high),
        (first, last),
        f"Outputs range from {engineering(low, 'V')} to {engineering(high, 'V')}; the supply allows "
        f"{engineering(first, 'V')} to {engineering(last, 'V')}.",
    )


def adc_headroom(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Smallest distance of a converted voltage from the ends of the converter's range, V."""
    design = subject.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    (low, at_low), (high, at_high) = _extremes(subject)
    box = box_of(subject)
    widths = [np.abs(box.factors.matrix[f"adc.{name}"]).sum() for name in ("offset_voltage", "gain_error", "inl_steps")]
    errors = [sign * np.array(widths) for sign in (-1.0, 1.0)]
    lowest, highest = (
        float(pick([box.converted(np.array(v), e) for e in errors])) for v, pick in ((low, min), (high, max))
    )
    first, last = design.adc.range
    return _headroom(
        (lowest, at_low),
        (highest, at_high),
        (first + design.adc.step, last - design.adc.step),
        f"Converted voltages range from {engineering(lowest, 'V')} to {engineering(highest, 'V')}; the converter "
        f"takes {engineering(first, 'V')} to {engineering(last, 'V')}, without its first and last code.",
    )


def _headroom(low: tuple[float, str], high: tuple[float, str], limits: tuple[float, float], text: str) -> Measurement:
    """Smallest distance in V of the lowest and the highest voltage, each with its place, from the limits."""
    below, above = low[0] - limits[0], limits[1] - high[0]
    volts, place = low if below < above else high
    return Measurement(
        min(below, above),
        "V",
        where=f"{place}: {engineering(volts, 'V')}",
        confidence="corners of parts and presses, by sensitivities",
        text=[text],
    )


def adc_range_used(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Share of the converter's range that the cells' readings move over, from rest to full scale, %."""
    design = subject.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    shape = design.array.shape
    frames = np.stack([np.full(shape, subject.rest), np.full(shape, subject.pressed)])
    volts = scan_population(design, Boards.of(design), frames).volts
    moved = np.abs(np.clip(volts, *design.adc.range)[1] - np.clip(volts, *design.adc.range)[0])
    place = np.unravel_index(np.argmin(moved), shape)
    span = design.adc.range[1] - design.adc.range[0]
    return Measurement(
        float(100 * moved[place] / span),
        "%",
        where=f"cell {tuple(map(int, place))}",
        confidence="nominal parts; all cells at rest, then all pressed",
    )


def resolution(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Change of a cell's resistance that one step of the converter stands for, at the least favourable load, ohm."""
    design = subject.design
    if design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    worst, where = 0.0, ""
    for ohms, state in ((subject.rest, "at rest"), (subject.pressed, "at full scale")):
        slope = _ohms_per_volt(design, np.full(design.array.shape, ohms))
        place = np.unravel_index(np.argmax(slope), slope.shape)
        if slope[place] * design.adc.step > worst:
            worst, where = float(slope[place] * design.adc.step), f"cell {tuple(map(int, place))}, {state}"
    return Measurement(worst, "ohm", where=where, confidence="nominal parts; one code of the converter")


def _ohms_per_volt(design: Design, cells: FloatArray) -> FloatArray:
    """|d(apparent resistance)/d(volts)| (N, M)."""
    volts = scan_population(design, Boards.of(design), cells[None]).volts[0]
    assert design.adc is not None
    small = design.adc.step / 8
    change = apparent_resistance(design, volts + small) - apparent_resistance(design, volts - small)
    return np.abs(change) / (2 * small)


def _extremes(subject: Subject) -> tuple[tuple[float, str], tuple[float, str]]:
    try:
        return output_extremes(subject)
    except InputError as error:
        raise NotRun(f"no worst case: {error}") from error
