"""The benchmark measures what it says: true errors against an independent reference, bounds, ages on a clock."""

from __future__ import annotations

import gc
import json
import logging
import math
import re
from dataclasses import asdict, dataclass, field, replace
from math import inf
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from ohmskin import bench
from ohmskin.bench import _driver, _peers, boards, measurements, oracle, scenarios, scenes, search
from ohmskin.bench._driver import FRAME_RATE_HZ, design, packets_of, pressed
from ohmskin.bench._paced_port import PacedPort
from ohmskin.bench._reference import Indeterminate, reference_volts
from ohmskin.bench.harness import column, interval_score, table
from ohmskin.cell import ESTIMATORS, Cell
from ohmskin.circuits import METHODS, Design, adc_codes, scan, scan_batch
from ohmskin.cli import run
from ohmskin.driver import Arrival, CountReader, Skin
from ohmskin.errors import InputError, SolverError
from ohmskin.wire import host_protocol


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.bench._measurement._BUDGET", 0.002)


def test_the_reference_is_right_to_the_last_digits() -> None:
    design, frame = bench.board(3, 2.0), bench.cells(3)[0]
    exact = reference_volts(design, frame) / 1000.0
    np.testing.assert_allclose(_peers.reference(design, frame), exact, rtol=5e-16)


@pytest.mark.parametrize("peer", _peers.PEERS, ids=lambda peer: peer.name)
def test_every_peer_answers_the_same_question(peer: _peers.Peer) -> None:
    reason = peer.missing()
    if reason is not None:
        assert "install" in reason
        pytest.skip(reason)
    handlers = list(logging.getLogger().handlers)
    design, frame = bench.board(5, 3.0), bench.cells(5)[0]
    np.testing.assert_allclose(peer.solve(design, frame), _peers.reference(design, frame), rtol=1e-9)
    assert logging.getLogger().handlers == handlers


def test_errors_lie_within_bounds_and_methods_are_all_there() -> None:
    rows = list(bench.measure([4, 12], [20.0], peers=False))
    assert {(row.size, row.segment) for row in rows} == {(4, 20.0), (12, 20.0)}
    for size in (4, 12):
        assert set(METHODS) < {row.method for row in rows if row.size == size}
    certified = [row for row in rows if row.bound is not None]
    assert {(row.size, row.method) for row in certified} >= {(size, method) for size in (4, 12) for method in METHODS}
    for row in certified:
        assert row.full_scale_error is not None
        assert row.full_scale_error <= row.bound + 5e-16
    assert all(row.seconds > 0 for row in rows if row.seconds is not None)
    assert "exact, in a batch" in {row.method for row in rows}


def test_slow_peers_are_left_out_by_name_and_waited_for_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = _peers.Peer("slow", lambda: None, _peers.reference, 3)
    monkeypatch.setattr("ohmskin.bench._measurement.PEERS", (slow,))
    for patient in (False, True):
        row = next(row for row in bench.measure([4], [1.0], patient=patient) if row.method == "slow")
        assert (row.seconds is not None) == patient
        assert row.error == (0.0 if patient else None)
        assert row.note == ("" if patient else "not waited for beyond 3 x 3 (--wait)")


def test_the_command_prints_a_table_or_json_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "bench.svg"
    asked = ["bench", "--no-peers", "--size", "4", "6", "--segment", "1"]
    assert run([*asked, "--picture", str(picture)]) == 0
    titles, *lines = capsys.readouterr().out.splitlines()
    assert titles.split()[:4] == ["cells", "ohm", "per", "segment"]
    assert {line[:5] for line in lines} == {"4 x 4", "6 x 6"}
    assert ElementTree.parse(picture).getroot().tag.endswith("svg")
    assert run([*asked, "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["segment"] for row in rows} == {1.0, 2.0}
    assert {"size", "segment", "method", "seconds", "error", "bound"} <= rows[0].keys()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "0"], "size is 0; expected 1 to 1024"),
        (["--size", "8", "5000"], "size is 5000"),
        (["--segment", "0"], "segment is 0.0 ohm; expected 1e-30 to 1e+30"),
        (["--size", "x"], "Invalid value for '--size'"),
        (["--driver", "--size=-3"], "size is -3; expected 1 to 256"),
        (["--emulator", "--size=0"], "size is 0; expected 1 to 256"),
        (["--driver", "--size=257"], "size is 257; expected 1 to 256"),
    ],
)
def test_bad_requests_are_refused_by_name(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", *options]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.out.count("\n") <= 2  # what the columns are


@dataclass(frozen=True)
class Measured:
    size: int = field(metadata=column("cells", "{0} x {0}"))
    name: str = field(metadata=column("name", "{}", width=6))
    seconds: float = field(metadata=column("ms", "{:.1f}", unit=1e-3))
    found: dict[str, float] = field(metadata=column("{}, %", "{:.0f}", unit=0.01))
    hidden: float = 1.0
    default: bool = field(default=True, metadata=column("default"))


def test_a_table_prints_as_it_is_measured_and_numbers_that_are_not_finite_are_null(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = Measured(4, "a", 0.0123, {"taps": 0.5})
    unknown = replace(row, seconds=math.nan, hidden=math.inf)
    monkeypatch.setitem(measurements.TABLES, "estimators", lambda _: [("", [row, unknown])])  # type: ignore[arg-type]
    assert run(["bench", "--estimators"]) == 0
    assert "12.3" in capsys.readouterr().out
    assert run(["bench", "--estimators", "--json"]) == 0
    nothing = asdict(row) | {"seconds": None, "hidden": None}
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == [asdict(row), nothing]


def test_every_estimator_of_the_cells_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    every = scenarios.rows("rest | contact")
    monkeypatch.setattr(scenarios, "rows", lambda only: every)
    found = {row.gate: row.rows for row in scenarios.by_estimator()}
    assert found.keys() == {name for name in ESTIMATORS if found.get(name)}
    assert found["static"] == len(every)


def test_any_recording_is_a_row_by_its_name() -> None:
    (row,) = scenarios.rows("taps | relays | 7")
    assert (row.name, row.gate, row.today) == ("taps | relays | 7", "recording", None)
    for wrong in ("taps | foam | 7", "tap | relays | 7", "taps | relays | x"):
        with pytest.raises(InputError, match="expected LOAD"):
            scenarios.rows(wrong)


def test_columns_are_aligned_and_other_fields_are_left_out() -> None:
    rows = (
        Measured(4, "a", 0.0123, {"taps": 0.5, "rubs": math.nan}),
        Measured(16, "second", 1.5, {"taps": 1.0, "rubs": 0.25}),
    )
    assert list(table(rows, "what it is")) == [
        "what it is",
        "cells  name      ms  taps, %  rubs, %  default",
        "4 x 4  a       12.3       50        -      yes",
        "16 x 16  second  1500.0      100       25      yes",
    ]
    assert list(table([], "what it is")) == ["what it is"]


def test_the_emulator_is_measured_beside_the_full_physics(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ohmskin.bench._emulator._BUDGET_S", 0.1)
    assert run(["bench", "--emulator", "--size", "6", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["size"], row["contacts"]) for row in rows] == [(6, 0), (6, 1), (6, 5)]
    for row in rows:
        assert row["certified_steps"] <= 0.25
        assert row["frames_per_second"] > 0 < row["full_frames_per_second"]


# -- the live path -----------------------------------------------------------------------------------------------------


def test_every_estimator_of_the_data_sheet_is_judged_at_every_size() -> None:
    rows = list(bench.live_estimators((3,), learned=False, frames=300))
    assert [row.size for row in rows] == [3, 3, 3]
    assert {row.estimator for row in rows} == {"static", "paper", "inverse"}
    default, static = (
        next(row for row in rows if part(row)) for part in (lambda r: r.is_default, lambda r: r.estimator == "static")
    )
    assert default.estimator == Cell.example().default_estimator
    assert default.rmse_kpa < 0.35 * static.rmse_kpa
    assert default.rmse_kpa <= default.worst_kpa
    for row in rows:
        assert sum(row.shares) == pytest.approx(1.0)
        assert row.frames_per_second > 0


def test_the_errors_of_the_benchmark_are_those_of_a_skin() -> None:
    """The errors that the benchmark states are those that a user of the driver gets."""
    board = design(4, "inverting-amplifier", "ground", 12)
    truth, cells = pressed((4, 4), 60)
    port = PacedPort(packets_of(board, cells), 1.0 / FRAME_RATE_HZ, board, clock=lambda: 0.0)
    shown = []
    with Skin(port, design=board, cell=Cell.example(), delivery="every") as skin:
        for _ in range(60):
            port.work(1.0 / FRAME_RATE_HZ)
            shown.append(skin.read(0.0).pressure)
    (row,) = [r for r in bench.live_estimators((4,), learned=False, frames=60) if r.is_default]
    assert row.worst_kpa == pytest.approx(float(np.abs(np.array(shown) - truth).max()), rel=1e-9)


def test_what_a_program_keeps_from_the_garbage_collector_stays_kept() -> None:
    gc.freeze()
    kept = gc.get_freeze_count()
    next(iter(bench.live_estimators((2,), learned=False, frames=20)))
    assert gc.get_freeze_count() > kept // 2  # some are gone by now, as nobody refers to them


def test_setting_up_a_skin_leaves_nothing_for_its_first_frames() -> None:
    """A skin tries its circuit out with counts that its board never sent: the inversion must not begin there."""
    board = design(8, "voltage-divider", "ground", 8)
    packets = packets_of(board, pressed((8, 8), 20)[1])
    read, decode = CountReader(board), host_protocol("ohmskin")
    port = PacedPort(packets, 1.0 / FRAME_RATE_HZ, board, clock=lambda: 0.0)
    with Skin(port, design=board, cell=Cell.example(), delivery="every", timeout=60.0) as skin:
        for packet in packets:
            port.work(1.0 / FRAME_RATE_HZ)
            frame, expected = skin.read(0.0), read(decode.feed(packet, 0.0)[0].counts)  # type: ignore[union-attr]
            np.testing.assert_array_equal(frame.reason, expected.reason)
            np.testing.assert_array_equal(frame.resistance, expected.resistance)


def test_a_slow_reader_s_frames_are_young_and_all_accounted_for() -> None:
    (row,) = bench.freshness((4,), cycles=20)
    assert row.unaccounted == 0
    assert row.skipped > 5 * 20  # 10 ms of work, a frame each ms: about ten come, one is taken
    assert 0 < row.median_age <= row.worst_age


def test_a_frame_that_comes_while_others_are_decoded_is_the_newest() -> None:
    board = design(4, "inverting-amplifier", "ground", 12)

    class SlowToDecode(PacedPort):
        """Whatever comes in a burst takes one and a half periods to decode."""

        def read(self) -> Arrival:
            arrival = super().read()
            if len(arrival.data) > len(packets[0]):
                self.work(1.5)
            return arrival

    packets = packets_of(board, pressed((4, 4), 20)[1])
    port = SlowToDecode(packets, 1.0, board, clock=lambda: 0.0)
    with Skin(port, design=board, cell=Cell.example(), timeout=60.0) as skin:
        port.work(5.0)
        frame = skin.latest(inf)
        assert frame.sequence == int(port.now()) - 1 == 5
        port.work(1.0)
        assert skin.latest(inf).sequence == 6


def test_the_command_prints_all_three(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("ohmskin.bench._driver.rehearsed", lambda cell: cell)
    monkeypatch.setattr("ohmskin.bench._worst_frames.CASES", ())
    monkeypatch.setattr("ohmskin.bench._driver.CASES", _driver.CASES[:2])
    for measured in (_driver.driver, _driver.live_estimators):
        monkeypatch.setitem(measured.__kwdefaults__, "frames", 60)
    assert run(["bench", "--driver", "--size", "2", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert sum("saturated_cells" in row for row in rows) == 1 + 3  # seven saturated cells are more than there are
    assert sum("median_age" in row for row in rows) == 1


@pytest.mark.parametrize(("circuit", "idle_rows"), [("voltage-divider", "float"), ("inverting-amplifier", "ground")])
def test_the_least_deviation_of_a_frame_is_that_of_the_linear_law(circuit: str, idle_rows: str) -> None:
    """Beside the inverse of the information matrix by differences of the circuit model; and no fit is better."""
    board = design(4, circuit, idle_rows, 12)
    cells = 3e4 * 10 ** np.random.default_rng(0).uniform(-0.2, 0.2, (4, 4))
    assert board.adc is not None
    slopes = np.empty((16, 16))
    for place in range(16):
        more, less = cells.copy(), cells.copy()
        more.flat[place] *= 1.001
        less.flat[place] /= 1.001
        slopes[:, place] = (scan(board, more).volts - scan(board, less).volts).ravel() / (2 * np.log(1.001))
    noise = board.adc.step * np.sqrt(0.25 + 1 / 12)
    expected = noise * np.sqrt(np.diagonal(np.linalg.inv(slopes.T @ slopes)))
    least = boards.bound(board, cells)
    np.testing.assert_allclose(least.ravel(), expected, rtol=1e-4)
    random, read, found = np.random.default_rng(1), CountReader(board), []
    volts = scan(board, cells).volts
    for _ in range(300):
        noisy = volts + random.normal(scale=0.5 * board.adc.step, size=volts.shape)
        found.append(np.log(read(adc_codes(board, noisy).astype(np.uint16)).resistance / cells))
    spread = np.std(found[20:], axis=0)
    assert (spread > 0.8 * least).all()  # of 280 frames: 4.7 standard deviations of a standard deviation
    assert (spread < 1.5 * least).all()


# A bounded search for wrong readings, the findings of past searches, and what the search itself must notice


@pytest.mark.parametrize("family", search.FAMILIES)
def test_a_search_of_each_family_finds_nothing(family: str) -> None:
    tally = search.Tally()
    for number in range(25):
        search.check(family, number, tally)
    assert tally.designs == 25
    assert not tally.findings


def feedback(cells: object, *, gain: float = inf, offset: float = 0.0, **array: object) -> Design:
    rows, columns = np.shape(cells)
    return Design.model_validate(
        {
            "array": {"rows": rows, "columns": columns} | array,
            "drive": {"voltage": -1.0},
            "readout": {
                "circuit": "voltage-feedback",
                "reference_resistance": 1000.0,
                "open_loop_gain": gain,
                "offset_voltage": offset,
            },
        }
    )


def test_shorts_among_ideal_and_real_lines_keep_the_bound() -> None:
    """Conductances that stand for shorts tie with each other; LU interchanged rows, and the bound was broken."""
    cells = [[0.0, 0.0, 0.0], [0.0, 0.0, 1e4]]
    design = feedback(cells, gain=1e5, row_lead=17.3, column_lead=[4.29, 20.7, 0.0])
    result = scan(design, cells)
    exact = reference_volts(design, cells)
    assert np.abs(result.volts - exact).max() <= result.error_bound * np.abs(exact).max()
    assert result.error_bound < 1e-10
    assert exact[0, 2] == pytest.approx(-0.98293, abs=1e-5)


@pytest.mark.parametrize(
    ("cells", "parts", "message"),
    [
        ([[0.0, 1e4], [1e4, 1e4]], {"offset": 1e-3}, "the driver of row 0 and the end of column 0"),
        ([[0.0], [1e4]], {"offset": 1e-3}, "the driver of row 0 and the end of column 0"),
        ([[0.0, 0.0]], {"gain": 1e5}, "the driver of row 0 and the end of column 0"),
        ([[0.0, 0.0], [1e4, 1e4]], {"row_lead": 1.0}, "the ends of columns 0 and 1"),
        ([[0.0, 1e4], [0.0, 1e4]], {"column_lead": 1.0}, "the row drivers 0 and 1"),
    ],
)
def test_contradictions_of_a_follower_are_refused(cells: object, parts: dict[str, float], message: str) -> None:
    design = feedback(cells, **parts)
    with pytest.raises(SolverError, match=message):
        scan(design, cells)
    with pytest.raises(Indeterminate):
        reference_volts(design, cells)


def test_a_complete_short_by_a_fault_is_a_contradiction_as_one_by_a_cell_is() -> None:
    base = feedback([[1e4, 1e4]])
    design = base.replace(
        readout={"circuit": "inverting-amplifier"},
        array={"row_lead": 1.0},
        fault=[{"kind": "shorted-cell", "place": [0, column]} for column in range(2)],
    )
    with pytest.raises(SolverError, match="ideal amplifiers of columns 0 and 1"):
        scan(design, [[1e4, 1e4]])


def test_what_an_idle_driver_leaves_open_has_no_bound() -> None:
    """Driver and virtual ground hold the same potential, and nothing says how they share the current."""
    cells = np.array([[0.0, 1e4], [1e4, 1e4]])
    for circuit in ("inverting-amplifier", "row-amplifier"):
        design = feedback(cells).replace(readout={"circuit": circuit, "supply": (-1.0, 3.0)})
        with pytest.raises(Indeterminate):
            reference_volts(design, cells)
        result = scan(design, cells)
        assert result.saturated.tolist() == [[True, False], [False, False]]
        assert result.error_bound == inf
        frames = scan_batch(design, [cells, np.full((2, 2), 1e4)])
        assert frames.error_bound[0] == inf
        assert frames.error_bound[1] < 1e-12


def test_nearly_equal_sources_that_are_joined_keep_their_bound() -> None:
    """Their difference has lost digits before it meets any conductance (a finding in the family of faults)."""
    tally = search.Tally()
    for number in (210000141, 210000478, 210000541):
        search.check("faults", number, tally)
    assert not tally.findings


def test_the_search_notices_wrong_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(design: Design, cells: object, **options: object) -> object:
        result = scan(design, cells)
        result.volts[0, 0] *= 1.0 + 1e-6
        return result

    monkeypatch.setattr(search, "scan", wrong)
    tally = search.Tally()
    for number in range(20):
        search.check("ordinary", number, tally)
    assert len(tally.findings) > 10
    assert all("broken bound" in finding for finding in tally.findings)


def test_the_command_prints_counts_and_shows_a_design() -> None:
    ran = CliRunner().invoke(search.main, ["--seconds", "0.5", "--family", "ties"])
    assert ran.exit_code == 0, ran.output
    assert "designs" in ran.output
    shown = CliRunner().invoke(search.main, ["--show", "ties:3"])
    assert shown.exit_code == 0
    assert "cells = [[" in shown.output


def test_the_command_shows_the_stream_of_a_live_finding() -> None:
    """It searched instead, until the time was up."""
    shown = CliRunner().invoke(search.main, ["--live", "--show", "inverting:3"])
    assert shown.exit_code == 0
    design, *frames = shown.output.splitlines()
    shape = Design.model_validate(json.loads(design)).array.shape
    assert frames
    for frame in frames:
        values = re.fullmatch(r"cells = (.*), noise_steps = (.*), counts = (.*)", frame)
        assert values is not None
        assert np.shape(json.loads(values[3])) == shape
    for wrong in ("ties:3", "inverting:x", "inverting"):
        refused = CliRunner().invoke(search.main, ["--live", "--show", wrong])
        assert refused.exit_code == 2
        assert "expected FAMILY:NUMBER" in refused.output


# Regression scenarios: the table is that of this source, figures are what their names say, and gates are limits


FROZEN = (
    "taps | example, 100 Hz, 12 bits, 1 mV",
    "random | paper, 100 Hz, 12 bits, 1 mV",
    "press, opens | example, 100 Hz, 12 bits, 1 mV",
    "wavering | example, 100 Hz, 12 bits, 1 mV",
    "hold | example, 100 Hz, 8 bits, 0.1 mV",
    "taps, mismatched | example, 100 Hz, 12 bits, 1 mV",
)


class Knows:
    """Shows the truth, off by so many of its own deviations."""

    def __init__(self, cell: Cell, shape: tuple[int, ...], off: float = 0.5) -> None:
        self.played: scenes.Played | None = None
        self.frame, self.off = -1, off
        self.std_kpa = np.full(shape, 0.01 * cell.full_scale_kpa)

    def step(self, elapsed_s: float, resistance: np.ndarray) -> np.ndarray:
        assert self.played is not None
        self.frame += 1
        np.testing.assert_array_equal(resistance, self.played.ohms[self.frame])
        return np.asarray(self.played.pressure_kpa[self.frame] + self.off * self.std_kpa)


@pytest.mark.parametrize("name", FROZEN)
def test_the_table_holds_for_this_source(name: str) -> None:
    """No limit is missed that the frozen figures met."""
    row = next(row for row in scenarios.rows(name) if row.name == name)
    (verdict,) = scenarios.judge([row], scenarios.maker(None))
    assert row.today is not None
    assert set(verdict.misses) <= set(scenarios.misses(row, row.today))


def test_figures_are_those_of_an_estimator_whose_errors_are_known() -> None:
    """Half a deviation off everywhere, of one percent of full scale."""
    scene = scenes.Scene("taps", "example")
    cell, played = scenes.cells()["example"], scenes.play(scene)
    estimator = Knows(cell, played.pressure_kpa.shape[1:])
    estimator.played = played
    pressure, std, _ = scenarios.estimated(played, estimator)
    found = scenarios.figures(played, pressure, std, cell.full_scale_kpa)
    assert (found.rmse, found.interval, found.sd, found.rest) == pytest.approx((0.5, 4.0, 1.0, 0.5))
    assert found.within == 100.0


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, ()),
        ({"rmse": 0.55}, ()),  # 1.25 times today's, and 0.3 % of full scale
        ({"rmse": 0.6}, ("rmse",)),
        ({"within": 87.0}, ("within",)),
        ({"interval": 7.0, "sd": 9.0}, ("interval",)),
        ({"rest": 11.0}, ("rest",)),
        ({"interval": math.nan}, ("interval",)),
        ({"rest": math.nan}, ()),  # no cell is released
    ],
)
def test_a_gate_names_the_figures_that_miss_it(change: dict[str, float], missed: tuple[str, ...]) -> None:
    gate = scenarios.Gate(
        rmse_percent=0.3, rmse_times_today=1.25, within_percent=88, interval_times_today=1.5, rest_percent=10
    )
    today = scenarios.Figures(rmse=0.2, within=99.0, interval=4.0, sd=1.0, rest=0.05)
    row = scenarios.Row("", "", gate, today, None, quick=False)
    assert scenarios.misses(row, replace(today, **change)) == missed


@given(st.floats(0.1, 10.0), st.floats(1.05, 3.0), st.booleans())
def test_the_interval_score_is_least_for_the_deviation_that_is_true(std: float, factor: float, wide: bool) -> None:
    """Of normal errors; the least lies where the interval has 95 %, which is 1.96 deviations to a side."""
    error = std * np.asarray(norm.ppf((np.arange(20_000) + 0.5) / 20_000))
    stated = np.full_like(error, 1.96 / 2.0 * std)
    assert interval_score(error, stated) < interval_score(error, stated * (factor if wide else 1.0 / factor))


def test_a_cell_that_the_converter_cannot_tell_from_an_open_one_reads_infinite() -> None:
    played = scenes.play(scenes.Scene("rest", "fsr", noise_mv=0.0))
    assert np.isinf(played.ohms).all()


def test_rows_are_chosen_by_name_and_gate(capsys: pytest.CaptureFixture[str]) -> None:
    assert {row.gate for row in scenarios.rows("vibration")} >= {"hard"}
    assert run(["bench", "--scenarios", "--only", "rest | contact", "--json"]) == 0
    (verdict,) = json.loads(capsys.readouterr().out)
    assert verdict["name"] == "rest | contact, 100 Hz, 12 bits, 1 mV"
    assert verdict["limits"]["within"] == 88.0
    assert run(["bench", "--scenarios", "--only", "no such row"]) == 2
    assert run(["bench", "--scenarios", "--estimator", "ohmskin.cell:nobody"]) == 2


# -- what the readings allow --


@given(st.floats(0.0, 1.0), st.floats(0.01, 1.0), st.integers(5, 60), st.integers(0, 2**32 - 1))
def test_the_oracle_weighs_no_load_and_plateaus_by_bayes_rule(
    height: float, noise: float, frames: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    gain = random.uniform(0.4, 0.8, frames)
    error = height * gain + noise * random.standard_normal(frames)
    x = np.linspace(0.0, 1.0, 4001)
    fits = norm.logpdf(error[:, None], x * gain[:, None], noise).sum(axis=0)
    density, rest = np.exp(fits - fits.max()), np.exp(norm.logpdf(error, 0.0, noise).sum() - fits.max())
    found, std = oracle.plateau(error, np.full(frames, noise), gain)
    assert found == pytest.approx(np.mean(density * x) / (np.mean(density) + rest), abs=2e-3)
    assert std == pytest.approx(noise / np.linalg.norm(gain))


def test_a_release_of_a_tap_is_one_that_the_oracle_judges() -> None:
    """In little noise it shows nothing."""
    scene = scenes.Scene("press", "example", noise_mv=0.1)
    found = oracle.releases(scene, scenes.play(scene), Cell.example())
    assert len(found) == 6  # of eight cells two bear no load
    assert max(shown for shown, _ in found) < 1e-3
