"""Quantities of settled readings: errors, crosstalk, and the ranges of outputs and converter that are used."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from ..circuits import Boards, Design, Requirement, apparent_resistance, scan_population
from ..common.arrays import FloatArray
from ..errors import InputError
from ._corner import WorstCase, improved, worst_case
from ._maps import value_map
from ._montecarlo import CONFIDENCE, blocks, boards_needed, proportion_bounds, sample_block, worst_board
from ._outcome import DoesNotApply, Figure, Measurement, NotRun
from ._parameters import Factors
from ._record import CornerRecord, number
from ._subject import Subject
from ._targets import Box, Crosstalk, Excursion, GainError, Press, ReadingError, Target
from ._units import engineering

TARGETS: dict[str, Target] = {"crosstalk": Crosstalk(), "reading_error": ReadingError(), "gain_error": GainError()}
HEADROOM = ("output_headroom", "adc_headroom")
MOST_CELLS_BY_PART = 16 * 16
"""cells of an array up to which each kind of part is searched alone"""


def box_of(subject: Subject, *, spread: bool = True) -> Box:
    """What a worst-case search of the subject ranges over; without ``spread``, only the places of presses."""
    factors = subject.factors if spread else Factors.nominal(subject.design)
    return Box(subject.design, factors, subject.rest, subject.pressed, subject.cell_spread if spread else 0.0)


def excursion_of(design: Design, quantity: str) -> Excursion | None:
    """What :data:`HEADROOM` is about: how far a voltage goes beyond its limits; None where there are no limits."""
    if quantity == "output_headroom":
        low, high = design.readout.supply
        limited = design.board.circuit.has_amplifiers and (low > -inf or high < inf)
        return Excursion("output", (low, high), at_converter=False) if limited else None
    if design.adc is None:
        return None
    (low, high), step = design.adc.range, design.adc.step
    return Excursion("converter", (low + step, high - step), at_converter=True)


def worst_of(subject: Subject, quantity: str, *, spread: bool = True) -> WorstCase:
    """The worst case of one of :data:`TARGETS` or :data:`HEADROOM`, worked out once."""
    key = f"worst case of {quantity}, spread {spread}"
    if key not in subject.memo:
        box = box_of(subject, spread=spread)
        if quantity in TARGETS:
            # A corner that leaves a range is an infinite error there, whatever leads to it.
            ranges = [worst_of(subject, name, spread=spread) for name in HEADROOM if excursion_of(box.design, name)]
            starts = [found.corner for found in ranges if found.value >= 0]
            saturates = any(found.value >= 0 and found.target.name == "output" for found in ranges)
            subject.memo[key] = worst_case(TARGETS[quantity], replace(box, saturates=saturates), starts)
        else:
            excursion = excursion_of(box.design, quantity)
            assert excursion is not None
            free = replace(box, design=box.design.replace(readout={"supply": (-inf, inf)}))
            subject.memo[key] = worst_case(excursion, free)
    found: WorstCase = subject.memo[key]
    return found


def samples_of(subject: Subject, quantity: str) -> FloatArray:
    """(boards,) the values of the Monte Carlo analysis, relative; drawn once."""
    key = f"samples of {quantity}"
    if key not in subject.memo:
        box, presses = box_of(subject), presses_of(subject, quantity)
        parts = [
            sample_block(TARGETS[quantity], box, presses, subject.seed, block)
            for block in range(blocks(subject.samples))
        ]
        keep_samples(subject, quantity, np.concatenate(parts))
    found: FloatArray = subject.memo[key]
    return found


def keep_samples(subject: Subject, quantity: str, values: FloatArray) -> None:
    """Keep the values of all blocks. A board that is worse than the worst case so far becomes a start of its search."""
    subject.memo[f"samples of {quantity}"] = values[: subject.samples]
    try:
        found = worst_of(subject, quantity)
    except InputError:
        return
    if values[: subject.samples].max() > found.value:
        boards = worst_board(found.target, found.box, presses_of(subject, quantity), subject.seed, values)
        subject.memo[f"worst case of {quantity}, spread True"] = improved(found, boards)


def presses_of(subject: Subject, quantity: str) -> list[Press]:
    """The presses under which the Monte Carlo analysis judges its boards, found once."""
    key = f"presses of {quantity}"
    if key not in subject.memo:
        try:
            subject.memo[key] = worst_of(subject, quantity).presses
        except InputError:  # no sensitivities: every second cell pressed, in place of the worst presses
            second = np.indices(subject.design.array.shape).sum(axis=0) % 2 == 0
            subject.memo[key] = [(pattern, (0, 0)) for pattern in (second & False, second | True, second, ~second)]
    found: list[Press] = subject.memo[key]
    return found


def reading_quantity(quantity: str, subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Crosstalk, reading error or gain error, in %."""
    if quantity == "crosstalk" and subject.design.array.rows * subject.design.array.columns == 1:
        raise DoesNotApply("a single cell has no neighbours")
    if method == "monte-carlo":
        return _yield(quantity, subject, requirement)
    spread = method == "worst-case"
    found = _searched(subject, quantity, spread=spread)
    where = _where(found)
    if not np.isfinite(found.value):
        beyond = f"{where}: a reading at or beyond the reference or the converter's range, or an output at its limit"
        return Measurement(inf, "%", where=beyond, confidence=found.search, corner=_corner_of(found))
    with_parts = spread and found.box.cells <= MOST_CELLS_BY_PART
    return Measurement(
        100 * found.value,
        "%",
        where=where,
        confidence=found.search,
        incomplete=found.incomplete,
        contributions={kind: 100 * value for kind, value in found.by_part.items()} if with_parts else {},
        figures=_maps(found, requirement),
        corner=_corner_of(found),
    )


def _searched(subject: Subject, quantity: str, *, spread: bool = True) -> WorstCase:
    try:
        return worst_of(subject, quantity, spread=spread)
    except InputError as error:
        raise NotRun(f"no worst case: {error}") from error


def _where(found: WorstCase) -> str:
    """Cell, press and parts of a worst case, in words."""
    parts = f"; {found.box.factors.describe(found.factors)}" if len(found.box.factors) else ""
    return f"cell {found.cell}; {found.pressed_cells}{parts}"


def _corner_of(found: WorstCase) -> CornerRecord:
    parts = found.box.factors.varied(found.factors)
    return CornerRecord(
        cell=found.cell,
        parts={key: [number(value) for value in values.tolist()] for key, values in parts.items()},
        cells_ohm=[[[number(ohms) for ohms in row] for row in frame.tolist()] for frame in found.frames],
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
    values = 100 * samples_of(subject, quantity)
    low, high = requirement.min, requirement.max
    kept = np.isfinite(values)
    kept &= (values >= low) if low is not None else True
    kept &= (values <= high) if high is not None else True
    count, good = len(values), int(kept.sum())
    wanted = requirement.conditions.yield_percent / 100
    bounds = proportion_bounds(good, count)
    quantile = float(np.sort(values)[min(int(np.ceil(wanted * count)) - 1, count - 1)])
    worst = int(np.argmax(values))
    presses = len(presses_of(subject, quantity))
    return Measurement(
        quantile,
        "%",
        where=f"board {worst} of seed {subject.seed} is the worst: {engineering(float(values[worst]), '%')}",
        confidence=(
            f"{good} of {count} boards keep the limit: yield {100 * good / count:.4g} %, "
            f"at least {100 * bounds[0]:.4g} % "
            f"({100 * CONFIDENCE:.0f} % confidence, Clopper-Pearson); wanted {100 * wanted:.4g} %"
        ),
        text=[
            f"The value shown is the {100 * wanted:.4g} % quantile of the boards.",
            f"Each board is judged under {presses} presses: all cells at rest, all pressed, and the presses of the "
            "worst corners that the worst-case search of this quantity found. The largest value counts.",
        ],
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


def output_headroom(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Smallest distance of an output from its supply limits, V; negative: it would go beyond."""
    if not subject.design.board.circuit.has_amplifiers:
        raise DoesNotApply(f"'{subject.design.readout.circuit}' has no amplifier that could saturate")
    if excursion_of(subject.design, "output_headroom") is None:
        raise NotRun("missing: readout.supply")
    return _headroom(subject, "output_headroom", "Outputs range", "the supply allows")


def adc_headroom(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Smallest distance of a converted voltage from the ends of the converter's range, V."""
    if subject.design.adc is None:
        raise NotRun("missing: adc.bits, adc.range")
    limits = "without its first and last code the converter takes"
    return _headroom(subject, "adc_headroom", "Converted voltages range", limits)


def _headroom(subject: Subject, quantity: str, what: str, allowed: str) -> Measurement:
    """Smallest distance in V of the lowest and the highest voltage from their limits."""
    found = _searched(subject, quantity)
    target = found.target
    assert isinstance(target, Excursion)
    low, high = target.limits
    beyond, below = found.by_sign.max(axis=(1, 2))
    ends = [engineering(end, "V") if np.isfinite(end) else "not limited" for end in (low - below, high + beyond)]
    volts = high + found.value if found.corner.sign[0] > 0 else low - found.value
    cell, _, rest = _where(found).partition("; ")
    return Measurement(
        -found.value,
        "V",
        where=f"{cell}: {engineering(volts, 'V')}; {rest}",
        confidence=found.search,
        incomplete=found.incomplete,
        text=[f"{what} from {ends[0]} to {ends[1]}; {allowed} {engineering(low, 'V')} to {engineering(high, 'V')}."],
        corner=_corner_of(found),
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
