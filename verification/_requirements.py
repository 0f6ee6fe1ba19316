"""Requirements: the shipped set for a design, those of a file, and what becomes of each."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
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
from ._own_code import OwnFunction, is_own
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


def at_ratings(design: Design) -> tuple[Requirement, ...]:
    """That parts bear no more than the share of their ratings that may be used."""
    found = []
    for quantity in CATALOGUE.values():
        name, kind = quantity.rates or ("", "")
        part = getattr(design.parts, name, None)
        if part is None or kind not in part.ratings:
            continue
        derated = f", derated to {100 * part.derating:g} %" if part.derating < 1 else ""
        found.append(
            Requirement(
                id=f"{name}.{kind}",
                quantity=quantity.name,
                text=f"The {name.replace('_', ' ')} keeps its rating.",
                source=f"rating of {part.number or f'[parts.{name}]'}{derated}",
                max=part.derating * part.ratings[kind],
            )
        )
    return tuple(found)


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
            if is_own(requirement):
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


def evaluate(dut: DesignUnderTest, requirement: Requirement, own: Mapping[str, OwnFunction]) -> Result:
    """One requirement on the design under test, whatever happens.

    Args:
        dut: the design under test.
        requirement: what is asked for.
        own: the functions of the design's own, by quantity.
    """
    start = time.perf_counter()
    quantity = None if is_own(requirement) else CATALOGUE[requirement.quantity]
    method = requirement.method or ("own function" if quantity is None else quantity.methods[0])
    found: dict[str, Any] = {}
    scaled = requirement
    try:
        scaled = _in_unit_of(dut, requirement, quantity)
        if quantity is None:
            found["measurement"] = own[requirement.quantity].measure(dut, requirement.unit)
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
