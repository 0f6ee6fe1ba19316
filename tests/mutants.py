"""``python -m tests.mutants``: small random faults in the code, and which of them no test notices (mutation testing).

A mutant has one changed expression: another operator, a constant, min for max, a term or a `not` left out, two swapped
arguments. Each mutant is tried in a process forked from this one, where all modules are imported and all kernels are
compiled: its function gets the changed code, the kernels that use it are compiled again, and the tests run that call
the function, the quickest first. Which those are is found out once for each test file and kept in ``build/mutants``.
Programs that a test starts run without the fault. Processor time is limited, not time.
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
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import pytest

import ohmskin
from ohmskin.common import compiled

ROOT = Path(__file__).parent.parent
KEPT = ROOT / "build" / "mutants"
PACKAGES = ("cell", "circuits", "driver", "verification")
TRIAL_CPU_S = 90
"""of the tests of one mutant, and of their kernels' compiler; a loop without end is a fault that is noticed"""
TESTS_CPU_S = 25.0
"""of the tests that are chosen for one mutant"""
MAPPING_CPU_S = 600
"""of one test file when it is looked at which functions its tests call"""
_PAIRS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE,
    ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or, ast.Or: ast.And, ast.Is: ast.IsNot,
    ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_OTHERS = {"min": "max", "minimum": "maximum", "any": "all", "argmin": "argmax", "floor": "ceil", "fmin": "fmax"}
_OTHERS |= {other: name for name, other in _OTHERS.items()}
_EXCLUDED = (ast.Raise, ast.Assert, ast.JoinedStr, ast.arguments, ast.AnnAssign)
"""what reports or states, and does not compute"""

Key = tuple[str, str]
"""file below the root, and qualified name of a function"""


@dataclass(frozen=True)
class Mutant:
    """One changed expression."""

    key: Key
    line: int
    before: str
    after: str
    code: CodeType
    """of the whole module"""

    def __str__(self) -> str:
        return f"{self.key[0]}:{self.line} {self.key[1]}: {self.before}  ->  {self.after}"


# -- mutants -----------------------------------------------------------------------------------------------------------


def variants(node: ast.AST) -> Iterator[ast.AST]:
    """Other expressions in place of this one, or statements."""

    def changed(**fields: Any) -> ast.AST:
        other = copy.copy(node)
        for name, value in fields.items():
            setattr(other, name, value)
        return other

    match node:
        case ast.BinOp(left=left, op=op, right=right):
            if type(op) in _PAIRS and not isinstance(left, ast.Constant | ast.JoinedStr):
                yield changed(op=_PAIRS[type(op)]())
            if isinstance(op, (ast.Add, ast.Sub, ast.Mult)):
                yield left
                yield right
        case ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in _PAIRS:
            yield changed(op=_PAIRS[type(op)]())
        case ast.Compare(ops=[op, *more]) if type(op) in _PAIRS:
            yield changed(ops=[_PAIRS[type(op)](), *more])
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield changed(value=not value)
        case ast.Constant(value=int(value)):
            yield changed(value=value + 1)
        case ast.Constant(value=float(value)):
            yield changed(value=2.0 * value if value else 1.0)
        case ast.Call(func=ast.Name(id=name)) if name in _OTHERS and name not in ("floor", "ceil"):
            yield changed(func=ast.Name(_OTHERS[name], ast.Load()))
        case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in _OTHERS:
            yield changed(func=ast.Attribute(value, _OTHERS[name], ast.Load()))
        case ast.Call(args=[first, second, *more]) if not {type(first), type(second)} & {ast.Starred, ast.Constant}:
            yield changed(args=[second, first, *more])


def _places(node: ast.AST, name: str = "") -> Iterator[tuple[str, ast.AST, str, int | None]]:
    """Qualified name of the outermost function, parent, field and index of whatever may be replaced."""
    for field, value in ast.iter_fields(node):
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST) or isinstance(child, _EXCLUDED) or field in ("decorator_list", "returns"):
                continue
            inside = name
            if isinstance(child, ast.ClassDef) or (isinstance(child, ast.FunctionDef) and not name.endswith("()")):
                inside = f"{name}.{child.name}".lstrip(".") + "()" * isinstance(child, ast.FunctionDef)
            if name.endswith("()"):
                yield name[:-2], node, field, index
            yield from _places(child, inside)


def mutants_of(path: Path) -> list[Callable[[], Mutant]]:
    """All mutants of a file; a mutant is made when it is called for."""
    text = path.read_text()
    file = str(path.relative_to(ROOT))
    tree = ast.parse(text)

    def make(name: str, parent: ast.AST, field: str, index: int | None, other: ast.AST) -> Mutant:
        before = getattr(parent, field)
        child = before if index is None else before[index]
        after = other if index is None else [*before[:index], other, *before[index + 1 :]]
        setattr(parent, field, after)
        code = compile(ast.fix_missing_locations(tree), str(path), "exec", dont_inherit=True)
        setattr(parent, field, before)
        return Mutant((file, name), child.lineno, ast.unparse(child), ast.unparse(other), code)

    found: list[Callable[[], Mutant]] = []
    for name, parent, field, index in _places(tree):
        child = getattr(parent, field) if index is None else getattr(parent, field)[index]
        for other in variants(child):
            place = (name, parent, field, index, ast.copy_location(other, child))
            found.append(lambda place=place: make(*place))  # type: ignore[misc]
    return found


def infect(mutant: Mutant) -> None:
    """Give the mutant's code to the function, in this process, and compile anew what kernels it is in."""
    (new,) = (code for code in _codes(mutant.code) if code.co_qualname == mutant.key[1])
    functions = [
        each for each in gc.get_objects() if isinstance(each, FunctionType) and _key(each.__code__) == mutant.key
    ]
    if not functions:
        raise ValueError("no such function is there")
    for function in functions:
        function.__code__ = new
    for cached in ("_signature", "_stamp", "_makes_arrays", "plain"):
        getattr(compiled.Loop, cached).cache_clear()
    compile_it = compiled.Loop._compiled_by_numba
    compiled.Loop._compiled_by_numba = lambda kernel, keep: compile_it(kernel, keep=False)  # type: ignore[method-assign]
    compiled._tell_of_the_wait = lambda: None  # type: ignore[assignment]
    sick = [kernel for kernel in compiled._offered if {mutant.key} & set(_kernels_in(kernel))]
    for kernel in sick:
        kernel._compiled = None
    compiled.load(*sick)


def _codes(code: CodeType) -> Iterator[CodeType]:
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield part
            yield from _codes(part)


def _key(code: CodeType) -> Key:
    path = os.path.realpath(code.co_filename)
    return path.removeprefix(f"{ROOT}/"), code.co_qualname.partition(".<locals>")[0]


def _kernels_in(kernel: Any) -> Iterator[Key]:
    yield _key(kernel.function.__code__)
    for used in kernel._globals().values():
        if isinstance(used, compiled.Loop):
            yield from _kernels_in(used)


# -- which tests call a function ---------------------------------------------------------------------------------------


class Calls:
    """A plugin of pytest: the functions of the packages that each test calls, and its processor time."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[float, list[Key]]] = {}
        self._seen: set[CodeType] = set()
        for kernel in compiled._offered:
            kernel.code, kernel.unchecked = self._watched(kernel, kernel.code), self._watched(kernel, kernel.unchecked)

    def _watched(self, kernel: Any, code: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            self._seen.add(kernel.function.__code__)
            return code(*args)

        return call

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            self._seen.add(frame.f_code)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch one test."""
        import threading

        self._seen.clear()
        began = time.process_time()
        threading.setprofile(self._note)
        sys.setprofile(self._note)
        try:
            return (yield)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)  # type: ignore[arg-type]
            kernels = {kernel.function.__code__: kernel for kernel in compiled._offered}
            keys = {_key(code) for code in self._seen}
            keys |= {key for code in self._seen & kernels.keys() for key in _kernels_in(kernels[code])}
            own = sorted(key for key in keys if key[0].partition("/")[0] in PACKAGES)
            self.found[item.nodeid] = time.process_time() - began, own


def tests_by_function(files: Sequence[Path]) -> dict[Key, list[tuple[float, str]]]:
    """(s, test) of the tests of these files by the function that they call, the quickest first."""
    KEPT.mkdir(parents=True, exist_ok=True)
    found: dict[Key, list[tuple[float, str]]] = defaultdict(list)
    for file in files:
        kept = KEPT / f"{file.stem}.json"
        if not kept.exists() or kept.stat().st_mtime < file.stat().st_mtime:
            print(f"which functions does {file.name} call?", flush=True)
            in_child(MAPPING_CPU_S, lambda file=file, kept=kept: _map(file, kept))  # type: ignore[misc]
        for test, (spent, keys) in json.loads(kept.read_text()).items() if kept.exists() else ():
            for key in keys:
                found[tuple(key)].append((spent, test))
    return {key: sorted(tests) for key, tests in found.items()}


def _map(file: Path, kept: Path) -> int:
    calls = Calls()
    run_tests([str(file)], calls)
    kept.write_text(json.dumps(calls.found))
    return 0


def run_tests(names: Sequence[str], *plugins: object) -> int:
    """Exit code of pytest, which stops at the first test that fails unless there is a plugin."""
    usual = ["-q", "--assert=plain", "-m", "not slow", "--rootdir", str(ROOT)]
    usual += [part for plugin in ("cacheprovider", "randomly", "xdist") for part in ("-p", f"no:{plugin}")]
    return int(pytest.main([*usual, *([] if plugins else ["-x"]), *names], plugins))


def in_child(cpu_s: int, work: Callable[[], int]) -> int:
    """What ``work`` returns in a forked process; -1 where that ends otherwise, or takes more than ``cpu_s``."""
    pid = os.fork()
    if pid:
        _, status = os.waitpid(pid, 0)
        return os.waitstatus_to_exitcode(status) if os.WIFEXITED(status) else -1
    code = 255
    with contextlib.suppress(BaseException), tempfile.TemporaryFile() as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        spent = int(time.process_time())
        resource.setrlimit(resource.RLIMIT_CPU, (spent + cpu_s, spent + cpu_s + 5))
        code = work()
    os._exit(code)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; the survivors are printed, a line each, and a line for each package."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=50, help="mutants [50]")
    parser.add_argument("--seed", type=int, default=1, help="another seed makes other mutants [1]")
    parser.add_argument("--only", default="", metavar="PATTERN", help="files, as 'driver/_cl' [all of the packages]")
    parser.add_argument("--tests", default="", metavar="PATTERN", help="test files, as 'test_(cell|filter)' [all]")
    options = parser.parse_args(arguments)
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT / "tests")]
    for module in pkgutil.walk_packages(ohmskin.__path__, "ohmskin."):
        with contextlib.suppress(ImportError):
            if not module.name.endswith("__main__") and "hil.suite" not in module.name:
                importlib.import_module(module.name)
    compiled.load()
    files = [file for name in PACKAGES for file in sorted((ROOT / name).rglob("*.py"))]
    files = [file for file in files if re.search(options.only, str(file.relative_to(ROOT)))]
    packages = {file.relative_to(ROOT).parts[0] for file in files}
    asked = re.compile(rf"ohmskin\.({'|'.join(packages)})\b|ohmskin import")
    test_files = [file for file in sorted((ROOT / "tests").rglob("test_*.py")) if re.search(options.tests, file.name)]
    tests = tests_by_function([file for file in test_files if asked.search(file.read_text())])
    rng = random.Random(options.seed)
    made = {
        package: [m for file in files if file.relative_to(ROOT).parts[0] == package for m in mutants_of(file)]
        for package in sorted(packages)
    }
    tally: dict[str, Counter[str]] = {package: Counter() for package in made}
    for number in range(options.count):
        package = sorted(made)[number % len(made)]
        mutant = rng.choice(made[package])()
        outcome = judge(mutant, tests.get(mutant.key, []))
        tally[package][outcome] += 1
        if outcome != "killed":
            print(f"{outcome}: {mutant}", flush=True)
    print(f"{'package':<14} {'mutants':>8} {'killed':>8} {'survived':>8} {'not called':>10}   (seed {options.seed})")
    for package, count in tally.items():
        print(f"{package:<14} {count.total():>8} {count['killed']:>8} {count['survived']:>8} {count['not called']:>10}")
    return 0


def judge(mutant: Mutant, tests: Sequence[tuple[float, str]]) -> str:
    """What becomes of a mutant."""
    chosen, spent = [], 0.0
    for took, name in tests:
        spent += took
        if chosen and spent > TESTS_CPU_S:
            break
        chosen.append(name)
    if not chosen:
        return "not called"

    def trial() -> int:
        try:
            infect(mutant)
        except (ValueError, TypeError, SyntaxError):
            return 99  # another number of free variables
        return run_tests(chosen)

    return {0: "survived", 99: "no mutant"}.get(in_child(TRIAL_CPU_S, trial), "killed")


if __name__ == "__main__":
    sys.exit(main())
