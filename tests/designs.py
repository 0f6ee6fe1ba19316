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
