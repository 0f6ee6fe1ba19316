"""The error budget: what each real part costs alone, in an otherwise ideal board."""

from __future__ import annotations

from math import inf
from typing import Any

from ..circuits import Design
from ..errors import InputError
from ._corner import Crosstalk, ReadingError, Target, worst_case
from ._outcome import Table
from ._parameters import Factors
from ._static import box_of
from ._subject import Subject
from ._units import engineering

IDEAL: dict[str, dict[str, Any]] = {
    "array": {"row_lead": 0.0, "column_lead": 0.0, "row_segment": 0.0, "column_segment": 0.0},
    "readout": {"open_loop_gain": inf, "offset_voltage": 0.0, "bias_current": 0.0, "supply": (-inf, inf)},
}
MOST_CELLS = 16 * 16
"""Of larger arrays the budget is left out: it takes a search per part, and the tornado says nearly the same."""
ALONE: dict[str, tuple[tuple[str, str], ...]] = {
    "row leads and switches": (("array", "row_lead"),),
    "column leads": (("array", "column_lead"),),
    "line segments": (("array", "row_segment"), ("array", "column_segment")),
    "reference resistors": (("readout", "reference_resistance"),),
    "open-loop gain": (("readout", "open_loop_gain"),),
    "offset voltage": (("readout", "offset_voltage"),),
    "bias current": (("readout", "bias_current"),),
    "output swing": (("readout", "supply"),),
    "drive voltage": (("drive", "voltage"),),
    "reference voltage": (("readout", "reference_voltage"),),
    "converter": (("adc", ""),),
}


def error_budget(subject: Subject) -> Table | None:
    """Reading error and crosstalk at the worst corner of each part alone, and of all parts together."""
    if "budget" in subject.memo:
        known: Table | None = subject.memo["budget"]
        return known
    if subject.design.array.rows * subject.design.array.columns > MOST_CELLS:
        return None
    rows = []
    try:
        for name, keys in [*ALONE.items(), ("all together", ())]:
            design = _only(subject.design, keys) if keys else subject.design
            found = [_worst(subject, design, keys, target) for target in (ReadingError(), Crosstalk())]
            rows.append([name, *(engineering(v, "%") if v > 1e-9 else "none" for v in found)])
    except InputError:  # a continuous sheet has no sensitivities, and so no corners
        rows = []
    table = Table(
        ["part, alone", "worst reading error", "worst crosstalk"],
        rows,
        "Error budget: each part alone with its tolerance, all others ideal; and all together.",
    )
    subject.memo["budget"] = table if rows else None
    found_table: Table | None = subject.memo["budget"]
    return found_table


def _only(design: Design, keys: tuple[tuple[str, str], ...]) -> Design:
    """The design with ideal parts but for the given ones."""
    changes: dict[str, Any] = {section: dict(values) for section, values in IDEAL.items()}
    for section, key in keys:
        changes.get(section, {}).pop(key, None)
    result = design.replace(**changes)
    return result if keys == (("adc", ""),) else result.replace(adc=None)


def _worst(subject: Subject, design: Design, keys: tuple[tuple[str, str], ...], target: Target) -> float:
    box = box_of(subject)
    factors = Factors.of(design)
    if keys:
        names = {f"{section}.{key}" for section, key in keys}
        kept = [
            k for k, f in enumerate(factors.factors) if f.key in names or (keys[0][0] == "adc" and f.key[:3] == "adc")
        ]
        factors = Factors(
            tuple(factors.factors[k] for k in kept),
            factors.centre,
            {key: matrix[:, kept] for key, matrix in factors.matrix.items()},
        )
    part = type(box)(design, factors, box.rest_ohm, box.pressed_ohm, box.cell_spread)
    return 100 * abs(worst_case(target, part).value)
