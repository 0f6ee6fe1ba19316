"""Usual circuits of the families, as tables of DESIGN.toml.

Their publications name topology and converter, but seldom every resistor. What is not known is the project's own
choice, and said where it is made: pass ``design=`` to ``Skin.open`` for your board.
"""

from __future__ import annotations

from typing import Any

DIVIDER_OHM = 1e3
"""load of the dividers, the project's own choice: a tenth of the example cell at rest. With a larger load the cells of
a column share its voltage so evenly that eight bits cannot tell them apart."""


def divider(rows: int, columns: int, adc_bits: int, supply: float) -> dict[str, Any]:
    """Rows driven with the supply, idle rows at ground, a load resistor at each column, a converter over the supply."""
    return {
        "array": {"rows": rows, "columns": columns},
        "drive": {"voltage": supply, "idle_rows": "ground"},
        "readout": {"circuit": "voltage-divider", "reference_resistance": DIVIDER_OHM},
        "adc": {"bits": adc_bits, "range": [0.0, supply]},
    }
