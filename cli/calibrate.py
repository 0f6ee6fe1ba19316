"""``ohmskin calibrate``: guided presses with known loads to a calibration of every cell."""

from __future__ import annotations

import sys
from pathlib import Path

import click
import numpy as np

from ..calibration import Guide, Plan, Press, Verdict, align, calibrate_cells, read_reference, with_reference
from ..common.files import check_writable
from ..common.json_text import json_text
from ..driver import Calibration
from ..errors import InputError
from . import arguments
from ._skin_options import QUEUE, SkinOptions, skin_options

STANDARD_GRAVITY = 9.80665
"""m/s^2"""


@click.command(
    epilog=arguments.example(
        "ohmskin calibrate /dev/ttyACM0 --load 5 --load 12 -o left-arm.toml",
        "ohmskin calibrate /dev/ttyACM0 --mass 0.2 --mass 0.5 --area 1e-4 -o left-arm.toml",
        "ohmskin calibrate presses.mcap --load 5 --load 12 --press all --reference sensor.csv -o left-arm.toml",
    )
)
@click.argument("port", metavar="PORT|FILE.mcap")
@click.option("-o", "output", required=True, type=click.Path(path_type=Path), metavar="FILE.toml")
@click.option(
    "--load",
    "loads",
    multiple=True,
    type=float,
    metavar="KPA",
    help="Load of a step; better two or more. One alone is pressed twice.",
)
@click.option("--mass", "masses", multiple=True, type=float, metavar="KG", help="Weight of a step, instead of a load.")
@click.option(
    "--area",
    type=click.FloatRange(min=0, min_open=True),
    metavar="M2",
    help="Area of the stamp. One that is smaller than what it presses loads the cells by its share only.",
)
@click.option(
    "--pitch", type=click.FloatRange(min=0, min_open=True), metavar="M", help="From cell to cell, for --area."
)
@click.option(
    "--press",
    default="each",
    show_default=True,
    metavar="each|all|RxC",
    help="What bears a load together: each cell by itself, all under a plate, or patches of rows x columns.",
)
@click.option(
    "--hold",
    type=click.FloatRange(0.2, 600),
    default=4.0,
    show_default=True,
    metavar="S",
    help="How long each load is held.",
)
@click.option(
    "--rest",
    type=click.FloatRange(0.2, 600),
    default=3.0,
    show_default=True,
    metavar="S",
    help="How long the unloaded skin is read at first.",
)
@click.option(
    "--reference",
    type=click.Path(path_type=Path),
    metavar="CSV",
    help="Loads as a sensor had them: time_s,pressure_kpa.",
)
@click.option(
    "--tolerance",
    type=float,
    default=0.1,
    show_default=True,
    metavar="SHARE",
    help="Residual up to which a cell is good, as a share of the load.",
)
@click.option("--allow-partial", is_flag=True, help="Give cells that failed the median gain of the others.")
@click.option("--resume", is_flag=True, help="Go on with the progress kept beside the output.")
@click.option("--yes", is_flag=True, help="Do not ask whether the skin is unloaded.")
@skin_options("board", "baud", "design", "cell")
@arguments.as_json("the summary")
def command(
    port: str,
    output: Path,
    loads: tuple[float, ...],
    masses: tuple[float, ...],
    area: float | None,
    pitch: float | None,
    press: str,
    hold: float,
    rest: float,
    reference: Path | None,
    tolerance: float,
    allow_partial: bool,
    resume: bool,
    yes: bool,
    options: SkinOptions,
    as_json: bool,
) -> None:
    """Measure rest resistance and gain of every cell of the skin at PORT, by presses with known loads.

    Put each load on each place, hold it until told to take it off, and go on; places may be pressed in any order. What
    is pressed is noticed by itself. A recording is calibrated from likewise. A press that went wrong is repeated. A
    calibration that does not hold is refused with the reason.
    """
    if output.suffix.lower() != ".toml":
        raise InputError(f"{output}: is no name of a calibration; expected FILE.toml")
    if bool(loads) == bool(masses):
        raise InputError("give the loads in kPa (--load) or the weights in kg (--mass), one or the other")
    if masses and area is None:
        raise InputError("--mass needs the --area of the stamp, in m^2")
    given = loads or tuple(mass * STANDARD_GRAVITY / (area or 1.0) / 1000.0 for mass in masses)
    Plan.check(press, given)
    progress = output.with_name(output.name + ".progress")
    check_writable(output, progress)
    if reference is not None and port.endswith(".mcap"):
        read_reference(reference)
    if not (yes or port.endswith(".mcap")):
        _ask_for_rest()
    with options.open(port, delivery="lossless", queue=QUEUE) as skin:
        shape = skin.design.array.shape
        share = 1.0 if area is None else _share(press, shape, area, pitch or skin.design.sheet.pitch)
        plan = Plan.make(shape, press, [share * load for load in given])
        guide = Guide(
            skin,
            plan,
            hold_s=hold,
            rest_s=rest,
            tell=lambda line: click.echo(line, err=True),
            progress=progress,
            resume=resume,
            keep_trace=reference is not None,
        )
        guide.run()
    presses = guide.watch.presses
    if reference is not None:
        presses = _by_reference(guide, reference)
    assert guide.watch.rest is not None
    assert skin.cell is not None
    verdict = calibrate_cells(skin.cell, guide.watch.rest, presses, tolerance=tolerance)
    made = verdict.calibration(skin.design, skin.cell, skin.serial_number, allow_partial=allow_partial)
    made.save(output)
    progress.unlink(missing_ok=True)
    click.echo(json_text(_summary(made)) if as_json else _text(made, verdict, output))


def _ask_for_rest() -> None:
    if not sys.stdin.isatty():
        raise InputError("nobody is there to say that the skin is unloaded; --yes says so")
    click.confirm("Is everything off the skin?", default=True, abort=True, err=True)


def _share(press: str, shape: tuple[int, int], area: float, pitch: float) -> float:
    """Mean pressure on the cells over that under the stamp."""
    cells = len(Plan.make(shape, press, [1.0]).targets[0])
    return min(1.0, area / (cells * pitch**2))


def _by_reference(guide: Guide, path: Path) -> list[Press]:
    time_s, kpa = read_reference(path)
    skin_s, skin_kpa = np.array(guide.trace).T
    alignment = align(skin_s, skin_kpa, time_s, kpa)
    click.echo(f"{path}: {alignment.text()}", err=True)
    return with_reference(guide.watch.presses, alignment, time_s, kpa)


def _summary(made: Calibration) -> dict[str, object]:
    good = made.calibrated
    return {
        "hash": made.hash,
        "serial_number": made.serial_number,
        "cells": int(good.size),
        "calibrated": int(good.sum()),
        "presses": made.presses,
        "loads_kpa": list(made.loads_kpa),
        "gain": [float(made.gain[good].min()), float(made.gain[good].max())],
        "rest_ohm": [float(made.rest_ohm[good].min()), float(made.rest_ohm[good].max())],
        "residual_kpa": float(made.residual_kpa[good].max()),
        "remarks": list(made.remarks),
    }


def _text(made: Calibration, verdict: Verdict, output: Path) -> str:
    good = made.calibrated
    lines = [
        f"{output}: {int(good.sum())} of {good.size} cells calibrated with {made.presses} presses; "
        f"gains {made.gain[good].min():.3g} to {made.gain[good].max():.3g}, rest {made.rest_ohm[good].min():.4g} to "
        f"{made.rest_ohm[good].max():.4g} ohm, residual at most {made.residual_kpa[good].max():.2g} kPa; "
        f"hash {made.hash[:16]}",
    ]
    text = verdict.text()
    if text:
        lines.append(f"left out: {text}")
    return "\n".join(lines)
