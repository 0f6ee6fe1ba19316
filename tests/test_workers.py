"""Worker processes give the results of a loop, and end with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from busy import fail, wait_long

from ohmskin.circuits import Requirement
from ohmskin.cli import run
from ohmskin.common.workers import in_processes
from ohmskin.verification import prototype, verify

TESTS = Path(__file__).parent


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_items(jobs: int) -> None:
    seen: list[int] = []
    assert in_processes(abs, [-3, 2, -1, 0], jobs=jobs, done=seen.append) == [3, 2, 1, 0]
    assert sorted(seen) == [0, 1, 2, 3]


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_exception_is_the_callers(jobs: int) -> None:
    with pytest.raises(ZeroDivisionError):
        in_processes(fail, [0, 1, 2], jobs=jobs)


def test_what_fails_does_not_wait_for_the_others(tmp_path: Path) -> None:
    """The other task sleeps for ten minutes, longer than this test may take."""
    with pytest.raises(ZeroDivisionError):
        in_processes(wait_long, [str(tmp_path / "first"), ""], jobs=2)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_its_parent(number: int, tmp_path: Path) -> None:
    """The parent is signalled together with its workers for Ctrl-C, as a terminal does, and alone otherwise."""
    code = (
        "from ohmskin.common import signals, workers; import busy\n"
        "if __name__ == '__main__':\n"
        "    signals.leave_at_once(); signals.raise_from_now_on()\n"
        f"    workers.in_processes(busy.wait_long, [r'{tmp_path}/a', r'{tmp_path}/b', r'{tmp_path}/c'], jobs=2)\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    paths = os.pathsep.join([str(TESTS), *os.environ.get("PYTHONPATH", "").split(os.pathsep)])
    parent = subprocess.Popen(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": paths},
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    workers = [_process_id(tmp_path / name) for name in "ab"]
    if number == signal.SIGINT:
        os.killpg(parent.pid, number)
    else:
        parent.send_signal(number)
    parent.wait()
    while any(_runs(worker) for worker in workers):  # the test's own timeout is the judge
        time.sleep(0.05)
    assert parent.stderr is not None
    said = parent.stderr.read()
    parent.stderr.close()
    assert said.count("Traceback") <= 1, said  # the parent's, which catches nothing; none of a worker


def _process_id(file: Path) -> int:
    """What a worker has written, once it has."""
    while not file.exists() or not file.read_text().endswith("\n"):
        time.sleep(0.05)
    return int(file.read_text())


def _runs(process: int) -> bool:
    """Whether it is there and no zombie, which a container without an init process leaves."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def test_workers_import_nothing_from_the_working_folder(tmp_path: Path) -> None:
    """It may be that of a design from somebody else."""
    folder = tmp_path / "foreign"
    folder.mkdir()
    for name in ("signal", "pickle", "struct", "random"):
        (folder / f"{name}.py").write_text(f"import os; os.write(2, b'{name} of the folder runs')\n")
    script = tmp_path / "parent.py"
    script.write_text(
        "from ohmskin.common import workers\n"
        "if __name__ == '__main__':\n    print(workers.in_processes(abs, [-1, 2], jobs=2))\n"
    )
    done = subprocess.run([sys.executable, script], cwd=folder, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr, done.returncode) == ("[1, 2]\n", "", 0)


# A real Dask cluster of several worker processes, one of which is killed in mid-run


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
            if done and not killed.is_set():
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
