"""The benchmark measures what it says: true errors against an independent reference, bounds, all methods."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from ohmskin import bench
from ohmskin.bench import _estimators as benchmark
from ohmskin.bench import _memory as memory
from ohmskin.bench import _peers as peers
from ohmskin.bench._reference import reference_volts
from ohmskin.circuits import METHODS
from ohmskin.cli import run
from ohmskin.errors import InputError


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ohmskin.bench._measurement._BUDGET", 0.002)


def test_the_reference_is_right_to_the_last_digits() -> None:
    design, frame = bench.board(3, 2.0), bench.cells(3)[0]
    exact = reference_volts(design, frame) / 1000.0
    np.testing.assert_allclose(peers.reference(design, frame), exact, rtol=5e-16)


@pytest.mark.parametrize("peer", peers.PEERS, ids=lambda peer: peer.name)
def test_every_peer_answers_the_same_question(peer: peers.Peer) -> None:
    reason = peer.missing()
    if reason is not None:
        assert "install" in reason
        pytest.skip(reason)
    handlers = list(logging.getLogger().handlers)
    design, frame = bench.board(5, 3.0), bench.cells(5)[0]
    np.testing.assert_allclose(peer.solve(design, frame), peers.reference(design, frame), rtol=1e-9)
    assert logging.getLogger().handlers == handlers


def test_errors_lie_within_bounds_and_methods_are_all_there() -> None:
    rows = list(bench.measure([4, 12], [0.5, 20.0], memory=False, peers=False))
    assert {(row.size, row.segment) for row in rows} == {(4, 0.5), (4, 20.0), (12, 0.5), (12, 20.0)}
    for size in (4, 12):
        assert set(METHODS) < {row.method for row in rows if row.size == size}
    certified = [row for row in rows if row.bound is not None]
    assert len(certified) == 4 * 6
    for row in certified:
        assert row.full_scale_error is not None
        assert row.full_scale_error <= row.bound + 5e-16
    assert all(row.seconds > 0 for row in rows if row.seconds is not None)
    assert "exact, in a batch" in {row.method for row in rows}


def test_slow_peers_are_left_out_by_name_and_waited_for_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = peers.Peer("slow", lambda: None, peers.reference, 3)
    monkeypatch.setattr("ohmskin.bench._measurement.PEERS", (slow,))
    monkeypatch.setattr("ohmskin.bench._measurement._ONCE", 0.0)
    for patient in (False, True):
        row = next(row for row in bench.measure([4], [1.0], memory=False, patient=patient) if row.method == "slow")
        if patient:
            assert row.seconds is not None
            assert (row.error, row.note) == (0.0, "once")
        else:
            assert (row.seconds, row.note) == (None, "not waited for beyond 3 x 3 (--wait)")


def test_memory_is_that_of_a_frame(capsys: pytest.CaptureFixture[str]) -> None:
    memory.main("exact", 128, 1.0)
    added = json.loads(capsys.readouterr().out)
    assert added is None or 0 <= added < 200e6


def test_the_command_prints_a_table_or_json_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "bench.svg"
    options = ["--no-memory", "--no-peers"]
    assert run(["bench", "--size", "4", "6", "--segment", "1", *options, "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    titles, *rows = printed.splitlines()
    assert titles.split()[:4] == ["cells", "ohm", "per", "segment"]
    assert {row[:5] for row in rows} == {"4 x 4", "6 x 6"}
    assert ElementTree.parse(picture).getroot().tag.endswith("svg")
    assert run(["bench", "--json", "--size", "4", "--segment", "1", "2", *options]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["segment"] for row in rows} == {1.0, 2.0}
    assert {"size", "segment", "method", "seconds", "error", "bound", "memory"} <= rows[0].keys()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "0"], "size is 0; expected 1 to 1024"),
        (["--segment", "0"], "segment is 0.0 ohm; expected 1e-30 to 1e+30"),
        (["--size", "x"], "Invalid value for '--size'"),
    ],
)
def test_bad_requests_are_refused_by_name(options: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", *options]) == 2
    assert message in capsys.readouterr().err


def test_measure_checks_before_it_measures() -> None:
    with pytest.raises(InputError, match="size is 5000"):
        bench.measure([8, 5000], [1.0])


def test_the_estimators_have_a_table_of_their_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    row = benchmark.Row("foam", "play", rmse_percent=12.5, microseconds=0.25, is_default=True)
    monkeypatch.setattr(benchmark, "estimators", lambda: [row])
    assert run(["bench", "--estimators"]) == 0
    assert "12.50" in capsys.readouterr().out
    assert run(["bench", "--estimators", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [asdict(row)]
