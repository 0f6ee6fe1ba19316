"""``ohmskin explore``: variations of a design, their Pareto front, and what must change."""

from __future__ import annotations

import csv
import io
from math import isnan
from pathlib import Path

import click

from ..cell import Cell
from ..circuits import Design
from ..common.files import check_writable, make_folder, write_together
from ..common.text import printable
from ..errors import MissingExtra
from ..verification import (
    DesignUnderTest,
    Variation,
    at_ratings,
    best_carbon_black,
    carbon_black_line,
    check_requirements,
    default_requirements,
    explore,
    explore_picture,
    load_requirements,
    remedies,
    with_front,
)
from . import arguments
from ._dask import dask_executor, workers


@click.command(epilog=arguments.example("ohmskin explore design.toml -o variations"))
@arguments.design_file
@click.option("--cell", "cell_file", metavar="CELL.toml", help="What the skin is made of.")
@click.option(
    "--requirements", "requirement_files", multiple=True, metavar="FILE", help="Requirements beside the design."
)
@click.option("-o", "--output", metavar="DIR", help="Write explore.csv and explore.svg here.")
@workers
@click.option("--points", type=click.IntRange(min=1), default=60, show_default=True, help="Variations in all.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the random combinations.")
def command(
    design_file: Path,
    cell_file: str | None,
    requirement_files: tuple[str, ...],
    output: str | None,
    jobs: int,
    dask: str | None,
    points: int,
    seed: int,
) -> None:
    """Vary a design: what each change buys, and what must change to keep its requirements.

    Each variation and each remedy is printed when it is known. What was found until a stop is written.
    """
    design = Design.load(design_file)
    beside = [requirement for file in requirement_files for requirement in load_requirements(file)]
    requirements = ((*design.requirement, *beside) or default_requirements(design)) + at_ratings(design)
    check_requirements(requirements)
    dut = DesignUnderTest(design, None if cell_file is None else Cell.load(cell_file), seed=seed)
    folder = None if output is None else make_folder(output)
    if folder is not None:
        check_writable(folder / "explore.csv", folder / "explore.svg")
    click.echo(f"ohmskin: judging {points} variations", err=True)
    click.echo(Variation.HEAD)
    found: list[Variation] = []

    def tell(done: int, total: int, one: Variation) -> None:
        found.append(one)
        click.echo(f"{one.line}  ({done} of {total})")

    try:
        with dask_executor(jobs, dask) as executor:
            variations = explore(dut, points=points, jobs=jobs, executor=executor, tell=tell)
    except BaseException:
        if folder is not None and found:
            _write(folder, with_front(found), None)
        raise
    if folder is not None:
        _write(folder, variations, None)
    click.echo("The Pareto front:")
    for variation in sorted(variations, key=lambda v: v.reading_error_percent):
        if variation.front or not variation.changes:
            click.echo(variation.line)
    for reason in variations[0].unknown:
        click.echo(printable(reason))
    best = best_carbon_black(dut)
    if best is not None:
        click.echo(carbon_black_line(best, variations[0]))

    def tell_requirement(done: int, total: int, what: str) -> None:
        click.echo(f"ohmskin: looking for remedies, {done + 1} of {total}: {what}", err=True)

    for remedy in remedies(dut, requirements, progress=tell_requirement):
        click.echo(remedy.line)
    if folder is not None and best is not None:
        _write(folder, variations, best)


def _write(folder: Path, variations: list[Variation], best: Variation | None) -> None:
    """Write the table and the picture."""
    contents: dict[str | Path, bytes | None] = {folder / "explore.csv": _table(variations, best).encode()}
    try:
        contents[folder / "explore.svg"] = explore_picture(variations).encode()
    except MissingExtra as error:
        click.echo(f"ohmskin: explore.svg not written: {error}", err=True)
    write_together(contents)


def _table(variations: list[Variation], best: Variation | None) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ["reading_error_percent", "crosstalk_percent", "resolution_kpa", "settling_error_percent", "frame_rate_hz"]
    writer.writerow(["variation", *names, "pareto_front", "best_carbon_black"])
    for v in [*variations, *([] if best is None else [best])]:
        figures = ("" if isnan(value := float(getattr(v, name))) else repr(value) for name in names)
        writer.writerow([v.name, *figures, int(v.front), int(v is best)])
    return text.getvalue()
