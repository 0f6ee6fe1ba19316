"""Run every experiment, whatever happens to any of them."""

from __future__ import annotations

import importlib.resources
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from ..cell import Cell
from ..circuits import Design
from ..driver import Skin
from ..errors import OhmskinError
from .bench import Bench
from .claims import STATEMENTS, Statement
from .outcome import Claim, Finding, not_run
from .report import Report

NO_PORT = ("emulated", "firmware")


def prototype() -> Design:
    """The paper's 4 x 4 prototype with ordinary parts; the parts' values are the project's own."""
    with importlib.resources.as_file(importlib.resources.files(__package__) / "prototype.toml") as path:
        return Design.load(path)


def verify(
    design: Design | None = None, *, title: str | None = None, target: str = "emulated", jobs: int = 1
) -> Report:
    """Run the experiments P1 to P14 on a design.

    Args:
        design: None takes :func:`prototype`.
        title: what the report calls the design.
        target: the board of P14: "emulated", or a serial port.
        jobs: how many experiments run side by side, each in a process of its own.

    Raises:
        LinkError, ProtocolError: the target is a port with no board behind it, found before anything is run.
    """
    if target not in NO_PORT:
        with Skin.open(target) as skin:
            next(skin)
    start = time.perf_counter()
    bench = Bench(prototype() if design is None else design, Cell.example(), target)
    run = partial(_run, bench)
    numbers = range(len(STATEMENTS))
    if jobs == 1:
        claims = [run(number) for number in numbers]
    else:
        with ProcessPoolExecutor(jobs) as pool:
            claims = list(pool.map(run, numbers))
    name = title or ("the paper's 4 × 4 prototype" if design is None else "readout design")
    command = " ".join(["ohmskin verify", *([name] if design is not None else [])])
    return Report(name, bench.design, target, claims, time.perf_counter() - start, command)


def _run(bench: Bench, number: int) -> Claim:
    statement = STATEMENTS[number]
    return Claim(statement.id, statement.title, statement.where, statement.says, _finding(bench, statement))


def _finding(bench: Bench, statement: Statement) -> Finding:
    if statement.experiment is None:
        return not_run("experiment", "not built yet")
    try:
        return statement.experiment(bench)
    except OhmskinError as error:
        return not_run("experiment", f"{type(error).__name__}: {error}")
    except Exception:  # a defect in one experiment must not cost the report of the others
        return not_run("experiment", f"stopped by a defect: {traceback.format_exc(limit=-3)}")
