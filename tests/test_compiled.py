"""Compilation of loops: the compiled form rounds as the written one, and everything works without it."""

from __future__ import annotations

import copy
import math
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from types import FunctionType
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ohmskin.common import compiled
from ohmskin.common.compiled import FixedRow, Flags, Row, Rows, loop

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
def nearest(rows: Rows, at: int) -> float:
    """Twice as long as what the compiler makes a part of its callers of its own accord."""
    low, high = math.inf, -math.inf
    for row in range(1, rows.shape[0]):
        off = math.sqrt(abs(rows[row, at] - rows[0, at])) / (1.0 + abs(rows[row, at]))
        if off < low:
            low, rows[row, at] = off, rows[0, at]
        elif off > high:
            high, rows[0, at] = off, rows[row, at]
        else:
            rows[row, at] = min(max(rows[row, at], rows[0, at] / (1.0 + off)), low + high)
    return math.sqrt(low * low + high * high) / (low + high)


@loop
def summed(rows: Rows) -> float:
    total = 0.0
    for at in range(1, rows.shape[1]):
        total += nearest(rows, at) - nearest(rows, 0)
    return total


@loop
def added(rows: Rows) -> float:
    sums, total = np.zeros(rows.shape[1]), 0.0
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            sums[j] += first_of(rows, i) * rows[i, j]
    for j in range(sums.size):
        total += sums[j] * sums[j]
    return total


@loop
def named(at: int) -> int:
    return len(NAMES[at])


@loop
def grows(a: Row) -> float:
    return a.no_such_attribute  # type: ignore[attr-defined,no-any-return]


numbers = st.lists(st.floats(width=64), min_size=1, max_size=20)


@given(a=numbers, b=numbers)
def test_machine_code_rounds_as_array_operations_do(a: list[float], b: list[float]) -> None:
    code = divided.machine_code()
    assert code is not None, divided.failure or compiled.why_not()
    size = min(len(a), len(b))
    one, other = np.array(a[:size]), np.array(b[:size])
    out, large = np.empty(size), np.zeros(size, dtype=np.bool_)
    with np.errstate(all="ignore"):
        expected = one / other + np.sqrt(np.abs(one)) * other - ENOUGH * other
    assert code(one, other, out, large) == np.count_nonzero(expected > ENOUGH)
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(large, expected > ENOUGH)


def test_a_loop_is_the_same_function_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    code = first_of.machine_code()
    assert code is not None
    assert code is not first_of.function
    rows = np.array([[1.0, 2.0], [3.0, 4.0]])
    assert code(rows, 1) == first_of.function(rows, 1) == 3.0
    monkeypatch.setenv(compiled.SWITCH, "off")
    assert first_of.machine_code() is None
    assert "OHMSKIN_COMPILED=off" in (compiled.why_not() or "")
    monkeypatch.setenv(compiled.SWITCH, "1")
    assert first_of.machine_code() is code


def test_a_loop_is_a_part_of_those_that_call_it_and_counts_no_references() -> None:
    """A call for each cell would take as long as the work that is done there."""
    (native,) = summed._compiled_by_numba(keep=False).inspect_llvm().values()
    calls = [line for line in native.splitlines() if " call " in line]
    assert calls, "the interpreter's functions, of the arguments"
    assert not [line for line in calls if "nearest" in line or "NRT_" in line]


def test_a_loop_that_makes_arrays_is_compiled_as_well() -> None:
    code, rows = added.machine_code(), np.array([[1.0, 2.0], [3.0, 4.0]])
    assert code is not None, added.failure
    assert code(rows) == 10.0**2 + 14.0**2


def test_a_loop_that_was_compiled_for_another_one_first_is_compiled_for_its_own_callers_too() -> None:
    rows = np.array([[1.0, 2.0], [3.0, 4.0]])
    helper = loop(first_of.function)
    plain = cast(FunctionType, added.function)
    user = loop(FunctionType(plain.__code__, {**plain.__globals__, "first_of": helper}, plain.__name__))
    user.function.__annotations__.update(plain.__annotations__)
    assert user.machine_code() is not None, user.failure
    assert helper.machine_code() is helper.code is not helper.function
    assert helper.code(rows, 1) == 3.0


def test_a_compiler_that_does_not_know_an_undocumented_option_compiles_without(monkeypatch: pytest.MonkeyPatch) -> None:
    documented = summed._options().keys() - {"forceinline", "_nrt"}
    assert documented != summed._options().keys()
    monkeypatch.setattr("numba.core.cpu.CPUTargetOptions", object)
    assert summed._options().keys() == documented


def test_arguments_of_other_types_are_refused_rather_than_compiled_for() -> None:
    code = first_of.machine_code()
    assert code is not None
    with pytest.raises(TypeError, match="argument type"):
        code(np.zeros((2, 2), dtype=np.float32), 0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="argument type"):
        code(np.zeros((4, 4))[:, ::2], 0)


def test_without_a_look_at_types_loops_answer_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests look at the types in calls that else do not, so that no caller goes wrong unseen."""
    assert first_of.machine_code() is first_of.code is first_of.unchecked
    monkeypatch.delenv(compiled.SWITCH, raising=False)
    usual, rows = loop(first_of.function), np.arange(12.0).reshape(3, 4)
    code = usual.machine_code()
    assert code is usual.code is not usual.unchecked
    assert code(rows, 2) == usual.unchecked(rows, 2) == 8.0
    with pytest.raises(TypeError, match="argument type"):
        code(rows.T, 2)


def test_arrays_that_nobody_may_write_to_are_taken_where_the_loop_says_so() -> None:
    code = divided.machine_code()
    assert code is not None
    fixed, out = np.array([4.0]), np.empty(1)
    fixed.flags.writeable = False
    code(fixed, fixed, out, np.zeros(1, dtype=np.bool_))
    assert out[0] == 1.0 + 8.0 - 10.0
    with pytest.raises(TypeError, match="argument type"):
        code(fixed, fixed, fixed, np.zeros(1, dtype=np.bool_))


@pytest.mark.parametrize(("refused", "why"), [(named, "neither a number nor a loop"), (grows, "no_such_attribute")])
def test_what_cannot_be_compiled_says_why_and_is_left_to_array_operations(
    refused: compiled.Loop[[int], int], why: str
) -> None:
    assert refused.machine_code() is None
    assert why in (refused.failure or "")


def test_loops_are_copied_and_pickled_by_name() -> None:
    assert copy.deepcopy(divided) is divided
    assert divided.__reduce__() == "divided"


def test_the_name_on_disk_changes_with_the_numbers_and_helpers_that_are_compiled_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = rooted._stamp(), divided._stamp()
    assert (rooted._stamp(), divided._stamp()) == before
    monkeypatch.setitem(globals(), "ENOUGH", 2.0)
    after = rooted._stamp(), divided._stamp()
    assert after[0] != before[0]
    assert after[1] != before[1]


def _run(program: str, *, told: int = 0, **variables: str) -> str:
    """What a new interpreter prints that treats warnings as errors.

    Args:
        program: of Python, indented.
        told: lines that it writes to standard error, all of them of a wait for the compiler.
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
    assert all(line.startswith("ohmskin[fast] compiles") for line in lines), done.stderr
    assert len(lines) == told
    return done.stdout


def test_importing_the_package_does_not_import_the_compiler() -> None:
    program = "import sys, ohmskin.cell, ohmskin.driver, ohmskin.cli; print('numba' in sys.modules)"
    assert _run(program) == "False\n"


USE = """
    from ohmskin.common import compiled
    from some_loops import doubled
    code = doubled.machine_code()
    print(code and code(4.0), doubled.failure, compiled.why_not())
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


def _used(folder: Path, *, told: int, **variables: str) -> str:
    return _run(f"import sys; sys.path.insert(0, {str(folder)!r})\n" + textwrap.dedent(USE), told=told, **variables)


@pytest.mark.slow
def test_machine_code_is_kept_for_the_next_process_and_renewed_when_damaged(some_loops: Path) -> None:
    assert _used(some_loops, told=1) == "8.0 None None\n"
    kept = list((some_loops / "__pycache__").glob("*.nb?"))
    assert len(kept) == 2, "an index and the code"
    times = [file.stat().st_mtime_ns for file in kept]
    assert _used(some_loops, told=0) == "8.0 None None\n"
    assert [file.stat().st_mtime_ns for file in kept] == times, "taken from disk"
    for file in kept:
        file.write_bytes(b"damaged")
    assert _used(some_loops, told=1) == "8.0 None None\n"


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
    ("log", "told"),
    [
        pytest.param("", 1, id="a program that sets up no log"),
        pytest.param("logging.basicConfig(format='%(message)s')", 1, id="a program that shows its log"),
        pytest.param("logging.basicConfig(level=logging.ERROR)", 0, id="a program that wants no warnings"),
        pytest.param(COMMAND.format(watched=True), 1, id="a command on a terminal"),
        pytest.param(COMMAND.format(watched=False), 0, id="a command that nobody watches"),
    ],
)
def test_a_wait_for_the_compiler_is_told_once(some_loops: Path, log: str, told: int) -> None:
    text = (some_loops / "some_loops.py").read_text()
    (some_loops / "some_loops.py").write_text(text + "@loop\ndef tripled(x: float) -> float:\n    return 3.0 * x\n")
    log = textwrap.indent(textwrap.dedent(log), "    ").strip()
    program = LOADING.format(folder=str(some_loops), log=log)
    assert _run(program, told=told) == "True\n"


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
    assert _used(some_loops, told=1, **elsewhere) == "8.0 None None\n"
    assert _used(some_loops, told=1, **elsewhere) == "8.0 None None\n"


def test_where_numba_compiles_nothing_array_operations_do_the_work(some_loops: Path) -> None:
    """It would hand out the loops as they are written, which take ten times as long as array operations."""
    off = "switched off by NUMBA_DISABLE_JIT"
    assert _used(some_loops, told=0, NUMBA_DISABLE_JIT="1") == f"None None {off}\n"


def test_without_numba_there_is_no_machine_code(some_loops: Path) -> None:
    (some_loops / "numba.py").write_text("raise ModuleNotFoundError('no numba', name='numba')")
    assert _used(some_loops, told=0) == "None None numba is not installed\n"
    (some_loops / "numba.py").write_text("raise ImportError('Numba needs NumPy 2.4 or less')")
    assert _used(some_loops, told=0) == "None None numba cannot be imported: Numba needs NumPy 2.4 or less\n"
