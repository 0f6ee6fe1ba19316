"""What a verdict leaves out: effects that no quantity models for a design, and values that the design does not give.

The lists follow from the design. An effect that a quantity models for this circuit with these keys is not among them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

import numpy as np

from ..circuits import AmplifierModel, Design, Spread
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


class Setting(NamedTuple):
    """A line of the table of component values."""

    section: str
    key: str
    value: str
    spread: str
    named: bool
    """whether the design names it"""


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
JUDGED = ("array", "drive", "readout", "adc", "cells", "operation")
"""sections of a design whose values are judged; all but the last have parts"""
NOT_KNOWN, INFINITE = "not known: what depends on it is not run", "infinite"
ABSENT = {"temperature_range": "298.15 K only", "amplifier_model": "an amplifier of one pole"}
"""what is taken where a key is not given, if it is no number"""
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


def settings_of(design: Design) -> list[Setting]:
    """Every component value, with its unit and its tolerance."""
    rows, spreads = [], design.spreads
    for section in type(design).model_fields:
        part = getattr(design, section)
        for key, value in () if part is None or isinstance(part, tuple) else part:
            if key == "spread":
                continue
            unit, name = UNITS.get(section, {}).get(key, ""), f"{section}.{key}"
            spread, shown = spreads.get(name), ""
            if spread is not None:
                shown = _spread_shown(spread, unit, absolute=name in MAXIMA)
            elif name in MAXIMA and np.any(np.asarray(value)):
                shown = "data-sheet maximum of either sign"
            absent = ABSENT.get(key, NOT_KNOWN if section in JUDGED else "not given")
            rows.append(Setting(section, key, _shown(value, unit, absent), shown, key in part.model_fields_set))
    for place, fault in enumerate(design.fault):
        rows.append(Setting("fault", str(place), f"{fault.kind} at {fault.place}, {fault.ohms:g} ohm", "", True))
    return rows


def _shown(value: Any, unit: str, absent: str) -> str:
    """A value in words; ``absent`` where there is none."""
    if value is None:
        return absent
    if isinstance(value, AmplifierModel):
        return f"{value.subcircuit} of {value.file.name}"
    if isinstance(value, tuple | list):
        limits = [_shown(item, unit, absent) for item in value]
        return "no limit" if {*limits} <= {INFINITE, f"−{INFINITE}"} else f"[{', '.join(limits)}]"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return engineering(float(value), unit, 6) if abs(value) < inf else "−" * (value < 0) + INFINITE


def _spread_shown(spread: Spread, unit: str, *, absolute: bool) -> str:
    drift = spread.temperature_coefficient
    per_kelvin = f"± {engineering(abs(drift), unit)}/K" if absolute else f"{1e6 * drift:g} ppm/K"
    parts = [f"± {100 * spread.tolerance:g} %" if spread.tolerance else ""]
    parts += [f"± {engineering(spread.deviation, unit)}" if spread.deviation else ""]
    parts += [f"matched to {100 * spread.matching:g} %" if spread.matching is not None else ""]
    parts += [f"packages of {spread.package}" if spread.package else ""]
    parts += [per_kelvin if drift else "", f"follows {spread.tied_to}" if spread.tied_to else ""]
    return ", ".join([*filter(None, parts), spread.distribution])


def _not_given(design: Design) -> Iterator[tuple[str, str]]:
    for section in JUDGED:
        if getattr(design, section) is None:
            yield f"[{section}]", "the shipped example cell" if section == "cells" else "none"
    for setting in settings_of(design):
        if setting.section in JUDGED and not setting.named and _matters(design, setting.section, setting.key):
            yield f"{setting.section}.{setting.key}", setting.value


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


def _exact(design: Design) -> list[str]:
    spreads, found = design.spreads, []
    for section in JUDGED[:-1]:
        part = getattr(design, section)
        for key in () if part is None else type(part).PARTS:
            name, value = f"{section}.{key}", np.asarray(getattr(part, key), dtype=np.float64)
            counts = value.any() and np.isfinite(value).all() and _matters(design, section, key)
            if counts and name not in spreads and name not in MAXIMA:
                found.append(name)
    return found
