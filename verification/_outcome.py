"""Outcomes of checks and requirements, with the figures and tables that explain them.

====================  =================================================================================================
outcome               meaning
====================  =================================================================================================
pass                  a finite number was found, and it keeps every limit
fail                  a limit is not kept, or what was found is no finite number
not run               no number could be found: parts are not given, a program or a board is missing, no limit is given;
                      or too few boards were drawn to decide about a yield
does not apply        the design has nothing that the quantity describes (a divider has no phase margin)
====================  =================================================================================================
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from ..circuits import Requirement
from ..errors import MissingExtra, OhmskinError
from ._record import BoundsRecord, CornerRecord, Outcome, worst
from ._units import engineering

T = TypeVar("T")
_LARGEST_SHARE = 1000
"""% of a limit beyond which a margin's share is not stated exactly"""


STOPPED = "the run was stopped before"
"""why something was not run"""


class NotRun(Exception):  # no error: a defined outcome
    """A quantity cannot be found; the message says what is missing."""


class DoesNotApply(Exception):
    """The design has nothing that the quantity describes; the message says why."""


@dataclass(frozen=True)
class Check:
    """One limit: ``measured`` must be at most (or, with ``at_least``, no less than) ``limit``.

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
    def relation(self) -> str:
        return ">=" if self.at_least else "<="

    @property
    def required(self) -> str:
        return f"{'≥' if self.at_least else '≤'} {engineering(self.limit, self.unit)}"

    @property
    def found(self) -> str:
        return self.reason if self.measured is None else engineering(self.measured, self.unit)


@dataclass(frozen=True)
class Figure:
    """A picture as SVG text, with the sentence a reader needs under it."""

    svg: str
    caption: str


def drawn(*draw: Callable[[], Figure]) -> list[Figure]:
    """The pictures that these functions draw; none without matplotlib, whose absence costs no verdict."""
    try:
        return [each() for each in draw]
    except MissingExtra:
        return []


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
    inapplicable: str = ""
    """why the claim says nothing about this design"""

    @property
    def outcome(self) -> Outcome:
        if self.inapplicable:
            return Outcome.NOT_APPLICABLE
        return worst(check.outcome for check in self.checks)


@dataclass(frozen=True)
class Claim:
    """A numbered statement of the paper (P1 ... P14), where it stands, and what was found about it."""

    id: str
    title: str
    where: str
    says: str
    finding: Finding = field(default_factory=lambda: Finding(checks=()))
    seconds: float = 0.0
    """of computing"""

    @property
    def outcome(self) -> Outcome:
        return self.finding.outcome

    @property
    def checks(self) -> Sequence[Check]:
        return self.finding.checks


@dataclass(frozen=True)
class Measurement:
    """What was found for a requirement."""

    value: float
    """in ``unit``; the magnitude where only that counts"""
    unit: str
    where: str = ""
    """cell, pattern and corner at which the value is worst"""
    confidence: str = ""
    """how sure the value is: a search, a number of samples, a bound"""
    text: Sequence[str] = ()
    incomplete: str = ""
    """what page one says beside the value of a search that may have missed a worse one"""
    resolution: float = 0.0
    """of the measurement, in ``unit``: a value that misses a limit by less counts as one that keeps it"""
    contributions: Mapping[str, float] = field(default_factory=dict)
    """by kind of part alone, in ``unit``: for the tornado, and of worst cases for the error budget"""
    samples: Sequence[float] = ()
    """in ``unit``, one per board of the Monte Carlo analysis"""
    proven: bool | None = None
    """Monte Carlo: whether the lower confidence bound of the yield keeps the wanted yield; None: the value decides"""
    undecided: str = ""
    """why the value is no verdict: too few boards neither prove the wanted yield nor miss it, or a simulator has left
    out a part of a model; and what would decide"""
    bounds: BoundsRecord | None = None
    """of a worst case"""
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    corner: CornerRecord | None = None
    """worst case: what to solve to find the value again"""


@dataclass(frozen=True)
class Result:
    """A requirement and what became of it."""

    requirement: Requirement
    title: str
    """of the quantity"""
    method: str
    unit: str
    measurement: Measurement | None = None
    reason: str = ""
    """why it was not run, or does not apply"""
    inapplicable: bool = False
    seconds: float = 0.0
    """of computing"""

    @property
    def outcome(self) -> Outcome:
        if self.inapplicable:
            return Outcome.NOT_APPLICABLE
        found, limits = self.measurement, self.requirement
        if found is None or (limits.min is None and limits.max is None):
            return Outcome.NOT_RUN
        if not math.isfinite(found.value):
            return Outcome.FAIL
        if found.proven is not None:
            missed = Outcome.NOT_RUN if found.undecided else Outcome.FAIL
            return Outcome.PASS if found.proven else missed
        if found.undecided:
            return Outcome.NOT_RUN
        return Outcome.PASS if self.margin is not None and self.margin >= -found.resolution else Outcome.FAIL

    @property
    def why(self) -> str:
        """What decided, where the value beside its limit does not say; empty for a pass."""
        found = self.measurement
        if found is None or self.outcome is Outcome.PASS:
            return self.reason
        if found.undecided:
            return found.undecided
        if self.reason:
            return self.reason
        if found.proven is not None:
            return found.confidence
        if not math.isfinite(found.value):
            return f"no finite number: {found.where}" if found.where else "no finite number"
        return f"worst at {found.where}" if found.where else ""

    @property
    def margin(self) -> float | None:
        """By how much the nearer limit is kept (positive) or missed, in the unit of the limits."""
        if self.measurement is None or not math.isfinite(self.measurement.value):
            return None
        value, low, high = self.measurement.value, self.requirement.min, self.requirement.max
        margins = ([] if low is None else [value - low]) + ([] if high is None else [high - value])
        return min(margins, default=None)

    @property
    def required(self) -> str:
        """In words."""
        low, high = self.requirement.min, self.requirement.max
        if low is not None and high is not None:
            return f"{engineering(low, self.unit)} to {engineering(high, self.unit)}"
        if low is not None:
            return f"≥ {engineering(low, self.unit)}"
        return "none given" if high is None else f"≤ {engineering(high, self.unit)}"

    @property
    def found(self) -> str:
        """The value with its unit, or why there is none."""
        return self.reason if self.measurement is None else engineering(self.measurement.value, self.unit)

    @property
    def margin_shown(self) -> str:
        """The margin with its unit, and its share of the limit."""
        if self.margin is None:
            return ""
        resolution = 0.0 if self.measurement is None else self.measurement.resolution
        if abs(self.margin) <= resolution:
            return f"within ±{engineering(resolution, self.unit, 2)}"
        limits = [abs(limit) for limit in (self.requirement.min, self.requirement.max) if limit]
        if not limits:
            return engineering(self.margin, self.unit)
        share = 100 * self.margin / min(limits)
        shown = f"{share:.0f} %" if abs(share) < _LARGEST_SHARE else f"{'>' if share > 0 else '< −'}{_LARGEST_SHARE} %"
        return f"{engineering(self.margin, self.unit)} ({shown.replace('-', '−')})"


class Attempt(NamedTuple, Generic[T]):
    """What came of a quantity or an experiment, whatever happened."""

    found: T | None = None
    reason: str = ""
    """why nothing was found"""
    inapplicable: bool = False
    seconds: float = 0.0
    """of computing"""


def attempted(compute: Callable[[], T]) -> Attempt[T]:
    """Compute something; a defect in it must not cost the report of the others."""
    start = time.perf_counter()
    found, reason, inapplicable = None, "", False
    try:
        found = compute()
    except NotRun as missing:
        reason = str(missing)
    except DoesNotApply as other:
        reason, inapplicable = str(other), True
    except OhmskinError as error:
        reason = f"{type(error).__name__}: {error}"
    except Exception as error:  # in one line, with the last place that it came through
        last = traceback.extract_tb(error.__traceback__)[-1]
        said = " ".join(f"{type(error).__name__}: {error}".split())
        reason = f"stopped by a defect: {said} ({Path(last.filename).name}, line {last.lineno})"
    return Attempt(found, reason, inapplicable, time.perf_counter() - start)
