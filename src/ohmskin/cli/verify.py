"""``ohmskin verify``: the design verification report."""

from __future__ import annotations

import click

from ..circuits import Design
from ..verification import verify
from . import arguments


@click.command(epilog=arguments.example("ohmskin verify design.toml -o report --jobs 2"))
@click.argument("design_file", metavar="[DESIGN.toml]", required=False)
@click.option(
    "-o", "--output", default="ohmskin-report", show_default=True, metavar="DIR", help="Where the report goes."
)
@click.option(
    "--target", default="emulated", show_default=True, metavar="emulated|firmware|PORT", help="The board of P14."
)
@click.option("--jobs", type=click.IntRange(min=1), default=1, show_default=True, help="Experiments side by side.")
def command(design_file: str | None, output: str, target: str, jobs: int) -> int:
    """Verify a readout design; without DESIGN.toml, the paper's 4 x 4 prototype.

    Writes report.html, report.json and junit.xml. Exit code 0: all pass; 1: a requirement fails; 2: bad input;
    3: something could not be run.
    """
    design = None if design_file is None else Design.load(design_file)
    report = verify(design, title=design_file, target=target, jobs=jobs)
    paths, missing = report.write(output)
    for claim in report.sections:
        click.echo(f"{claim.id:>4}  {claim.outcome:<8} {claim.title}")
        for check in claim.finding.checks:
            if check.outcome != "pass":
                reason = check.found.splitlines()[-1] if check.found else ""
                click.echo(f"      {'':8} {check.name}: {reason}")
    for reason in missing:
        click.echo(f"ohmskin: {reason}", err=True)
    passed, failed, left = (report.count(outcome) for outcome in ("pass", "fail", "not run"))
    click.echo(f"{passed} pass, {failed} fail, {left} not run: {paths.get('report.html', paths['report.json'])}")
    return report.exit_code
