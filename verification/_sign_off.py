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

RATINGS = ("part", "outcome", "number", "stress", "rating", "allowed", "worst stress", "of the rating")
Cell = tuple[str, str]
"""what a column shows, and what stands below it in small print"""


class Line(NamedTuple):
    """One requirement, in words; cells are empty where an analysis says nothing of it."""

    result: Result
    name: str
    cells: Sequence[Cell]
    """of the columns behind name and outcome"""

    @property
    def row(self) -> tuple[str, ...]:
        """As plain text."""
        cells = (f"{text} ({small})".strip() if small else text for text, small in self.cells)
        return self.name, self.result.outcome, *cells


class SignOff(NamedTuple):
    """All that the page shows, in words."""

    filed_under: list[tuple[str, str]]
    part_numbers: list[tuple[str, str]]
    columns: list[str]
    """of the bounds; worst cases of new parts stand beside those at the end of life if parts age"""
    bounds: list[Line]
    """all requirements but those that stand for ratings"""
    ratings: list[Line]
    """with the worst stress and the share of the rating that it leaves"""
    failed: list[tuple[str, str]]
    """(requirement, reason)"""
    coverage: Table

    @classmethod
    def of(cls, dut: DesignUnderTest, results: Sequence[Result]) -> SignOff:
        """The page of one run."""
        design, ages = dut.design, dut.design.ages
        worst = ["worst case, end of life", "new parts"] if ages else ["worst case"]
        columns = ["requirement", "outcome", "limit", *worst, "root sum of squares", "Monte Carlo, 99 %", "margin"]
        bounds = [_bounds_line(result, ages=ages) for result in results if _rates(result) is None]
        ratings = [_rating_line(design, result, rates) for result in results if (rates := _rates(result)) is not None]
        failed = [(_name(result), result.why) for result in results if result.outcome is Outcome.FAIL]
        papers = filed_under(design), part_numbers(design)
        return cls(*papers, columns, bounds, ratings, failed, coverage(dut))


def _name(result: Result) -> str:
    return f"{result.requirement.id} {result.title}"


def _bounds_line(result: Result, *, ages: bool) -> Line:
    found = result.measurement
    value, new, root_sum_square, drawn = ("", ""), ("", ""), ("", ""), ("", "")
    if found is not None and result.method == SAMPLED:
        drawn = result.found, f"of {len(found.samples)} boards"
    elif found is not None:
        value = result.found, result.method if found.bounds is None else found.incomplete
    if found is not None and (bounds := found.bounds) is not None:
        names = ("initial", "root_sum_square", "quantile_99", "sampled")
        shown = [engineering(n, result.unit) if (n := getattr(bounds, name)) is not None else "" for name in names]
        new, root_sum_square, drawn = (
            (shown[0], ""),
            (shown[1], ""),
            (shown[2], f"worst of {bounds.boards}: {shown[3]}"),
        )
    cells = (result.required, ""), value, *([new] if ages else []), root_sum_square, drawn, (result.margin_shown, "")
    return Line(result, _name(result), cells)


def _rates(result: Result) -> tuple[str, str] | None:
    """Part and kind of the rating that a requirement stands for."""
    quantity = CATALOGUE.get(result.requirement.quantity)
    rates = None if quantity is None else quantity.rates
    return rates if rates is not None and result.requirement.id == ".".join(rates) else None


def _rating_line(design: Design, result: Result, rates: tuple[str, str]) -> Line:
    part, found, left = getattr(design.parts, rates[0]), result.measurement, ""
    rating = part.ratings[rates[1]]
    if found is not None and np.isfinite(found.value):
        share = 100.0 * found.value / rating
        left = f"{share:.3g} % used, {100.0 * part.derating - share:.3g} % left".replace("-", "−")
    allowed = f"{engineering(part.derating * rating, result.unit)} ({100.0 * part.derating:g} %)"
    stress, shown = CATALOGUE[result.requirement.quantity].title.lower(), result.found if found is not None else ""
    texts = part.number, stress, engineering(rating, result.unit), allowed, shown, left
    return Line(result, rates[0].replace("_", " "), [(text, "") for text in texts])


def part_numbers(design: Design) -> list[tuple[str, str]]:
    """What the parts of the circuit are bought as."""
    parts = ((name, getattr(design.parts, name)) for name in type(design.parts).model_fields)
    return [(name.replace("_", " "), part.number) for name, part in parts if part is not None and part.number]


def filed_under(design: Design) -> list[tuple[str, str]]:
    """Document number, revision, author and date, as far as they are given."""
    keys = {"number": "document", "revision": "revision", "author": "author", "date": "date"}
    values = ((shown, getattr(design.document, key)) for key, shown in keys.items())
    return [(shown, str(value)) for shown, value in values if value]


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
