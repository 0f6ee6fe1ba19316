"""``python -m tests.mutants``: small random faults in the code, and which of them no test notices (mutation testing).

A mutant has one changed expression: another operator, a constant, min for max, a term or a `not` left out, two swapped
arguments. Each is tried in a process forked from this one, where all modules are imported and all kernels are compiled:
its function gets the changed code, the kernels that use it are compiled again, and the tests run that call the
function, the quickest first. Which those are is found out once for each test file and kept in ``build/mutants``.
Programs that a test starts run without the fault. What is limited is processor time.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import gc
import importlib
import json
import os
import pkgutil
import random
import re
import resource
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, NamedTuple

import pytest

import ohmskin
from ohmskin.common import compiled

ROOT = Path(__file__).parent.parent
KEPT = ROOT / "build" / "mutants"
PACKAGES = ("cell", "circuits", "driver", "verification")
TRIAL_CPU_S = 90
"""of one mutant's tests and compiler; a loop without end is a fault that is noticed"""
TESTS_CPU_S = 25.0
"""of the tests that are chosen for one mutant, as long as they took without it"""
MAPPING_CPU_S = 600
"""of one test file when it is looked at which functions its tests call"""
NO_MUTANT = 99
_SWAPS = [
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr), (ast.Lt, ast.GtE), (ast.Gt, ast.LtE),
    (ast.Eq, ast.NotEq), (ast.And, ast.Or), (ast.Is, ast.IsNot), (ast.In, ast.NotIn),
]  # fmt: skip
_OPERATORS = {one: other for swap in _SWAPS for one, other in (swap, swap[::-1])} | {ast.Pow: ast.Mult}
_NAMES = [("min", "max"), ("minimum", "maximum"), ("any", "all"), ("argmin", "argmax"), ("fmin", "fmax")]
_OTHERS = {one: other for swap in _NAMES for one, other in (swap, swap[::-1])}
_EXCLUDED = (ast.Raise, ast.Assert, ast.JoinedStr, ast.arguments, ast.AnnAssign)
"""what reports or states, and does not compute"""

Key = tuple[str, str]
"""file below the root, and qualified name of a function"""
Tests = dict[Key, list[tuple[float, str]]]
"""(s, test), by the function that it calls"""


class Mutant(NamedTuple):
    """One changed expression, and the code of its whole module."""

    key: Key
    text: str
    code: CodeType


def variants(node: ast.AST) -> Iterator[ast.AST]:
    """Other expressions, or statements, in place of this one."""

    def changed(**fields: Any) -> ast.AST:
        other = copy.copy(node)
        vars(other).update(fields)
        return other

    match node:
        case ast.BinOp(left=left, op=op, right=right):
            if type(op) in _OPERATORS and not isinstance(left, ast.Constant | ast.JoinedStr):
                yield changed(op=_OPERATORS[type(op)]())
            if isinstance(op, (ast.Add, ast.Sub, ast.Mult)):
                yield from (left, right)
        case ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in _OPERATORS:
            yield changed(op=_OPERATORS[type(op)]())
        case ast.Compare(ops=[op, *more]) if type(op) in _OPERATORS:
            yield changed(ops=[_OPERATORS[type(op)](), *more])
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield changed(value=not value)
        case ast.Constant(value=int(value)):
            yield changed(value=value + 1)
        case ast.Constant(value=float(value)):
            yield changed(value=2.0 * value if value else 1.0)
        case ast.Call(func=ast.Name(id=name)) if name in _OTHERS:
            yield changed(func=ast.Name(_OTHERS[name], ast.Load()))
        case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in _OTHERS:
            yield changed(func=ast.Attribute(value, _OTHERS[name], ast.Load()))
        case ast.Call(args=[first, second, *more]) if not {type(first), type(second)} & {ast.Starred, ast.Constant}:
            yield changed(args=[second, first, *more])


def mutants_of(path: Path) -> list[Callable[[], Mutant]]:
    """All mutants of a file; one is made when it is called for."""
    file, tree = str(path.relative_to(ROOT)), ast.parse(path.read_text())
    found: list[Callable[[], Mutant]] = []

    def make(name: str, parent: ast.AST, field: str, index: int | None, child: Any, other: ast.AST) -> Mutant:
        before = getattr(parent, field)
        setattr(parent, field, other if index is None else [*before[:index], other, *before[index + 1 :]])
        code = compile(ast.fix_missing_locations(tree), str(path), "exec", dont_inherit=True)
        setattr(parent, field, before)
        return Mutant((file, name), f"{file}:{child.lineno} {name}: {ast.unparse(child)} -> {ast.unparse(other)}", code)

    def walk(node: ast.AST, name: str, within: bool) -> None:
        for field, value in ast.iter_fields(node):
            for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
                if not isinstance(child, ast.AST) or isinstance(child, _EXCLUDED):
                    continue
                if within and field not in ("decorator_list", "returns"):
                    for other in variants(child):
                        place = (name, node, field, index, child, ast.copy_location(other, child))
                        found.append(lambda place=place: make(*place))  # type: ignore[misc]
                is_function = isinstance(child, ast.FunctionDef)
                named = not within and (is_function or isinstance(child, ast.ClassDef))
                walk(child, f"{name}.{child.name}".lstrip(".") if named else name, within or is_function)  # type: ignore[attr-defined]

    walk(tree, "", within=False)
    return found


def infect(mutant: Mutant) -> None:
    """Give the mutant's code to its function in this process; ValueError where that cannot be."""
    (new,) = (code for code in _codes(mutant.code) if code.co_qualname == mutant.key[1])
    functions = [one for one in gc.get_objects() if isinstance(one, FunctionType) and _key(one.__code__) == mutant.key]
    if not functions:
        raise ValueError("no such function is there")
    for function in functions:
        function.__code__ = new
    for cached in ("_signature", "_stamp", "_makes_arrays", "plain"):
        getattr(compiled.Loop, cached).cache_clear()
    compile_it = compiled.Loop._compiled_by_numba
    compiled.Loop._compiled_by_numba = lambda kernel, keep: compile_it(kernel, keep=False)  # type: ignore[method-assign]
    compiled._tell_of_the_wait = lambda: None  # type: ignore[assignment]
    sick = [kernel for kernel in compiled._offered if mutant.key in _kernels_in(kernel)]
    for kernel in sick:
        kernel._compiled = None
    for kernel in sick:
        kernel.load()


def _codes(code: CodeType) -> Iterator[CodeType]:
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield from (part, *_codes(part))


def _key(code: CodeType) -> Key:
    return os.path.realpath(code.co_filename).removeprefix(f"{ROOT}/"), code.co_qualname.partition(".<locals>")[0]


def _kernels_in(kernel: Any) -> set[Key]:
    used = [_kernels_in(one) for one in kernel._globals().values() if isinstance(one, compiled.Loop)]
    return {_key(kernel.function.__code__)}.union(*used)


class Calls:
    """A plugin of pytest: the functions of the packages that each test calls, and its processor time."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[float, list[Key]]] = {}
        self._seen: dict[int, CodeType] = {}  # by identity: the hash of code changes while it runs (Python 3.11)
        self._kernels = {id(kernel.function.__code__): kernel for kernel in compiled._offered}
        for kernel in self._kernels.values():
            code = kernel.function.__code__
            kernel.code, kernel.unchecked = self._noting(code, kernel.code), self._noting(code, kernel.unchecked)

    def _noting(self, code: CodeType, call: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args: (self._seen.setdefault(id(code), code), call(*args))[1]

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            self._seen[id(frame.f_code)] = frame.f_code

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch one test."""
        self._seen.clear()
        began = time.process_time()
        for module in (threading, sys):
            module.setprofile(self._note)
        try:
            return (yield)
        finally:
            for module in (threading, sys):
                module.setprofile(None)  # type: ignore[arg-type]
            keys = {_key(code) for code in self._seen.values()}
            keys = keys.union(*(_kernels_in(self._kernels[code]) for code in self._seen & self._kernels.keys()))
            own = sorted(key for key in keys if key[0].partition("/")[0] in PACKAGES)
            self.found[item.nodeid] = time.process_time() - began, own


def tests_by_function(files: Sequence[Path]) -> Tests:
    """Of the tests of these files, the quickest first."""
    KEPT.mkdir(parents=True, exist_ok=True)
    found: Tests = defaultdict(list)
    for file in files:
        kept = KEPT / f"{file.stem}.json"

        def look(file: Path = file, kept: Path = kept) -> int:
            calls = Calls()
            run_tests([str(file)], calls)
            kept.write_text(json.dumps(calls.found))
            return 0

        if not kept.exists() or kept.stat().st_mtime < file.stat().st_mtime:
            print(f"which functions does {file.name} call?", flush=True)
            in_child(MAPPING_CPU_S, look)
        for test, (spent, keys) in json.loads(kept.read_text()).items() if kept.exists() else ():
            for key in keys:
                found[tuple(key)].append((spent, test))
    return {key: sorted(tests) for key, tests in found.items()}


def run_tests(names: Sequence[str], *plugins: object) -> int:
    """Exit code of pytest, which stops at the first test that fails unless there is a plugin."""
    usual = ["-q", "--assert=plain", "-m", "not slow", "--rootdir", str(ROOT), *([] if plugins else ["-x"])]
    usual += [part for plugin in ("cacheprovider", "randomly", "xdist") for part in ("-p", f"no:{plugin}")]
    return int(pytest.main([*usual, *names], plugins))


def in_child(cpu_s: int, work: Callable[[], int]) -> int:
    """What ``work`` returns in a forked process; -1 where that ends otherwise, or takes more than ``cpu_s``."""
    if pid := os.fork():
        _, status = os.waitpid(pid, 0)
        return os.waitstatus_to_exitcode(status) if os.WIFEXITED(status) else -1
    code = 255
    with contextlib.suppress(BaseException), tempfile.TemporaryFile() as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        limit = int(time.process_time()) + cpu_s
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        code = work()
    os._exit(code)


def outcome(mutant: Mutant, tests: Sequence[tuple[float, str]]) -> str:
    """What becomes of a mutant."""
    chosen = [name for k, (_, name) in enumerate(tests) if not k or sum(s for s, _ in tests[: k + 1]) < TESTS_CPU_S]
    if not chosen:
        return "not called"

    def trial() -> int:
        try:
            infect(mutant)
        except (ValueError, TypeError):  # another number of variables of the function around it
            return NO_MUTANT
        return run_tests(chosen)

    return {0: "survived", NO_MUTANT: "no mutant"}.get(in_child(TRIAL_CPU_S, trial), "killed")


def main() -> int:
    """Run; a line for each survivor, and one for each package."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="mutants, in turn of the packages [40]")
    parser.add_argument("--seed", type=int, default=1, help="another seed makes other mutants [1]")
    parser.add_argument("--only", default="", metavar="PATTERN", help="files, as 'driver/_cl' [all of the packages]")
    parser.add_argument("--tests", default="", metavar="PATTERN", help="test files, as 'test_(cell|filter)' [all]")
    options = parser.parse_args()
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT / "tests")]
    for module in pkgutil.walk_packages(ohmskin.__path__, "ohmskin."):
        if not module.name.endswith("__main__") and "hil.suite" not in module.name:
            with contextlib.suppress(ImportError):
                importlib.import_module(module.name)
    compiled.load()
    made: dict[str, list[Callable[[], Mutant]]] = {}
    for package in PACKAGES:
        files = [
            file
            for file in sorted((ROOT / package).rglob("*.py"))
            if re.search(options.only, str(file.relative_to(ROOT)))
        ]
        if mutants := [mutant for file in files for mutant in mutants_of(file)]:
            made[package] = mutants
    asked = re.compile(rf"ohmskin\.({'|'.join(made)})\b|ohmskin import")
    files = [file for file in sorted((ROOT / "tests").rglob("test_*.py")) if re.search(options.tests, file.name)]
    tests = tests_by_function([file for file in files if asked.search(file.read_text())])
    draw, tally = random.Random(options.seed), {package: Counter[str]() for package in made}
    for number in range(options.count):
        package = list(made)[number % len(made)]
        mutant = draw.choice(made[package])()
        became = outcome(mutant, tests.get(mutant.key, []))
        tally[package][became] += 1
        if became != "killed":
            print(f"{became}: {mutant.text}", flush=True)
    print(f"{'package':<14}{'killed':>9}{'survived':>9}{'not called':>11}{'no mutant':>10}   (seed {options.seed})")
    for package, count in tally.items():
        print(
            f"{package:<14}{count['killed']:>9}{count['survived']:>9}{count['not called']:>11}{count['no mutant']:>10}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
