"""Transient response event by event, against the settling of a scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ohmskin.circuits import Design, Settling, Transient, scan
from ohmskin.errors import InputError

BOARD = Design.load(Path(__file__).parents[1] / "examples" / "board-4x4.toml")
# Rows without cells between the others: each loaded row then follows one without signal, as sampled_from_rest has it.
CELLS = np.array([[12e3, 9e3, 17e3, 11e3], [np.inf] * 4, [8e3, 10e3, 30e3, 1e6], [np.inf] * 4])
VARIANTS = {
    "as built": BOARD,
    "without capacitances": BOARD.replace(readout={"column_capacitance": 0.0, "feedback_capacitance": 0.0}),
    "slow capacitor": BOARD.replace(adc={"sampling_capacitance": 2e-10}),
    "no capacitor": BOARD.replace(adc={"sampling_capacitance": 0.0, "acquisition_time": 0.0}),
    "floating idle rows": BOARD.replace(drive={"idle_rows": "float"}),
}


@pytest.mark.parametrize("design", VARIANTS.values(), ids=VARIANTS.keys())
@pytest.mark.parametrize("period", [50e-6, 90e-6])
def test_a_row_selected_from_rest_reads_as_settling_predicts(design: Design, period: float) -> None:
    predicted = Settling(design, CELLS).sampled_from_rest(period)
    settled = scan(design, CELLS).volts
    assert design.adc is not None
    acquisition = design.adc.acquisition_time
    for row in (0, 2):
        for column in range(4):
            transient = Transient(design, CELLS)
            transient.aim(settled[row], row)
            transient.advance(period - (4 - column) * acquisition)  # the last conversion ends with the step
            transient.connect(column)
            transient.advance(acquisition)
            assert transient.disconnect() == pytest.approx(predicted[row, column], abs=1e-10)
    assert np.abs(predicted - settled)[[0, 2]].max() > 1e-4 or not design.readout.feedback_capacitance


def test_time_may_pass_in_any_pieces() -> None:
    settled = scan(BOARD, CELLS).volts
    whole, pieces = Transient(BOARD, CELLS), Transient(BOARD, CELLS)
    for one in (whole, pieces):
        one.aim(settled[2])
        one.connect(1)
    whole.advance(23e-6)
    for share in (1e-6, 7e-6, 15e-6):
        pieces.advance(share)
    np.testing.assert_allclose(pieces.outputs(), whole.outputs(), rtol=1e-12)
    assert pieces.disconnect() == pytest.approx(whole.disconnect(), rel=1e-12)


def test_outputs_go_on_without_a_jump_when_row_or_cells_change() -> None:
    settled = scan(BOARD, CELLS).volts
    transient = Transient(BOARD, CELLS)
    transient.aim(settled[0])
    transient.advance(10e-6)
    before = transient.outputs()
    transient.aim(settled[2])
    np.testing.assert_allclose(transient.outputs(), before, rtol=1e-12)
    other = np.where(np.isinf(CELLS), 20e3, CELLS)
    transient.change(BOARD, other)
    transient.aim(scan(BOARD, other).volts[2])
    np.testing.assert_allclose(transient.outputs(), before, rtol=1e-12)
    transient.advance(1e-2)
    np.testing.assert_allclose(transient.outputs(), scan(BOARD, other).volts[2], rtol=1e-12)


def test_a_capacitor_as_slow_as_an_output_is_no_division_by_zero() -> None:
    """The limit of the difference quotient of two equal time constants."""
    design = BOARD.replace(
        readout={"gain_bandwidth": np.inf, "open_loop_gain": np.inf, "column_capacitance": 0.0},
        adc={"switch_resistance": 15e3, "sampling_capacitance": 1e-9},
    )
    near = design.replace(adc={"sampling_capacitance": 1.001e-9})
    values = []
    for one in (design, near):
        transient = Transient(one, CELLS)
        transient.aim(scan(one, CELLS).volts[0])
        transient.connect(0)
        transient.advance(20e-6)
        values.append(transient.disconnect())
    assert values[0] == pytest.approx(values[1], rel=1e-3)
    assert values[0] != values[1]


def test_circuits_without_amplifiers_are_refused() -> None:
    with pytest.raises(InputError, match="settling and noise"):
        Transient(BOARD.replace(readout={"circuit": "voltage-divider"}), CELLS)
