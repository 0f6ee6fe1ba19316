"""The command ngspice, run on a netlist: without ``.spiceinit``, and within limits of time, memory and output.

A netlist may hold a maker's model, which is a program of somebody else. Its author decides neither how long the run
takes nor how much memory or disk.
"""

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

from ...common.files import size
from ...common.system import POSIX
from ...errors import MissingExtra, SolverError
from .._tuning import LEAST_LIMIT_S, LIMIT_PER_CARD_S, MOST_LIMIT_S, WAITING

MOST_MEMORY = 2 * 2**30
"""bytes of address space of the command; a netlist of 128 x 128 cells with segments takes 0.13 GB"""
MOST_OUTPUT = 2**30
"""bytes of each file that the command writes: results, and what it says"""
MOST_SAID = 2**24
"""bytes that are read of what it says"""
_LIMITED = 'ulimit -t "$0"; ulimit -v "$1" 2>/dev/null; ulimit -f "$2"; shift 2; exec "$@"'
"""for ``sh``: seconds, KiB (macOS has no such limit) and blocks of 512 bytes, then the command"""
_ENDS = {
    "SIGXCPU": "{limit_s} s of processor time",
    "SIGKILL": "{limit_s} s of processor time",
    "SIGXFSZ": "{output} of output",
    "SIGSEGV": "its limits: it crashed",
}
"""by the signal that ended it"""
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
        # A raw file is written whatever comes of the analysis; what was said tells.
        _, said = _run(text, "-r", str(raw), folder=folder)
        if "abort" in said or not raw.exists():
            raise SolverError(f"ngspice gave no result: {gist(said)}")
        return _read_raw(raw.read_bytes())


def _run(text: str, *options: str, folder: str) -> tuple[str, str]:
    """What ngspice writes to its standard output and error about a netlist. Raises SolverError beyond the limits."""
    # -n: no .spiceinit, whose commands could do anything.
    command = ["ngspice", "-n", "-b", *options]
    limit_s = round(min(LEAST_LIMIT_S + LIMIT_PER_CARD_S * text.count("\n"), MOST_LIMIT_S))
    if POSIX:
        command = ["sh", "-c", _LIMITED, str(limit_s), str(MOST_MEMORY // 2**10), str(MOST_OUTPUT // 512), *command]
    out, errors = Path(folder, "stdout"), Path(folder, "stderr")
    try:
        with out.open("wb") as to_out, errors.open("wb") as to_errors:
            process = subprocess.run(
                command,
                input=text.encode(),
                stdout=to_out,
                stderr=to_errors,
                check=False,
                timeout=WAITING * limit_s,
                cwd=folder,
            )
    except subprocess.TimeoutExpired as error:
        raise SolverError(f"ngspice found no result within {WAITING * limit_s:g} s") from error
    said = []
    for path in (out, errors):
        with path.open("rb") as file:
            said.append(file.read(MOST_SAID).decode(errors="replace"))
    if re.search("out of memory|can't allocate", said[1]):
        raise SolverError(f"ngspice found no result within {size(MOST_MEMORY)} of memory")
    ended_by = {getattr(signal, name, None): what for name, what in _ENDS.items()}.get(-process.returncode)
    if ended_by is not None:
        raise SolverError(
            f"ngspice found no result within {ended_by.format(limit_s=limit_s, output=size(MOST_OUTPUT))}"
        )
    return said[0], said[1]


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
    # In PSpice's mode ngspice takes *# for a comment, but runs .control blocks.
    options = ["-D", "ngbehavior=psa"] if pspice else []
    with tempfile.TemporaryDirectory(prefix="ohmskin-") as folder:
        out, errors = _run(_with_control_block(text) if pspice else text, *options, folder=folder)
    printed = re.findall(r"^(\w+) = (\S+)\s*$", out, flags=re.MULTILINE)
    said = errors + out
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
