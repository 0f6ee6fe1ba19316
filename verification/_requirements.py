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
from ._catalogue import CATALOGUE, HARDWARE, SAMPLED, SPICE, quantity_of
from ._hardware import measured_on_board
from ._outcome import DoesNotApply, NotRun, Result, defect
from ._own_code import OwnFunction, is_own
from ._spice_check import measured_in_spice
from ._subject import Subject
from ._units import conversion

DEFAULT_SOURCE = "shipped default"


class RequirementFile(Section):
    """A file of ``[[requirement]]`` tables beside the design."""

    requirement: tuple[Requirement, ...] = Field(strict=False, min_length=1)


def load_requirements(path: str | Path) -> tuple[Requirement, ...]:
    """The requirements of a TOML file. Raises InputError with one located message."""
    return load(path, RequirementFile).requirement


def default_requirements(design: Design) -> tuple[Requirement, ...]:
    """What a design without requirements of its own is held to: the project's own choice of limits."""
    limits = design.requirements
    step = design.operation.frame_rate

    def ask(number: int, quantity: str, text: str, **keys: Any) -> Requirement:
        return Requirement(id=f"D{number}", quantity=quantity, text=text, source=DEFAULT_SOURCE, **keys)

    shipped: tuple[Requirement, ...] = (
        ask(1, "crosstalk", "A press does not show on untouched cells.", max=limits.crosstalk_percent),
        ask(2, "reading_error", "Resistances are right without calibration.", max=limits.reading_error_percent),
        ask(3, "gain_error", "A press is read at its true size.", max=limits.reading_error_percent),
        ask(4, "output_headroom", "No output reaches its supply.", min=0.0),
        ask(5, "adc_headroom", "No reading leaves the converter's range.", min=0.0),
        ask(6, "adc_range_used", "Presses move over a good part of the converter's range.", min=10.0),
        ask(7, "pressure_resolution", "Noise is small beside the load.", max=_percent_of_scale(design, 1.0)),
        ask(8, "settling_error", "Readings settle at the declared frame rate.", max=1.0),
        ask(9, "fastest_scan", "The declared frame rate can be had to a quarter of an ADC step.", min=step),
        ask(10, "phase_margin", "Amplifiers are stable on their columns.", min=45.0),
        ask(11, "cell_power", "Cells do not heat themselves.", max=0.01),
        ask(12, "fault_coverage", "A self-test tells broken lines and cells.", min=60.0),
        ask(13, "pressure_rmse", "The pressure follows the load.", max=limits.pressure_rmse_percent),
        ask(14, "pressure_peak_error", "No estimate is far off.", max=4 * limits.pressure_rmse_percent),
        ask(15, "lost_readings", "No press drives a reading beyond a limit.", max=0.0),
        ask(16, "latency", "The host sees a press in time.", max=0.1),
        ask(17, "lost_frames", "The line carries every frame.", max=0.0),
        ask(
            18, "reading_error", "99 % of all boards keep the error.", max=limits.reading_error_percent, method=SAMPLED
        ),
        ask(19, "spice_agreement", "An independent simulator finds the same.", max=1.0),
        ask(20, "valid_cells", "The driver can tell every cell.", min=100.0),
        ask(23, "output_current", "Amplifiers can deliver their currents.", max=limits.output_current),
        ask(24, "switch_current", "A driver can deliver the current of its line.", max=limits.driver_current),
    )
    if design.drive.idle_leakage:
        leakage = limits.reading_error_percent / 5
        shipped = (*shipped, ask(25, "leakage_error", "Idle switches do not shift readings.", max=leakage))
    if design.readout.amplifier_model is None:
        return shipped
    return (
        *shipped,
        ask(21, "phase_margin", "The maker's model is stable on its column.", min=45.0, method=SPICE),
        ask(22, "settling_error", "The maker's model settles at the declared rate.", max=1.0, method=SPICE),
    )


def _percent_of_scale(design: Design, percent: float) -> float:
    """kPa."""
    full = design.cells.full_scale_kpa if design.cells is not None else None
    return percent / 100 * (full or 15.5)


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
            _factor(requirement, quantity.unit)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        if requirement.method not in (None, HARDWARE, *quantity.methods):
            raise InputError(
                f"{name}: '{quantity.name}' is not verified by '{requirement.method}'; "
                f"expected {', '.join((*quantity.methods, HARDWARE))}"
            )


def evaluate(subject: Subject, requirement: Requirement, own: Mapping[str, OwnFunction]) -> Result:
    """One requirement on the subject, whatever happens; ``own`` has the functions of the design's own by quantity."""
    start = time.perf_counter()
    quantity = None if is_own(requirement) else CATALOGUE[requirement.quantity]
    title = requirement.quantity if quantity is None else quantity.title
    unit = requirement.unit if quantity is None else quantity.unit
    method = requirement.method or ("own function" if quantity is None else quantity.methods[0])
    factor = 1.0 if quantity is None else _factor(requirement, unit)
    limits = {key: value * factor for key in ("min", "max") if (value := getattr(requirement, key)) is not None}
    scaled = requirement.replace(**limits, unit=unit) if limits else requirement
    found: dict[str, Any] = {}
    try:
        if method == HARDWARE:
            found["measurement"] = measured_on_board(subject, scaled)
        elif method == SPICE:
            found["measurement"] = measured_in_spice(subject, scaled)
        elif quantity is None:
            found["measurement"] = own[requirement.quantity].measure(subject, unit)
        else:
            found["measurement"] = quantity.compute(subject, scaled, method)
    except NotRun as missing:
        found["reason"] = str(missing)
    except DoesNotApply as other:
        found |= {"reason": str(other), "inapplicable": True}
    except OhmskinError as error:
        found["reason"] = f"{type(error).__name__}: {error}"
    except Exception as error:  # a defect in one quantity must not cost the report of the others
        found["reason"] = defect(error)
    if not limits and "reason" not in found:
        found["reason"] = "the requirement has no limit"
    seconds = time.perf_counter() - start
    return Result(requirement=scaled, title=title, method=method, unit=unit, seconds=seconds, **found)


def _factor(requirement: Requirement, unit: str) -> float:
    given = requirement.unit
    return 1.0 if given == "%" and unit.startswith("%") else conversion(given, unit)
