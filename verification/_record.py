"""The JSON report as data: a published schema, and the comparison of two reports."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationError, WithJsonSchema

from ..common.config import describe
from ..common.files import read_text
from ..common.json_text import finite_or_text
from ..errors import InputError

SCHEMA_VERSION = 3


class Outcome(StrEnum):
    """A check passes only if it was run and kept its limit."""

    PASS = "pass"
    FAIL = "fail"
    NOT_RUN = "not run"
    NOT_APPLICABLE = "does not apply"


def worst(outcomes: Iterable[Outcome]) -> Outcome:
    """A failure outweighs what could not be run, which outweighs a pass; nothing at all was not run."""
    found = set(outcomes) or {Outcome.NOT_RUN}
    return next(each for each in (Outcome.FAIL, Outcome.NOT_RUN, Outcome.PASS, Outcome.NOT_APPLICABLE) if each in found)


_INFINITE = ("inf", "-inf", "nan")
"""JSON has no infinity: such values become text"""
Number = Annotated[
    float | None,
    BeforeValidator(lambda value: float(value) if value in _INFINITE else value),
    PlainSerializer(finite_or_text, when_used="json"),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"enum": [*_INFINITE], "type": "string"}, {"type": "null"}]}),
]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, from_attributes=True)


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
    outcome: Outcome
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
    outcome: Outcome
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
    outcome: Outcome
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
    outcome: Outcome
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


_RANK = {Outcome.FAIL: 0, Outcome.NOT_RUN: 1, Outcome.NOT_APPLICABLE: 2, Outcome.PASS: 3}


def compare(new: ReportRecord, old: ReportRecord) -> list[ChangeRecord]:
    """What became better, worse, new or gone; a margin counts as changed from 1 % of the limit on."""
    before, after = _by_id(old), _by_id(new)
    changes = []
    for id in {**after, **before}:
        was, now = before.get(id), after.get(id)
        change = "new" if was is None else "gone" if now is None else _change(was, now)
        changes.append(ChangeRecord(id=id, change=change, was=_shown(was), is_now=_shown(now)))
    return changes


def _by_id(report: ReportRecord) -> dict[str, RequirementRecord | ClaimRecord]:
    items: list[RequirementRecord | ClaimRecord] = [*report.requirements, *report.claims]
    return {item.id: item for item in items}


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


def _shown(item: RequirementRecord | ClaimRecord | None) -> str:
    if isinstance(item, RequirementRecord) and item.measured is not None and math.isfinite(item.measured):
        return f"{item.outcome}, {item.measured:.4g} {item.unit}"
    return "" if item is None else item.outcome.value
