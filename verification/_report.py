"""The report of a verification run: one HTML file for people, JSON and JUnit for programs."""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import json
import platform
import sys
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from .. import __version__
from ..circuits import Design
from ..errors import InputError, MissingExtra
from ..tables import write_text
from ._outcome import Claim, Outcome, worst

EXIT_CODES = {Outcome.PASS: 0, Outcome.FAIL: 1, Outcome.NOT_RUN: 3}


@dataclass(frozen=True)
class Report:
    """What a verification run found, and on what."""

    title: str
    design: Design
    target: str
    claims: list[Claim]
    """P1 to P14"""
    appendices: list[Claim]
    """what goes beyond the paper"""
    seconds: float
    command: str = "ohmskin verify"
    """that makes this report again"""
    finished: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def sections(self) -> list[Claim]:
        return [*self.claims, *self.appendices]

    @property
    def outcome(self) -> Outcome:
        return worst(claim.outcome for claim in self.sections)

    @property
    def exit_code(self) -> int:
        """0 all pass, 1 a requirement fails, 3 something could not be run."""
        return EXIT_CODES[self.outcome]

    def count(self, outcome: str) -> int:
        """How many claims ended so."""
        return sum(claim.outcome == outcome for claim in self.sections)

    def write(self, folder: str | Path) -> tuple[dict[str, Path], list[str]]:
        """Write ``report.json``, ``report.html`` and ``junit.xml``; returns their paths, and what was missing for some.

        Raises:
            InputError: the folder cannot be made or written to.
        """
        texts, missing = {"report.json": self.json()}, []
        for name, make in (("report.html", self.html), ("junit.xml", self.junit)):
            try:
                texts[name] = make()
            except MissingExtra as error:
                missing.append(f"{name} not written: {error}")
        target = Path(folder)
        try:
            target.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror}") from error
        for name, text in texts.items():
            write_text(target / name, text)
        return {name: target / name for name in texts}, missing

    def html(self) -> str:
        """A self-contained page."""
        try:
            import jinja2
        except ImportError as error:
            raise _missing("jinja2") from error
        source = importlib.resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8")
        page = jinja2.Environment(
            autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
        )
        return page.from_string(source).render(
            report=self, settings=self._settings(), environment=_environment(), command=self.command
        )

    def json(self) -> str:
        """Every claim and check with its numbers."""
        return json.dumps(
            {
                "title": self.title,
                "outcome": self.outcome,
                "finished": self.finished.isoformat(timespec="seconds"),
                "seconds": round(self.seconds, 3),
                "target": self.target,
                "design": _jsonable(self.design.model_dump(mode="python")),
                "environment": _environment(),
                "claims": [_record(claim) for claim in self.claims],
                "appendices": [_record(claim) for claim in self.appendices],
            },
            indent=2,
            allow_nan=False,
            ensure_ascii=False,
        )

    def junit(self) -> str:
        """One suite per claim, one case per check; what was not run is skipped with its reason."""
        try:
            from junitparser import Failure, JUnitXml, Skipped, TestCase, TestSuite
        except ImportError as error:
            raise _missing("junitparser") from error
        xml = JUnitXml("ohmskin verify")
        for claim in self.sections:
            suite = TestSuite(f"{claim.id} {claim.title}")
            for check in claim.finding.checks:
                case = TestCase(check.name, classname=f"ohmskin.verify.{claim.id}")
                if check.outcome is Outcome.FAIL:
                    case.result = [Failure(f"measured {check.found}, required {check.requirement}")]
                elif check.outcome is Outcome.NOT_RUN:
                    case.result = [Skipped(f"not run: {check.reason}")]
                suite.add_testcase(case)
            xml.add_testsuite(suite)
        xml.update_statistics()
        text: bytes | str = xml.tostring()
        return text.decode() if isinstance(text, bytes) else text

    def _settings(self) -> list[tuple[str, str, str, bool]]:
        """(section, key, value, named by the design) for the design table."""
        rows = []
        for section in type(self.design).model_fields:
            part = getattr(self.design, section)
            if part is None:
                continue
            rows += [(section, key, _shown(value), key in part.model_fields_set) for key, value in part]
        return rows


def _record(claim: Claim) -> dict[str, Any]:
    checks = [
        {
            "name": check.name,
            "outcome": check.outcome,
            "measured": _jsonable(check.measured),
            "limit": check.limit,
            "relation": ">=" if check.at_least else "<=",
            "unit": check.unit,
            "reason": check.reason,
        }
        for check in claim.finding.checks
    ]
    return {"id": claim.id, "title": claim.title, "where": claim.where, "outcome": claim.outcome, "checks": checks}


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_shown, value)) + "]"
    return str(value)


def _jsonable(value: Any) -> Any:
    """JSON has no infinity: such values become text."""
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    return value if not isinstance(value, float) or abs(value) < float("inf") else str(value)


def _environment() -> dict[str, str]:
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "scipy")}
    return {"ohmskin": __version__, "python": platform.python_version(), "system": sys.platform, **versions}


def _missing(module: str) -> MissingExtra:
    return MissingExtra(f"the report needs {module}: pip install 'ohmskin[report]'")
