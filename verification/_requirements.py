"""Requirements: the shipped set for a design, those of a file, and what becomes of each."""

from __future__ import annotations

import importlib.util
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pydantic import Field

from ..circuits import Design, Requirement
from ..common.config import Section, load
from ..errors import InputError, OhmskinError
from ._catalogue import CATALOGUE, quantity_of
from ._dut import DesignUnderTest
from ._hardware import measured_on_board
from ._outcome import STOPPED, DoesNotApply, Measurement, NotRun, Result, defect
from ._quantity import HARDWARE, SPICE, Quantity
from ._spice_check import measured_in_spice
from ._units import conversion

BOARD_SUFFIX = "-board"
"""of the id of a requirement that is measured beside its simulation"""


class RequirementFile(Section):
    """A file of ``[[requirement]]`` tables beside the design."""

    requirement: tuple[Requirement, ...] = Field(strict=False, min_length=1)


def load_requirements(path: str | Path) -> tuple[Requirement, ...]:
    """The requirements of a TOML file. Raises InputError with one located message."""
    return load(path, RequirementFile).requirement


def default_requirements(design: Design) -> tuple[Requirement, ...]:
    """What a design without requirements of its own is held to: the project's own choice of limits."""
    found = [
        (shipped.number, shipped.requirement(quantity.name, design))
        for quantity in CATALOGUE.values()
        for shipped in quantity.shipped
        if shipped.applies(design)
    ]
    return tuple(requirement for _, requirement in sorted(found, key=lambda item: item[0]))


def twins(dut: DesignUnderTest, requirements: tuple[Requirement, ...]) -> tuple[Requirement, ...]:
    """The requirements and, after each that a board can show, the same to be measured on the target."""
    if dut.target == "emulated":
        return requirements
    both = []
    for requirement in requirements:
        both.append(requirement)
        quantity = CATALOGUE.get(requirement.quantity)
        if quantity is not None and quantity.measured is not None and requirement.method != HARDWARE:
            both.append(requirement.replace(id=f"{requirement.id}{BOARD_SUFFIX}", method=HARDWARE))
    return tuple(both)


def check_requirements(requirements: Iterable[Requirement]) -> None:
    """Find bad requirements before anything is run. Functions of a design's own are not looked at.

    Raises:
        InputError: an id that is given twice, an unknown quantity, a method or a unit that does not fit.
    """
    seen: set[str] = set()
    for requirement in requirements:
        name = f"requirement {requirement.id}"
        if requirement.id in seen:
            raise InputError(f"{name}: the id is given twice")
        seen.add(requirement.id)
        try:
            if _is_own(requirement):
                continue
            quantity = quantity_of(requirement.quantity)
            if requirement.unit not in quantity.units:
                _factor(requirement, quantity.unit)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        if requirement.method not in (None, HARDWARE, *quantity.methods):
            raise InputError(
                f"{name}: '{quantity.name}' is not verified by '{requirement.method}'; "
                f"expected {', '.join((*quantity.methods, HARDWARE))}"
            )


def load_own_functions(requirements: Iterable[Requirement], folder: Path) -> list[str]:
    """Run the files of the functions of the design's own that these requirements name; returns "FILE.py:FUNCTION" each.

    Raises:
        InputError: a file that is not below ``folder``, or has no such function.
    """
    found = []
    for requirement in filter(_is_own, requirements):
        try:
            _own_function(requirement.quantity, folder)
        except InputError as error:
            raise InputError(f"requirement {requirement.id}: {error}") from error
        found.append(requirement.quantity)
    return list(dict.fromkeys(found))


def evaluate(dut: DesignUnderTest, requirement: Requirement, folder: Path) -> Result:
    """One requirement on the design under test, whatever happens."""
    start = time.perf_counter()
    quantity = None if _is_own(requirement) else CATALOGUE[requirement.quantity]
    method = requirement.method or ("own function" if quantity is None else quantity.methods[0])
    found: dict[str, Any] = {}
    scaled = requirement
    try:
        scaled = _in_unit_of(dut, requirement, quantity)
        if quantity is None:
            found["measurement"] = _own(dut, requirement, folder)
        elif method == HARDWARE:
            found["measurement"] = measured_on_board(dut, quantity.name, quantity.measured)
        elif method == SPICE:
            found["measurement"] = measured_in_spice(dut, scaled, quantity.analysis, quantity.unit)
        else:
            found["measurement"] = quantity.compute(dut, scaled, method)
    except NotRun as missing:
        found["reason"] = str(missing)
    except DoesNotApply as other:
        found |= {"reason": str(other), "inapplicable": True}
    except OhmskinError as error:
        found["reason"] = f"{type(error).__name__}: {error}"
    except Exception as error:  # a defect in one quantity must not cost the report of the others
        found["reason"] = defect(error)
    if scaled.min is None and scaled.max is None and "reason" not in found:
        found["reason"] = "the requirement has no limit"
    measurement: Measurement | None = found.get("measurement")
    return Result(
        requirement=scaled,
        title=requirement.quantity if quantity is None else quantity.title,
        method=method,
        unit=measurement.unit if measurement is not None else scaled.unit,
        seconds=time.perf_counter() - start,
        **found,
    )


def stopped_result(requirement: Requirement) -> Result:
    """What becomes of a requirement that a stopped run did not come to."""
    quantity = CATALOGUE.get(requirement.quantity)
    return Result(
        requirement=requirement,
        title=requirement.quantity if quantity is None else quantity.title,
        method=requirement.method or ("own function" if quantity is None else quantity.methods[0]),
        unit=requirement.unit or ("" if quantity is None else quantity.unit),
        reason=STOPPED,
    )


def _in_unit_of(dut: DesignUnderTest, requirement: Requirement, quantity: Quantity | None) -> Requirement:
    """The requirement with limits in the unit of its quantity, or in % of full scale where it asks for that.

    Raises:
        NotRun: limits in kPa, but the full scale is not known.
    """
    if quantity is None:
        return requirement
    unit, factor = quantity.unit, 1.0
    if requirement.unit in quantity.units:
        unit = quantity.units[0]
        if requirement.unit != unit:
            if not dut.knows_pressure:
                raise NotRun("missing: cells.full_scale_kpa")
            factor = 100.0 / dut.full_scale_kpa
    else:
        factor = _factor(requirement, unit)
    limits = {key: value * factor for key in ("min", "max") if (value := getattr(requirement, key)) is not None}
    return requirement.replace(**limits, unit=unit) if limits else requirement


def _factor(requirement: Requirement, unit: str) -> float:
    given = requirement.unit
    return 1.0 if given == "%" and unit.startswith("%") else conversion(given, unit)


def _is_own(requirement: Requirement) -> bool:
    return ".py:" in requirement.quantity


def _own_function(quantity: str, folder: Path) -> Callable[..., Any]:
    """The function of ``FILE.py:FUNCTION``. Raises InputError."""
    name, _, function = quantity.rpartition(":")
    path = folder / name
    if Path(name).is_absolute() or not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{name}: a function is loaded from beside the design only, not from outside its folder")
    if ".." in Path(name).parts:
        raise InputError(f"{name}: expected a path below the design's folder, without '..'")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path}: {type(error).__name__}: {error}") from error
    found = getattr(module, function, None)
    if not callable(found):
        raise InputError(f"{path}: no function '{function}'")
    return found  # type: ignore[no-any-return]  # a user's function has no type


def _own(dut: DesignUnderTest, requirement: Requirement, folder: Path) -> Measurement:
    """A quantity of the user's own: ``function(design, cell)`` to a number, or to a number and a place."""
    function = _own_function(requirement.quantity, folder)
    try:
        found = function(dut.design, dut.cell)
        value, where = found if isinstance(found, tuple) else (found, "")
        number = float(value)
    except NotRun:
        raise
    except Exception as error:
        raise NotRun(_where_raised(error, folder / requirement.quantity.rpartition(":")[0])) from error
    return Measurement(number, requirement.unit, where=str(where), confidence=f"as {requirement.quantity} says")


def _where_raised(error: Exception, path: Path) -> str:
    """The error of a user's function in one line, with the last line of the user's file that it came through."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename).resolve() == path.resolve()
    ]
    place = f"{path.name}, line {lines[-1]}" if lines else "function(design, cell), or the number that it returns"
    return " ".join(f"{place}: {type(error).__name__}: {error}".split())
