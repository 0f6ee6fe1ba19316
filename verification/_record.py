"""The JSON report as data: a published schema, and the comparison of two reports."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ..common.config import describe
from ..common.files import read_text
from ..errors import InputError

SCHEMA_VERSION = 3

OutcomeName = Literal["pass", "fail", "not run", "does not apply"]
Number = float | Literal["inf", "-inf", "nan"] | None


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class CornerRecord(_Record):
    """The worst corner, ready to be solved by `scan`: the design with `parts`, and the cells of each frame."""

    cell: tuple[int, int] = Field(description="row and column of the cell that is judged")
    parts: dict[str, list[Number]] = Field(description="SI values, one per line, by section and key of the design")
    cells_ohm: list[list[list[Number]]] = Field(description="resistances of all cells, one table per frame")


class BoundsRecord(_Record):
    """A worst case by other analyses of the same target, in the unit of the requirement."""

    nominal: Number = Field(description="nominal parts, under the worst presses")
    initial: Number = Field(description="worst case with initial tolerances; null: no part ages")
    root_sum_square: Number = Field(description="nominal, and the root sum of squares of what all parts add")
    quantile_99: Number = Field(description="that 99 % of the random boards keep")
    sampled: Number = Field(description="of the worst random board")
    boards: int


class RequirementRecord(_Record):
    """A requirement and its result."""

    id: str
    text: str
    source: str
    quantity: str
    title: str
    method: str
    unit: str
    min: float | None
    max: float | None
    outcome: OutcomeName
    measured: Number = Field(description="in `unit`; null: not run or does not apply")
    margin: float | None = Field(description="by how much the nearer limit is kept (positive) or missed, in `unit`")
    resolution: float = Field(
        default=0.0, description="of a measurement, in `unit`: a limit that is missed by less counts as kept"
    )
    where: str = Field(description="cell, pattern and corner at which the value is worst")
    incomplete: str = Field(default="", description="of a search that may have missed a worse value: what it covered")
    confidence: str
    reason: str = Field(description="what decided against a pass, where the value and its limits do not say")
    contributions: dict[str, float] = Field(description="by kind of part, in `unit`")
    samples: list[Number] = Field(description="one per board of the Monte Carlo analysis, in `unit`")
    seconds: float
    corner: CornerRecord | None = Field(default=None, description="of a worst case")
    bounds: BoundsRecord | None = Field(default=None, description="of a worst case")


class CheckRecord(_Record):
    """One limit within an experiment."""

    name: str
    outcome: OutcomeName
    measured: Number
    limit: float
    relation: Literal["<=", ">="]
    unit: str
    reason: str


class ClaimRecord(_Record):
    """One claim of the paper."""

    id: str
    title: str
    where: str
    outcome: OutcomeName
    checks: list[CheckRecord]
    seconds: float


class ChangeRecord(_Record):
    """A requirement or claim against an older report."""

    id: str
    change: Literal["better", "worse", "new", "gone", "same"]
    was: str
    is_now: str


class ReportRecord(_Record):
    """report.json."""

    schema_version: int
    title: str
    document: dict[str, str] = Field(default={}, description="number, revision, author and date, as far as given")
    parts: dict[str, Any] = Field(default={}, description="part numbers and ratings that the design gives")
    outcome: OutcomeName
    exit_code: int
    finished: str
    seconds: float
    command: str
    target: str
    seed: int
    samples: int
    design_sha256: str
    cell_sha256: str
    run_sha256: str = Field(description="of everything that the numbers depend on")
    cell_source: str
    design: dict[str, Any]
    cell: dict[str, Any]
    environment: dict[str, str]
    requirements: list[RequirementRecord]
    not_judged: list[str] = Field(description="quantities of the catalogue that no requirement names")
    not_modelled: list[str] = Field(default=[], description="effects that no quantity models for this design")
    not_given: dict[str, str] = Field(default={}, description="keys of the design that are not given: what is taken")
    exact: list[str] = Field(default=[], description="keys of parts that are given without a tolerance")
    claims: list[ClaimRecord]
    changes: list[ChangeRecord]


def schema() -> str:
    """The JSON schema of report.json."""
    tables = ReportRecord.model_json_schema()
    tables["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps(tables, indent=2) + "\n"


def load_record(path: str | Path) -> ReportRecord:
    """An older report.json. Raises InputError."""
    try:
        return ReportRecord.model_validate_json(read_text(path, most_bytes=1 << 28), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        if first["type"] == "json_invalid":
            reason = first["ctx"]["error"]
            raise InputError(f"{path}: not valid JSON: {reason}; expected a report.json of ohmskin verify") from None
        raise InputError(f"{path}: not a report.json of this version: {describe(error, ReportRecord, {})}") from None


def number(value: float | None) -> Number:
    """JSON has no infinity: such values become text."""
    if value is None or math.isfinite(value):
        return value
    return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"


def jsonable(value: Any) -> Any:
    """Nested tables with infinities as text."""
    if isinstance(value, dict):
        return {key: jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    return number(value) if isinstance(value, float) else value


_RANK = {"fail": 0, "not run": 1, "does not apply": 2, "pass": 3}


def compare(new: ReportRecord, old: ReportRecord) -> list[ChangeRecord]:
    """What became better, worse, new or gone; a margin counts as changed from 1 % of the limit on."""
    before = _by_id(old)
    after = _by_id(new)
    changes = []
    for id, item in after.items():
        if id not in before:
            changes.append(ChangeRecord(id=id, change="new", was="", is_now=_shown(item)))
            continue
        change = _change(before[id], item)
        changes.append(ChangeRecord(id=id, change=change, was=_shown(before[id]), is_now=_shown(item)))
    changes += [
        ChangeRecord(id=id, change="gone", was=_shown(item), is_now="")
        for id, item in before.items()
        if id not in after
    ]
    return changes


def _by_id(report: ReportRecord) -> dict[str, RequirementRecord | ClaimRecord]:
    requirements = {item.id: item for item in report.requirements}
    claims = {item.id: item for item in report.claims}
    return {**requirements, **claims}


def _change(
    old: RequirementRecord | ClaimRecord, new: RequirementRecord | ClaimRecord
) -> Literal["better", "worse", "same"]:
    if old.outcome != new.outcome:
        return "better" if _RANK[new.outcome] > _RANK[old.outcome] else "worse"
    if not isinstance(old, RequirementRecord) or not isinstance(new, RequirementRecord):
        return "same"
    if old.margin is None or new.margin is None:
        return "same"
    limits = [abs(limit) for limit in (new.min, new.max) if limit]
    least = 0.01 * min(limits, default=max(abs(old.margin), 1e-12))
    if abs(new.margin - old.margin) < least:
        return "same"
    return "better" if new.margin > old.margin else "worse"


def _shown(item: RequirementRecord | ClaimRecord) -> str:
    if isinstance(item, RequirementRecord) and isinstance(item.measured, float):
        return f"{item.outcome}, {item.measured:.4g} {item.unit}"
    return item.outcome
