"""The report of a verification run: a page for people, JSON and JUnit for programs, Markdown for a pull request."""

from __future__ import annotations

import base64
import importlib.metadata
import importlib.resources
import json
import math
import platform
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..circuits import Design, spice
from ..common import plots
from ..common.config import fingerprint
from ..common.extras import install_command
from ..common.files import make_folder, write_together
from ..common.json_text import finite_or_text, replaced
from ..common.text import markdown, markdown_code, printable
from ..errors import MissingExtra, OhmskinError
from ._assumptions import Assumptions, assumptions_of, settings_of
from ._catalogue import CATALOGUE
from ._dut import DesignUnderTest, everything_of
from ._explore import may_be_mended
from ._export import export_samples
from ._outcome import Check, Claim, Figure, Measurement, Result, Table
from ._pictures import picture
from ._record import (
    SCHEMA_VERSION,
    ChangeRecord,
    ClaimRecord,
    Outcome,
    ReportRecord,
    RequirementRecord,
    compare,
    worst,
)
from ._schematic import schematic
from ._sign_off import RATINGS, SignOff, filed_under
from ._units import PREFIXED, engineering

EXIT_CODES = {Outcome.PASS: 0, Outcome.FAIL: 1, Outcome.NOT_RUN: 3, Outcome.NOT_APPLICABLE: 3}
FILES = ("report.html", "report.json", "junit.xml", "summary.md", "netlist.cir")


@dataclass(frozen=True)
class Report:
    """What a verification run found, and on what."""

    title: str
    dut: DesignUnderTest
    results: list[Result]
    """of the requirements"""
    claims: list[Claim]
    """P1 to P14, if the paper's claims were run"""
    seconds: float
    command: str = "ohmskin verify"
    """that makes this report again"""
    fingerprint: str = ""
    """SHA-256 of everything that the numbers depend on"""
    require_all: bool = False
    judged_by_default: bool = False
    """the limits are the shipped defaults, not the user's"""
    changes: list[ChangeRecord] = field(default_factory=list)
    """against an older report"""
    interruption: KeyboardInterrupt | None = None
    """what stopped the run; what was not run until then says so"""
    explore_command: str = ""
    """that says which single parts mend failed requirements; empty: the design has no file"""
    finished: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def design(self) -> Design:
        return self.dut.design

    @property
    def target(self) -> str:
        return self.dut.target

    @property
    def outcome(self) -> Outcome:
        found = worst([*(r.outcome for r in self.results), *(claim.outcome for claim in self.claims)])
        return Outcome.FAIL if self.require_all and found is not Outcome.PASS else found

    @property
    def exit_code(self) -> int:
        """0 all pass, 1 a requirement fails, 3 something could not be run."""
        return EXIT_CODES[self.outcome]

    def count(self, outcome: str) -> int:
        """How many requirements and claims ended so."""
        outcomes = [r.outcome for r in self.results] + [claim.outcome for claim in self.claims]
        return sum(found == outcome for found in outcomes)

    def to_mend(self, result: Result) -> str:
        """The command to type about a failed requirement; empty where exploration has no answer."""
        failed = result.outcome is Outcome.FAIL and may_be_mended(result.requirement)
        return self.explore_command if failed else ""

    @cached_property
    def assumptions(self) -> Assumptions:
        """What this verdict leaves out."""
        return assumptions_of(self.design)

    @property
    def not_judged(self) -> list[str]:
        """Quantities of the catalogue that no requirement names."""
        named = {result.requirement.quantity for result in self.results}
        return [name for name in CATALOGUE if name not in named]

    @property
    def assumed(self) -> str:
        """The assumptions in one line."""
        known = self.assumptions
        effects = ", ".join(effect.name for effect in known.effects)
        return (
            f"Not modelled: {effects}. Not given: {', '.join(key for key, _ in known.not_given) or 'nothing'}. "
            f"Without tolerance: {', '.join(known.exact) or 'nothing'}."
        )

    @property
    def left_out(self) -> list[tuple[str, str, str]]:
        """(id, what, reason) of everything that was not run or does not apply."""
        found = [
            (r.requirement.id, r.title, f"{r.outcome}: {r.why or 'no limit is given'}")
            for r in self.results
            if r.outcome in (Outcome.NOT_RUN, Outcome.NOT_APPLICABLE)
        ]
        for claim in self.claims:
            if claim.finding.inapplicable:
                found.append((claim.id, claim.title, f"does not apply: {claim.finding.inapplicable}"))
            found += [
                (claim.id, check.name, f"not run: {check.reason.splitlines()[-1] if check.reason else 'no reason'}")
                for check in claim.finding.checks
                if check.outcome is Outcome.NOT_RUN
            ]
        return found

    @property
    def left_out_by_reason(self) -> list[tuple[str, str]]:
        """(what, reason), one line per reason: ids with their titles, or ids alone where many share it."""
        by_reason: dict[str, list[tuple[str, str]]] = {}
        for id, what, reason in self.left_out:
            by_reason.setdefault(reason, []).append((id, what))
        return [
            (
                ", ".join(dict.fromkeys(id for id, _ in items)) if len(items) > 2 else "; ".join(map(" ".join, items)),
                why,
            )
            for why, items in by_reason.items()
        ]

    def against(self, old: ReportRecord) -> Report:
        """The same report with its changes against an older one."""
        return replace(self, changes=compare(self.record(), old))

    def write(self, folder: str | Path) -> tuple[dict[str, Path], list[str]]:
        """Write all files together, or none; returns their paths, and what was missing for some.

        Raises:
            InputError: the folder cannot be made or written to.
        """
        target = make_folder(folder)
        texts: dict[str, str] = {"report.json": self.json(), "summary.md": self.markdown()}
        missing = []
        for name, make in (("report.html", self.html), ("junit.xml", self.junit)):
            try:
                texts[name] = make()
            except MissingExtra as error:
                missing.append(f"{name} not written: {error}")
        if self.netlist:
            texts["netlist.cir"] = self.netlist
        # An old page of another design must not lie beside new numbers.
        contents: dict[str | Path, bytes | None] = {
            target / name: texts[name].encode() if name in texts else None for name in FILES
        }
        write_together(contents)
        return {name: target / name for name in texts}, missing

    @cached_property
    def netlist(self) -> str:
        """One scan step as a SPICE deck, in time where the design has dynamic parts; empty where it has no netlist."""
        cells = np.full(self.design.array.shape, self.dut.rest)
        for write in (spice.dynamic_netlist, spice.netlist):
            try:
                return write(self.design, cells, 0)
            except OhmskinError:
                continue
        return ""

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
        page.filters["printable"] = printable
        return page.from_string(source).render(
            report=self,
            settings=settings_of(self.design),
            sheet=SignOff.of(self.dut, self.results),
            rating_columns=RATINGS,
            environment=environment(),
            schematic=schematic(self.design),
            budget=error_budget(self.results),
            pictures={r.requirement.id: _pictures(r) for r in self.results},
            netlist=base64.b64encode(self.netlist.encode()).decode(),
            engineering=engineering,
        )

    def record(self) -> ReportRecord:
        """Everything that report.json holds."""
        return ReportRecord(
            schema_version=SCHEMA_VERSION,
            title=printable(self.title),
            document={name: printable(value) for name, value in filed_under(self.design)},
            parts=replaced(self.design.parts.model_dump(mode="python", exclude_none=True), finite_or_text),
            outcome=self.outcome,
            exit_code=self.exit_code,
            finished=self.finished.isoformat(timespec="seconds"),
            seconds=round(self.seconds, 3),
            command=printable(self.command),
            target=self.target,
            seed=self.dut.seed,
            samples=self.dut.samples,
            design_sha256=self.design_sha256,
            cell_sha256=self.cell_sha256,
            run_sha256=self.fingerprint,
            cell_source=self.dut.cell_source,
            design=replaced(self.design.model_dump(mode="python"), finite_or_text),
            cell=replaced(self.dut.cell.model_dump(mode="python"), finite_or_text),
            environment=environment(),
            requirements=[_requirement_record(result) for result in self.results],
            not_judged=self.not_judged,
            not_modelled=[effect.name for effect in self.assumptions.effects],
            not_given=dict(self.assumptions.not_given),
            exact=list(self.assumptions.exact),
            claims=[ClaimRecord.model_validate(claim) for claim in self.claims],
            changes=self.changes,
        )

    def json(self) -> str:
        """Every requirement, claim and check with its numbers; :func:`._record.schema` is its schema."""
        return json.dumps(self.record().model_dump(mode="json"), indent=2, allow_nan=False, ensure_ascii=False) + "\n"

    def export(self, path: str | Path) -> None:
        """The Monte Carlo boards as a table: .parquet (pandas), .nc (xarray) or .csv.

        Raises:
            InputError: nothing was sampled, another kind of file, or it cannot be written.
            MissingExtra: the extra ``data`` is not installed.
        """
        export_samples(self.results, path)

    @property
    def design_sha256(self) -> str:
        return fingerprint(everything_of(self.design))

    @property
    def cell_sha256(self) -> str:
        return fingerprint(self.dut.cell)

    def junit(self) -> str:
        """One case per requirement and per check, with values as properties and times; what was not run is skipped."""
        try:
            from junitparser import Failure, JUnitXml, Properties, Property, Skipped, TestCase, TestSuite
        except ImportError as error:
            raise _missing("junitparser") from error

        def case(found: Result | Check, name: str, group: str, seconds: float | None = None) -> TestCase:
            made = TestCase(_xml(name), group, seconds)
            why = found.why if isinstance(found, Result) else found.reason
            if found.outcome is Outcome.FAIL:
                because = f"; {why}" if why else ""
                made.result = [Failure(_xml(f"measured {found.found}, required {found.required}{because}"))]
            elif found.outcome is not Outcome.PASS:
                made.result = [Skipped(_xml(f"{found.outcome}: {why or 'no limit is given'}"))]
            return made

        xml = JUnitXml("ohmskin verify")
        suite = TestSuite("requirements")
        for result in self.results:
            requirement = case(result, f"{result.requirement.id} {result.title}", "ohmskin.verify", result.seconds)
            properties = Properties()
            for name, value in _properties(result).items():
                properties.add_property(Property(name, _xml(value)))
            requirement.append(properties)
            suite.add_testcase(requirement)
        if self.results:
            xml.add_testsuite(suite)
        for claim in self.claims:
            suite = TestSuite(f"{claim.id} {claim.title}")
            suite.add_property("seconds", f"{claim.seconds:.3f}")
            for check in claim.checks:
                suite.add_testcase(case(check, check.name, f"ohmskin.verify.{claim.id}"))
            xml.add_testsuite(suite)
        xml.update_statistics()
        text: bytes | str = xml.tostring()
        return text.decode() if isinstance(text, bytes) else text

    def markdown(self) -> str:
        """The verdict and the table of requirements."""
        sheet = SignOff.of(self.dut, self.results)
        lines = [
            f"# {markdown(self.title)}: {self.outcome}",
            "",
            *(f"{name}: {markdown(value)}  " for name, value in sheet.filed_under),
            *(f"{name}: {markdown(value)}  " for name, value in sheet.part_numbers),
            f"{self.count('pass')} pass, {self.count('fail')} fail, {self.count('not run')} not run, "
            f"{self.count('does not apply')} do not apply. Design {self.design_sha256[:12]}, seed {self.dut.seed}, "
            f"ohmskin {__version__}.",
            "",
            *_table(sheet.columns, (line.row for line in sheet.bounds)),
            "",
        ]
        if sheet.ratings:
            lines += [*_table(RATINGS, (line.row for line in sheet.ratings)), ""]
        reasons = [*sheet.failed, *self.left_out_by_reason]
        if reasons:
            lines += [*_table(["not passed", "why"], reasons), ""]
        lines += [*_table(sheet.coverage.header, sheet.coverage.rows), "", markdown(self.assumed)]
        mended = ", ".join(r.requirement.id for r in self.results if self.to_mend(r))
        if mended:
            command = markdown_code(self.explore_command)
            lines += ["", f"Which single part would mend {markdown(mended)}: {command}"]
        if self.claims:
            lines += ["", *_table(["claim", "outcome"], ((f"{c.id} {c.title}", c.outcome) for c in self.claims))]
        if self.changes:
            changed = ((c.id, c.change, c.was, c.is_now) for c in self.changes if c.change != "same")
            lines += ["", *_table(["against the older report", "change", "was", "is"], changed)]
        return "\n".join(lines) + "\n"


def _table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a table in Markdown."""
    cells = (" | ".join(markdown(str(cell)) for cell in row) for row in rows)
    return [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}", *(f"| {line} |" for line in cells)]


def _xml(text: str) -> str:
    return printable(" ".join(text.split()))


def _properties(result: Result) -> dict[str, str]:
    """What JUnit carries beside the outcome."""
    found = {"quantity": result.requirement.quantity, "method": result.method, "limit": result.required}
    found |= {"measured": result.found, "margin": result.margin_shown, "source": result.requirement.source}
    if result.measurement is not None:
        found |= {"value": repr(result.measurement.value), "unit": result.unit, "where": result.measurement.where}
        found["confidence"] = result.measurement.confidence
    return {name: value for name, value in found.items() if value}


def _requirement_record(result: Result) -> RequirementRecord:
    """Each field by its name, of the result, of the requirement or of the measurement."""
    found, sources = result.measurement, (result, result.requirement, result.measurement or Measurement(0.0, ""))
    values = {
        name: next(getattr(source, name) for source in sources if hasattr(source, name))
        for name in RequirementRecord.model_fields
        if name not in ("measured", "reason", "contributions")
    }
    return RequirementRecord(
        **values,
        measured=found.value if found else None,
        reason="" if result.outcome is Outcome.PASS else result.why,
        contributions={k: v for k, v in (found.contributions if found else {}).items() if math.isfinite(v)},
    )


def _pictures(result: Result) -> list[Figure]:
    """Figures of a requirement: its own, the tornado of its contributions, and the histogram of its samples."""
    found = result.measurement
    if found is None:
        return []
    pictures = list(found.figures)
    if len(found.contributions) > 1:
        pictures += _tornado(result, found)
    if found.samples:
        pictures += _histogram(result, found)
    return pictures


def _tornado(result: Result, found: Measurement) -> list[Figure]:
    scale, unit = _scale(result.unit, max(map(abs, found.contributions.values()), default=1.0))
    items = sorted(found.contributions.items(), key=lambda item: abs(item[1]))

    def draw(panels: Any) -> None:
        panel, values = panels[0, 0], [scale * value for _, value in items]
        panel.barh(range(len(items)), values, color=[plots.BLUE if v >= 0 else plots.ORANGE for v in values])
        panel.set_yticks(range(len(items)), [name for name, _ in items])
        panel.axvline(0, color=plots.INK, lw=0.8)
        panel.set_xlabel(f"{result.title.lower()} / {unit}" if unit else result.title.lower())
        panel.grid(visible=False, axis="y")

    caption = f"{result.title} by each kind of part alone, all others nominal (tornado)."
    return picture(caption, draw, width=7.2, height=0.7 + 0.26 * len(items))


def _histogram(result: Result, found: Measurement) -> list[Figure]:
    values = np.array([v for v in found.samples if math.isfinite(v)])
    lost = len(found.samples) - len(values)

    def draw(panels: Any) -> None:
        panel = panels[0, 0]
        if len(values):
            panel.hist(values, bins=min(60, max(8, len(values) // 12)), color=plots.SKY)
        for limit in (result.requirement.min, result.requirement.max):
            if limit is not None:
                panel.axvline(limit, color=plots.RED, lw=1.6)
                panel.text(limit, panel.get_ylim()[1], " limit", color=plots.RED, va="top", fontsize=8)
        panel.set(xlabel=f"{result.title.lower()} / {result.unit}", ylabel="boards")

    note = f" {lost} boards gave no number and count as failed." if lost else ""
    caption = f"{result.title} of {len(found.samples)} boards drawn at random.{note}"
    return picture(caption, draw, width=7.2, height=2.5)


def _scale(unit: str, largest: float) -> tuple[float, str]:
    """A factor and a unit with prefix for axes."""
    if unit not in PREFIXED or not largest:
        return 1.0, unit
    shown = engineering(largest, unit)
    value, _, prefixed = shown.partition(" ")
    factor = 10.0 ** round(math.log10(float(value) / largest)) if float(value) else 1.0
    return factor, prefixed


def error_budget(results: Sequence[Result]) -> Table | None:
    """The worst cases by kind of part of all results that have them, side by side; None if there are none."""
    found = [(r, r.measurement) for r in results if r.method == "worst-case" and r.measurement is not None]
    found = [(result, measured) for result, measured in found if measured.contributions]
    if not found:
        return None
    kinds = dict.fromkeys(kind for _, measured in found for kind in measured.contributions)
    rows = [
        [kind, *(_budget_entry(measured.contributions.get(kind), measured.unit) for _, measured in found)]
        for kind in kinds
    ]
    rows.append(["all together", *(engineering(measured.value, measured.unit) for _, measured in found)])
    return Table(
        ["part, alone", *(f"{result.requirement.id} {result.title.lower()}" for result, _ in found)],
        rows,
        "Error budget: the worst case with each kind of part over its tolerance and all others nominal, whatever is "
        "pressed; and with all parts together.",
    )


def _budget_entry(value: float | None, unit: str) -> str:
    return "" if value is None else engineering(value, unit)


def environment() -> dict[str, str]:
    """Versions that the numbers come from."""
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "scipy")}
    return {"ohmskin": __version__, "python": platform.python_version(), "system": sys.platform, **versions}


def _missing(module: str) -> MissingExtra:
    return MissingExtra(f"the report needs {module}: {install_command('report')}")
