"""The live recovery of coupled boards: what cells cost each other, and deviations that are those of the errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from designs import KINDS, digitised
from live import counts_of, follow
from misread_streams import stream

from ohmskin.circuits import Design, Reason
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader, Measurement


def board(kind: str, rows: int, columns: int, bits: int = 12, *, lead: float = 5.0, **sections: Any) -> Design:
    real = {} if KINDS[kind][0] == "voltage-divider" else {"open_loop_gain": 1e4, "offset_voltage": 1e-3}
    return digitised(kind, rows, columns, bits, lead=lead, readout=real | sections.pop("readout", {}), **sections)


@pytest.mark.parametrize("shape", [(1, 6), (4, 1)])
def test_a_cell_without_a_contact_that_is_alone_on_its_line_does_not_end_the_reader(shape: tuple[int, int]) -> None:
    """Floating lines that nothing is connected to have no potential."""
    design = board("floating rows", *shape, fault=[{"kind": "open-cell", "place": [0, 0]}])
    reading = CountReader(design)(counts_of(design, np.full(shape, 1e4)))
    assert reading.reason[0, 0] == Reason.HIDDEN


@pytest.mark.parametrize("row_lead", [1.0, 15.0])
def test_cells_open_at_rest_cost_a_press_nothing(row_lead: float) -> None:
    """A mat of contacts: what conducts less than a step, however many they are, opens no column that a load holds."""
    design = digitised("divider", 7, 11, 10, array={"row_lead": row_lead}, readout={"reference_resistance": 2.2e3})
    row, column = np.indices((7, 11))
    cells = 1.0 / (np.exp(-((row - 3) ** 2 + (column - 5) ** 2) / 1.6) / 2e3 + 1.0 / 2e6)
    frames = [np.full((7, 11), 2e6)] * 10 + [cells] * 30
    assert all(one.valid[cells < 1e4].all() for one in follow(design, frames, 0.93, np.random.default_rng(0))[10:])


def test_no_step_waits_for_ever() -> None:
    """Strong presses on 16 x 12 cells with segments: potentials by sparse elimination are half of what a frame has."""
    found = stream("loaded events:171000004")
    read = CountReader(found.design)
    for counts in found.counts:
        last = read(counts)
    assert last.valid.all()


@pytest.mark.parametrize(("seed", "noise_steps"), [(24, 12.4), (13, 40.0), (0, 12.4)])
def test_cells_that_noise_has_carried_away_come_back(seed: int, noise_steps: float) -> None:
    """Whole steps from one side of a cell's conductance to the other, and back, would never end (seeds 24 and 13)."""
    parts = {"reference_resistance": 1e3}
    design = board("open divider", 8, 8, 10, lead=0.0, array={"row_lead": 25.0}, readout=parts)
    draw, cells, read = np.random.default_rng(seed), np.full((8, 8), 1e4), CountReader(design)
    draw.uniform(size=64)
    for _ in range(10):
        read(counts_of(design, cells, noise_steps, draw))
    assert follow(design, [cells] * 70, 0.1, draw, read=read)[-1].valid.all()


def errors(design: Design, cells: FloatArray, noise_steps: float, draw: np.random.Generator) -> tuple[Any, Measurement]:
    """Errors of the last of 25 equal frames, in standard deviations by steps and by noise, and its reading."""
    reading = follow(design, [cells] * 25, noise_steps, draw)[-1]
    return (reading.resistance / cells - 1.0) / np.hypot(reading.steps_std, reading.noise_std), reading


@pytest.mark.parametrize(("noise_steps", "least"), [(0.0, 0.4), (0.2, 0.6), (1.0, 0.75)])
@pytest.mark.parametrize("kind", ["divider", "loaded", "open divider", "feedback", "floating"])
def test_deviations_are_those_of_the_errors(kind: str, noise_steps: float, least: float) -> None:
    """Together, of many skins that hold still. Errors by steps are half as large as stated where no cells are alike."""
    design, draw, squares = board(kind, 6, 7), np.random.default_rng(0), []
    for _ in range(8):
        off, reading = errors(design, 2e4 * 10 ** draw.uniform(-0.3, 0.3, (6, 7)), noise_steps, draw)
        squares.append(off[reading.valid] ** 2)
    assert least < np.sqrt(np.mean(np.concatenate(squares))) < 1.25


@pytest.mark.parametrize("noise_steps", [0.0, 0.2, 0.4])
def test_deviations_are_those_of_errors_that_are_alike(noise_steps: float) -> None:
    """Cells at rest round alike. In a pressed column the sum of their errors counts."""
    design, draw, squares = board("divider", 6, 10, bits=8), np.random.default_rng(0), []
    for _ in range(40):
        cells = np.full((6, 10), draw.uniform(25e3, 35e3))
        cells[2:5, 6] = draw.uniform(850.0, 1300.0)
        off, reading = errors(design, cells, noise_steps, draw)
        squares.append(off[2:5, 6][reading.valid[2:5, 6]] ** 2)
    assert 0.5 < np.sqrt(np.mean(np.concatenate(squares))) < 1.25


@pytest.mark.parametrize(("rows", "bits", "reference_ohm"), [(16, 8, 10e3), (32, 12, 30e3)])
@pytest.mark.parametrize("kind", ["divider", "loaded"])
def test_equal_cells_that_round_alike_are_nearly_as_certain_as_stated(
    kind: str, rows: int, bits: int, reference_ohm: float
) -> None:
    """As on an emulated skin without noise: all readings of a column are off by the same part of a step.

    An uncertainty is that of a logarithm, and the scale of a column s / (1 - S): at the limit of validity this may
    exceed it by a half, which is no factor of two.
    """
    design, used = board(kind, rows, 3, bits, lead=0.0, readout={"reference_resistance": reference_ohm}), []
    for level in np.geomspace(0.5, 2.0, 20):
        read, cells = CountReader(design), np.full((rows, 3), level * 1e4)
        for number in range(9):
            if number == 6:
                cells[rows // 3 : rows // 3 + 2, 1] *= 1.5  # a finger
            reading = read(counts_of(design, cells))
            off = np.abs(reading.resistance / cells - 1.0) / reading.uncertainty
            used.append(np.max(off, where=reading.valid, initial=0.0))
    assert np.count_nonzero(used) > 60
    assert max(used) < 1.6


BROKEN_ROW = {"kind": "broken-row", "place": [1, 2]}
BROKEN_COLUMN = {"kind": "broken-column", "place": [1, 2]}


@pytest.mark.parametrize(
    ("kind", "fault", "known"),
    [("grounded", BROKEN_ROW, 32), ("grounded", BROKEN_COLUMN, 34), ("feedback", BROKEN_ROW, 32)],
)
@pytest.mark.parametrize("segment", [0.0, 0.5])
def test_a_complete_fault_hides_no_more_than_its_line(kind: str, fault: Any, known: int, segment: float) -> None:
    cells = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (6, 6))

    def frames() -> Iterator[FloatArray]:
        for _ in range(8):
            cells[2, 3] *= 0.9
            yield cells

    for reading in follow(board(kind, 6, 6, segment=segment, fault=[fault]), frames()):
        assert reading.valid.sum() >= known
