"""Designs in one line, for the tests."""

from __future__ import annotations

from typing import Any

from ohmskin.circuits import Array, Design, Drive, Readout


def amplifier(rows: int, columns: int, *, lead: float = 0.0, segment: float = 0.0, **readout: Any) -> Design:
    """Grounded idle rows, an inverting amplifier on each column, -1 V, 1 kohm."""
    return Design(
        array=Array(
            rows=rows,
            columns=columns,
            row_lead=lead,
            column_lead=lead,
            row_segment=segment,
            column_segment=segment,
        ),
        drive=Drive(voltage=-1.0),
        readout=Readout(**{"circuit": "inverting-amplifier", "reference_resistance": 1000.0} | readout),
    )


def divider(rows: int, columns: int, *, idle_rows: str = "float", idle_columns: str = "float", **array: Any) -> Design:
    """A plain voltage divider with a 1 kohm load."""
    return Design(
        array=Array(rows=rows, columns=columns, **array),
        drive=Drive.model_validate({"voltage": 1.0, "idle_rows": idle_rows}),
        readout=Readout.model_validate(
            {"circuit": "voltage-divider", "reference_resistance": 1000.0, "idle_columns": idle_columns}
        ),
    )


KINDS = {
    "divider": ("voltage-divider", "ground", "float"),
    "loaded": ("voltage-divider", "ground", "load"),
    "open divider": ("voltage-divider", "float", "float"),
    "floating loaded": ("voltage-divider", "float", "load"),
    "feedback": ("voltage-feedback", "ground", "float"),
    "floating": ("inverting-amplifier", "float", "float"),
    "floating rows": ("row-amplifier", "float", "float"),
    "rows": ("row-amplifier", "ground", "float"),
    "grounded": ("inverting-amplifier", "ground", "float"),
}
"""circuit, idle rows and idle columns"""


def digitised(
    kind: str, rows: int, columns: int, bits: int, *, lead: float = 0.0, segment: float = 0.0, **sections: Any
) -> Design:
    """A board of one of :data:`KINDS` behind a converter of 3.3 V, with the given keys of its sections."""
    circuit, idle_rows, idle_columns = KINDS[kind]
    amplified = circuit.endswith("amplifier")
    lines = {"row_lead": lead, "column_lead": lead, "row_segment": segment, "column_segment": segment}
    usual: dict[str, dict[str, Any]] = {
        "array": {"rows": rows, "columns": columns} | lines,
        "drive": {"voltage": -1.0 if amplified else 3.3, "idle_rows": idle_rows},
        "readout": {"circuit": circuit, "reference_resistance": 2e3 if amplified else 5e3}
        | {"idle_columns": idle_columns},
        "adc": {"bits": bits, "range": [0.0, 3.3]},
    }
    return Design.model_validate(sections | {name: keys | sections.get(name, {}) for name, keys in usual.items()})
