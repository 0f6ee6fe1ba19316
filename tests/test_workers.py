"""Worker processes give the results of a loop, and end with their parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from busy import fail, wait_long

from ohmskin.common.workers import in_processes

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
