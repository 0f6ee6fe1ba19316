"""ngspice as an independent judge: through PySpice and libngspice, or as a command of its own.

This is the only module that imports PySpice (GPL, extra ``spice``), and only when it is used. PySpice 1.5 is from
2021 and needs some care, all of it kept here.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import os
import re
import shutil
import signal
import subprocess
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...common.arrays import FloatArray
from ...common.extras import install_command
from ...errors import MissingExtra, SolverError
from .._design import Design
from ..readouts import REFERENCE
from ._netlist import Deck, frame_deck, step_deck

LEAST_LIMIT_S, LIMIT_PER_CARD_S = 20, 0.05
"""of processor time for one run of the command, as a constant and by cards of the netlist; a macro-model may find no
convergence for ever"""
_WAITING = 20.0
"""ratio of time to processor time on a busy machine, beyond which a run is given up all the same"""
COMMAND = "*# "
"""begins a line that ngspice runs, and that other simulators take for a comment"""
Vectors = dict[str, NDArray[Any]]
"""By ngspice's name of node or vector: float64, or complex128 after an AC analysis."""


def available() -> str | None:
    """Why :func:`spice_scan` cannot run here, or None if it can."""
    try:
        _library()
    except MissingExtra as error:
        return str(error)
    return None


def command_available() -> str | None:
    """Why :func:`command_scan` cannot run here, or None if it can."""
    if shutil.which("ngspice"):
        return None
    return "the command 'ngspice' is not installed (Debian, Ubuntu: apt install ngspice)"


def spice_scan(design: Design, resistance: ArrayLike) -> FloatArray:
    """The column outputs of one frame in V, (rows, columns): one operating point per row, by libngspice.

    Raises:
        InputError: cells that do not fit the design.
        MissingExtra: PySpice or libngspice is not installed.
        SolverError: contradictory ideal parts, or no convergence.
    """
    cells = design.resistance(resistance)
    decks = [step_deck(design, cells, row) for row in range(design.array.rows)]
    return np.vstack([_volts(deck, run_library(deck.batch_text()))[0] for deck in decks])


def command_scan(design: Design, resistance: ArrayLike) -> FloatArray:
    """As :func:`spice_scan`, by one process of the ngspice command and one sweep: its fastest way.

    Raises:
        InputError, SolverError: as :func:`spice_scan`; a few extreme circuits have no sweep, see
            :func:`ohmskin.circuits.spice._netlist.frame_deck`.
        MissingExtra: the command is not installed.
    """
    deck = frame_deck(design, resistance)
    return design.board.turn(_volts(deck, run_command(deck.batch_text())).reshape(design.board.shape))


def run_library(text: str) -> Vectors:
    """Run the analysis in a netlist by libngspice and return the vectors it saved.

    There is one libngspice per process, so this is not for several threads at once.

    Raises:
        MissingExtra: PySpice or libngspice is not installed.
        SolverError: ngspice gave no result; the message holds what it said.
    """
    ngspice = _library()
    with _quiet():
        try:
            ngspice.load_circuit(text)
            with suppress(NameError):
                # PySpice raises (heirs of NameError) at any note, even that another start of Newton's method
                # succeeded; whether there is a result shows below.
                ngspice.run()
            said, name = ngspice.stderr, ngspice.last_plot
            failed = name == "const" or "abort" in said  # "const" holds pi and the like, and is always there
            plot = {} if failed else ngspice.plot(None, name)
        except NameError as error:
            raise SolverError(f"ngspice refused the netlist: {_gist(ngspice.stdout)}") from error
        finally:
            # Without both, every circuit and every result stay in memory for good.
            with suppress(NameError):
                ngspice.destroy()
                ngspice.remove_circuit()
    vectors = {_canonical(name): vector._data for name, vector in plot.items()}
    if not any(len(vector) for vector in vectors.values()):
        raise SolverError(f"ngspice gave no result: {_gist(said)}")
    return vectors


def run_command(text: str) -> Vectors:
    """As :func:`run_library`, by a process of the ngspice command.

    Raises:
        MissingExtra: the command is not installed.
        SolverError: ngspice gave no result; the message holds what it said.
    """
    if reason := command_available():
        raise MissingExtra(reason)
    with tempfile.TemporaryDirectory(prefix="ohmskin-") as folder:
        raw = Path(folder, "result.raw")
        command = ["ngspice", "-b", "-r", str(raw)]
        # A raw file is written whatever comes of the analysis; what was said tells.
        process = subprocess.run(command, input=text, text=True, capture_output=True, check=False, cwd=folder)
        if "abort" in process.stderr or not raw.exists():
            raise SolverError(f"ngspice gave no result: {_gist(process.stderr)}")
        return _read_raw(raw.read_bytes())


def run_control(text: str) -> dict[str, float]:
    """Run a netlist that prints its own results (``name = number``) under ``ngspice -b`` and return those.

    Raises:
        MissingExtra: the command is not installed.
        SolverError: as :func:`simulate`.
    """
    return simulate(text).printed


class Simulated(NamedTuple):
    """What ngspice printed."""

    printed: dict[str, float]
    """results by name"""
    dropped: tuple[str, ...]
    """parameters of models that ngspice does not know and has left out"""
    complaints: str
    """its errors and warnings about an analysis that failed; empty: none"""


def simulate(text: str, *, pspice: bool = False) -> Simulated:
    """As :func:`run_control`, with what ngspice said.

    Args:
        text: of the netlist.
        pspice: whether parts of it may be in PSpice's dialect, as makers' models are.

    Raises:
        MissingExtra: the command is not installed.
        SolverError: nothing was printed, or not within the limit of processor time, which grows with the netlist; the
            message holds what ngspice said instead.
    """
    if reason := command_available():
        raise MissingExtra(reason)
    command = ["ngspice", "-n", "-b"]  # -n: no .spiceinit, whose commands could change the results
    if pspice:
        # In this mode ngspice takes *# for a comment, but runs .control blocks.
        command[1:1] = ["-D", "ngbehavior=psa"]
        text = _with_control_block(text)
    limit = round(LEAST_LIMIT_S + LIMIT_PER_CARD_S * text.count("\n"))
    try:
        process = subprocess.run(
            ["sh", "-c", 'ulimit -t "$0"; exec "$@"', str(limit), *command],
            input=text,
            text=True,
            errors="replace",
            capture_output=True,
            check=False,
            timeout=_WAITING * limit,
        )
    except subprocess.TimeoutExpired as error:
        raise SolverError(f"ngspice found no result within {_WAITING * limit:g} s") from error
    if process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise SolverError(f"ngspice found no result within {limit} s of processor time")
    printed = re.findall(r"^(\w+) = (\S+)\s*$", process.stdout, flags=re.MULTILINE)
    said = process.stderr + process.stdout
    if not printed:
        raise SolverError(f"ngspice gave no result: {_gist(said)}")
    dropped = re.findall(r"unrecognized parameter \((\w+)\) - ignored", said)
    complaints = _gist(said) if re.search(_COMPLAINT, said, flags=re.IGNORECASE) else ""
    return Simulated({name: float(number) for name, number in printed}, tuple(dict.fromkeys(dropped)), complaints)


def _with_control_block(text: str) -> str:
    """The netlist with its commands in a .control block instead of behind ``*#``."""
    lines = text.splitlines()
    commands = [line[3:] for line in lines if line.startswith(COMMAND)]
    cards = [line for line in lines if not line.startswith((COMMAND, ".tran", ".meas")) and line != ".end"]
    return "\n".join([*cards, ".control", *commands, ".endc", ".end", ""])


def _volts(deck: Deck, vectors: Vectors) -> FloatArray:
    """The outputs of a deck against board ground, (points of the row sweep, columns)."""
    points = len(next(iter(vectors.values())))
    potential = {REFERENCE: np.zeros(points)} | vectors
    volts = np.column_stack([potential[node] for node in deck.outputs]) - potential[deck.ground][:, None]
    if not deck.one_by_one:
        return volts
    columns = len(deck.outputs)
    return volts.reshape(-1, columns, columns).diagonal(axis1=1, axis2=2)


def _canonical(name: str) -> str:
    """A node by its own name, whichever way the vector of its potential is called."""
    return name[2:-1] if name.startswith("v(") else name


def _read_raw(content: bytes) -> Vectors:
    """The first plot of an ngspice raw file."""
    header, _, body = content.partition(b"Binary:\n")
    lines = header.decode("ascii", errors="replace").splitlines()
    fields = dict(line.split(": ", 1) for line in lines if ": " in line)
    count, points = int(fields["No. Variables"]), int(fields["No. Points"])
    names = [line.split("\t")[2] for line in lines[-count:]]
    kind = np.dtype("complex128" if "complex" in fields["Flags"] else "float64")
    table = np.frombuffer(body, dtype=kind, count=count * points).reshape(points, count)
    return {_canonical(name): column for name, column in zip(names, table.T, strict=True)}


_COMPLAINT = "error|singular|fail|fatal|too small|no convergence|trouble|abort"


def _gist(said: str) -> str:
    """What matters in ngspice's many words about a failure."""
    spoken = (line.strip() for line in said.splitlines() if not re.match(r"\s*(error: )?meas", line, re.IGNORECASE))
    lines = [line for line in spoken if re.search(_COMPLAINT, line, flags=re.IGNORECASE)]
    return "; ".join(list(dict.fromkeys(lines))[:3]) or said.strip()[-200:] or "it said nothing"


def _library() -> Any:
    """PySpice's handle of libngspice (one per process). Raises MissingExtra."""
    path = os.environ.get("NGSPICE_LIBRARY_PATH") or ctypes.util.find_library("ngspice")
    if path is None:
        raise MissingExtra("libngspice is not installed (Debian, Ubuntu: apt install libngspice0)")
    try:
        ctypes.CDLL(path)  # PySpice does not survive a first attempt that fails
        with _quiet():
            from PySpice.Spice.NgSpice.Shared import NgSpiceShared  # here, because it is optional

            NgSpiceShared.LIBRARY_PATH = path  # its own guess needs the library's development link
            return NgSpiceShared.new_instance()
    except ImportError as error:
        raise MissingExtra(f"PySpice is not installed: {install_command('spice')}") from error
    except OSError as error:
        raise MissingExtra(f"libngspice cannot be loaded from {path}: {error}") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep PySpice's own noise away: it logs every note of ngspice as an error, complains of each ngspice newer
    than itself, and imports what Python has since deprecated.
    """
    logger = logging.getLogger("PySpice")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)
