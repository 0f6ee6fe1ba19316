"""Usual frames take a short way through one kernel: it gives what the whole recovery gives, or hands the frame over."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from designs import digitised
from hypothesis import given, settings
from hypothesis import strategies as st

from ohmskin.circuits import Design, Reason, adc_codes, live_recovery, scan
from ohmskin.circuits.recovery._usual_fits import UsualFits
from ohmskin.common.measurement import Measurement
from ohmskin.driver import CountReader

KINDS = "grounded", "floating", "divider", "loaded", "floating rows"


AMPLIFIED = "grounded", "floating", "floating rows"


def board(kind: str, bits: int, rows: int, columns: int, **readout: Any) -> Design:
    return digitised(kind, rows, columns, bits, array={"row_lead": 5.0, "column_lead": 5.0}, readout=readout)


def readers(design: Design, accuracy: float | None = None) -> tuple[CountReader, CountReader, list[bool]]:
    """One that takes the short way, one that never does, and whether each frame went the short way."""
    short, whole, went = CountReader(design, accuracy=accuracy), CountReader(design, accuracy=accuracy), []
    way = short._recover.usual
    assert way is not None

    def noted(*frame: Any) -> Measurement | None:
        found = way(*frame)
        went.append(found is not None)
        return found

    short._recover.usual, whole._recover.usual = noted, None
    return short, whole, went


def assert_same(one: Measurement, other: Measurement) -> None:
    np.testing.assert_array_equal(one.reason, other.reason)
    np.testing.assert_allclose(one.block, other.block, rtol=1e-9, atol=0.0)


@settings(max_examples=25)
@given(
    st.sampled_from(KINDS),
    st.sampled_from([8, 10, 12, 16]),
    st.integers(3, 9),
    st.integers(2, 9),
    st.sampled_from([None, 0.1]),
    st.integers(0, 2**32 - 1),
)
def test_the_short_way_gives_what_the_whole_recovery_gives(
    kind: str, bits: int, rows: int, columns: int, accuracy: float | None, seed: int
) -> None:
    """Under a finger that wanders, with noise of up to a few steps, with open cells, and with lines that all differ."""
    draw = np.random.default_rng(seed)
    lines = rows if kind == "floating rows" else columns
    own = {"reference_resistance": tuple((2e3 if kind in AMPLIFIED else 5e3) * draw.uniform(0.9, 1.1, lines))}
    design = board(kind, bits, rows, columns, **own)
    assert design.adc is not None
    rest, noise = 8e3 * 10 ** draw.uniform(-0.2, 0.2, (rows, columns)), draw.choice([0.1, 0.6, 3.0]) * design.adc.step
    if draw.random() < 0.3:
        rest[draw.integers(rows), draw.integers(columns)] = 1e9
    short, whole, _ = readers(design, accuracy)
    at, row, column = draw.uniform(0, [rows, columns]), *np.indices((rows, columns))
    for frame in range(14):
        place = at + 0.3 * frame
        cells = rest * (1.0 + 2.0 * np.exp(-((row - place[0]) ** 2 + (column - place[1]) ** 2)))
        counts = adc_codes(design, scan(design, cells).volts + draw.normal(scale=noise, size=cells.shape))
        short._kept = whole._kept = None  # results that are kept were judged with the noise of their time
        assert_same(short(counts), whole(counts))


@pytest.mark.parametrize("kind", KINDS)
def test_most_frames_of_a_sound_board_go_the_short_way(kind: str) -> None:
    design, draw = board(kind, 12, 8, 8), np.random.default_rng(1)
    assert design.adc is not None
    short, _, went = readers(design)
    for frame in range(40):
        cells = np.full((8, 8), 8e3)
        cells[2:4, 3:5] *= 1.0 + min(max(frame - 10, 0), 10) / 10
        short(adc_codes(design, scan(design, cells).volts + draw.normal(scale=design.adc.step, size=(8, 8))))
    assert sum(went) >= 30


@settings(max_examples=15)
@given(
    st.sampled_from(KINDS),
    st.sampled_from([10, 12]),
    st.sampled_from([0.0, 0.3, 5.0, 30.0]),
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 4), st.sampled_from([0.5, 8.0, 400.0, 1e9])), max_size=4),
)
def test_cells_at_a_limit_take_the_short_way_and_cost_the_others_the_same(
    kind: str, bits: int, lead: float, places: list[tuple[int, int, float]]
) -> None:
    """A cell at a limit costs the others what its interval costs, by the kernel as by the whole recovery."""
    array, readout = {"row_lead": lead, "column_lead": lead}, {"supply": (-0.2, 3.3)} if kind in AMPLIFIED else {}
    design = digitised(kind, 6, 5, bits, array=array, readout=readout)
    cells, (short, whole, went) = np.full((6, 5), 8e3), readers(design)
    for frame in range(14):
        if frame >= 4:
            for row, column, ohm in places:
                cells[row, column] = ohm
        counts = adc_codes(design, scan(design, cells).volts)
        short._kept = whole._kept = None
        assert_same(short(counts), whole(counts))
    assert went[-1] or kind not in AMPLIFIED


UNHELD = {
    "together": ("voltage-divider", "float", {"idle_columns": "load"}),
    "in turns": ("voltage-divider", "float", {"idle_columns": "float"}),
    "pulled together": ("voltage-divider", "pull", {"idle_columns": "load"}),
    "pulled in turns": ("voltage-divider", "pull", {"idle_columns": "float"}),
    "amplifiers in turns": ("inverting-amplifier", "float", {"columns": "multiplexed", "idle_columns": "float"}),
    "rows in turns": ("row-amplifier", "float", {"columns": "multiplexed", "idle_columns": "load"}),
    "pulled rows in turns": ("row-amplifier", "pull", {"columns": "multiplexed", "idle_columns": "load"}),
}
"""boards whose idle rows nothing holds: circuit, idle rows, columns"""


def unheld(kind: str, bits: int, rows: int, columns: int, lead: float, pull: float) -> Design:
    circuit, idle_rows, readout = UNHELD[kind]
    parts: dict[str, Any] = {"circuit": circuit, "reference_resistance": 1e4}
    if circuit != "voltage-divider":
        parts |= {"reference_resistance": 2e3, "offset_voltage": 1e-3, "open_loop_gain": 1e5}
    drive: dict[str, Any] = {"voltage": 3.3 if circuit == "voltage-divider" else -1.0, "idle_rows": idle_rows}
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns, "row_lead": lead, "column_lead": 0.3 * lead},
            "drive": drive | ({"idle_row_resistance": pull} if idle_rows == "pull" else {}),
            "readout": parts | readout,
            "adc": {"bits": bits, "range": [-0.1, 3.3]},
        }
    )


@settings(max_examples=15)
@given(
    st.sampled_from(sorted(UNHELD)),
    st.sampled_from([10, 12, 16]),
    st.integers(2, 9),
    st.integers(2, 9),
    st.integers(0, 2**32 - 1),
)
def test_the_short_way_of_unheld_rows_is_right_and_as_sure_as_the_whole_recovery(
    kind: str, bits: int, rows: int, columns: int, seed: int
) -> None:
    """Both iterate to a fraction of the uncertainty, so that they agree within it."""
    draw = np.random.default_rng(seed)
    design = unheld(kind, bits, rows, columns, 25.0, 10 ** draw.uniform(2.0, 4.5))
    reference = float(np.max(design.readout.reference_resistance))
    short, whole, went = readers(design)
    rest = reference * 10 ** draw.uniform(0.3, 0.8, (rows, columns))
    for frame in range(12):
        cells = rest * draw.uniform(0.98, 1.02, rest.shape) * (1.0 + 0.02 * frame)
        counts = adc_codes(design, scan(design, cells).volts)
        short._kept = whole._kept = None
        one, other = short(counts), whole(counts)
        with np.errstate(divide="ignore", invalid="ignore"):
            apart = np.abs(one.resistance / other.resistance - 1.0) / one.uncertainty
            off = np.abs(one.resistance / cells - 1.0) / one.uncertainty
        assert (off[one.valid] <= 1.0).all()
        assert (apart[one.valid & other.valid] <= 0.3).all()
        assert (one.valid == other.valid).mean() > 0.9
        np.testing.assert_allclose(one.uncertainty[one.valid], other.uncertainty[one.valid], rtol=0.6)
    assert sum(went) >= 6


@pytest.mark.parametrize("kind", [kind for kind, (circuit, *_) in UNHELD.items() if circuit == "voltage-divider"])
@pytest.mark.parametrize("ohm", [0.5, np.inf])
def test_a_short_or_an_open_cell_that_stays_costs_unheld_rows_the_short_way_once(kind: str, ohm: float) -> None:
    """Readings like those of a short or of nothing are readings; nothing is wrong in those frames."""
    design, draw = unheld(kind, 14, 6, 5, 25.0, 1e4), np.random.default_rng(3)
    reference = float(np.max(design.readout.reference_resistance))
    short, _, went = readers(design)
    rest = reference * 10 ** draw.uniform(0.3, 0.8, (6, 5))
    for frame in range(40):
        cells = rest * (1.0 + 0.005 * np.sin(frame))
        if frame >= 10:
            cells[2, 3] = ohm
        found = short(adc_codes(design, scan(design, cells).volts))
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.abs(found.resistance / cells - 1.0) / found.uncertainty
        assert (off[found.valid] <= 1.0).all()
    assert sum(went[-10:]) >= 8
    assert found.valid.sum() >= 20


FAULTS = (
    {"kind": "shorted-cell", "place": (1, 2), "resistance": 2e4},
    {"kind": "open-cell", "place": (3, 0), "resistance": 5e3},
    {"kind": "broken-row", "place": (2, 4)},
)


@pytest.mark.parametrize(("kind", "number"), [*product(["grounded"], range(3)), *product(["divider"], range(2))])
def test_boards_with_named_faults_go_the_short_way_too(kind: str, number: int) -> None:
    """But for cells behind a break on dividers, which join lines that nothing holds."""
    fault = FAULTS[number]
    design, draw = board(kind, 14, 6, 5), np.random.default_rng(4)
    design = Design.model_validate(design.model_dump() | {"fault": [fault]})
    short, _, went = readers(design)
    hidden, rest = np.zeros((6, 5), dtype=np.bool_), 8e3 * 10 ** draw.uniform(-0.2, 0.2, (6, 5))
    hidden[2, 4] = fault["kind"] == "broken-row"
    for _ in range(12):
        cells = rest * draw.uniform(0.999, 1.001)
        found = short(adc_codes(design, scan(design, cells).volts))
        assert (found.valid == ~hidden).all()
        assert (np.abs(found.resistance / cells - 1.0) <= found.uncertainty)[found.valid].all()
        assert (found.reason[hidden] == Reason.HIDDEN).all()
    assert all(went[2:])


@settings(max_examples=40)
@given(st.sampled_from(sorted(UNHELD)), st.integers(2, 5), st.integers(2, 5), st.integers(0, 2**32 - 1))
def test_the_model_of_unheld_rows_is_that_of_the_scan(kind: str, rows: int, columns: int, seed: int) -> None:
    draw = np.random.default_rng(seed)
    design = unheld(kind, 12, rows, columns, 10 ** draw.uniform(-1, 2), 10 ** draw.uniform(2.0, 4.5))
    way = live_recovery(design).usual
    assert isinstance(way, UsualFits)
    cells = 10 ** draw.uniform(2, 6, (rows, columns))
    np.testing.assert_allclose(
        design.board.transpose(way.volts(design.board.transpose(cells))),
        scan(design, cells).volts,
        rtol=1e-8,
        atol=1e-12,
    )
