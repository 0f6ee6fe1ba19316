"""Measurement on the firmware in the loop: settling error against dwell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...circuits import Design, Settling, scan
from ...common.arrays import FloatArray
from .._scene import Scene
from .._skin import Sample
from .._tuning import PREDICTED_ACQUISITION_S, TICK_S
from ._board import BoardSettings, FirmwareBoard

ERROR_BUDGET_STEPS = 0.5
"""ADC steps by which a reading may be off because it has not settled"""


@dataclass(frozen=True, slots=True)
class DwellError:
    """How far readings are from settled at one dwell. Errors in ADC steps, the largest of the frame."""

    dwell_us: int
    """us from selecting a row to its first conversion, as set"""
    measured_steps: float
    predicted_steps: float
    """by :class:`ohmskin.circuits.Settling` for the same instants"""


def harsh_cells(design: Design) -> FloatArray:
    """(rows, columns) ohm: rows at 10 kohm between rows without cells, so that every output jumps at every step."""
    cells = np.full(design.array.shape, 10e3)
    cells[1::2] = np.inf
    return cells


def dwell_error(design: Design, settings: BoardSettings) -> DwellError:
    """Run the firmware over cells that are hard to settle, and compare with the model for its sample instants.

    Args:
        design: of a board that there is a firmware for.
        settings: with the dwell.

    Raises:
        MissingExtra: the emulated processor is not installed.

    """
    cells = harsh_cells(design)
    samples: list[Sample] = []
    with FirmwareBoard(_scene(design), settings=settings, record=samples.append) as board:
        board.hold_cells(cells)
        while not samples:
            board.run(TICK_S)
        selected = {row: time for time, row in board.row_switches}
        instants = [(time - selected[row], row, column) for time, row, column in board.sample_instants]
        dwell_us = board.settings.dwell_us if board.settings.dwell_us is not None else board.kind.dwell_us
    assert design.adc is not None
    settling = Settling(design.replace(adc={"acquisition_time": PREDICTED_ACQUISITION_S}), cells)
    settled = scan(design, cells, method="exact").volts
    predicted = np.zeros(cells.shape)
    columns = design.array.columns
    for after, row, column in instants:
        if row % 2 == 0:
            period = after + (columns - 1 - column) * PREDICTED_ACQUISITION_S
            predicted[row, column] = settling.sampled_from_rest(period)[row, column] - settled[row, column]
    loaded = slice(None, None, 2)
    return DwellError(
        dwell_us,
        float(np.abs(samples[-1].volts - settled)[loaded].max() / design.adc.step),
        float(np.abs(predicted).max() / design.adc.step),
    )


def _scene(design: Design) -> Scene:
    return Scene.model_validate({"skin": {"design": design}})
