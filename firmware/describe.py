"""Write the header that tells the firmware about its own circuit: ``describe.py DESIGN.toml CELL.toml > header``.

The header holds the description that the board sends (docs/wire.md), reduced to what differs from the defaults of
DESIGN.toml, and the numbers that the self-test needs.
"""

from __future__ import annotations

import json
import sys

import numpy as np

from ohmskin.cell import Cell
from ohmskin.circuits import Design, apparent_resistance
from ohmskin.emulator.firmware import REFERENCE_RESISTORS_OHM, reference_outputs
from ohmskin.wire import write_description

COLUMNS_OF_TEXT = 100
NOT_SENT = {"operation", "requirements", "requirement"}
"""tables of the design that a host has no use for"""


def header(design: Design, cell: Cell) -> str:
    """Text of the C header for a board built after ``design``, read by a 10-bit converter from 0 V."""
    assert design.adc is not None
    tables = design.model_dump(exclude_defaults=True, exclude=NOT_SENT)
    text = write_description(tables, cell.model_dump(exclude_none=True)).decode()
    pieces = [text[i : i + COLUMNS_OF_TEXT] for i in range(0, len(text), COLUMNS_OF_TEXT)]
    reference_code = design.readout.reference_voltage / design.adc.step
    drive_code = -design.drive.voltage / design.adc.step
    even, odd = REFERENCE_RESISTORS_OHM
    at_rest = np.full(design.array.shape, cell.rest_resistance_ohm)
    outputs = np.broadcast_to(reference_outputs(design, at_rest), design.array.shape)
    apparent = apparent_resistance(design, outputs)[0]
    lines = [
        "/* Written by describe.py from the DESIGN.toml of the board: do not edit. */",
        f"#define REFERENCE_CODE {round(reference_code)} /* of the reference voltage */",
        f"#define REFERENCE_CODE_EXACT {reference_code:.3f}f",
        f"#define DRIVE_CODE {drive_code:.3f}f",
        f"#define FEEDBACK_OHM {design.readout.reference_resistance:.1f}f",
        f"#define EVEN_REFERENCE_OHM {even:.1f}f",
        f"#define ODD_REFERENCE_OHM {odd:.1f}f",
        f"#define EVEN_REFERENCE_APPARENT_OHM {apparent[0::2].mean():.1f}f /* behind their common switch */",
        f"#define ODD_REFERENCE_APPARENT_OHM {apparent[1::2].mean():.1f}f",
        "#define DESCRIPTION \\",
        " \\\n".join(f"    {json.dumps(piece)}" for piece in pieces),
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    design_file, *cell_file = sys.argv[1:]
    cell = Cell.load(cell_file[0]) if cell_file else Cell.example()
    sys.stdout.write(header(Design.load(design_file), cell))
