"""Run every requirement and every experiment, whatever happens to any of them.

Each one is a task of its own: a function of the subject that shares nothing with the others. Tasks run in this process,
in worker processes, or in any executor of ``concurrent.futures``, with the same numbers. What a task found is stored as
soon as it is there, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import importlib.resources
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
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
from ._catalogue import HARDWARE, SAMPLED, WORST
from ._claims import STATEMENTS, Statement
from ._hardware import twins
from ._montecarlo import BLOCK, blocks, sample_block
from ._outcome import Claim, Finding, Result, defect, not_run
from ._own_code import Allowing, OwnFunction, read_own_functions
from ._report import Report
from ._requirements import check_requirements, default_requirements, evaluate
from ._static import TARGETS, box_of, keep_samples, presses_of
from ._subject import SAMPLES, SEED, Subject, everything_of
from ._targets import Press

NO_PORT = ("emulated", "firmware")
_SEARCHED = (None, WORST, SAMPLED)
"""methods of a requirement that rest on the worst-case search of its quantity"""
ON_TARGET = ("P14",)
"""claims that talk to the target of the run"""


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
    kind: str
    """"requirement", "claim" or "samples\""""
    number: int
    """of the requirement, of the statement, or of the block of boards"""


class Work(NamedTuple):
    """What the tasks of one run have in common."""

    subject: Subject
    requirements: tuple[Requirement, ...]
    own: Mapping[str, OwnFunction]
    """functions of the design's own, by quantity"""
    presses: tuple[tuple[str, list[Press]], ...] = ()
    """of the Monte Carlo analysis, by quantity"""


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
        progress: told of each task that is done.
        announce: told, before anything is computed, which files of the design's own are run.

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
    subject = Subject(prototype() if design is None else design, cell, target, seed, samples, jig, board, baud)
    wanted = tuple(requirements if requirements is not None else subject.design.requirement)
    wanted = wanted or default_requirements(subject.design)
    check_requirements(wanted)
    wanted = twins(subject, wanted)
    with_paper = design is None and requirements is None if paper is None else paper
    statements = list(STATEMENTS if with_paper else ())
    wanted, statements = _chosen(wanted, statements, tuple(only))
    own = read_own_functions(wanted, folder or Path(), allow_code)
    for path, sha256 in {function.path: function.sha256 for function in own.values() if function.allowed}.items():
        announce(f"the design's own code is run: {path}, SHA-256 {sha256}")
    work = Work(subject, wanted, own)
    memory = _Store(store, _fingerprint(work))
    if target != "emulated":  # another board may answer at the same port by now
        _subjects.pop(memory.fingerprint, None)
    results = _compute(work, statements, memory, jobs, executor, progress)
    name = title or ("the paper's 4 × 4 prototype" if design is None else "readout design")
    report = Report(
        title=name,
        subject=subject,
        results=[found for found in results if isinstance(found, Result)],
        claims=[found for found in results if isinstance(found, Claim)],
        seconds=time.perf_counter() - start,
        command=command,
        fingerprint=memory.fingerprint,
        require_all=require_all,
        judged_by_default=requirements is None and not subject.design.requirement,
    )
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
) -> list[Result | Claim]:
    """All results in order; those stored are not computed again."""
    sampled = {r.quantity for r in work.requirements if r.method == SAMPLED and r.quantity in TARGETS}
    # The presses of the boards come from the worst-case search here, whose own requirement then costs nothing more, and
    # which the worst board may have to correct.
    last = [number for number, r in enumerate(work.requirements) if r.quantity in sampled and r.method in _SEARCHED]
    names = [statement.id for statement in STATEMENTS]
    tasks = [
        Task(f"requirement-{number}", f"{r.id} {r.quantity}", "requirement", number)
        for number, r in enumerate(work.requirements)
        if number not in last
    ]
    tasks += [Task(f"claim-{s.id}", f"{s.id} {s.title}", "claim", names.index(s.id)) for s in statements]
    if sampled:
        work = work._replace(presses=tuple((name, presses_of(work.subject, name)) for name in sorted(sampled)))
        tasks += [
            Task(f"samples-{k}", f"boards {k * BLOCK + 1} to {(k + 1) * BLOCK}", "samples", k)
            for k in range(blocks(work.subject.samples))
        ]
    found = _run_all(work, tasks, memory, jobs, executor, progress)
    for quantity, _ in work.presses:
        parts = [found[f"samples-{k}"][quantity] for k in range(blocks(work.subject.samples))]
        keep_samples(work.subject, quantity, np.concatenate(parts))
    for number in last:
        found[f"requirement-{number}"] = evaluate(work.subject, work.requirements[number], work.own)
    ordered = [found[f"requirement-{number}"] for number in range(len(work.requirements))]
    return ordered + [found[f"claim-{statement.id}"] for statement in statements]


def _run_all(
    work: Work, tasks: list[Task], memory: _Store, jobs: int, executor: Executor | None, progress: Progress
) -> dict[str, Any]:
    found = {task.key: value for task in tasks if (value := memory.load(task)) is not None}
    left = [task for task in tasks if task.key not in found]
    done = len(found)

    def tell(item: tuple[Task, Any]) -> None:
        nonlocal done
        task, value = item
        found[task.key] = value
        memory.save(task, value)
        done += 1
        progress(done, len(tasks), task.what)

    run = partial(_do, work)
    # A port has one owner: what is measured on the board is measured here, one after the other.
    in_processes(run, [task for task in left if _on_board(work, task)], jobs=1, done=tell)
    apart = [task for task in left if not _on_board(work, task)]
    if executor is None:
        in_processes(run, apart, jobs=jobs, done=tell)
    else:
        futures = [executor.submit(run, task) for task in apart]
        for future in as_completed(futures):
            tell(future.result())
    return found


def _on_board(work: Work, task: Task) -> bool:
    """Whether a task talks to the target of the run."""
    if work.subject.target == "emulated":
        return False
    if task.kind == "requirement":
        return work.requirements[task.number].method == HARDWARE
    return task.kind == "claim" and STATEMENTS[task.number].id in ON_TARGET


_subjects: dict[str, Subject] = {}
"""In each process: the subject with the intermediate results that earlier tasks have left."""


def _do(work: Work, task: Task) -> tuple[Task, Any]:
    """One task, in whatever process."""
    subject = _subjects.setdefault(_fingerprint(work), work.subject)
    if len(_subjects) > 4:  # a long-lived worker serves many runs
        _subjects.clear()
    if task.kind == "samples":
        box = box_of(subject)
        return task, {
            quantity: sample_block(TARGETS[quantity], box, presses, subject.seed, task.number).tolist()
            for quantity, presses in work.presses
        }
    if task.kind == "requirement":
        return task, evaluate(subject, work.requirements[task.number], work.own)
    return task, _claim(subject, STATEMENTS[task.number])


def _claim(subject: Subject, statement: Statement) -> Claim:
    start = time.perf_counter()
    finding = _finding(subject, statement)
    seconds = time.perf_counter() - start
    return Claim(statement.id, statement.title, statement.where, statement.says, finding, seconds)


def _finding(subject: Subject, statement: Statement) -> Finding:
    try:
        return statement.experiment(subject)
    except OhmskinError as error:
        return not_run("experiment", f"{type(error).__name__}: {error}")
    except Exception as error:  # a defect in one experiment must not cost the report of the others
        return not_run("experiment", defect(error))


def _fingerprint(work: Work) -> str:
    """SHA-256 of everything that the numbers depend on."""
    subject = work.subject
    told = {
        "version": __version__,
        "design": everything_of(subject.design),
        "cell": subject.cell.model_dump(),
        "requirements": [requirement.model_dump(mode="python") for requirement in work.requirements],
        "own code": {quantity: function.allowed and function.sha256 for quantity, function in work.own.items()},
        "target": subject.target,
        "jig": None if subject.jig is None else subject.jig.tolist(),
        "seed": subject.seed,
        "samples": subject.samples,
    }
    return fingerprint(told)


class _Store:
    """Results of tasks in a folder, one JSON file each, so that a run can go on after an interruption."""

    def __init__(self, folder: Path | None, fingerprint: str) -> None:
        self.fingerprint = fingerprint
        self._folder = None if folder is None else folder / fingerprint

    def load(self, task: Task) -> Any:
        """What an earlier run found, or None."""
        if self._folder is None or not (path := self._folder / f"{task.key}.json").is_file():
            return None
        try:
            value = json.loads(read_text(path, most_bytes=1 << 28))
            kinds: dict[str, Any] = {"requirement": Result, "claim": Claim, "samples": dict[str, list[float]]}
            return TypeAdapter(kinds[task.kind]).validate_python(value)
        except (ValueError, InputError):  # a file of another version is computed again
            return None

    def save(self, task: Task, value: Any) -> None:
        if self._folder is None:
            return
        make_folder(self._folder)
        plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
        write_text(self._folder / f"{task.key}.json", json.dumps(plain, default=_plain))

    def clear(self) -> None:
        """The run is complete: its report takes the place of what was stored."""
        if self._folder is None or not self._folder.is_dir():
            return
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)
        with suppress(OSError):
            self._folder.rmdir()


def _plain(value: Any) -> Any:
    return value.model_dump(mode="python") if isinstance(value, BaseModel) else str(value)
