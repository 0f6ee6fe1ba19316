"""Shorts on boards whose cells share their current: no other cells are read in their place, and none beside them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ohmskin.bench import _live_hunt
from ohmskin.circuits import Design, adc_codes, scan
from ohmskin.common.arrays import FloatArray
from ohmskin.driver import CountReader

KINDS = {
    "divider": ("voltage-divider", "ground", "float"),
    "loaded": ("voltage-divider", "ground", "load"),
    "open divider": ("voltage-divider", "float", "float"),
    "feedback": ("voltage-feedback", "ground", "float"),
}
RESISTANCES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 30.0, 100.0)
"""ohm of a short"""


def board(kind: str, shape: tuple[int, int], bits: int = 10, **changes: Any) -> Design:
    circuit, idle_rows, idle_columns = KINDS[kind]
    readout: dict[str, Any] = {"circuit": circuit, "reference_resistance": 4.7e3, "idle_columns": idle_columns}
    if circuit == "voltage-feedback":
        readout["open_loop_gain"] = 1e3
    return Design.model_validate(
        {
            "array": {"rows": shape[0], "columns": shape[1]} | changes.pop("array", {}),
            "drive": {"voltage": 3.3, "idle_rows": idle_rows},
            "readout": readout | changes.pop("readout", {}),
            "adc": {"bits": bits, "range": [0.0, 3.3]},
        }
    )


def counts_of(design: Design, cells: FloatArray) -> Any:
    return adc_codes(design, scan(design, cells).volts).astype(np.uint16)


def check(reading: Any, cells: FloatArray) -> None:
    """All valid cells are within their uncertainties, and none is off by a factor of two."""
    valid = reading.valid
    share = reading.resistance[valid] / cells[valid]
    assert (np.abs(share - 1.0) <= reading.uncertainty[valid]).all()
    assert ((share > 0.5) & (share < 2.0)).all()


@pytest.mark.parametrize(
    ("family", "number"),
    [
        ("feedback", 910000116),  # two shorts of a row read like two cells of 2.3 kohm behind a follower
        ("feedback", 3010000245),  # and like two different ones, with an offset
        ("feedback", 2020000241),  # and like one strong and one weak cell, where their resistances differ
        ("feedback events", 6120000094),  # and a row of 8 to 130 ohm reads like one of 110 to 850
        ("feedback events", 4010000738),  # steps that shrink by a third each, ended early in what seems to be noise
        ("loaded events", 4030000106),  # ten times as large ones give the same readings, by way of other cells
        ("loaded events", 4010000610),  # a scale that is known to 36 % of its logarithm
        ("floating events", 4030000019),  # readings below the range, which leave their cells open
        ("feedback events", 4010000029),  # offsets through cells of a few ohm read more than any short: not unsolved
        ("open divider events", 4010000269),  # as does a noise of 20 steps in its first frame
        ("divider", 310000415),
        ("divider", 910000216),  # a step with derivatives from cells that were different
        ("divider", 910000404),  # a cell beside a known shunt went to no conductance, and never came back
        ("divider", 310000401),
        ("loaded", 410000126),
        ("loaded", 3010000430),
        ("feedback events", 5010000130),  # noise begins a frame before all cells are pressed at once
        ("loaded events", 4030000002),  # noise begins while fingers move a third of the readings
        ("feedback", 70020000174),  # two shorts that join columns by a seventh of what would divide readings notably
        ("feedback events", 70020000107),
        ("divider events", 6120000271),  # a row whose lead loses all to shorts, and feeds others by unknown cells
        ("loaded events", 6130000060),  # a row behind a break, known so badly that its effect is no longer linear
        ("loaded events", 70030000121),
        ("row events", 6120000231),  # a noise forgotten while all readings stood at a limit
        ("floating events", 6120000299),
        ("inverting", 91010000068),  # an output at its limit that noise of the first frame brings back
        ("divider events", 91010000227),  # a column of shorts of unknown scale, beside bridged rows
        ("feedback", 3010000064),  # an open cell whose amplifier's offset lies below the converter's range
        ("feedback", 91020000131),  # a cell of 30 ohm, whose idle row takes current before the column's lead
        ("feedback extremes", 202010000032),  # the same through leads of 1 kohm: off by a factor of two
        ("feedback extremes", 202020000221),
        ("divider extremes", 202020000179),  # a column whose scale a converter's offset of 1800 steps hides
        ("row floating extremes", 202020000198),  # a cell behind six times its resistance, and such an offset
        ("feedback extremes", 202020000238),  # a lost row's cells seem to conduct less than they do, by such a lead
        ("loaded extremes", 201040000012),  # a row behind a break of 300 ohm, fed by a column of 1 ohm: two solutions
        ("loaded twofold", 10000091),  # two rows that hang on one column
        ("loaded twofold", 10000161),  # two columns of shorts with two rows behind leads
        ("loaded twofold", 10000184),  # a row that lies below a column by less than the column below the drive
        ("loaded twofold", 60000021),  # a column that may lie anywhere within the steps of all its readings
        ("divider twofold", 10000028),  # a row that reads nothing, and hangs on a column of shorts
        ("divider twofold", 10000135),  # the same with two columns
        ("divider twofold", 20000023),  # a column's scale that is known, which lifts a row nevertheless
        ("divider twofold", 60000073),
        ("loaded twofold", 30000924),  # rows that hang on two columns, of which one lies above them
        ("loaded twofold", 140000286),  # a cell that conducts little beside its column's others
    ],
)
def test_streams_that_were_read_wrong(family: str, number: int) -> None:
    tally = _live_hunt.LiveTally()
    _live_hunt.check(family, number, tally)
    assert tally.findings == []


def places(draw: np.random.Generator, shape: tuple[int, int], form: str) -> list[tuple[int, int]]:
    """Shorts in one row, in one column, or at the corners of a rectangle."""
    count = int(draw.integers(2, 5))
    rows, columns = draw.permutation(shape[0]), draw.permutation(shape[1])
    if form == "row":
        return [(int(rows[0]), int(j)) for j in columns[:count]]
    if form == "column":
        return [(int(i), int(columns[0])) for i in rows[:count]]
    return [(int(i), int(j)) for i in rows[:2] for j in columns[:2]]


@pytest.mark.parametrize("form", ["row", "column", "rectangle"])
@pytest.mark.parametrize("kind", KINDS)
def test_shorts_of_a_line_are_never_read_as_other_cells(kind: str, form: str) -> None:
    """They come and go in mid-stream; lines, converters and references are drawn."""
    draw = np.random.default_rng([*kind.encode(), *form.encode()])
    for _ in range(12):
        shape = int(draw.integers(2, 9)), int(draw.integers(2, 9))
        lead = float(draw.choice([0.0, 1.0, 5.0, 25.0, 100.0]))
        array = {"row_lead": lead, "column_lead": float(draw.choice([0.0, lead]))}
        array["row_segment"] = array["column_segment"] = float(draw.choice([0.0, 0.0, 0.5]))
        reference = float(draw.choice([1e3, 4.7e3, 10e3, 47e3]))
        bits = int(draw.choice([8, 10, 12, 16]))
        design = board(kind, shape, bits, array=array, readout={"reference_resistance": reference})
        read, rest = CountReader(design), reference * 4.0 * 10 ** draw.uniform(-0.2, 0.2, shape)
        shorted = rest.copy()
        for place in places(draw, shape, form):
            shorted[place] = draw.choice(RESISTANCES)
        for cells in (rest, rest, shorted, shorted, shorted, shorted, rest, rest):
            check(read(counts_of(design, cells)), cells)


@pytest.mark.parametrize("gain", [1e4, 1e5])
def test_a_finger_on_a_board_with_a_follower_and_no_column_leads_is_read(gain: float) -> None:
    """Its cells are ordinary ones, although shorts of its rows could read like them if readings elsewhere agreed."""
    design = board("feedback", (8, 8), 12, array={"row_lead": 25.0}, readout={"open_loop_gain": gain})
    read, (row, column) = CountReader(design), np.indices((8, 8))
    rest = 2e4 * 10 ** np.random.default_rng(0).uniform(-0.1, 0.1, (8, 8))
    for number in range(12):
        load = np.exp(-((row - 3.0) ** 2 + (column - 3.0 - 0.1 * number) ** 2) / 2.0)
        cells = rest / (1.0 + 20.0 * load)
        reading = read(counts_of(design, cells))
        check(reading, cells)
    assert reading.valid.all()


@pytest.mark.parametrize("shape", [(16, 16), (16, 32)])
def test_large_dividers_of_8_bits_with_fingers_and_shorts(shape: tuple[int, int]) -> None:
    draw = np.random.default_rng(shape[1])
    design = board("divider", shape, 8, array={"row_lead": 25.0, "column_lead": 25.0})
    read, rest = CountReader(design), 3e4 * 10 ** draw.uniform(-0.1, 0.1, shape)
    row, column = np.indices(shape)
    for number in range(8):
        load = np.exp(-((row - 6.0) ** 2 + (column - 3.0 - number) ** 2) / 3.0)
        cells = rest / (1.0 + 20.0 * load)
        if 3 <= number < 6:
            cells[4, 9] = cells[11, 9] = cells[4, 12] = 0.1
        check(read(counts_of(design, cells)), cells)
