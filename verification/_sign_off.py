"""The page that a reviewer signs: bounds beside each other, ratings with what is left of them, and what bounds cover.

The three bounds are those of a worst-case analysis as ECSS-Q-HB-30-01A has them: extreme values, root sum of squares,
and Monte Carlo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..circuits import Design
from ._catalogue import CATALOGUE
from ._dut import DesignUnderTest
from ._outcome import Result, Table
from ._parameters import TEMPERATURE
from ._quantity import SAMPLED
from ._record import Outcome
from ._units import engineering

SEARCH = "worst case"
"""how a value is found that needs no other word in its column"""


class BoundsLine(NamedTuple):
    """One requirement with its bounds, in words; empty where an analysis says nothing of it."""

    result: Result
    value: str
    """what is judged"""
    how: str
    """the method that it is found by"""
    new: str
    root_sum_square: str
    monte_carlo: tuple[str, str]
    """what 99 % of the boards keep, and the worst of how many"""


class RatingLine(NamedTuple):
    """A rating of a part with the worst stress that was found."""

    result: Result
    part: str
    number: str
    stress: str
    rating: str
    allowed: str
    found: str
    left: str


class SignOff(NamedTuple):
    """All that the page shows, in words."""

    filed_under: list[tuple[str, str]]
    part_numbers: list[tuple[str, str]]
    ages: bool
    """whether worst cases of new parts stand beside those at the end of life"""
    bounds: list[BoundsLine]
    ratings: list[RatingLine]
    failed: list[tuple[str, str]]
    coverage: Table

    @classmethod
    def of(cls, dut: DesignUnderTest, results: Sequence[Result]) -> SignOff:
        """The page of one run."""
        design = dut.design
        bounds, ratings = bounds_lines(results), rating_lines(design, results)
        papers = filed_under(design), part_numbers(design)
        return cls(*papers, design.ages, bounds, ratings, why_not(results), coverage(dut))

    @property
    def columns(self) -> list[str]:
        """Heads of the columns of bounds."""
        worst = ["worst case, end of life", "new parts"] if self.ages else ["worst case"]
        return [*worst, "root sum of squares", "Monte Carlo, 99 %"]

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """One per requirement: its name, outcome, limit, bounds and margin."""
        found = []
        for line in self.bounds:
            result, how = line.result, f" ({line.how})" if line.how not in ("", SEARCH) else ""
            names = f"{result.requirement.id} {result.title}", result.outcome, result.required
            new = (line.new,) if self.ages else ()
            both = line.root_sum_square, ", ".join(filter(None, line.monte_carlo)), result.margin_shown
            found.append((*names, f"{line.value}{how}", *new, *both))
        return found


def bounds_lines(results: Sequence[Result]) -> list[BoundsLine]:
    """All requirements but those that stand for ratings."""
    return [_bounds_line(result) for result in results if rating_of(result) is None]


def _bounds_line(result: Result) -> BoundsLine:
    measurement = result.measurement
    if measurement is None:
        return BoundsLine(result, "", "", "", "", ("", ""))
    if result.method == SAMPLED:
        return BoundsLine(result, "", "", "", "", (result.found, f"of {len(measurement.samples)} boards"))
    if (bounds := measurement.bounds) is None:
        return BoundsLine(result, result.found, result.method, "", "", ("", ""))
    new, root_sum_square, quantile, sampled = (
        "" if number is None else engineering(number, result.unit)
        for number in (bounds.initial, bounds.root_sum_square, bounds.quantile_99, bounds.sampled)
    )
    drawn = quantile, f"worst of {bounds.boards}: {sampled}"
    return BoundsLine(result, result.found, SEARCH, new, root_sum_square, drawn)


def rating_of(result: Result) -> tuple[str, str] | None:
    """Part and kind of the rating that a requirement stands for."""
    quantity = CATALOGUE.get(result.requirement.quantity)
    rates = None if quantity is None else quantity.rates
    return rates if rates is not None and result.requirement.id == ".".join(rates) else None


def rating_lines(design: Design, results: Sequence[Result]) -> list[RatingLine]:
    """All ratings that the design gives, with the worst stress and the share of the rating that it leaves."""
    found = []
    for result in results:
        if (rates := rating_of(result)) is None:
            continue
        name, kind = rates
        part = getattr(design.parts, name)
        rating = part.ratings[kind]
        left = ""
        if result.measurement is not None and np.isfinite(result.measurement.value):
            share = 100.0 * result.measurement.value / rating
            left = f"{share:.3g} % used, {100.0 * part.derating - share:.3g} % left".replace("-", "−")
        allowed = f"{engineering(part.derating * rating, result.unit)} ({100.0 * part.derating:g} %)"
        shown = result.found if result.measurement is not None else ""
        stress = CATALOGUE[result.requirement.quantity].title.lower()
        line = (name.replace("_", " "), part.number, stress, engineering(rating, result.unit), allowed, shown, left)
        found.append(RatingLine(result, *line))
    return found


def part_numbers(design: Design) -> list[tuple[str, str]]:
    """What the parts of the circuit are bought as."""
    parts = ((name, getattr(design.parts, name)) for name in type(design.parts).model_fields)
    return [(name.replace("_", " "), part.number) for name, part in parts if part is not None and part.number]


def filed_under(design: Design) -> list[tuple[str, str]]:
    """Document number, revision, author and date, as far as they are given."""
    keys = {"number": "document", "revision": "revision", "author": "author", "date": "date"}
    values = ((shown, getattr(design.document, key)) for key, shown in keys.items())
    return [(shown, str(value)) for shown, value in values if value]


def why_not(results: Sequence[Result]) -> list[tuple[str, str]]:
    """(requirement, reason) of those that fail."""
    failed = (result for result in results if result.outcome is Outcome.FAIL)
    return [(f"{result.requirement.id} {result.title}", result.why) for result in failed]


def coverage(dut: DesignUnderTest) -> Table:
    """What each of the three bounds ranges over, and what none does."""
    design, factors = dut.design, dut.factors.factors
    kinds = dict.fromkeys(factor.key for factor in factors if factor.key != TEMPERATURE)
    aged = [key for key, spread in design.spreads.items() if any(spread.ageing)]
    kelvin = design.operation.temperature_range
    drifts = any(factor.key == TEMPERATURE for factor in factors)
    of_cells = f"± {100 * dut.cell_spread:.3g} % each" if dut.cell_spread else "none"
    presses = f"each cell from {engineering(dut.rest, 'ohm')} to {engineering(dut.pressed, 'ohm')}"
    faults = ", ".join(f"{fault.kind} at {fault.place}" for fault in design.fault)
    rows = [
        ("tolerances", ", ".join(kinds) or "none", "searched, not all combined", "each alone, at random", "drawn"),
        ("end of life", ", ".join(aged) or "no part ages", *(["included"] * 3 if aged else [""] * 3)),
        (
            "temperature",
            "298.15 K only" if kelvin is None else f"{kelvin[0]:g} to {kelvin[1]:g} K",
            *(("all parts at one temperature", "added as it is", "drawn") if drifts else ("no part drifts", "", "")),
        ),
        (
            "cells' deviations",
            of_cells,
            *(("searched", "each alone, at random", "drawn") if dut.cell_spread else [""] * 3),
        ),
        ("presses", presses, "searched", "as in the worst case", "as in the worst case"),
        ("faults", faults or "none: sound boards only", *(["present"] * 3 if faults else ["no"] * 3)),
    ]
    return Table(
        ["what", "given", "worst case", "root sum of squares", "Monte Carlo"],
        rows,
        "What the bounds cover. None covers what is assumed or not modelled.",
    )
