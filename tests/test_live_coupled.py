"""The live recovery of coupled boards: its derivatives against the certified ones, and what a frame may cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from designs import KINDS, digitised
from misread_streams import stream

from ohmskin.circuits import Design, Reason, adc_codes, scan
from ohmskin.driver import CountReader


def board(kind: str, rows: int, columns: int, bits: int = 12, *, fault: Any = (), **array: Any) -> Design:
    real = {} if KINDS[kind][0] == "voltage-divider" else {"open_loop_gain": 1e4, "offset_voltage": 1e-3}
    lines = {"row_lead": 5.0, "column_lead": 5.0} | array
    return digitised(kind, rows, columns, bits, fault=fault, array=lines, readout=real)


@pytest.mark.parametrize("shape", [(1, 6), (4, 1)])
def test_a_cell_without_a_contact_that_is_alone_on_its_line_does_not_end_the_reader(shape: tuple[int, int]) -> None:
    """Floating lines that nothing is connected to have no potential."""
    design = board("floating rows", *shape, fault=[{"kind": "open-cell", "place": [0, 0]}])
    reading = CountReader(design)(adc_codes(design, scan(design, np.full(shape, 1e4)).volts))
    assert reading.reason[0, 0] == Reason.HIDDEN


@pytest.mark.parametrize("row_lead", [1.0, 15.0])
def test_cells_open_at_rest_cost_a_press_nothing(row_lead: float) -> None:
    """A mat of contacts: what conducts less than a step, however many they are, opens no column that a load holds."""
    design = digitised("divider", 7, 11, 10, array={"row_lead": row_lead}, readout={"reference_resistance": 2.2e3})
    row, column = np.indices((7, 11))
    pressed = np.exp(-((row - 3) ** 2 + (column - 5) ** 2) / 1.6) / 2e3
    cells = 1.0 / (pressed + 1.0 / 2e6)
    read, draw = CountReader(design), np.random.default_rng(0)
    readings = []
    for frame in range(40):
        volts = scan(design, cells if frame > 9 else np.full((7, 11), 2e6)).volts
        readings.append(read(adc_codes(design, volts + draw.normal(scale=3e-3, size=volts.shape))))
    reading = readings[-1]
    assert all(one.valid[cells < 1e4].all() for one in readings[10:])
    assert (np.abs(reading.resistance / cells - 1.0) <= reading.uncertainty)[reading.valid].all()


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
    design = board("open divider", 8, 8, 10, row_lead=25.0, column_lead=0.0)
    design = design.replace(readout={"reference_resistance": 1e3})
    draw, step = np.random.default_rng(seed), 3.3 / 2**10
    draw.uniform(size=64)
    read, volts = CountReader(design), scan(design, np.full((8, 8), 1e4)).volts
    for noise in [noise_steps] * 10 + [0.1] * 70:
        reading = read(adc_codes(design, volts + draw.normal(scale=noise * step, size=volts.shape)))
    assert reading.valid.all()
    assert (np.abs(reading.resistance / 1e4 - 1.0) <= reading.uncertainty).all()


@pytest.mark.parametrize("hard", [8.0])
@pytest.mark.parametrize("places", [((1, 2),), ((1, 2), (6, 5))])
@pytest.mark.parametrize("kind", ["divider", "loaded"])
def test_cells_of_a_few_ohm_cost_their_columns_and_rows_that_they_join(kind: str, places: Any, hard: float) -> None:
    """What a cell near a short is, nobody can tell, nor what is beside it in its column. Others stay known."""
    design, draw = board(kind, 9, 10), np.random.default_rng(0)
    rest, columns = 1e4 * 10 ** draw.uniform(-0.05, 0.05, (9, 10)), [column for _, column in places]
    rows = [row for row, _ in places]
    free = np.ones((9, 10), dtype=np.bool_)
    free[:, columns], free[rows] = False, False
    read = CountReader(design)
    for number in range(16):
        cells = rest.copy()
        if number >= 4:
            cells[tuple(np.transpose(places))] = hard
        if number >= 9:
            cells[6:8, 3:6] = np.minimum(cells[6:8, 3:6], 3e3)  # a finger, in part on lost columns
        reading = read(adc_codes(design, scan(design, cells).volts))
        valid = reading.valid
        assert (np.abs(reading.resistance / cells - 1.0)[valid] <= reading.uncertainty[valid]).all()
        if number == 8 or number >= 12:  # four frames after the events
            assert valid[free].all()


@pytest.mark.parametrize(("noise_steps", "least"), [(0.0, 0.4), (0.2, 0.6), (1.0, 0.75)])
@pytest.mark.parametrize("kind", ["divider", "loaded", "open divider", "feedback", "floating"])
def test_deviations_are_those_of_the_errors(kind: str, noise_steps: float, least: float) -> None:
    """Standard deviations by steps and by noise, together, against the errors of many skins that hold still.

    Errors by steps are half as large as stated where no cells are alike.
    """
    design, draw, squares = board(kind, 6, 7), np.random.default_rng(0), []
    assert design.adc is not None
    for _ in range(8):
        cells, read = 2e4 * 10 ** draw.uniform(-0.3, 0.3, (6, 7)), CountReader(design)
        volts = scan(design, cells).volts
        for _ in range(25):
            noise = draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
            reading = read(adc_codes(design, volts + noise))
        off = reading.resistance / cells - 1.0
        std = np.hypot(reading.steps_std, reading.noise_std)
        squares.append((off / std)[reading.valid] ** 2)
    assert least < np.sqrt(np.mean(np.concatenate(squares))) < 1.25


@pytest.mark.parametrize("noise_steps", [0.0, 0.2, 0.4])
def test_deviations_are_those_of_errors_that_are_alike(noise_steps: float) -> None:
    """Cells at rest round alike. In a pressed column the sum of their errors counts."""
    design, draw, squares = board("divider", 6, 10, bits=8), np.random.default_rng(0), []
    assert design.adc is not None
    for _ in range(40):
        cells, read = np.full((6, 10), draw.uniform(25e3, 35e3)), CountReader(design)
        cells[2:5, 6] = draw.uniform(850.0, 1300.0)
        volts = scan(design, cells).volts
        for _ in range(25):
            noise = draw.normal(scale=noise_steps * design.adc.step, size=volts.shape)
            reading = read(adc_codes(design, volts + noise))
        off = (reading.resistance / cells - 1.0)[2:5, 6]
        std = np.hypot(reading.steps_std, reading.noise_std)[2:5, 6]
        squares.append((off / std)[reading.valid[2:5, 6]] ** 2)
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
    design = board(kind, rows, 3, bits, row_lead=0.0, column_lead=0.0)
    design, used = design.replace(readout={"reference_resistance": reference_ohm}), []
    for level in np.geomspace(0.5, 2.0, 20):
        read, cells = CountReader(design), np.full((rows, 3), level * 1e4)
        for number in range(9):
            if number == 6:
                cells[rows // 3 : rows // 3 + 2, 1] *= 1.5  # a finger
            reading = read(adc_codes(design, scan(design, cells).volts))
            off = np.abs(reading.resistance / cells - 1.0) / reading.uncertainty
            used.append(np.max(off, where=reading.valid, initial=0.0))
    assert np.count_nonzero(used) > 60
    assert max(used) < 1.6


BROKEN_ROW = {"kind": "broken-row", "place": [1, 2]}
BROKEN_COLUMN = {"kind": "broken-column", "place": [1, 2]}


@pytest.mark.parametrize(
    ("kind", "fault", "known"),
    [
        ("grounded", BROKEN_ROW, 32),
        ("grounded", BROKEN_COLUMN, 34),
        ("feedback", BROKEN_ROW, 32),
    ],
)
@pytest.mark.parametrize("segment", [0.0, 0.5])
def test_a_complete_fault_hides_no_more_than_its_line(kind: str, fault: Any, known: int, segment: float) -> None:
    design = board(kind, 6, 6, row_segment=segment, column_segment=segment, fault=[fault])
    cells = 1e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (6, 6))
    read = CountReader(design)
    for _ in range(8):
        cells[2, 3] *= 0.9
        reading = read(adc_codes(design, scan(design, cells).volts))
        valid = reading.valid
        assert valid.sum() >= known
        off = np.abs(reading.resistance / cells - 1.0)[valid]
        assert (off <= reading.uncertainty[valid]).all()
        assert not valid[1, 1] or fault["kind"] != "shorted-cell"
