"""Boards whose lines end in networks, against ngspice, which reads the very cards of the design."""

from __future__ import annotations

import subprocess
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from needs import need

from ohmskin.circuits import (
    Boards,
    Design,
    Readings,
    Reason,
    Status,
    adc_codes,
    conditioning,
    ideal_volts,
    live_recovery,
    recover,
    scan,
    scan_population,
    volts_of_codes,
)
from ohmskin.circuits.spice import command_available, netlist, run_control
from ohmskin.common.config import parse
from ohmskin.driver import CountReader
from ohmskin.errors import InputError, SolverError
from ohmskin.verification import verify
from ohmskin.wire import read_description, write_description

GROUNDED = ["V1 line 0 0"]
NEGATIVE = ["V1 line 0 -1"]
LOAD = ["R1 line 0 10k"]
DRIVER = ["V1 drive 0 3.3", "R1 drive line 70"]
PULL = ["R9 line 0 10k"]
TIA = ["E1 out 0 ref line 1e6", "R1 line out 2k", "V1 ref 0 1.65"]
D = "IS=2.52n N=1.752 RS=0.568"


def board(selected: list[str], idle_row: list[str], parts: list[str], **turns: Any) -> dict[str, Any]:
    return {"row_end": {"selected": selected, "idle": idle_row}, "column_end": {"parts": parts} | turns}


INVERTER = ["E1 out 0 0 line 1e6", "R1 line out 2k"]
UP = ["V1 vcc 0 5", "R1 vcc line 10k"]
SALLEN_KEY = ["E1 f 0 line 0 1", "R2 f a 10k", "R3 a b 10k", "C1 a out 10n", "C2 b 0 10n", "E2 out 0 b out 1e6"]
KINDS: dict[str, dict[str, Any]] = {
    "divider, rows pulled down": board(DRIVER, PULL, ["R1 line 0 33k", "R2 line out 1k", "C1 out 0 10n"]),
    "divider, idle rows driven low": board(DRIVER, ["V1 drive 0 0", "R1 drive line 70"], ["R1 line 0 4.7k"]),
    "sampled without a load": board(DRIVER, ["R1 line 0 70"], ["R1 line out 1k", "C1 out 0 10p"]),
    "selected row low, columns pulled up": board(["R1 line 0 25"], PULL, UP),
    "open-drain rows": board(["R1 line 0 25"], [], UP),
    "a diode in each driven row": board(["V1 d 0 5", f"D1 d line {D}"], PULL, ["R1 line 0 10k"]),
    "diodes towards low rows": board([f"D1 line low {D}", "R1 low 0 50"], [], UP),
    "a clamp at each column": board(DRIVER, GROUNDED, ["R1 line 0 10k", f"D1 line v {D}", "V1 v 0 0.4"]),
    "zero potential, mid-supply": board(["V1 line 0 0.65"], ["V1 line 0 1.65"], TIA),
    "zero potential, buffered rows": board(
        ["V1 in 0 -1", "E1 o 0 in fb 1e5", "R1 o fb 50", "R2 fb line 5"],
        ["E1 o 0 0 fb 1e5", "R1 o fb 50", "R2 fb line 5"],
        INVERTER,
    ),
    "a second stage": board(
        NEGATIVE, GROUNDED, ["E1 a 0 0 line 1e6", "R1 line a 1k", "R2 a b 10k", "R3 b out 47k", "E2 out 0 0 b 1e6"]
    ),
    "a Sallen-Key filter": board(DRIVER, PULL, ["R1 line 0 10k", *SALLEN_KEY]),
    "feedback by a T of resistors": board(
        NEGATIVE, GROUNDED, ["E1 out 0 0 line 1e6", "R1 line t 10k", "R2 t 0 1k", "R3 t out 10k"]
    ),
    "a current that takes the rest away": board(NEGATIVE, GROUNDED, [*INVERTER, "I1 line 0 0.1m"]),
    "current-driven rows": board(["I1 0 line 1m"], ["R1 line 0 50"], ["R1 line 0 1k"]),
    "a resistance bypasses each column": board(
        NEGATIVE, ["R1 line 0 100"], ["R9 line 0 5k", "E1 out 0 0 m 1e5", "R1 line m 100", "R2 m out 2k"]
    ),
    "multiplexer in groups, others low": board(DRIVER, PULL, LOAD, shared_by=2, idle=["R1 line 0 100"]),
    "multiplexer in groups, others open": board(DRIVER, ["R1 line 0 70"], ["R1 line s 100", "R2 s 0 10k"], shared_by=2),
    "one amplifier behind a multiplexer": board(
        ["V1 line 0 0.65"], ["V1 line 0 1.65"], TIA, shared_by=4, idle=["R1 line v 100", "V1 v 0 1.65"]
    ),
    "a reference without a buffer": board(["V1 line ref -1"], ["R1 line ref 25"], TIA[:2])
    | {"reference": {"parts": ["V1 supply 0 5", "R1 supply ref 10k", "R2 ref 0 10k"]}},
    "rows driven by a divider": board(["V1 s 0 5", "R1 s line 5k", "R2 line 0 5k"], GROUNDED, LOAD),
    "a strip as a potentiometer": board(["V1 line 0 3.3"], GROUNDED, ["C1 line 0 1n"]),
    "a transconductance load": board(DRIVER, PULL, ["G1 line 0 line 0 50u", "R1 line out 10k", "C1 out 0 1n"]),
    "a current mirror": board(DRIVER, GROUNDED, ["V1 line m 0", "R1 m 0 1k", "F1 0 out V1 2", "R2 out 0 3.3k"]),
    "a current sensed by a transresistance": board(
        DRIVER, GROUNDED, ["V1 line m 0", "L1 m a 1u", "R1 a 0 1k", "H1 out 0 V1 2.2k"]
    ),
}
DIODES = {name for name, tables in KINDS.items() if D in str(tables)}
CELLS = np.round(10 ** np.random.default_rng(52).uniform(3, 4.7, (4, 4)))


def designed(kind: str, **array: Any) -> Design:
    lines = {"rows": 4, "columns": 4, "row_lead": 6.0, "column_lead": 9.0} | array
    return Design.model_validate({"array": lines} | KINDS[kind])


def by_ngspice(tables: dict[str, Any]) -> np.ndarray:
    """The readings of a board with leads of 6 and 9 ohm; one circuit for each selected row and turn of the columns."""
    need(command_available())
    volts = np.full((4, 4), np.nan)
    rows, columns = tables["row_end"], tables["column_end"]
    shared, reference = columns.get("shared_by", 1), tables.get("reference", {}).get("parts", [])
    common = {"0", "ref"} if reference else {"0"}
    out = "out_ce" if any(" out" in card for card in columns["parts"]) else "ce"
    grid = [f"Rc{i}{j} r{i} c{j} {CELLS[i, j]}" for i in range(4) for j in range(4)]
    grid += [f"Ra{i} r{i} re{i} 6\nRb{i} c{i} ce{i} 9" for i in range(4)] + _renamed(reference, "x", common)
    for row in range(4):
        for turn in range(shared):
            lines, read = grid.copy(), [j for j in range(4) if j % shared == turn]
            for i in range(4):
                lines += _renamed(rows["selected" if i == row else "idle"], f"re{i}", common)
                lines += _renamed(columns["parts"] if i in read else columns.get("idle", []), f"ce{i}", common)
            lines += [".options reltol=1e-9 vntol=1e-12 abstol=1e-15", ".control", "set numdgt=12", "op"]
            lines += [f"print v({out}{j})" for j in read]
            text = "\n".join(["* a scan step", *lines, "quit", ".endc", ".end"])
            said = subprocess.run(
                ["ngspice", "-b"], input=text, capture_output=True, text=True, timeout=60, check=False
            )
            volts[row, read] = [float(line.split("=")[1]) for line in said.stdout.splitlines() if line[:2] == "v("]
    return volts


def _renamed(cards: list[str], line: str, common: set[str]) -> list[str]:
    """Cards at one line, with names and inner nodes of their own; models of diodes as cards."""
    written = []
    for card in cards:
        name, *words = card.split()
        count = 4 if name[0] in "EG" else 2
        nodes = [line if word == "line" else word if word in common else f"{word}_{line}" for word in words[:count]]
        rest = [f"{word}_{line}" if name[0] in "FH" and word[0] == "V" else word for word in words[count:]]
        if name[0] == "D":
            written.append(f".model m{name}_{line} D({' '.join(rest)})")
            rest = [f"m{name}_{line}"]
        written.append(" ".join([f"{name}_{line}", *nodes, *rest]))
    return written


@pytest.mark.parametrize("kind", KINDS)
def test_a_board_reads_as_ngspice_says(kind: str) -> None:
    result = scan(designed(kind), CELLS)
    limit = 1e-3 if kind in DIODES else 1e-6
    np.testing.assert_allclose(result.volts, by_ngspice(KINDS[kind]), rtol=limit, atol=limit * 1e-3)
    assert result.error_bound < 1e-8


@pytest.mark.parametrize("kind", KINDS)
def test_the_netlist_of_a_step_has_the_parts(kind: str) -> None:
    need(command_available())
    design = designed(kind, row_segment=2.0, column_segment=3.0)
    step = run_control(netlist(design, CELLS, 2))
    limit = 1e-3 if kind in DIODES else 1e-6
    volts = [step[f"volts_{j}"] for j in range(4)]
    np.testing.assert_allclose(volts, scan(design, CELLS).volts[2], rtol=limit, atol=limit * 1e-3)


@pytest.mark.parametrize("shared", [1, 4])
def test_a_diode_at_each_cell(shared: int) -> None:
    """Against a netlist of its own, in which the diode and the cell of each crosspoint are in series."""
    need(command_available())
    tables = board(DRIVER, PULL, LOAD, shared_by=shared) | {"crosspoint": {"parts": [f"D1 row cell {D}"]}}
    design = Design.model_validate({"array": {"rows": 4, "columns": 4, "row_lead": 6.0, "column_lead": 9.0}} | tables)
    volts = scan(design, CELLS).volts
    for row in range(4):
        for turn in range(shared):
            lines = [f".model d D({D})", *(f"Ra{i} r{i} re{i} 6\nRb{i} c{i} ce{i} 9" for i in range(4))]
            lines += [
                f"D{i}{j} r{i} x{i}{j} d\nRc{i}{j} x{i}{j} c{j} {CELLS[i, j]}" for i in range(4) for j in range(4)
            ]
            read = [j for j in range(4) if j % shared == turn]
            for i in range(4):
                lines += _renamed(DRIVER if i == row else PULL, f"re{i}", {"0"})
                lines += _renamed(LOAD if i in read else [], f"ce{i}", {"0"})
            text = "\n".join(
                ["* step", *lines, ".options reltol=1e-9", ".control", "op", "print all", "quit", ".endc", ".end"]
            )
            said = subprocess.run(
                ["ngspice", "-b"], input=text, capture_output=True, text=True, timeout=60, check=False
            )
            values = dict(line.split(" = ") for line in said.stdout.splitlines() if line.startswith("ce"))
            np.testing.assert_allclose(volts[row, read], [float(values[f"ce{j}"]) for j in read], rtol=1e-3)
    step = run_control(netlist(design, CELLS, 1))
    np.testing.assert_allclose([step[f"volts_{j}"] for j in range(4)], volts[1], rtol=1e-4)
    with pytest.raises(SolverError, match="parts at each cell"):
        recover(design, volts)
    with pytest.raises(InputError, match="crosspoint: expected lines without resistance"):
        design.replace(array={"row_segment": 1.0})


UNDETERMINED = {
    "sampled without a load": "nothing loads the columns",
    "a strip as a potentiometer": "nothing loads the columns",
    "a clamp at each column": "70 ohm while it is selected",
    "current-driven rows": "a current source while it is selected",
    "rows driven by a divider": "2500 ohm while it is selected",
    "a current mirror": "70 ohm while it is selected",
    "a current sensed by a transresistance": "70 ohm while it is selected",
}


def test_a_pressed_cell_is_read_where_networks_hold_idle_rows() -> None:
    """It reads more than a short would behind the resistance that drives its row, which the row's end is part of."""
    resistors = {"selected": ["V1 drive 0 3.3", "R1 drive line 70", "R2 line 0 10k"], "idle": ["R1 line 0 70"]}
    sections = {"row_end": resistors, "column_end": {"parts": ["R1 line out 0", "R2 out 0 3.3k"]}}
    array = {"rows": 4, "columns": 4, "row_lead": 5.0, "column_lead": 5.0}
    design = Design.model_validate({"array": array, "adc": {"bits": 12, "range": [0.0, 5.0]}} | sections)
    cells = np.full((4, 4), 1e4)
    cells[2, 1] = 1e3
    live = live_recovery(design)
    for _ in range(3):
        reading = live(Readings.of(volts_of_codes(design, adc_codes(design, scan(design, cells).volts))))
    assert reading.valid.all()
    assert (np.abs(reading.conductance * cells - 1) <= reading.uncertainty).all()


SEVERAL_ANSWERS = {"multiplexer in groups, others low"}
"""boards whose idle columns conduct better than those that are read: readings need not be valid"""


@pytest.mark.parametrize("kind", KINDS)
def test_the_cells_are_recovered_or_the_reason_is_given(kind: str) -> None:
    design = designed(kind)
    volts = scan(design, CELLS).volts
    adc = {"bits": 16, "range": (float(volts.min()) - 0.1, float(volts.max()) + 0.1)}
    digitised = design.replace(adc=adc)
    if kind in UNDETERMINED:
        for attempt in (lambda: recover(design, volts), lambda: live_recovery(digitised)):
            with pytest.raises((InputError, SolverError), match=UNDETERMINED[kind]):
                attempt()
        return
    if kind not in SEVERAL_ANSWERS:
        np.testing.assert_allclose(recover(design, volts).resistance, CELLS, rtol=1e-8)
    live = live_recovery(digitised)
    for _ in range(3):
        reading = live(Readings.of(volts_of_codes(digitised, adc_codes(digitised, volts))))
    right = np.abs(reading.conductance * CELLS - 1)
    if kind in SEVERAL_ANSWERS:
        assert not (right > 1e-3).any()
        assert (reading.valid | (reading.reason == Reason.UNCERTAIN)).all()
    else:
        assert reading.valid.all()
        assert (right <= reading.uncertainty).all()


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - DIODES - UNDETERMINED.keys()))
def test_errors_of_readings_propagate_as_differences_say(kind: str) -> None:
    design = designed(kind)
    moved = np.repeat(CELLS[None], CELLS.size, axis=0)
    moved.reshape(CELLS.size, -1)[np.diag_indices(CELLS.size)] *= 1.0 + 1e-6
    apart = np.log(np.array([scan(design, cells).resistance for cells in (CELLS, *moved)]).reshape(-1, CELLS.size))
    by_cell = (apart[1:] - apart[0]).T / 1e-6
    np.testing.assert_allclose(conditioning(design, CELLS).inverse @ by_cell, np.eye(CELLS.size), atol=1e-3)


def test_a_second_set_of_cells_gives_the_readings_of_a_weakly_driven_row() -> None:
    """Why such boards are refused: Newton's method from elsewhere finds another answer."""
    design = Design.model_validate(
        {"array": {"rows": 2, "columns": 1}} | board(["V1 s 0 1", "R1 s line 1k"], GROUNDED, ["R1 line 0 1k"])
    )
    # G1 = a / (...): the readings of (G, G) fall again once the cells conduct better than the row's source.
    read = [scan(design, np.full((2, 1), ohm)).volts[0, 0] for ohm in (1e1, 5e2, 1e5)]
    assert read[1] > read[0]
    assert read[1] > read[2]


@pytest.mark.parametrize("kind", ["a diode in each driven row", "rows driven by a divider", "a Sallen-Key filter"])
def test_one_cell_alone_reads_as_its_apparent_resistance(kind: str) -> None:
    design = designed(kind, rows=1, columns=1, row_lead=0.0, column_lead=0.0)
    for ohm in (50.0, 1e3, 4.7e4, 1e6):
        assert scan(design, [[ohm]]).resistance[0, 0] == pytest.approx(ohm, rel=1e-4)
        assert ideal_volts(design, [[ohm]])[0, 0] == pytest.approx(scan(design, [[ohm]]).volts[0, 0], rel=1e-3)
    assert scan(design, [[np.inf]]).resistance[0, 0] > 1e8


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"column_end": {"parts": ["R1 line 0 x"]}}, r"column_end.parts: card 0: 'x' is no value"),
        ({"column_end": {"parts": ["Q1 a b c"]}}, r"'Q1 a b c' is no part; expected R, C, L"),
        ({"column_end": {"parts": [".include /etc/passwd"]}}, "is no part"),
        ({"column_end": {"parts": ["R1 line 0 1k", "R1 line 0 2k"]}}, "there is a R1 already"),
        ({"column_end": {"parts": ["F1 line 0 V1 2"]}}, "F1 is controlled by V1, which is no part"),
        ({"column_end": {"parts": ["D1 line 0 whatever"]}}, "no such diode; expected IS="),
        ({"column_end": {"parts": LOAD, "idle": LOAD}}, "idle has no effect with shared_by = 1"),
        ({"column_end": {"parts": LOAD, "tolerance": {"R2": 0.1}}}, "tolerance.R2: no such part; expected one of R1"),
        ({"column_end": {"parts": LOAD}, "readout": {"idle_columns": "load"}}, "readout.idle_columns has no effect"),
        (
            {"row_end": {"selected": DRIVER, "idle": []}, "drive": {"idle_rows": "float"}},
            "drive.idle_rows has no effect",
        ),
        ({"column_end": {"parts": {"file": "a.cir", "subcircuit": "B"}}}, "names a file; only a file of your own"),
        ({"column_end": {"parts": LOAD}, "readout": {"circuit": "voltage-feedback"}}, "senses columns and drives rows"),
    ],
)
def test_what_a_design_may_not_say(tables: dict[str, Any], message: str) -> None:
    readout = {"circuit": "voltage-divider", "reference_resistance": 1e3} | tables.get("readout", {})
    whole = {"array": {"rows": 2, "columns": 2}, "drive": {"voltage": 1.0}} | tables | {"readout": readout}
    with pytest.raises(InputError, match=message):
        parse(whole, Design, source="design.toml")


def test_ends_that_contradict_themselves_are_refused() -> None:
    for parts, why in ((["V1 line 0 1", "V2 line 0 2"], "contradict"), (["R1 line 0 1k", "C1 line out 1n"], "no path")):
        design = Design.model_validate({"array": {"rows": 2, "columns": 2}} | board(DRIVER, PULL, parts))
        with pytest.raises(InputError, match=why):
            scan(design, np.full((2, 2), 1e3))


@given(st.lists(st.sampled_from(["line", "out", "0", "a", "b"]), min_size=6, max_size=6))
def test_a_board_of_any_connections_is_read_or_refused(nodes: list[str]) -> None:
    plus, minus, output, *ends = nodes
    parts = [f"X1 {plus} {minus} {output} opamp", f"R1 {ends[0]} {ends[1]} 1k", f"R2 {ends[2]} 0 1k"]
    with suppress(InputError, SolverError):
        design = parse({"array": {"rows": 2, "columns": 2}} | board(DRIVER, PULL, parts), Design, source="design")
        assert np.isfinite(scan(design, np.full((2, 2), 1e3)).volts).all()


def test_a_file_gives_the_same_board(tmp_path: Path) -> None:
    (tmp_path / "ends.cir").write_text(
        "* ends\n.subckt FILTER a b\nR1 a b\n+ 1k\nC1 b 0 10n\n.ends\n"
        ".subckt COLUMN line out ; the load and its filter\nR1 line 0 33k\nX1 line out FILTER\n.ends\n"
    )
    (tmp_path / "design.toml").write_text(
        "[array]\nrows = 4\ncolumns = 4\n[row_end]\nselected = ['V1 drive 0 3.3', 'R1 drive line 70']\n"
        "idle = ['R9 line 0 10k']\n[column_end]\nparts = { file = 'ends.cir', subcircuit = 'COLUMN' }\n"
        "[scan]\nrow = [{ wait = 1e-4 }]\ncolumn = [{ discharge = 2e-6 }, { read = 4 }]\n"
    )
    design = Design.load(tmp_path / "design.toml")
    same = designed("divider, rows pulled down", row_lead=0.0, column_lead=0.0)
    np.testing.assert_array_equal(scan(design, CELLS).volts, scan(same, CELLS).volts)
    tables, _ = read_description(write_description(design.model_dump(), None))
    assert tables is not None
    sent = parse(tables, Design, source="a board")
    assert sent.scan == design.scan
    np.testing.assert_array_equal(scan(sent, CELLS).volts, scan(design, CELLS).volts)


def test_short_names_and_their_networks_are_one_board() -> None:
    """What [drive] and [readout] say, said again in parts."""
    array = {"rows": 4, "columns": 4, "row_lead": 25.0, "column_lead": 25.0, "row_segment": 2.0}
    readout = {"circuit": "inverting-amplifier", "reference_resistance": 1e3, "reference_voltage": 1.65}
    named = {"array": array, "drive": {"voltage": -1.0}, "readout": readout | {"open_loop_gain": 1e5}}
    amplifier = ["X1 ref line out opamp open_loop_gain=1e5", "R1 line out 1k"]
    rows = {"row_end": {"selected": ["V1 line ref -1"], "idle": ["V1 line ref 0"]}}
    for tables in (rows, {"column_end": {"parts": amplifier}}, rows | {"column_end": {"parts": amplifier}}):
        design = Design.model_validate(
            named | {"readout": readout} | tables if "column_end" in tables else named | tables
        )
        expected = scan(Design.model_validate(named), CELLS)
        np.testing.assert_allclose(scan(design, CELLS).volts, expected.volts, rtol=1e-13)
        np.testing.assert_allclose(scan(design, CELLS).resistance, expected.resistance, rtol=1e-3)  # of finite gain


def test_outputs_stay_within_the_supply_of_their_amplifier() -> None:
    array = {"rows": 4, "columns": 4, "row_lead": 25.0}
    readout = {"circuit": "inverting-amplifier", "reference_resistance": 4e3, "supply": [-0.5, 1.2]}
    named = Design.model_validate({"array": array, "drive": {"voltage": -1.0}, "readout": readout})
    design = named.replace(reference={"parts": ["V1 ref 0 0"]})
    assert scan(named, CELLS).saturated.any()
    np.testing.assert_allclose(scan(design, CELLS).volts, scan(named, CELLS).volts, atol=1e-12)
    np.testing.assert_array_equal(scan(design, CELLS).saturated, scan(named, CELLS).saturated)


@pytest.mark.parametrize(
    "parts",
    [
        ["X1 0 line out opamp low=-0.5 high=1", "R1 line out 2k"],
        ["X1 0 line a opamp low=-0.5 high=0.6 offset_voltage=1m", "R1 line a 2k", "R2 a out 1k", "R3 out 0 3k"],
        ["X1 0 line a opamp", "R1 line a 500", "R2 a b 10k", "R3 b out 47k", "X2 0 b out opamp low=-2 high=2"],
    ],
)
@pytest.mark.parametrize("at_limit", [[(1, 2)], [(0, 0), (1, 2)]])
def test_readers_know_where_described_outputs_stay(parts: list[str], at_limit: list[tuple[int, int]]) -> None:
    """Within the converter's range nothing else tells such a reading from one of another cell."""
    given = {
        "array": {"rows": 3, "columns": 4, "row_lead": 5.0, "column_lead": 5.0},
        "row_end": {"selected": ["V1 s 0 -1", "R1 s line 25"], "idle": ["R1 line 0 25"]},
        "column_end": {"parts": parts},
        "adc": {"bits": 14, "range": [-3.3, 3.3]},
    }
    design = Design.model_validate(given)
    cells = np.random.default_rng(1).uniform(7e3, 9e3, (3, 4))
    for place in at_limit:
        cells[place] = 100.0
    frame = scan(design, cells)
    saturated = np.zeros((3, 4), dtype=bool)
    saturated[tuple(zip(*at_limit, strict=True))] = True
    ends = design.board.supply
    np.testing.assert_allclose(np.abs(frame.volts[saturated][:, None] - ends).min(axis=1), 0.0, atol=1e-3)
    recovery = recover(design, frame.volts)
    assert (recovery.status[saturated] == Status.SATURATED).all()
    known = np.isfinite(recovery.uncertainty)
    assert (np.abs(recovery.resistance[known] / cells[known] - 1.0) <= recovery.uncertainty[known]).all()
    reader, codes = CountReader(design), adc_codes(design, frame.volts)
    for _ in range(3):
        found = reader(codes)
    assert not found.valid[saturated].any()
    assert found.valid.any()
    off = np.abs(cells / found.resistance - 1.0)[found.valid]
    assert (off <= found.uncertainty[found.valid]).all()


def test_cells_that_nothing_drives_are_not_called_open() -> None:
    ends = board(["R1 line 0 25"], [], ["X1 0 line out opamp", "R1 line out 2k"])
    design = Design.model_validate({"array": {"rows": 3, "columns": 2, "row_lead": 5.0}} | ends)
    volts = scan(design, np.full((3, 2), 8e3)).volts
    with pytest.raises(SolverError, match="no reading depends on the cells"):
        recover(design, volts)
    driven = design.replace(row_end={"selected": ["V1 line 0 -1"], "idle": ["R1 line 0 25"]})
    assert (recover(driven, volts).status == Status.OPEN).all()


def test_each_end_has_its_own_values() -> None:
    design = designed("zero potential, mid-supply", row_lead=0.0, column_lead=0.0)
    assert design.end_parts["column_end.R1"].tolist() == [2e3] * 4
    assert design.end_parts["row_end.idle.V1"].tolist() == [1.65] * 4
    parts = {"column_end.R1": [2e3, 2e3, 2.2e3, 2e3], "row_end.selected.V1": [0.65, 0.65, 0.65, 0.55]}
    signal, changed = (scan(each, CELLS).volts - 1.65 for each in (design, design.with_end_parts(parts)))
    expected = signal * np.array([1.0, 1.0, 1.1, 1.0]) * np.array([1.0, 1.0, 1.0, 1.1])[:, None]
    np.testing.assert_allclose(changed, expected, rtol=1e-4)  # of the amplifiers' gain
    shared = designed("multiplexer in groups, others low").end_parts
    assert shared["column_end.parts.R1"].tolist() == [10e3, 10e3]
    assert shared["column_end.idle.R1"].tolist() == [100.0] * 4


def test_calls_of_subcircuits_without_parts_are_not_followed(tmp_path: Path) -> None:
    """A thousand calls in each of eight levels would be, for ever."""
    levels = "".join(f".subckt l{d} a\n" + f"x1 a l{d + 1}\n" * 1000 + ".ends\n" for d in range(7))
    (tmp_path / "end.cir").write_text(f".subckt col line out\nx1 line l0\n.ends\n{levels}.subckt l7 a\n.ends\n")
    (tmp_path / "design.toml").write_text(
        '[array]\nrows = 1\ncolumns = 1\n[row_end]\nselected = ["V1 line 0 1"]\nidle = []\n'
        '[column_end]\nparts = { file = "end.cir", subcircuit = "col" }\n'
    )
    with pytest.raises(InputError, match=r"a \.subckt without parts"):
        Design.load(tmp_path / "design.toml")


def test_boards_differ_in_the_parts_of_their_ends() -> None:
    design = designed("divider, rows pulled down")
    drawn = np.random.default_rng(1).uniform(0.9, 1.1, (3, 4)) * 33e3
    boards = replace(Boards.of(design), ends={"column_end.R1": drawn})
    found = scan_population(design, boards, CELLS[None]).volts
    for volts, ohms in zip(found, drawn, strict=True):
        np.testing.assert_array_equal(volts, scan(design.with_end_parts({"column_end.R1": ohms}), CELLS).volts)


def test_the_worst_board_has_the_tolerance_of_a_networks_part() -> None:
    """An amplifier's feedback that is 5 % low reads resistances 1 / 0.95 too high."""
    parts = {"parts": ["X1 0 line out opamp", "R1 line out 20k"], "tolerance": {"R1": 0.05}}
    rows = {"selected": NEGATIVE, "idle": GROUNDED}
    tables = {"array": {"rows": 1, "columns": 1}, "row_end": rows, "column_end": parts}
    design = Design.model_validate(tables | {"adc": {"bits": 16, "range": (0.0, 3.3)}})
    (found,) = verify(design, only=("D2",), samples=20).results
    assert found.measurement is not None
    assert found.measurement.value == pytest.approx(100 * (1 / 0.95 - 1), rel=0.01)
    assert "column_end.R1 low" in found.measurement.where
