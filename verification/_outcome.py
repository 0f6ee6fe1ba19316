"""What an experiment finds: measured numbers against limits, with figures and tables for a reader."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum


class Outcome(StrEnum):
    """A check passes only if it was run and kept its limit."""

    PASS = "pass"
    FAIL = "fail"
    NOT_RUN = "not run"


def worst(outcomes: Iterable[Outcome]) -> Outcome:
    """A failure outweighs what could not be run, which outweighs a pass; nothing at all was not run."""
    found = set(outcomes)
    if Outcome.FAIL in found:
        return Outcome.FAIL
    return Outcome.PASS if found == {Outcome.PASS} else Outcome.NOT_RUN


@dataclass(frozen=True)
class Check:
    """One requirement: ``measured`` must be at most (or, with ``at_least``, no less than) ``limit``.

    A measured value that is not finite fails; None means the check was not run, for ``reason``.
    """

    name: str
    measured: float | None
    limit: float
    unit: str = ""
    at_least: bool = False
    reason: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.limit):
            raise ValueError(f"check '{self.name}' has no finite limit and could not fail")

    @property
    def outcome(self) -> Outcome:
        if self.measured is None:
            return Outcome.NOT_RUN
        kept = self.measured >= self.limit if self.at_least else self.measured <= self.limit
        return Outcome.PASS if kept and math.isfinite(self.measured) else Outcome.FAIL

    @property
    def requirement(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {self.limit:.4g} {self.unit}".rstrip()

    @property
    def found(self) -> str:
        return self.reason if self.measured is None else f"{self.measured:.4g} {self.unit}".rstrip()


@dataclass(frozen=True)
class Figure:
    """A picture as SVG text, with the sentence a reader needs under it."""

    svg: str
    caption: str


@dataclass(frozen=True)
class Table:
    """Rows of text below a header."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True)
class Finding:
    """All that one experiment says about one claim of the paper."""

    checks: Sequence[Check]
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()

    @property
    def outcome(self) -> Outcome:
        return worst(check.outcome for check in self.checks)


@dataclass(frozen=True)
class Claim:
    """A numbered statement of the paper (P1 ... P14), where it stands, and what was found about it."""

    id: str
    title: str
    where: str
    says: str
    finding: Finding = field(default_factory=lambda: Finding(checks=()))

    @property
    def outcome(self) -> Outcome:
        return self.finding.outcome


def not_run(name: str, reason: str) -> Finding:
    """The finding of an experiment that could not be carried out."""
    return Finding(checks=[Check(name, None, 0.0, reason=reason)])
