"""The packages know only those below them (docs/design.md)."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from patience import HANG_S

from ohmskin.circuits.readouts import CIRCUITS

ROOT = Path(__file__).parent.parent
SHARED = {"common", "errors"}
MAY_IMPORT = {
    "common": {"errors"},
    "circuits": SHARED,
    "cell": SHARED,
    "kicad": SHARED | {"circuits"},
    "wire": SHARED,
    "bench": SHARED | {"circuits", "cell", "wire", "emulator", "driver", "view"},
    "emulator": SHARED | {"circuits", "cell", "wire"},
    "driver": SHARED | {"circuits", "cell", "wire"},
    "calibration": SHARED | {"circuits", "cell", "wire", "driver"},
    "doctor": SHARED | {"circuits", "wire", "driver"},
    "hil": SHARED | {"circuits", "driver", "emulator"},
    "view": SHARED | {"circuits", "driver"},
    "verification": SHARED | {"circuits", "cell", "wire", "emulator", "driver"},
}
PACKAGES = [*MAY_IMPORT, "errors", "cli"]

CELL_MAY_IMPORT = {
    "_state": set(),
    "materials": set(),
    "estimation": {"_state", "materials"},
    "inversions": {"_state", "materials", "estimation"},
    "_cell": {"materials", "estimation", "inversions"},
    "identification": {"materials", "estimation", "inversions", "_cell"},
}
"""The parts of the package cell: the state of a cell, three sub-packages, CELL.toml, and the sub-package above it."""


def _place(file: Path) -> tuple[str, ...]:
    """Folders and name of a module below the package, whose root is src/ohmskin and the packages beside it."""
    top = ROOT / "src/ohmskin"
    return file.relative_to(top if file.is_relative_to(top) else ROOT).parts


@cache
def _imports(file: Path) -> frozenset[str]:
    """First names below ``ohmskin`` that a module imports, and the top-level modules of other packages."""
    package = ["ohmskin", *_place(file)[:-1]]
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = [*base, *(node.module.split(".") if node.module else [])]
            found |= {".".join([*stem, name.name]) for name in node.names}
    return frozenset(found)


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_imports_only_what_is_below_it(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    for file in files:
        imports = _imports(file)
        bare = {name.split(".")[0] for name in imports} & MAY_IMPORT.keys()
        assert not bare, f"{file.relative_to(ROOT)} imports {bare} without the package name ohmskin"
        inner = {name.split(".")[1] for name in imports if name.startswith("ohmskin.")}
        forbidden = inner - MAY_IMPORT[package] - {package, "__version__"}
        assert not forbidden, f"{file.relative_to(ROOT)} imports {forbidden}"


def test_solvers_know_conductances_and_lines_only() -> None:
    """Nothing of circuits but themselves: no Design, no Board, no readout."""
    files = sorted((ROOT / "circuits/solvers").glob("*.py"))
    assert len(files) > 5
    for file in files:
        inner = {name for name in _imports(file) if name.startswith("ohmskin.")}
        allowed = ("ohmskin.common.arrays", "ohmskin.common.compiled", "ohmskin.errors", "ohmskin.circuits.solvers")
        assert all(name.startswith(allowed) for name in inner), f"{file.name} imports {inner}"


@pytest.mark.parametrize("part", CELL_MAY_IMPORT)
def test_a_part_of_the_cell_imports_only_what_is_below_it(part: str) -> None:
    files = sorted((ROOT / "cell" / part).glob("*.py")) or [ROOT / "cell" / f"{part}.py"]
    assert files
    for file in files:
        inner = {name.split(".")[2] for name in _imports(file) if name.startswith("ohmskin.cell.")}
        forbidden = inner - CELL_MAY_IMPORT[part] - {part}
        assert not forbidden, f"{file.relative_to(ROOT)} imports {forbidden}"


def test_modules_import_the_interfaces_of_sub_packages() -> None:
    interfaces = 0
    for package in MAY_IMPORT:
        folders = {interface.parent for interface in (ROOT / package).glob("*/__init__.py")}
        for file in (ROOT / package).rglob("*.py"):
            for folder in folders - {file.parent}:
                stem = ".".join(["ohmskin", *_place(folder), "_"])
                hidden = {name for name in _imports(file) if name.startswith(stem)}
                assert not hidden, f"{file.relative_to(ROOT)} imports {hidden}"
        interfaces += len(folders)
    assert interfaces > 9


def test_a_tuned_number_says_its_unit_and_what_sets_it() -> None:
    tables = [file for package in MAY_IMPORT for file in (ROOT / package).rglob("_tuning.py")]
    assert len(tables) > 7
    for file in tables:
        body = ast.parse(file.read_text()).body
        for one, after in zip(body, [*body[1:], None], strict=True):
            if isinstance(one, ast.Assign | ast.AnnAssign):
                says = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                assert says, f"{file.relative_to(ROOT)}:{one.lineno} says nothing of its number"


def test_only_one_module_imports_pyspice() -> None:
    """PySpice is under the GPL."""
    users = {
        str(file.relative_to(ROOT))
        for folder in [*PACKAGES, "examples"]
        for file in (ROOT / folder).rglob("*.py")
        if any(name.split(".")[0] == "PySpice" for name in _imports(file))
    }
    assert users == {"circuits/spice/_pyspice.py"}


READS_ARRAYS = {"zipfile": "common/archives.py", "pickle": "verification/_own_code.py", "marshal": "", "shelve": ""}
"""Modules that read untrusted input, and who may use them. The pickle is one of this process for its child."""
OPENS_FILES = ("load", "loadtxt", "genfromtxt", "fromfile", "DataSource")
"""functions of NumPy"""


def test_arrays_of_files_are_read_in_one_module() -> None:
    """Which holds them against a schema, and sizes them first."""
    for file in (file for package in PACKAGES for file in (ROOT / package).rglob("*.py")):
        here = str(file.relative_to(ROOT))
        for name in {name.split(".")[0] for name in _imports(file)} & READS_ARRAYS.keys():
            assert here == READS_ARRAYS[name], f"{here} imports {name}"
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "np":
                assert node.attr not in OPENS_FILES, f"{here}:{node.lineno}"


def test_only_the_table_of_circuits_knows_their_names() -> None:
    names = {circuit.name for circuit in CIRCUITS.values()}
    for file in sorted([*(ROOT / "circuits").rglob("*.py"), *(ROOT / "verification").rglob("*.py")]):
        if file.parent.name == "readouts":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Compare):
                said = {part.value for part in ast.walk(node) if isinstance(part, ast.Constant)} & names
                assert not said, f"{file.relative_to(ROOT)}:{node.lineno} compares the name of a circuit: {said}"


def _modules() -> dict[str, Path]:
    """Every module of the package by its name; an interface by the name of its folder."""
    top = ROOT / "src/ohmskin"
    files = [*top.glob("*.py"), *(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))]
    return {".".join(["ohmskin", *_place(file)]).removesuffix(".py").removesuffix(".__init__"): file for file in files}


def test_no_module_imports_itself_by_way_of_others() -> None:
    """Imports within functions and for the type checker count: they hide a circle and do not open it."""
    modules = _modules()
    graph = {}
    for name, file in modules.items():
        imported = {whole if whole in modules else whole.rpartition(".")[0] for whole in _imports(file)}
        graph[name] = imported & modules.keys() - {name}
    assert "ohmskin.circuits._board" in graph["ohmskin.circuits._design"]
    assert "ohmskin.driver" in graph["ohmskin.hil.plugin"], "an import within a function"
    assert "ohmskin.cli._skin_options" in graph["ohmskin.cli.view"]
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"circle of imports: {' <- '.join(error.args[1])}")


HEAVY = ["scipy", "numba", "matplotlib", "pandas", "asyncio", "websockets", "mcap", "ohmskin.cell.identification"]


@pytest.mark.parametrize(("package", "heavy"), [("driver", HEAVY), ("cell", ["scipy", "numba", "matplotlib"])])
def test_packages_start_without_others_that_take_long_to_load(package: str, heavy: list[str]) -> None:
    program = f"import sys, ohmskin.{package}; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=HANG_S)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("package", [*MAY_IMPORT, "cli"])
def test_other_packages_import_from_the_public_interface_only(package: str) -> None:
    for file in sorted((ROOT / package).rglob("*.py")):
        for name in _imports(file):
            parts = name.split(".")
            if parts[0] == "ohmskin" and len(parts) > 2 and parts[1] in MAY_IMPORT and parts[1] != package:
                hidden = [part for part in parts[2:] if part.startswith("_") and not part.startswith("__")]
                assert not hidden, f"{file.relative_to(ROOT)} imports {name}"
