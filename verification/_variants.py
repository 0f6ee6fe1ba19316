"""The design under verification beside others that differ from it in one respect, and what each of them reads."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..circuits import (
    Design,
    adc_codes,
    apparent_resistance,
    scan,
    volts_of_codes,
)
from ..common.arrays import FloatArray


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


def converted(design: Design, volts: FloatArray) -> FloatArray:
    """The volts that the ADC's codes stand for; without an ADC, the volts themselves."""
    return volts if design.adc is None else volts_of_codes(design, adc_codes(design, volts))


def apparent(design: Design, cells: FloatArray) -> FloatArray:
    """What equation (10) makes of the design's readings, ADC included."""
    return apparent_resistance(design, converted(design, scan(design, cells, method="exact").volts))


def change(design: Design, before: FloatArray, after: FloatArray) -> FloatArray:
    """Change of the apparent resistances in % of those before."""
    return 100 * (apparent(design, after) / apparent(design, before) - 1)
