"""Run every requirement and every experiment, whatever happens to any of them.

Each one is a task of its own: a function of the design under test that shares nothing with the others. Tasks run in
this process, in worker processes, or in any executor of ``concurrent.futures``, with the same numbers. What a task
finds is reported and stored as soon as it is there: an interrupted run leaves its report, and goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import importlib.resources
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import BaseModel, TypeAdapter

from .. import __version__
from ..cell import Cell
from ..circuits import Design, Requirement
from ..common.arrays import FloatArray
from ..common.config import fingerprint
from ..common.files import make_folder, read_text
from ..common.progress import Progress, silent
from ..common.tables import write_text
from ..common.workers import in_processes
from ..driver import Skin
from ..errors import InputError, OhmskinError
from . import _crosstalk as crosstalk
from . import _material as material
from . import _whole_skin as skin
from ._catalogue import CATALOGUE
from ._claim import Statement
from ._dut import SAMPLES, SEED, DesignUnderTest, everything_of
from ._judging import Searched, block_of, judged_by
from ._montecarlo import blocks
from ._outcome import STOPPED, Attempt, Claim, DoesNotApply, NotRun, Result
from ._own_code import Allowing, OwnFunction, read_own_functions
from ._quantity import HARDWARE, SAMPLED
from ._report import Report
from ._requirements import (
    at_ratings,
    check_requirements,
    default_requirements,
    evaluate,
    stopped_result,
    twins,
)
from ._search import Target
from ._tuning import BLOCK

NO_PORT = ("emulated", "firmware")
ON_TARGET = ("P14",)
"""claims that talk to the target of the run"""
STATEMENTS = (
    *(material.fraction, material.electrodes, material.strain, material.rising, material.recovery),
    *(material.identification, material.recovery_times, material.inverse_filter, material.steps),
    *(crosstalk.slicing, crosstalk.grid_resistance, crosstalk.equation_10, crosstalk.crosstalk),
    skin.whole_skin,
)
"""the paper's claims P1 to P14, in their order"""


def prototype() -> Design:
    """The paper's 4 x 4 prototype with ordinary parts; the parts' values are the project's own."""
    with importlib.resources.as_file(importlib.resources.files(__package__) / "prototype.toml") as path:
        return Design.load(path)


class Task(NamedTuple):
    """One piece of work, small enough to pickle."""

    key: str
    """unique, and fit for a file name"""
    what: str
    """for the progress bar"""
    item: Requirement | str | int
    """a requirement, the id of a claim, or the number of a block of random boards"""


class Work(NamedTuple):
    """What the tasks of one run have in common."""

    dut: DesignUnderTest
    requirements: tuple[Requirement, ...]
    own: Mapping[str, OwnFunction]
    """functions of the design's own, by quantity"""
    fingerprint: str
    """SHA-256 of everything that the numbers depend on"""


def verify(
    design: Design | None = None,
    *,
    cell: Cell | None = None,
    requirements: Sequence[Requirement] | None = None,
    paper: bool | None = None,
    only: Iterable[str] = (),
    title: str | None = None,
    target: str = "emulated",
    jig: FloatArray | None = None,
    board: str = "ohmskin",
    baud: int | None = None,
    samples: int = SAMPLES,
    seed: int = SEED,
    jobs: int = 1,
    executor: Executor | None = None,
    store: Path | None = None,
    folder: Path | None = None,
    allow_code: Allowing = False,
    require_all: bool = False,
    command: str = "ohmskin verify",
    progress: Progress = silent,
    announce: Callable[[str], None] = lambda said: None,
    tell: Callable[[Result | Claim], None] = lambda found: None,
) -> Report:
    """Verify a design against its requirements, and on request against the paper's claims.

    Args:
        design: None takes :func:`prototype`.
        cell: what the skin is made of; None: the design's [cells], else the shipped example cell.
        requirements: None takes those of the design, else :func:`default_requirements`.
        paper: whether the paper's claims P1 to P14 are run too; None: for the prototype and its own requirements.
        only: ids of requirements and claims, or several in one text, separated by commas; empty: all.
        title: what the report calls the design.
        target: the board that is measured: "emulated", "firmware", or a serial port.
        jig: (rows, columns) ohm of known resistors on the board; None: the skin is untouched.
        board: family of the board at a port, or its BOARD.toml.
        baud: baud rate of the port; None: that of the board.
        samples: boards of the Monte Carlo analysis.
        seed: of all random numbers.
        jobs: processes side by side.
        executor: computes the tasks instead, wherever that is.
        store: folder for what tasks have found so far, in which nobody else can write; None: nothing is kept.
        folder: where the files of quantities of one's own are; None: the present folder.
        allow_code: whether these files are run, or a function that is asked of each with its path and SHA-256. Without
            permission such a requirement is not run.
        require_all: what could not be run counts as failed.
        command: what the report says makes it again.
        progress: called at the start, and after each task that is done.
        announce: called at the start with a line about each file of the design's own that is run.
        tell: called with each result as soon as it is there.

    Returns:
        The report. After a :class:`KeyboardInterrupt` it holds what was found until then (:attr:`Report.interruption`).

    Raises:
        InputError: bad requirements, an unknown id, no samples.
        LinkError, ProtocolError: the target is a port with no board behind it, found before anything is run.
    """
    if samples < 1:
        raise InputError(f"samples is {samples}; expected at least 1")
    if target not in NO_PORT:
        with Skin.open(target, board=board, baudrate=baud) as skin:
            next(skin)
    start = time.perf_counter()
    dut = DesignUnderTest(prototype() if design is None else design, cell, target, seed, samples, jig, board, baud)
    wanted = tuple(requirements if requirements is not None else dut.design.requirement)
    wanted = wanted or default_requirements(dut.design)
    wanted += at_ratings(dut.design)
    check_requirements(wanted)
    wanted = twins(dut, wanted)
    with_paper = design is None and requirements is None if paper is None else paper
    statements = list(STATEMENTS if with_paper else ())
    wanted, statements = _chosen(wanted, statements, tuple(only))
    own = read_own_functions(wanted, folder or Path(), allow_code)
    for path, sha256 in {function.path: function.sha256 for function in own.values() if function.allowed}.items():
        announce(f"the design's own code is run: {path}, SHA-256 {sha256}")
    work = Work(dut, wanted, own, _fingerprint(dut, wanted, own))
    if target != "emulated":  # another board may answer at the same port by now
        _known.clear()
    memory = _Store(None if store is None else store / work.fingerprint)
    results, claims, interruption = _compute(work, statements, memory, jobs, executor, progress, tell)
    report = Report(
        title=title or ("the paper's 4 × 4 prototype" if design is None else "readout design"),
        dut=dut,
        results=results,
        claims=claims,
        seconds=time.perf_counter() - start,
        command=command,
        fingerprint=work.fingerprint,
        require_all=require_all,
        judged_by_default=requirements is None and not dut.design.requirement,
        interruption=interruption,
    )
    if interruption is None:
        memory.clear()
    return report


def _chosen(
    requirements: tuple[Requirement, ...], statements: list[Statement], only: tuple[str, ...]
) -> tuple[tuple[Requirement, ...], list[Statement]]:
    if not only:
        return requirements, statements
    every = {statement.id: statement for statement in STATEMENTS}
    known = {requirement.id for requirement in requirements}
    there = known | every.keys()
    chosen = {id for given in only for id in ([given] if given in there else given.split(","))}
    for id in sorted(chosen - there):
        raise InputError(f"--only {id}: no such requirement; expected one of {', '.join([*sorted(known), *every])}")
    # An id that a requirement has taken means a statement only where that was asked for as well (--paper).
    wanted = [s for s in every.values() if s.id in chosen and (s.id not in known or s in statements)]
    return tuple(r for r in requirements if r.id in chosen), wanted


def _compute(
    work: Work,
    statements: list[Statement],
    memory: _Store,
    jobs: int,
    executor: Executor | None,
    progress: Progress,
    tell: Callable[[Result | Claim], None],
) -> tuple[list[Result], list[Claim], KeyboardInterrupt | None]:
    """All results in order, and what stopped the run; those stored are not computed again."""
    requirements = [Task(f"requirement-{n}", f"{r.id} {r.quantity}", r) for n, r in enumerate(work.requirements)]
    claims = [Task(f"claim-{s.id}", f"{s.id} {s.title}", s.id) for s in statements]
    drawn = [task for task, requirement in zip(requirements, work.requirements, strict=True) if _is_drawn(requirement)]
    count = blocks(work.dut.samples) if drawn else 0
    boards = [Task(f"samples-{k}", f"boards {k * BLOCK + 1} to {(k + 1) * BLOCK}", k) for k in range(count)]
    total, found = len(requirements) + len(claims) + len(boards), dict[str, Any]()

    def take(answer: tuple[Task, Any]) -> None:
        task, value = answer
        found[task.key] = value
        if isinstance(value, Result | Claim):
            tell(value)

    def computed(answer: tuple[Task, Any]) -> None:
        memory.save(*answer)
        take(answer)
        progress(len(found), total, answer[0].what)

    def run(tasks: Iterable[Task]) -> None:
        left = []
        for task in tasks:
            if (value := memory.load(task)) is None:
                left.append(task)
            else:
                take((task, value))
        # A port has one owner: what is measured on the board is measured here, one after the other.
        here = [task for task in left if _on_board(work.dut, task)]
        in_processes(partial(_do, work), here, jobs=1, done=computed)
        apart = [task for task in left if task not in here]
        in_processes(partial(_do, work), apart, jobs=jobs, executor=executor, done=computed)

    interruption = None
    try:
        progress(0, total, next((task.what for task in (*requirements, *claims)), ""))
        run(task for task in (*requirements, *claims) if task not in drawn)
        run(boards)
        for task in drawn:
            assert isinstance(task.item, Requirement)
            values = [found[block.key][task.item.id] for block in boards if task.item.id in found[block.key]]
            sample = np.concatenate(values)[: work.dut.samples] if values else None
            computed((task, evaluate(work.dut, task.item, work.own, sample)))
    except KeyboardInterrupt as stopped:
        interruption = stopped
    results = [
        found.get(task.key) or stopped_result(requirement)
        for task, requirement in zip(requirements, work.requirements, strict=True)
    ]
    answers = [
        found.get(task.key) or s.claim(Attempt(reason=STOPPED)) for task, s in zip(claims, statements, strict=True)
    ]
    return results, answers, interruption


def _is_drawn(requirement: Requirement) -> bool:
    """Whether random boards judge a requirement, which are drawn in blocks before it is."""
    return requirement.method == SAMPLED and requirement.quantity in CATALOGUE


def _on_board(dut: DesignUnderTest, task: Task) -> bool:
    """Whether a task talks to the target of the run."""
    measured = task.item in ON_TARGET if isinstance(task.item, str) else getattr(task.item, "method", "") == HARDWARE
    return dut.target != "emulated" and measured


_known: dict[str, DesignUnderTest] = {}
"""In each process: the design of the latest run, with the intermediate results that earlier tasks have left."""


def _do(work: Work, task: Task) -> tuple[Task, Any]:
    """One task, in whatever process."""
    if work.fingerprint not in _known:
        _known.clear()
    dut = _known.setdefault(work.fingerprint, work.dut)
    match task.item:
        case Requirement():
            return task, evaluate(dut, task.item, work.own)
        case str():
            return task, next(s for s in STATEMENTS if s.id == task.item).tried(dut)
        case block:
            drawn = {r.id: _values(dut, r, block) for r in work.requirements if _is_drawn(r)}
            return task, {id: values for id, values in drawn.items() if values}


def _values(dut: DesignUnderTest, requirement: Requirement, block: int) -> list[float]:
    """By one block of boards; none of a requirement that cannot be run, which says so itself."""
    compute = CATALOGUE[requirement.quantity].compute
    with suppress(NotRun, DoesNotApply, OhmskinError):
        if isinstance(compute, Searched) and isinstance(target := compute.target(dut, requirement), Target):
            values: list[float] = block_of(dut, target, judged_by(requirement), block).tolist()
            return values
    return []


def _fingerprint(dut: DesignUnderTest, requirements: Sequence[Requirement], own: Mapping[str, OwnFunction]) -> str:
    """SHA-256 of everything that the numbers depend on."""
    decides = {
        "version": __version__,
        "design": everything_of(dut.design),
        "cell": dut.cell.model_dump(),
        "requirements": [requirement.model_dump(mode="python") for requirement in requirements],
        "own code": {quantity: function.allowed and function.sha256 for quantity, function in own.items()},
        "target": dut.target,
        "jig": None if dut.jig is None else dut.jig.tolist(),
        "seed": dut.seed,
        "samples": dut.samples,
    }
    return fingerprint(decides)


class _Store(NamedTuple):
    """Results of tasks in a folder, one JSON file each, so that a run can go on after an interruption."""

    folder: Path | None

    def load(self, task: Task) -> Any:
        """What an earlier run found; None where there is nothing."""
        if self.folder is None or not (path := self.folder / f"{task.key}.json").is_file():
            return None
        try:
            value = json.loads(read_text(path, most_bytes=1 << 28))
            kinds: dict[str, Any] = {"requirement": Result, "claim": Claim, "samples": dict[str, list[float]]}
            return TypeAdapter(kinds[task.key.partition("-")[0]]).validate_python(value)
        except (ValueError, InputError):  # a file of another version is computed again
            return None

    def save(self, task: Task, value: Any) -> None:
        if self.folder is None:
            return
        make_folder(self.folder)
        plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
        write_text(self.folder / f"{task.key}.json", json.dumps(plain, default=_plain))

    def clear(self) -> None:
        """The run is complete: its report takes the place of what was stored."""
        if self.folder is None or not self.folder.is_dir():
            return
        for path in self.folder.glob("*.json"):
            path.unlink(missing_ok=True)
        with suppress(OSError):
            self.folder.rmdir()


def _plain(value: Any) -> Any:
    return value.model_dump(mode="python") if isinstance(value, BaseModel) else str(value)
