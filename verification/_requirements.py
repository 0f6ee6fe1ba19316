"""Requirements: the shipped set for a design, those of a file, and what becomes of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from ..circuits import Design, Requirement
from ..common.arrays import FloatArray
from ..common.config import Section, load
from ..errors import InputError
from ._catalogue import CATALOGUE, quantity_of
from ._dut import DesignUnderTest
from ._hardware import measured_on_board
from ._judging import Searched
from ._outcome import STOPPED, Attempt, Measurement, NotRun, Result, attempted
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


def evaluate(
    dut: DesignUnderTest,
    requirement: Requirement,
    own: Mapping[str, OwnFunction],
    boards: FloatArray | None = None,
) -> Result:
    """One requirement on the design under test, whatever happens.

    Args:
        dut: the design under test.
        requirement: what is asked for.
        own: the functions of the design's own, by quantity.
        boards: (boards,) values of the requirement's target on random boards, drawn before; None: they are drawn here.
    """
    quantity = CATALOGUE.get(requirement.quantity)
    scaled = attempted(lambda: _in_unit_of(dut, requirement, quantity))
    asked = scaled.found or requirement

    def measure() -> Measurement:
        if quantity is None:
            return own[requirement.quantity].measure(dut, requirement.unit)
        method = _method(requirement)
        if method == HARDWARE:
            return measured_on_board(dut, quantity.name, quantity.measured)
        if method == SPICE:
            return measured_in_spice(dut, asked, quantity.analysis, quantity.unit)
        if boards is not None and isinstance(quantity.compute, Searched):
            return quantity.compute(dut, asked, method, boards)
        return quantity.compute(dut, asked, method)

    found: Attempt[Measurement] = Attempt(reason=scaled.reason) if scaled.found is None else attempted(measure)
    if asked.min is None and asked.max is None and not found.reason:
        found = found._replace(reason="the requirement has no limit")
    return _result(asked, found, asked.unit if found.found is None else found.found.unit)


def stopped_result(requirement: Requirement) -> Result:
    """What becomes of a requirement that a stopped run did not come to."""
    quantity = CATALOGUE.get(requirement.quantity)
    unit = requirement.unit or ("" if quantity is None else quantity.unit)
    return _result(requirement, Attempt(reason=STOPPED), unit)


def _method(requirement: Requirement) -> str:
    quantity = CATALOGUE.get(requirement.quantity)
    return requirement.method or ("own function" if quantity is None else quantity.methods[0])


def _result(requirement: Requirement, found: Attempt[Measurement], unit: str) -> Result:
    quantity = CATALOGUE.get(requirement.quantity)
    title = requirement.quantity if quantity is None else quantity.title
    return Result(
        requirement, title, _method(requirement), unit, found.found, found.reason, found.inapplicable, found.seconds
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
