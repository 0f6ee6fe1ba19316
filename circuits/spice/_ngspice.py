"""The command ngspice, run on a netlist."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import MissingExtra, SolverError

LEAST_LIMIT_S, LIMIT_PER_CARD_S = 20, 0.05
"""of processor time for one run of the command, as a constant and by cards of the netlist; a macro-model may find no
convergence for ever"""
_WAITING = 20.0
"""ratio of time to processor time on a busy machine, beyond which a run is given up all the same"""
COMMAND = "*# "
"""begins a line that ngspice runs, and that other simulators take for a comment"""
Vectors = dict[str, NDArray[Any]]
"""By ngspice's name of node or vector: float64, or complex128 after an AC analysis."""


def command_available() -> str | None:
    """Why ngspice cannot run here, or None if it can."""
    if shutil.which("ngspice"):
        return None
    return "the command 'ngspice' is not installed (Debian, Ubuntu: apt install ngspice)"


def run_command(text: str) -> Vectors:
    """Run the analysis in a netlist by ``ngspice -b`` and return the vectors that it saved.

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
            raise SolverError(f"ngspice gave no result: {gist(process.stderr)}")
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
        raise SolverError(f"ngspice gave no result: {gist(said)}")
    dropped = re.findall(r"unrecognized parameter \((\w+)\) - ignored", said)
    complaints = gist(said) if re.search(_COMPLAINT, said, flags=re.IGNORECASE) else ""
    return Simulated({name: float(number) for name, number in printed}, tuple(dict.fromkeys(dropped)), complaints)


def _with_control_block(text: str) -> str:
    """The netlist with its commands in a .control block instead of behind ``*#``."""
    lines = text.splitlines()
    commands = [line[3:] for line in lines if line.startswith(COMMAND)]
    cards = [line for line in lines if not line.startswith((COMMAND, ".tran", ".meas")) and line != ".end"]
    return "\n".join([*cards, ".control", *commands, ".endc", ".end", ""])


def canonical(name: str) -> str:
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
    return {canonical(name): column for name, column in zip(names, table.T, strict=True)}


_COMPLAINT = "error|singular|fail|fatal|too small|no convergence|trouble|abort"


def gist(said: str) -> str:
    """What matters in ngspice's many words about a failure."""
    spoken = (line.strip() for line in said.splitlines() if not re.match(r"\s*(error: )?meas", line, re.IGNORECASE))
    lines = [line for line in spoken if re.search(_COMPLAINT, line, flags=re.IGNORECASE)]
    return "; ".join(list(dict.fromkeys(lines))[:3]) or said.strip()[-200:] or "it said nothing"
