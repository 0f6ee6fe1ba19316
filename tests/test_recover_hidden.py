"""Cells that a fault hides: others must not be called read for readings that the hidden ones share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import Design, Recovery, Status, recover
from ohmskin.errors import SolverError


def design(rows: int, columns: int, fault: dict[str, Any], *, circuit: str, **tables: dict[str, Any]) -> Design:
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns} | tables.get("array", {}),
            "drive": {"voltage": 1.0} | tables.get("drive", {}),
            "readout": {"circuit": circuit, "reference_resistance": 5000.0} | tables.get("readout", {}),
            "fault": [fault],
        }
    )


def is_honest(found: Recovery, cells: np.ndarray) -> np.ndarray:
    """(rows, columns): whether the cell lies within what is claimed for it."""
    claimed = np.isin(found.status, (Status.READ, Status.DISTURBED, Status.OPEN))
    with np.errstate(invalid="ignore"):
        off = np.abs(found.resistance / cells - 1)
        within = off <= found.uncertainty / np.maximum(1 - found.uncertainty, 1e-300) + 1e-6
    opened = (found.status == Status.OPEN) & np.isinf(cells)
    return ~claimed | within | opened | ~np.isfinite(found.uncertainty)


@pytest.mark.parametrize("kind", ["broken-row", "broken-column"])
@pytest.mark.parametrize("idle_rows", ["ground", "float"])
@pytest.mark.parametrize("idle_columns", ["float", "load"])
def test_dividers_with_a_broken_line_claim_no_cell_that_the_loose_ones_shift(
    kind: str, idle_rows: str, idle_columns: str
) -> None:
    rng = np.random.default_rng(5)
    for _ in range(12):
        rows, columns = (int(n) for n in rng.integers(2, 4, 2))
        place = [int(rng.integers(rows)), int(rng.integers(columns))]
        board = design(
            rows,
            columns,
            {"kind": kind, "place": place},
            circuit="voltage-divider",
            array={"row_lead": 10.0, "column_lead": 10.0},
            drive={"idle_rows": idle_rows},
            readout={"idle_columns": idle_columns},
        )
        cells = 10 ** rng.uniform(3.3, 4.2, (rows, columns))
        try:
            found = recover(board, reference_volts(board, cells))
        except SolverError:
            continue  # nothing is claimed
        assert is_honest(found, cells).all(), (place, cells, found)


@pytest.mark.parametrize("idle_rows", ["ground", "float"])
def test_a_row_that_a_wire_ties_to_an_ideal_driver_is_hidden_not_open(idle_rows: str) -> None:
    board = design(
        2,
        2,
        {"kind": "bridged-rows", "place": [1, 1], "to": 0},
        circuit="voltage-divider",
        array={"row_lead": [0.0, 10.0]},
        drive={"idle_rows": idle_rows},
    )
    cells = np.array([[1e4, 2e4], [3e4, 4e4]])
    try:
        found = recover(board, reference_volts(board, cells))
    except SolverError:
        assert idle_rows == "float"
        return
    assert not np.isin(found.status, (Status.READ, Status.OPEN)).any()


@pytest.mark.parametrize("circuit", ["voltage-divider", "inverting-amplifier"])
def test_cells_beside_a_complete_short_at_an_ideal_driver_are_not_open(circuit: str) -> None:
    board = design(
        3,
        3,
        {"kind": "shorted-cell", "place": [0, 0]},
        circuit=circuit,
        array={"column_lead": 5.0},
        readout={"open_loop_gain": 1e5, "supply": [-3.0, 3.0]},
    )
    cells = np.array([[1e4, 2e4, 1e4], [9e3, 1.2e4, 1e4], [1.1e4, 2e4, 2e4]])
    found = recover(board, reference_volts(board, cells))
    assert not np.isin(found.status[:, 0], (Status.READ, Status.OPEN)).any()
    assert (found.status[:, 1:] == Status.READ).all()
    np.testing.assert_allclose(found.resistance[:, 1:], cells[:, 1:], rtol=1e-4)


def test_a_short_on_ideal_lines_without_a_supply_limit_is_read_and_hides_its_column() -> None:
    board = Design.model_validate(
        {
            "array": {"rows": 2, "columns": 2},
            "drive": {"voltage": -1.0},
            "readout": {"circuit": "inverting-amplifier", "reference_resistance": 1e3, "open_loop_gain": 1e5},
        }
    )
    cells = np.array([[0.0, 2e3], [3e3, 4e3]])
    found = recover(board, reference_volts(board, cells))
    np.testing.assert_array_equal(found.status, [[Status.READ, Status.READ], [Status.HIDDEN, Status.READ]])
    np.testing.assert_allclose(found.resistance[:, 1], cells[:, 1], rtol=1e-9)
    assert found.resistance[0, 0] == 0
