"""The design under verification beside others that differ from it in one respect, and what each of them reads."""

from __future__ import annotations

from itertools import product
from math import inf
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..circuits import (
    Design,
    adc_codes,
    apparent_resistance,
    clipped,
    conversion_changes,
    conversion_limits,
    scan,
    volts_of_codes,
)


def replaced(design: Design, section: str, **values: Any) -> Design:
    """The design with other values in one section."""
    return design.replace(**{section: getattr(design, section).replace(**values)})


def ideal(design: Design, circuit: str, idle_rows: str) -> Design:
    """The same array, drive voltage and reference resistors with perfect wires, parts and converter.

    A circuit that senses the other lines takes the mean of the reference resistors.
    """
    readout = design.readout
    reference = readout.reference_resistance
    if circuit != readout.circuit:
        reference = float(np.mean(reference))
    return Design.model_validate(
        {
            "array": {"rows": design.array.rows, "columns": design.array.columns},
            "sheet": design.sheet,
            "drive": {"voltage": design.drive.voltage, "idle_rows": idle_rows},
            "readout": {
                "circuit": circuit,
                "reference_resistance": reference,
                "reference_voltage": readout.reference_voltage,
            },
        }
    )


def amplifiers(design: Design) -> Design:
    """The paper's circuit with ideal parts: grounded idle lines, an inverting amplifier on each sensed line."""
    own = design.board.circuit
    return ideal(design, own.name if own.virtual_ground else "inverting-amplifier", "ground")


def open_divider(design: Design) -> Design:
    """A plain divider with all idle lines open, otherwise ideal."""
    return ideal(design, "voltage-divider", "float")


def grounded_divider(design: Design) -> Design:
    """A plain divider with grounded idle rows, otherwise ideal."""
    return ideal(design, "voltage-divider", "ground")


def either_sign(design: Design) -> list[Design]:
    """Offset voltage and bias current are named as magnitudes: boards with each sign of them."""
    keys = [key for key in ("offset_voltage", "bias_current") if np.any(getattr(design.readout, key))]
    return [
        replaced(
            design, "readout", **{k: _times(s, getattr(design.readout, k)) for k, s in zip(keys, signs, strict=True)}
        )
        for signs in product((1.0, -1.0), repeat=len(keys))
    ]


def _times(sign: float, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
    return tuple(sign * part for part in value) if isinstance(value, tuple) else sign * value


def converted(design: Design, volts: FloatArray) -> FloatArray:
    """The volts that the ADC's codes stand for; without an ADC, the volts themselves."""
    return volts if design.adc is None else volts_of_codes(design, adc_codes(design, volts))


def apparent(design: Design, cells: FloatArray) -> FloatArray:
    """What equation (10) makes of the design's readings, ADC included."""
    return apparent_resistance(design, converted(design, scan(design, cells, method="exact").volts))


def change(design: Design, before: FloatArray, after: FloatArray) -> FloatArray:
    """Change of the apparent resistances in % of those before."""
    return 100 * (apparent(design, after) / apparent(design, before) - 1)


def worst_crosstalk(design: Design, before: FloatArray, after: FloatArray) -> float:
    """Largest change, in % of its reading, of a cell that is the same before and after.

    The worse sign of the amplifiers' offset and bias current counts, and the worst place within an ADC step.
    """
    untouched = before == after
    worst = 0.0
    for variant in either_sign(design):
        first, second = (scan(variant, cells, method="exact").volts for cells in (before, after))
        if variant.adc is not None:
            first, second = conversion_changes(variant, first, second)
        changed = apparent_resistance(variant, second) / apparent_resistance(variant, first) - 1
        worst = max(worst, 100 * float(np.abs(np.where(untouched, changed, 0.0)).max()))
    return worst


def worst_reading_error(design: Design, cells: FloatArray) -> float:
    """Largest error of an apparent resistance in %, wherever in its ADC step a reading falls; either sign of parts.

    The converter's own errors count; a reading beyond its range has no bound: inf.
    """
    worst = 0.0
    for variant in either_sign(design):
        volts = scan(variant, cells, method="exact").volts
        if variant.adc is not None:
            if clipped(variant, adc_codes(variant, volts)).any():
                return inf
            volts = conversion_limits(variant, volts)
        worst = max(worst, 100 * float(np.abs(apparent_resistance(variant, volts) / cells - 1).max()))
    return worst
