"""The benchmark measures what it says: true errors against an independent reference, bounds, ages on a clock."""

from __future__ import annotations

import gc
import json
import logging
import math
from dataclasses import asdict, dataclass, field, replace
from math import inf
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from ohmskin import bench
from ohmskin.bench import _driver, _peers, boards, measurements, scenarios
from ohmskin.bench._driver import FRAME_RATE_HZ, design, packets_of, pressed
from ohmskin.bench._paced_port import PacedPort
from ohmskin.bench._reference import reference_volts
from ohmskin.bench.harness import column, table
from ohmskin.cell import ESTIMATORS, Cell
from ohmskin.circuits import METHODS, adc_codes, scan
from ohmskin.cli import run
from ohmskin.driver import Arrival, CountReader, Skin
from ohmskin.errors import InputError
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


def test_the_emulator_is_as_near_to_the_full_physics_as_it_certifies(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ohmskin.bench._emulator._BUDGET_S", 0.1)
    assert run(["bench", "--emulator", "--size", "6", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["size"], row["contacts"]) for row in rows] == [(6, 0), (6, 1), (6, 5)]
    for row in rows:
        assert row["difference_steps"] <= row["certified_steps"] + 1e-6 <= 0.25 + 1e-6
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
    assert row.taken_us > 0


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
