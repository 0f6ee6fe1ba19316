"""A real Dask cluster of several worker processes, one of which is killed in mid-run."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ohmskin.circuits import Requirement
from ohmskin.cli import run
from ohmskin.verification import prototype, verify

distributed = pytest.importorskip("distributed")

ASKED = [
    Requirement(id="Y", quantity="reading_error", max=4.0, method="monte-carlo"),
    Requirement(id="C", quantity="crosstalk", max=2.0),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as running:
            yield running


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_killed_worker_costs_nothing(cluster: Any) -> None:
    alone = verify(prototype(), requirements=ASKED, samples=400)
    with distributed.Client(cluster, set_as_default=False) as client:
        workers = list(client.run(os.getpid).values())
        assert len(set(workers)) == 2
        killed = threading.Event()

        def kill_one(done: int, total: int, what: str) -> None:
            if not killed.is_set():
                killed.set()
                os.kill(workers[0], signal.SIGKILL)

        found = verify(
            prototype(), requirements=ASKED, samples=400, executor=client.get_executor(retries=3), progress=kill_one
        )
    assert killed.is_set()
    for here, there in zip(alone.results, found.results, strict=True):
        assert here.measurement is not None
        assert there.measurement is not None
        assert there.measurement.samples == here.measurement.samples
        assert there.measurement.value == here.measurement.value
        assert there.outcome == here.outcome


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("quick_verification")
def test_the_command_line_uses_an_existing_scheduler(cluster: Any, tmp_path: Path) -> None:
    deadline = time.monotonic() + 60
    while not cluster.scheduler_info["workers"] and time.monotonic() < deadline:
        time.sleep(0.1)
    arguments = ["verify", "-o", str(tmp_path / "out"), "--only", "D11", "--dask", cluster.scheduler_address]
    assert run(arguments) == 0


def test_no_scheduler_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("Timed out trying to connect")

    monkeypatch.setattr(distributed, "Client", refuse)
    assert run(["verify", "-o", str(tmp_path / "out"), "--dask", "tcp://127.0.0.1:9"]) == 2
    assert "no scheduler answers there" in capsys.readouterr().err
