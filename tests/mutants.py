"""``python -m tests.mutants``: small random faults in the code, and which of them no test notices (mutation testing).

A mutant has one changed expression: another operator, a constant, min for max, a term or a `not` left out, two swapped
arguments. Each is tried in a process forked from this one, where all modules are imported and all kernels are compiled:
its function gets the changed code, the kernels that use it are compiled again, and the tests run that reach the changed
line (of a kernel: that call it), the quickest of each file first. Which those are is found out once for each test file
and kept in ``build/mutants``. Programs that a test starts run without the fault. What is limited is processor time.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import functools
import gc
import hashlib
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
from itertools import chain, zip_longest
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NamedTuple

import pytest
from coverage import Coverage

import ohmskin
from ohmskin.common import compiled

ROOT = Path(__file__).parent.parent
KEPT = ROOT / "build" / "mutants"
PACKAGES = ("cell", "circuits", "driver", "verification")
COMPILING_CPU_S = 60
"""of one mutant beside its tests; a loop without end is a fault that is noticed"""
TESTS_CPU_S = 25.0
"""of the tests that are chosen for one mutant, as long as they took without it"""
MAPPING_CPU_S = 900
"""of one test file when the lines that its tests reach are noted"""
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
_EXCLUDED_ARGUMENTS = {"axis", "daemon", "maxsize", "stacklevel", "strict"}
"""keywords whose other value is an error, or is the same for the arrays at hand"""
_EXCLUDED_CALLS = {"cast", "debug", "info", "print", "warn", "warning"}
_EXCLUDED_FUNCTIONS = re.compile(r"cost|.*figures?|.*picture|_?said|words?|in_words|describe")
"""that only say how much something costs, draw, or word: a test of them would repeat their text"""
_EXCLUDED_FILES = {"_schematic.py", "_pictures.py"}
"""of drawings, whose faults are seen and not computed"""
_SYMMETRIC = {
    "add",
    "allclose",
    "array_equal",
    "gcd",
    "hypot",
    "isclose",
    "logaddexp",
    "multiply",
    "suppress",
    *_OTHERS,
}
"""functions whose first two arguments may be swapped"""
_GUARD = 1e-6
"""size of a float below which it keeps a division or a comparison from rounding; twice that is no other law"""

Key = tuple[str, str]
"""file below the root, and qualified name of a function"""
KERNEL = -1
"""in place of a line of a kernel, whose lines are not seen when it is compiled"""
Reached = dict[Key, dict[int, set[str]]]
"""the tests that reach a line, which is counted from the first of its function"""


class Map(NamedTuple):
    """What the tests of some files reach."""

    spent: dict[str, dict[str, float]]
    """(s) of each test by what takes it: the test itself, and the fixtures that it shares with others"""
    reached: Reached
    stale: set[Key]
    """functions that were changed since"""

    def tests(self, mutant: Mutant, cpu_s: float) -> list[str]:
        """Those for a mutant: in turn of the files, of each the quickest first, for ``cpu_s`` in all."""
        lines = self.reached.get(mutant.key, {})
        asked = lines if mutant.key in self.stale else (KERNEL, *mutant.lines)
        by_file: dict[str, list[str]] = defaultdict(list)
        for test in sorted(set().union(*(lines.get(line, ()) for line in asked)), key=self._alone):
            by_file[test.partition("::")[0]].append(test)
        queues = sorted(by_file.values(), key=lambda tests: self._alone(tests[0]))
        chosen: list[str] = []
        paid: dict[str, float] = {}
        for test in (test for test in chain(*zip_longest(*queues)) if test is not None):
            if not chosen or sum((paid | self.spent[test]).values()) < cpu_s:
                chosen.append(test)
                paid |= self.spent[test]
        return chosen

    def _alone(self, test: str) -> float:
        return sum(self.spent[test].values())


class Mutant(NamedTuple):
    """One changed expression, and the code of its whole module."""

    key: Key
    lines: range
    """of its statement, to that of the change"""
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
            yield changed(value=value + 1 if abs(value) < 10 else 2 * value)
        case ast.Constant(value=float(value)) if not 0.0 < value < _GUARD:
            yield changed(value=2.0 * value if value else 1.0)
        case ast.Call(func=ast.Name(id=name)) if name in _OTHERS:
            yield changed(func=ast.Name(_OTHERS[name], ast.Load()))
        case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in _OTHERS:
            yield changed(func=ast.Attribute(value, _OTHERS[name], ast.Load()))
        case ast.Call(args=[first, second, *more], func=func) if not (
            {type(first), type(second)} & {ast.Starred, ast.Constant} or _name(func) in _SYMMETRIC | {"isinstance"}
        ):
            yield changed(args=[second, first, *more])


def _name(function: ast.expr) -> str:
    return ast.unparse(function).rpartition(".")[2]


def _says_nothing(node: ast.AST) -> bool:
    """Whether no test needs to know the difference."""
    match node:
        case ast.keyword(arg=name):
            return name in _EXCLUDED_ARGUMENTS
        case ast.Call(func=func):
            return _name(func) in _EXCLUDED_CALLS
    return isinstance(node, _EXCLUDED)


def mutants_of(path: Path) -> list[Callable[[], Mutant]]:
    """All mutants of a file; one is made when it is called for."""
    file, tree = str(path.relative_to(ROOT)), ast.parse(path.read_text())
    found: list[Callable[[], Mutant]] = []

    def make(
        name: str, lines: range, parent: ast.AST, field: str, index: int | None, child: Any, other: ast.AST
    ) -> Mutant:
        before = getattr(parent, field)
        setattr(parent, field, other if index is None else [*before[:index], other, *before[index + 1 :]])
        code = compile(ast.fix_missing_locations(tree), str(path), "exec", dont_inherit=True)
        setattr(parent, field, before)
        text = f"{file}:{child.lineno} {name}: {ast.unparse(child)} -> {ast.unparse(other)}"
        return Mutant((file, name), lines, text, code)

    def walk(node: ast.AST, name: str, function: int, statement: int) -> None:
        """Outside of all functions ``function``, the line at which it begins, is 0."""
        for field, value in ast.iter_fields(node):
            for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
                if not isinstance(child, ast.AST) or _says_nothing(child):
                    continue
                begin = child.lineno if isinstance(child, ast.stmt) else statement
                if function and field not in ("decorator_list", "returns"):
                    for other in variants(child):
                        lines = range(begin - function, child.lineno - function + 1)  # type: ignore[attr-defined]
                        place = (name, lines, node, field, index, child, ast.copy_location(other, child))
                        found.append(lambda place=place: make(*place))  # type: ignore[misc]
                inner, first = name, function
                if not function and isinstance(child, ast.FunctionDef | ast.ClassDef):
                    inner = f"{name}.{child.name}".lstrip(".")
                    first = child.lineno if isinstance(child, ast.FunctionDef) else 0
                    if first and _EXCLUDED_FUNCTIONS.fullmatch(child.name):
                        continue
                walk(child, inner, first, begin)

    walk(tree, "", 0, 0)
    return found


class Functions(NamedTuple):
    """The functions of a file that are in no other one."""

    names: dict[int, tuple[str, int]]
    """name and first line, by line"""
    digests: dict[str, str]
    """of the text, by name"""

    @classmethod
    @functools.cache
    def of(cls, path: Path) -> Functions:
        """Of a file."""
        found, text = cls({}, {}), path.read_text()

        def walk(node: ast.AST, name: str) -> None:
            for child in ast.iter_child_nodes(node):
                inner = f"{name}.{getattr(child, 'name', '')}".lstrip(".")
                if isinstance(child, ast.FunctionDef):
                    lines = range(child.lineno, (child.end_lineno or 0) + 1)
                    found.names.update(dict.fromkeys(lines, (inner, child.lineno)))
                    found.digests[inner] = _digest(ast.get_source_segment(text, child) or "")
                elif isinstance(child, ast.ClassDef):
                    walk(child, inner)

        walk(ast.parse(text), "")
        return found


def _digest_of(key: Key) -> str | None:
    path = ROOT / key[0]
    return Functions.of(path).digests.get(key[1]) if path.exists() else None


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=6).hexdigest()


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


class Lines:
    """A plugin of pytest: the lines of the packages that each test reaches, and its processor time.

    What a fixture that several tests share reaches, and its time, counts for each of them.
    """

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self._fixtures: dict[str, set[str]] = {}
        self._kernels: dict[Key, set[str]] = defaultdict(set)
        self._coverage = Coverage(data_file=None, config_file=False, source=[str(ROOT / name) for name in PACKAGES])
        self._context = ""
        for kernel in compiled._offered:
            keys = _kernels_in(kernel)
            kernel.code, kernel.unchecked = self._noting(keys, kernel.code), self._noting(keys, kernel.unchecked)
        self._coverage.start()

    def _noting(self, keys: set[Key], call: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*args: Any) -> Any:
            for key in keys:
                self._kernels[key].add(self._context)
            return call(*args)

        return noted

    @contextlib.contextmanager
    def _within(self, context: str) -> Iterator[None]:
        before, self._context = self._context, context
        self._coverage.switch_context(context)
        began = time.process_time()
        try:
            yield
        finally:
            spent = time.process_time() - began
            self.spent[context] += spent
            if before:
                self.spent[before] -= spent
            self._context = before
            self._coverage.switch_context(before)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch one test, which finds no result of an earlier one."""
        for one in gc.get_objects():
            if isinstance(one, functools._lru_cache_wrapper):
                file = getattr(getattr(one.__wrapped__, "__code__", None), "co_filename", "")
                if os.path.realpath(file).startswith(f"{ROOT}/") and not file.endswith(("compiled.py", "mutants.py")):
                    one.cache_clear()
        self._fixtures[item.nodeid] = {f"fixture {name}" for name in getattr(item, "fixturenames", ())}
        with self._within(item.nodeid):
            return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
        """Watch a fixture that several tests share."""
        if fixturedef.scope == "function":
            return (yield)
        with self._within(f"fixture {fixturedef.argname}"):
            return (yield)

    def found(self) -> dict[str, Any]:
        """For a file."""
        self._coverage.stop()
        lines: dict[Key, dict[int, set[str]]] = defaultdict(lambda: defaultdict(set))
        data = self._coverage.get_data()
        for file in data.measured_files():
            path = Path(file)
            names = Functions.of(path).names
            for line, contexts in data.contexts_by_lineno(file).items():
                if line in names:
                    name, first = names[line]
                    lines[str(path.relative_to(ROOT)), name][line - first] |= set(contexts)
        for key, contexts in self._kernels.items():
            lines[key][KERNEL] |= contexts
        users: dict[str, set[int]] = defaultdict(set)
        for k, (test, fixtures) in enumerate(self._fixtures.items()):
            for context in (test, *fixtures):
                users[context].add(k)
        rows = [
            (
                *key,
                Functions.of(ROOT / key[0]).digests.get(key[1]),
                line,
                sorted({k for c in contexts for k in users[c]}),
            )
            for key, by_line in lines.items()
            for line, contexts in by_line.items()
        ]
        spent = {
            test: {one: self.spent[one] for one in (test, *fixtures) if one in self.spent}
            for test, fixtures in self._fixtures.items()
        }
        return {"spent": spent, "lines": [row for row in rows if row[-1]]}


def map_of(files: Sequence[Path]) -> Map:
    """What the tests of these files reach."""
    KEPT.mkdir(parents=True, exist_ok=True)
    whole = Map({}, defaultdict(lambda: defaultdict(set)), set())
    for file in files:
        digest = _digest(file.read_text())
        kept = KEPT / f"{file.stem}.json"

        def look(file: Path = file, kept: Path = kept, digest: str = digest) -> int:
            lines = Lines()
            run_tests([str(file)], lines)
            kept.write_text(json.dumps({"digest": digest, **lines.found()}))
            return 0

        if not kept.exists() or json.loads(kept.read_text())["digest"] != digest:
            began = time.monotonic()
            code = in_child(MAPPING_CPU_S, look)
            print(f"mapped {file.name} in {time.monotonic() - began:.0f} s{' in vain' if code else ''}", flush=True)
        if not kept.exists():
            continue
        found = json.loads(kept.read_text())
        whole.spent.update(found["spent"])
        names = list(found["spent"])
        for source, name, digest_then, line, tests in found["lines"]:
            whole.reached[source, name][line] |= {names[k] for k in tests}
            if _digest_of((source, name)) != digest_then:
                whole.stale.add((source, name))
    return whole


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


def outcome(mutant: Mutant, tests: Sequence[str], cpu_s: float) -> str:
    """What becomes of a mutant."""
    if not tests:
        return "not reached"

    def trial() -> int:
        try:
            infect(mutant)
        except (ValueError, TypeError):  # another number of variables of the function around it
            return NO_MUTANT
        return run_tests(tests)

    code = in_child(int(COMPILING_CPU_S + 3.0 * cpu_s), trial)
    return {0: "survived", NO_MUTANT: "no mutant"}.get(code, "killed")


def main() -> int:
    """Run; a line for each survivor, and one for each package."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="mutants, in turn of the packages [40]")
    parser.add_argument("--seed", type=int, default=1, help="another seed makes other mutants [1]")
    parser.add_argument("--only", default="", metavar="PATTERN", help="files, as 'driver/_cl' [all of the packages]")
    parser.add_argument("--tests", default="", metavar="PATTERN", help="test files, as 'test_(cell|filter)' [all]")
    parser.add_argument("--seconds", type=float, default=TESTS_CPU_S, help="of tests for one mutant [%(default)g]")
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
            if re.search(options.only, str(file.relative_to(ROOT))) and file.name not in _EXCLUDED_FILES
        ]
        if mutants := [mutant for file in files for mutant in mutants_of(file)]:
            made[package] = mutants
    asked = re.compile(rf"ohmskin\.({'|'.join(made)})\b|ohmskin import")
    files = [file for file in sorted((ROOT / "tests").rglob("test_*.py")) if re.search(options.tests, file.name)]
    reached = map_of([file for file in files if asked.search(file.read_text())])
    draw, tally = random.Random(options.seed), {package: Counter[str]() for package in made}
    for number in range(options.count):
        package = list(made)[number % len(made)]
        mutant = draw.choice(made[package])()
        tests = reached.tests(mutant, options.seconds)
        became = outcome(mutant, tests, options.seconds)
        tally[package][became] += 1
        if became != "killed":
            print(f"{number + 1} {became}: {mutant.text}   ({len(tests)} tests)", flush=True)
    columns = ("killed", "survived", "not reached", "no mutant")
    print(f"{'package':<14}", *(f"{name:>11}" for name in columns), f"   (seed {options.seed})")
    for package, count in tally.items():
        print(f"{package:<14}", *(f"{count[name]:>11}" for name in columns))
    return 0


if __name__ == "__main__":
    sys.exit(main())
