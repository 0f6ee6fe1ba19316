"""The quick test of a follower's readings: where it rules rows out, the whole test finds none that is pulled at."""

from __future__ import annotations

import numpy as np

from ohmskin.circuits import Design
from ohmskin.circuits.readouts import VoltageFeedback
from ohmskin.circuits.readouts import _pulled_rows as pulled


def readout(random: np.random.Generator) -> Design:
    """A board whose followers have little gain or much, offsets, and leads of a few ohm or none."""
    columns = int(random.integers(1, 6))
    return Design.model_validate(
        {
            "array": {
                "rows": int(random.integers(1, 6)),
                "columns": columns,
                "row_lead": 10 ** random.uniform(-1, 2),
                "column_lead": random.choice([0.0, 10 ** random.uniform(-1, 2)]),
            },
            "drive": {"voltage": random.choice([-1.0, 1.0]) * random.uniform(0.5, 5.0)},
            "readout": {
                "circuit": "voltage-feedback",
                "reference_resistance": 10 ** random.uniform(2, 5),
                "open_loop_gain": 10 ** random.uniform(1, 6),
                "offset_voltage": random.choice([0.0, 1e-3, 1e-2], columns).tolist(),
            },
            "adc": {"bits": 12, "range": [0.0, 5.0]},
        }
    )


def test_rows_that_are_ruled_out_have_no_second_solution() -> None:
    random, ruled_out, pulled_at = np.random.default_rng(0), 0, 0
    circuit = VoltageFeedback()
    for _ in range(400):
        board = readout(random).board
        lead = board.row_ohms[:, 0] * random.uniform(0.5, 1.5, board.shape[0])
        signal = board.drive * (random.uniform(0.0, 1.0, board.shape) ** random.choice([0.1, 1.0, 6.0]))
        lift = board.loop_share * board.offset - board.inverse_gain * board.level
        least = 10 ** random.uniform(-5, -2)
        rows = pulled.PulledRows.of(board, lead, signal, lift, least, circuit.apparent_conductance(board, signal))
        together = pulled._rows_together(rows, board, signal, lift, least)
        if rows.second_solutions() is not None or together:
            pulled_at += 1
            assert pulled._pulls_anywhere(board, float(lead.max()), signal, lift, least)
        else:
            ruled_out += not pulled._pulls_anywhere(board, float(lead.max()), signal, lift, least)
    assert ruled_out > 50
    assert pulled_at > 20
