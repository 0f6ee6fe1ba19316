"""What a verdict leaves out: effects that no quantity models for a design, and values that the design does not give.

The lists follow from the design. An effect that a quantity models for this circuit with these keys is not among them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..circuits import Design
from ._parameters import MAXIMA
from ._units import UNITS, engineering


@dataclass(frozen=True)
class Effect:
    """Something that real boards do and that the analysis leaves out."""

    name: str
    assumed: str
    """what the analysis takes in its place, as a sentence"""
    concerns: str
    """the quantities that it would change"""
    left_out: Callable[[Design], bool]
    """whether it applies to a design and nothing models it there"""


@dataclass(frozen=True)
class Assumptions:
    """What one verdict leaves out."""

    effects: tuple[Effect, ...]
    not_given: tuple[tuple[str, str], ...]
    """keys of the design ("readout.bias_current") that are not given, and what is taken in their place"""
    exact: tuple[str, ...]
    """keys of parts whose value is given without any tolerance"""


def _amplified(design: Design) -> bool:
    return design.board.circuit.has_amplifiers


def _always(design: Design) -> bool:
    return True


def _one_pole(design: Design) -> bool:
    return _amplified(design) and design.readout.amplifier_model is None


def _in_time(design: Design) -> bool:
    """Whether settling and noise are computed at all."""
    return not _amplified(design) or design.board.circuit.virtual_ground


EFFECTS = (
    Effect(
        "crossings without a cell",
        "Every crossing has a cell, also where the [shape] has none.",
        "all that presses change",
        lambda design: design.shape is not None and not design.geometry.is_whole,
    ),
    Effect("slewing", "Amplifiers follow at any rate.", "settling", _amplified),
    Effect("saturation recovery", "An amplifier leaves its limit at once.", "settling, crosstalk", _amplified),
    Effect("further amplifier poles", "Amplifiers have one pole; no model is named.", "phase margin", _one_pole),
    Effect("output impedance", "Amplifiers drive any load; no model is named.", "phase margin, headroom", _one_pole),
    Effect("all dynamics", "Nothing takes time in this circuit.", "settling, noise", lambda d: not _in_time(d)),
    Effect("supply rejection", "Supplies, common mode and their ripple do not matter.", "noise", _amplified),
    Effect(
        "swing tolerance",
        "The output swing is the same on all boards, at any load and temperature.",
        "headroom",
        lambda design: bool(np.isfinite(design.readout.supply).any()),
    ),
    Effect("1/f noise", "Noise is white; it neither pops nor drifts.", "noise, pressure resolution", _always),
    Effect("interference", "Mains, radio, shielding and grounding do not matter.", "noise", _always),
    Effect("distributed line capacitance", "All capacitance is at the columns' ends.", "settling, crosstalk", _always),
    Effect(
        "driven-line capacitance",
        "A driven line is at its level as soon as it is selected.",
        "settling, fastest scan",
        lambda design: bool(np.asarray(design.array.row_lead).any()),
    ),
    Effect("charge injection", "Switches leave no charge.", "settling, reading error", _always),
    Effect(
        "differential nonlinearity, converter reference, jitter",
        "The converter has an offset, a slope, a bow and equal steps.",
        "reading error, noise",
        lambda design: design.adc is not None,
    ),
    Effect("converter", "Voltages are not converted.", "all readings", lambda design: design.adc is None),
    Effect(
        "unequal dynamic parts",
        "Tolerances of bandwidth and capacitance are alike on all columns.",
        "phase margin, settling",
        lambda design: any(key in design.spreads for key in ("readout.column_capacitance", "readout.gain_bandwidth")),
    ),
    Effect("input protection", "There are no clamps, and they would not leak.", "reading error, noise", _always),
    Effect("cell voltage, humidity and age", "The material knows only pressure and time.", "reading error", _always),
    Effect(
        "cell temperature",
        "cells.rest_resistance has no temperature coefficient.",
        "reading error, pressure",
        lambda design: not _drifts(design, "cells.rest_resistance"),
    ),
    Effect("mechanical crosstalk", "A load stays on its cell.", "pressure", _always),
)
_AMPLIFIED_ONLY = (
    *("open_loop_gain", "gain_bandwidth", "offset_voltage", "bias_current", "supply", "feedback_capacitance"),
    *("voltage_noise", "current_noise", "amplifier_model"),
)


def _drifts(design: Design, key: str) -> bool:
    spread = design.spreads.get(key)
    return spread is not None and bool(spread.temperature_coefficient)


def assumptions_of(design: Design) -> Assumptions:
    """What a verdict about this design leaves out."""
    return Assumptions(
        effects=tuple(effect for effect in EFFECTS if effect.left_out(design)),
        not_given=tuple(_not_given(design)),
        exact=tuple(_exact(design)),
    )


def _not_given(design: Design) -> list[tuple[str, str]]:
    found = []
    for section in ("array", "drive", "readout", "adc", "cells", "operation"):
        part = getattr(design, section)
        if part is None:
            found.append((f"[{section}]", "the shipped example cell" if section == "cells" else "none"))
            continue
        for key in type(part).model_fields:
            if key == "spread" or key in part.model_fields_set or not _matters(design, section, key):
                continue
            found.append((f"{section}.{key}", _taken_as(key, getattr(part, key), UNITS.get(section, {}).get(key, ""))))
    return found


def _matters(design: Design, section: str, key: str) -> bool:
    """Whether a key has an effect on the circuit."""
    circuit = design.board.circuit
    match section, key:
        case "drive", "idle_row_resistance":
            return design.drive.idle_rows == "pull"
        case "readout", "idle_columns":
            shared = not circuit.virtual_ground or design.readout.columns == "multiplexed"
            return shared and not circuit.drives_idle_lines
        case ("drive", "idle_rows") | ("readout", "columns"):
            return not circuit.drives_idle_lines
        case "readout", _ if key in _AMPLIFIED_ONLY:
            return circuit.has_amplifiers
    return True


def _taken_as(key: str, value: Any, unit: str) -> str:
    if key == "temperature_range":
        return "298.15 K only"
    if key == "amplifier_model":
        return "an amplifier of one pole"
    if value is None:
        return "not known: what depends on it is not run"
    if isinstance(value, tuple):
        return "no limit" if np.isinf(value).all() else f"[{', '.join(engineering(v, unit) for v in value)}]"
    if isinstance(value, str):
        return value
    return "infinite" if np.isinf(value) else engineering(float(value), unit)


def _exact(design: Design) -> list[str]:
    spreads, found = design.spreads, []
    for section in ("array", "drive", "readout", "adc", "cells"):
        part = getattr(design, section)
        for key in () if part is None else type(part).PARTS:
            name, value = f"{section}.{key}", np.asarray(getattr(part, key), dtype=np.float64)
            counts = value.any() and np.isfinite(value).all() and _matters(design, section, key)
            if counts and name not in spreads and name not in MAXIMA:
                found.append(name)
    return found
