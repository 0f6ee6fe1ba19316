"""The error budget: what each kind of part costs over its own tolerance, beside all of them together."""

from __future__ import annotations

from collections.abc import Sequence

from ._outcome import Result, Table
from ._units import engineering


def error_budget(results: Sequence[Result]) -> Table | None:
    """The worst cases by kind of part of all results that have them, side by side; None if there are none."""
    found = [(r, r.measurement) for r in results if r.method == "worst-case" and r.measurement is not None]
    found = [(result, measured) for result, measured in found if measured.contributions]
    if not found:
        return None
    kinds = dict.fromkeys(kind for _, measured in found for kind in measured.contributions)
    rows = [
        [kind, *(_shown(measured.contributions.get(kind), measured.unit) for _, measured in found)] for kind in kinds
    ]
    rows.append(["all together", *(engineering(measured.value, measured.unit) for _, measured in found)])
    return Table(
        ["part, alone", *(f"{result.requirement.id} {result.title.lower()}" for result, _ in found)],
        rows,
        "Error budget: the worst case with each kind of part over its tolerance and all others nominal, whatever is "
        "pressed; and with all parts together.",
    )


def _shown(value: float | None, unit: str) -> str:
    return "" if value is None else engineering(value, unit)
