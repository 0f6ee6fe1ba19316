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
from ._claims import APPENDICES, STATEMENTS, Statement
from ._outcome import Claim, Finding, not_run
from ._report import Report
from ._subject import Subject

NO_PORT = ("emulated", "firmware")


def prototype() -> Design:
    """The paper's 4 x 4 prototype with ordinary parts; the parts' values are the project's own."""
    with importlib.resources.as_file(importlib.resources.files(__package__) / "prototype.toml") as path:
        return Design.load(path)


def verify(
    design: Design | None = None, *, title: str | None = None, target: str = "emulated", jobs: int = 1
) -> Report:
    """Run the experiments P1 to P14 and the appendices on a design.

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
    subject = Subject(prototype() if design is None else design, Cell.example(), target)
    run = partial(_run, subject)
    statements = [*STATEMENTS, *APPENDICES]
    if jobs == 1:
        claims = [run(statement) for statement in statements]
    else:
        _ = subject.calibrated  # once, before it goes to every process
        with ProcessPoolExecutor(jobs) as pool:
            claims = list(pool.map(run, statements))
    count = len(STATEMENTS)
    name = title or ("the paper's 4 × 4 prototype" if design is None else "readout design")
    command = " ".join(["ohmskin verify", *([name] if design is not None else [])])
    seconds = time.perf_counter() - start
    return Report(name, subject.design, target, claims[:count], claims[count:], seconds, command)


def _run(subject: Subject, statement: Statement) -> Claim:
    return Claim(statement.id, statement.title, statement.where, statement.says, _finding(subject, statement))


def _finding(subject: Subject, statement: Statement) -> Finding:
    try:
        return statement.experiment(subject)
    except OhmskinError as error:
        return not_run("experiment", f"{type(error).__name__}: {error}")
    except Exception:  # a defect in one experiment must not cost the report of the others
        return not_run("experiment", f"stopped by a defect: {traceback.format_exc(limit=-3)}")
