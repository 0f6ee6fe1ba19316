"""``ohmskin verify``: the design verification report."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path

import click

from ..cell import Cell
from ..circuits import Design
from ..common.files import check_writable, make_folder, user_cache
from ..common.tables import read_cells
from ..common.text import printable
from ..errors import InputError
from ..verification import CATALOGUE, Claim, Report, Result, load_record, load_requirements, prototype, schema, verify
from . import arguments
from ._bar import progress_bar
from ._dask import dask_executor, workers
from ._streams import extra_output

EXPORTS = (".parquet", ".nc", ".csv")


@click.command(epilog=arguments.example("ohmskin verify design.toml --cell cell.toml -o report --require-all"))
@click.argument("design_file", metavar="[DESIGN.toml]", required=False)
@click.option("--cell", "cell_file", metavar="CELL.toml", help="What the skin is made of.")
@click.option(
    "--requirements", "requirement_files", multiple=True, metavar="FILE", help="Requirements beside the design."
)
@click.option("--paper", is_flag=True, help="Run the paper's claims P1 to P14 on the design, too.")
@click.option(
    "-o", "--output", default="ohmskin-report", show_default=True, metavar="DIR", help="Where the report goes."
)
@click.option(
    "--target",
    default="emulated",
    show_default=True,
    metavar="emulated|firmware|PORT",
    help="The board that is measured.",
)
@click.option(
    "--board", default="ohmskin", show_default=True, metavar="NAME|FILE.toml", help="Board at the PORT of --target."
)
@click.option("--baud", type=click.IntRange(min=1), metavar="N", help="Baud rate of the PORT [the board's usual one].")
@click.option("--jig", metavar="CELLS.csv", help="Known resistors on the board of --target, in ohm.")
@click.option(
    "--only", multiple=True, metavar="ID[,ID]", help="Run only these requirements and claims; may be repeated."
)
@click.option("--require-all", is_flag=True, help="What could not be run fails the verification (for CI).")
@click.option("--against", metavar="OLD.json", help="Say what is better, worse, new or gone since that report.")
@click.option("--samples", type=click.IntRange(min=1), default=1000, show_default=True, help="Monte Carlo boards.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of all random numbers.")
@workers
@click.option("--export", metavar="FILE", help="The Monte Carlo boards as .parquet, .nc (xarray) or .csv.")
@click.option(
    "--allow-code", is_flag=True, help="Run the Python files that requirements of the design name, with your rights."
)
@click.option("--quantities", is_flag=True, help="List the quantities that a requirement may limit, and exit.")
@click.option("--schema", "print_schema", is_flag=True, help="Print the JSON schema of report.json, and exit.")
def command(
    design_file: str | None,
    cell_file: str | None,
    requirement_files: tuple[str, ...],
    paper: bool,
    output: str,
    target: str,
    board: str,
    baud: int | None,
    jig: str | None,
    only: tuple[str, ...],
    require_all: bool,
    against: str | None,
    samples: int,
    seed: int,
    jobs: int,
    dask: str | None,
    export: str | None,
    allow_code: bool,
    quantities: bool,
    print_schema: bool,
) -> int:
    """Verify a readout design against its requirements; without DESIGN.toml, the paper's 4 x 4 prototype.

    Requirements are [[requirement]] tables in the design or in a file beside it; a design without any is held to
    ohmskin's own. Writes report.html, report.json, junit.xml, summary.md and netlist.cir.

    Exit code 0: all pass; 1: a requirement fails; 2: bad input; 3: something could not be run.
    """
    if quantities or print_schema:
        click.echo(schema() if print_schema else _catalogue(), nl=False)
        return 0
    if jig is not None and target == "emulated":
        raise InputError("--jig: there is no board to carry it; expected --target firmware or a port")
    if target in ("emulated", "firmware") and (board != "ohmskin" or baud is not None):
        raise InputError(f"--board and --baud: of the board at a port; --target is {target}")
    design = None if design_file is None else Design.load(design_file)
    cell = None if cell_file is None else Cell.load(cell_file)
    requirements = [requirement for file in requirement_files for requirement in load_requirements(file)]
    old = None if against is None else load_record(against)
    if export is not None and Path(export).suffix not in EXPORTS:
        raise InputError(f"--export {export}: expected a file name that ends with {', '.join(EXPORTS)}")
    folder = make_folder(output)
    check_writable(folder / "report.html", folder / "report.json", *([export] if export else []))
    click.get_current_context().with_resource(extra_output())  # the report is what counts
    files = design_file, cell_file, requirement_files
    own = (design.requirement if design is not None else ()) if requirements else ()
    with dask_executor(jobs, dask) as executor, progress_bar("verifying") as progress:
        report = verify(
            design,
            cell=cell,
            requirements=[*own, *requirements] or None,
            paper=True if paper else None,
            only=only,
            title=None if design_file is None else design_file,
            target=target,
            board=board,
            baud=baud,
            jig=None if jig is None else read_cells(jig, (design or prototype()).array.shape),
            samples=samples,
            seed=seed,
            jobs=jobs,
            executor=executor,
            store=user_cache("verify"),
            folder=None if design_file is None else Path(design_file).parent,
            require_all=require_all,
            command=_command("verify", *files, *["--paper"] * paper, "--seed", f"{seed}", "--samples", f"{samples}"),
            progress=progress,
            allow_code=True if allow_code else _asked,
            announce=lambda said: click.echo(printable(said)),
            tell=_say_result,
        )
    if design_file is not None:
        report = replace(report, explore_command=_command("explore", *files))
    if old is not None:
        report = report.against(old)
    paths, missing = report.write(folder)
    if export is not None:
        report.export(export)
    _say_the_rest(report)
    for reason in missing:
        click.echo(f"ohmskin: {reason}", err=True)
    counts = ", ".join(f"{report.count(outcome)} {outcome}" for outcome in ("pass", "fail", "not run"))
    click.echo(
        f"{report.outcome}: {counts}, {report.count('does not apply')} do not apply: "
        f"{paths.get('report.html', paths['report.json'])}"
    )
    if report.interruption is not None:
        raise report.interruption
    return report.exit_code


def _asked(path: Path, sha256: str) -> bool:
    """Whether somebody at a terminal allows a Python file of the design."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    return click.confirm(printable(f"{path}, SHA-256 {sha256}: run this code of the design?"), err=True)


def _say_result(found: Result | Claim) -> None:
    """One verdict, as soon as it is known."""
    if sys.stderr.isatty():
        click.echo("\r\x1b[K", nl=False, err=True)  # the progress bar comes again below
    if isinstance(found, Result):
        value = f"{found.title}: {found.found} (required {found.required})"
        click.echo(printable(f"{found.requirement.id:>5}  {found.outcome:<14} {value}"))
        if found.outcome != "pass" and found.measurement is not None and found.why:
            click.echo(printable(f"       {'':14} {found.why}"))
        return
    click.echo(f"{found.id:>5}  {found.outcome:<14} {found.title}")
    for check in found.finding.checks:
        if check.outcome != "pass":
            reason = check.found.splitlines()[-1] if check.found else ""
            click.echo(printable(f"       {'':14} {check.name}: {reason}"))


def _say_the_rest(report: Report) -> None:
    mended = [r.requirement.id for r in report.results if report.to_mend(r)]
    if mended:
        click.echo(printable(f"Which single part would mend {', '.join(mended)}: {report.explore_command}"))
    for change in report.changes:
        if change.change != "same":
            click.echo(
                f"{change.id:>5}  {change.change}: was {change.was or 'not there'}, is {change.is_now or 'gone'}"
            )


def _command(name: str, design: str | None, cell: str | None, requirements: tuple[str, ...], *options: str) -> str:
    """A command about the same design, to type."""
    words = ["ohmskin", name, *([design] if design else []), *(["--cell", cell] if cell else [])]
    words += [word for file in requirements for word in ("--requirements", file)]
    return shlex.join([*words, *options])


def _catalogue() -> str:
    lines = [f"{'quantity':<22} {'unit':<16} {'methods':<36} what it is"]
    for q in CATALOGUE.values():
        lines.append(f"{q.name:<22} {q.unit:<16} {', '.join(q.methods):<36} {q.says}")
    return "\n".join(lines) + "\n"
