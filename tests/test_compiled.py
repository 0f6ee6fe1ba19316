"""Kernels: machine code rounds as the written functions do, is kept on disk, and can be switched off."""

from __future__ import annotations

import copy
import math
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from uncompiled import switched_off

from ohmskin.common import compiled
from ohmskin.common.arrays import FloatArray
from ohmskin.common.compiled import (
    FixedRow,
    Flags,
    Places,
    Record,
    Records,
    Row,
    Rows,
    loop,
    record,
    values,
)

ENOUGH = 2.5
NAMES = ["a", "list"]


@loop
def rooted(x: float, enough: bool) -> float:
    return math.sqrt(x) if enough else ENOUGH * x


@loop
def divided(a: FixedRow, b: FixedRow, out: Row, large: Flags) -> int:
    count = 0
    for i in range(a.size):
        out[i] = a[i] / b[i] + rooted(abs(a[i]), True) * b[i] - rooted(b[i], False)
        large[i] = out[i] > ENOUGH
        count += large[i]
    return count


@loop
def first_of(rows: Rows, at: int) -> float:
    return rows[at, 0]


@loop
def added(rows: Rows) -> float:
    sums, total = np.zeros(rows.shape[1]), 0.0
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            sums[j] += first_of(rows, i) * rows[i, j]
    for j in range(sums.size):
        total += sums[j] * sums[j]
    return total


class Point(Record):
    """A record, as the state of a cell is one."""

    x: float
    y: float
    series: Annotated[FloatArray, 3]


@loop
def move(point: Point, by: Point) -> None:
    point.x += by.x
    point.series[1] = point.x * by.y


@loop
def move_each(points: Records[Point], places: Places, by: Point) -> None:
    for k in range(places.size):
        move(points[places[k]], by)


def named(at: int) -> int:
    return len(NAMES[at])


def grows(a: Row) -> float:
    return a.no_such_attribute  # type: ignore[attr-defined,no-any-return]


numbers = st.lists(st.floats(width=64), min_size=1, max_size=20)


@given(a=numbers, b=numbers)
def test_machine_code_rounds_as_array_operations_do(a: list[float], b: list[float]) -> None:
    size = min(len(a), len(b))
    one, other = np.array(a[:size]), np.array(b[:size])
    out, large = np.empty(size), np.zeros(size, dtype=np.bool_)
    with np.errstate(all="ignore"):
        expected = one / other + np.sqrt(np.abs(one)) * other - ENOUGH * other
    assert divided(one, other, out, large) == np.count_nonzero(expected > ENOUGH)
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(large, expected > ENOUGH)


def test_a_kernel_changes_the_records_it_is_given() -> None:
    """Also as plain Python; and the fields are columns of one array."""
    points, by = compiled.zeros(Point, 4), record(Point, x=2.0, y=3.0, series=np.zeros(3))
    move_each(points, np.array([1, 3]), by)
    with switched_off():
        move_each(points, np.array([3]), by)
    np.testing.assert_array_equal(points["x"], [0.0, 2.0, 0.0, 4.0])
    np.testing.assert_array_equal(values(points)[:, 3], [0.0, 6.0, 0.0, 12.0])
    with pytest.raises(TypeError, match="missing or unknown"):
        record(Point, x=1.0, z=2.0)


def test_a_kernel_is_the_same_function_where_it_is_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.array([[1.0, 2.0], [3.0, 4.0]])
    assert first_of(rows, 1) == first_of.function(rows, 1) == 3.0
    code = first_of.machine_code()
    assert code is not None
    with switched_off():
        assert first_of.code is first_of.unchecked is first_of.function
        assert first_of.machine_code() is None
        assert "OHMSKIN_COMPILED=off" in (compiled.why_not() or "")
    assert first_of.machine_code() is first_of.code is code
    monkeypatch.setenv(compiled.SWITCH, "off")
    late = loop(first_of.function)
    assert late(rows, 1) == 3.0
    assert late.code is late.function
    monkeypatch.setenv(compiled.SWITCH, "1")
    assert late(rows, 1) == 3.0


def test_a_kernel_that_makes_arrays_is_compiled_as_well() -> None:
    assert added(np.array([[1.0, 2.0], [3.0, 4.0]])) == 10.0**2 + 14.0**2


def test_a_compiler_that_does_not_know_an_undocumented_option_compiles_without(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = move._options().keys()
    monkeypatch.setattr("numba.core.cpu.CPUTargetOptions", object)
    assert usual - move._options().keys() == {"_nrt"}


def test_arguments_of_other_types_are_refused_rather_than_compiled_for() -> None:
    """Unless a call is unchecked, which calls in tests are not, so that no caller goes wrong unseen."""
    assert first_of.machine_code() is first_of.code is first_of.unchecked
    fixed, out = np.array([4.0]), np.empty(1)
    fixed.flags.writeable = False
    divided(fixed, fixed, out, np.zeros(1, dtype=np.bool_))
    assert out[0] == 1.0 + 8.0 - 10.0
    for call in (
        lambda: first_of(np.zeros((2, 2), dtype=np.float32), 0),  # type: ignore[arg-type]
        lambda: first_of(np.zeros((4, 4))[:, ::2], 0),
        lambda: divided(fixed, fixed, fixed, np.zeros(1, dtype=np.bool_)),
    ):
        with pytest.raises(TypeError, match="argument type"):
            call()


@pytest.mark.parametrize(("refused", "why"), [(named, "neither a number nor a kernel"), (grows, "no_such_attribute")])
def test_what_cannot_be_compiled_says_why(
    refused: Callable[..., float], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "_offered", [])
    with pytest.raises(Exception, match=why):
        loop(refused).load()


def test_loops_are_copied_and_pickled_by_name() -> None:
    assert copy.deepcopy(divided) is divided
    assert divided.__reduce__() == "divided"


def test_the_name_on_disk_changes_with_the_numbers_and_helpers_that_are_compiled_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = rooted._stamp(), divided._stamp()
    monkeypatch.setitem(globals(), "ENOUGH", 2.0)
    compiled.Loop._stamp.cache_clear()
    after = rooted._stamp(), divided._stamp()
    compiled.Loop._stamp.cache_clear()
    assert after[0] != before[0]
    assert after[1] != before[1]


def _run(program: str, *, notices: int = 0, **variables: str) -> str:
    """What a new interpreter prints that treats warnings as errors.

    Args:
        program: of Python, indented.
        notices: lines that it writes to standard error, all of them of a wait for the compiler.
        variables: of the environment.

    """
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    inherited = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(program)],
        env={**inherited, "PYTHONPATH": paths, **variables},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert all(line.startswith("ohmskin compiles") for line in lines), done.stderr
    assert len(lines) == notices
    return done.stdout


def test_importing_the_package_does_not_import_the_compiler() -> None:
    program = "import sys, ohmskin.cell, ohmskin.driver, ohmskin.cli; print('numba' in sys.modules)"
    assert _run(program) == "False\n"


USE = """
    from ohmskin.common import compiled
    from some_loops import doubled
    code = doubled.machine_code()
    print(doubled(4.0), code is None, compiled.why_not())
"""


@pytest.fixture
def some_loops(tmp_path: Path) -> Path:
    """A module of loops in a folder of its own."""
    folder = tmp_path / "modules"
    folder.mkdir()
    text = (
        "from ohmskin.common.compiled import loop\nK = 2.0\n@loop\ndef doubled(x: float) -> float:\n    return K * x\n"
    )
    (folder / "some_loops.py").write_text(text)
    return folder


def _used(folder: Path, *, notices: int, **variables: str) -> str:
    return _run(
        f"import sys; sys.path.insert(0, {str(folder)!r})\n" + textwrap.dedent(USE), notices=notices, **variables
    )


@pytest.mark.slow
def test_machine_code_is_kept_for_the_next_process_and_renewed_when_damaged(some_loops: Path) -> None:
    assert _used(some_loops, notices=1) == "8.0 False None\n"
    kept = list((some_loops / "__pycache__").glob("*.nb?"))
    assert len(kept) == 2, "an index and the code"
    times = [file.stat().st_mtime_ns for file in kept]
    assert _used(some_loops, notices=0) == "8.0 False None\n"
    assert [file.stat().st_mtime_ns for file in kept] == times, "taken from disk"
    for file in kept:
        file.write_bytes(b"damaged")
    assert _used(some_loops, notices=1) == "8.0 False None\n"


LOADING = """
    import logging, sys
    sys.path.insert(0, {folder!r})
    {log}
    from ohmskin.common import compiled
    import some_loops
    print(compiled.load())
"""
COMMAND = """
    from ohmskin.cli import _set_up_log
    sys.stderr.isatty = lambda: {watched}
    logging.basicConfig(stream=sys.stderr)
    _set_up_log()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("log", "notices"),
    [
        pytest.param("", 1, id="a program that sets up no log"),
        pytest.param("logging.basicConfig(format='%(message)s')", 1, id="a program that shows its log"),
        pytest.param("logging.basicConfig(level=logging.ERROR)", 0, id="a program that wants no warnings"),
        pytest.param(COMMAND.format(watched=True), 1, id="a command on a terminal"),
        pytest.param(COMMAND.format(watched=False), 0, id="a command that nobody watches"),
    ],
)
def test_a_wait_for_the_compiler_is_announced_once(some_loops: Path, log: str, notices: int) -> None:
    text = (some_loops / "some_loops.py").read_text()
    (some_loops / "some_loops.py").write_text(text + "@loop\ndef tripled(x: float) -> float:\n    return 3.0 * x\n")
    log = textwrap.indent(textwrap.dedent(log), "    ").strip()
    program = LOADING.format(folder=str(some_loops), log=log)
    assert _run(program, notices=notices) == "True\n"


def test_a_wait_is_announced_with_its_length_and_whether_it_comes_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for kept, words in ((True, "only this once"), (False, "see `ohmskin doctor`")):
        monkeypatch.setattr(compiled, "is_kept", lambda kept=kept: kept)
        compiled._tell_of_the_wait.__wrapped__()
        assert words in caplog.messages[-1]
        assert compiled.WAIT in caplog.messages[-1]


@pytest.mark.slow
def test_nothing_is_kept_where_no_folder_can_be_written_to(some_loops: Path) -> None:
    (some_loops / "__pycache__").write_text("no folder")
    nowhere = str(some_loops / "some_loops.py")
    elsewhere = {"HOME": nowhere, "XDG_CACHE_HOME": nowhere, "PYTHONDONTWRITEBYTECODE": "1"}
    assert _used(some_loops, notices=1, **elsewhere) == "8.0 False None\n"
    assert _used(some_loops, notices=1, **elsewhere) == "8.0 False None\n"


def test_where_numba_is_told_to_compile_nothing_kernels_run_as_plain_python(some_loops: Path) -> None:
    off = "switched off by NUMBA_DISABLE_JIT"
    assert _used(some_loops, notices=0, NUMBA_DISABLE_JIT="1") == f"8.0 True {off}\n"


def test_no_machine_code_of_the_working_folder_is_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Numba takes the place of machine code from a file there, and unpickles what it finds in that place."""
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    compiled.is_kept()
    assert numba.config.CACHE_DIR == ""


ASIDE = """
    import sys, time
    sys.path.insert(0, {folder!r})
    from ohmskin.common import compiled
    from some_loops import doubled, twice_doubled
    began = compiled.compile_aside()
    print(began, doubled.code is doubled.plain(), twice_doubled(4.0))
    until = time.monotonic() + 300.0
    while compiled.is_aside() and time.monotonic() < until:
        time.sleep(0.05)
    print(doubled.code is doubled.machine_code() is not doubled.plain(), twice_doubled(4.0))
"""


@pytest.mark.slow
def test_another_process_compiles_while_kernels_run_as_plain_python(some_loops: Path) -> None:
    text = (some_loops / "some_loops.py").read_text()
    (some_loops / "some_loops.py").write_text(
        text + "@loop\ndef twice_doubled(x: float) -> float:\n    return doubled(doubled(x))\n"
    )
    program = ASIDE.format(folder=str(some_loops))
    assert _run(program, notices=1) == "True True 16.0\nTrue 16.0\n"
    assert _run(program, notices=0) == "False False 16.0\nTrue 16.0\n"
    assert _run(program, OHMSKIN_COMPILED="off") == "False False 16.0\nFalse 16.0\n"


@pytest.mark.slow
def test_where_no_other_process_can_compile_this_one_does(some_loops: Path) -> None:
    program = ASIDE.format(folder=str(some_loops)).replace(
        "began =", "compiled._PROGRAM = 'raise SystemExit(1)'; began ="
    )
    program = program.replace(", twice_doubled\n", "\n").replace("twice_doubled", "doubled")
    assert _run(program, notices=2) == "True True 8.0\nTrue 8.0\n"
