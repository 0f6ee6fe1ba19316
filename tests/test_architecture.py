"""The rooms know only those below them (docs/design.md)."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

from ohmskin.circuits.readouts import CIRCUITS

ROOT = Path(__file__).parent.parent
SHARED = {"arrays", "errors", "config", "files", "plots", "progress", "tables", "text", "workers"}
MAY_IMPORT = {
    "circuits": SHARED,
    "cell": SHARED,
    "wire": SHARED,
    "bench": SHARED | {"circuits", "cell", "wire", "emulator", "driver"},
    "emulator": SHARED | {"circuits", "cell", "wire"},
    "driver": SHARED | {"circuits", "cell", "wire"},
    "calibration": SHARED | {"circuits", "cell", "wire", "driver"},
    "doctor": SHARED | {"circuits", "wire", "driver"},
    "hil": SHARED | {"driver", "emulator"},
    "view": SHARED | {"driver"},
    "verification": SHARED | {"circuits", "cell", "wire", "emulator", "driver", "bench"},
}


def _imports(file: Path) -> set[str]:
    """First names below ``ohmskin`` that a module imports, and the top-level modules of other packages."""
    package = ["ohmskin", *file.relative_to(ROOT).parts[:-1]]
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = [*base, *(node.module.split(".") if node.module else [])]
            found |= {".".join([*stem, name.name]) for name in node.names}
    return found


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_what_is_below_it(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files
    for file in files:
        imports = _imports(file)
        bare = {name.split(".")[0] for name in imports} & MAY_IMPORT.keys()
        assert not bare, f"{file.relative_to(ROOT)} imports {bare} without the package name ohmskin"
        inner = {name.split(".")[1] for name in imports if name.startswith("ohmskin.")}
        forbidden = inner - MAY_IMPORT[room] - {room, "__version__"}
        assert not forbidden, f"{file.relative_to(ROOT)} imports {forbidden}"


def test_solvers_know_conductances_and_lines_only() -> None:
    """Nothing of circuits but themselves: no Design, no Board, no readout."""
    files = sorted((ROOT / "circuits/solvers").glob("*.py"))
    assert len(files) > 5
    for file in files:
        inner = {name for name in _imports(file) if name.startswith("ohmskin.")}
        allowed = ("ohmskin.arrays", "ohmskin.errors", "ohmskin.circuits.solvers")
        assert all(name.startswith(allowed) for name in inner), f"{file.name} imports {inner}"


def test_only_one_module_imports_pyspice() -> None:
    users = {
        str(file.relative_to(ROOT))
        for folder in [*MAY_IMPORT, "src/ohmskin/cli", "examples"]
        for file in (ROOT / folder).rglob("*.py")
        if any(name.split(".")[0] == "PySpice" for name in _imports(file))
    }
    assert users <= {"circuits/spice/_ngspice.py"}


def test_only_the_table_of_circuits_knows_their_names() -> None:
    names = {circuit.name for circuit in CIRCUITS.values()}
    for file in sorted([*(ROOT / "circuits").rglob("*.py"), *(ROOT / "verification").rglob("*.py")]):
        if file.parent.name == "readouts":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Compare):
                said = {part.value for part in ast.walk(node) if isinstance(part, ast.Constant)} & names
                assert not said, f"{file.relative_to(ROOT)}:{node.lineno} compares the name of a circuit: {said}"


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_other_rooms_import_from_the_face_only(room: str) -> None:
    for file in sorted((ROOT / room).rglob("*.py")):
        for name in _imports(file):
            parts = name.split(".")
            if parts[0] == "ohmskin" and len(parts) > 2 and parts[1] in MAY_IMPORT and parts[1] != room:
                hidden = [part for part in parts[2:] if part.startswith("_") and not part.startswith("__")]
                assert not hidden, f"{file.relative_to(ROOT)} imports {name}"


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_no_public_name_hides_a_module(room: str) -> None:
    face = importlib.import_module(f"ohmskin.{room}")
    modules = {file.stem for file in (ROOT / room).glob("*.py")}
    hidden = modules & set(getattr(face, "__all__", ()))
    assert not hidden, f"ohmskin.{room}: {hidden} are modules and names"
