"""libngspice through PySpice: the only module that imports PySpice (GPL, extra ``spice``), and only when it is used.

PySpice 1.5 is from 2021 and needs some care, all of it kept here.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ...common.extras import install_command
from ...errors import MissingExtra, SolverError
from ._ngspice import Vectors, canonical, gist


def library_available() -> str | None:
    """Why libngspice cannot be used here, or None if it can."""
    try:
        _library()
    except MissingExtra as error:
        return str(error)
    return None


def run_library(text: str) -> Vectors:
    """Run the analysis in a netlist by libngspice and return the vectors that it saved.

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
            raise SolverError(f"ngspice refused the netlist: {gist(ngspice.stdout)}") from error
        finally:
            # Without both, every circuit and every result stay in memory for good.
            with suppress(NameError):
                ngspice.destroy()
                ngspice.remove_circuit()
    vectors = {canonical(name): vector._data for name, vector in plot.items()}
    if not any(len(vector) for vector in vectors.values()):
        raise SolverError(f"ngspice gave no result: {gist(said)}")
    return vectors


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
            if not NgSpiceShared._instances:
                _refuse_commands()
            return NgSpiceShared.new_instance()
    except ImportError as error:
        raise MissingExtra(f"PySpice is not installed: {install_command('spice')}") from error
    except OSError as error:
        raise MissingExtra(f"libngspice cannot be loaded from {path}: {error}") from error


def _refuse_commands() -> None:
    """MissingExtra where libngspice would run a file of commands when it starts, which no option of it prevents."""
    for folder in (Path(), Path.home(), Path(os.environ.get("SPICE_USERINIT_DIR", ""))):
        for name in (".spiceinit", "spice.rc"):
            if (path := folder / name).exists():
                raise MissingExtra(f"libngspice would run the commands in {path}; the command ngspice is kept from it")


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
