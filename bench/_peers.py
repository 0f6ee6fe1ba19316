"""What others would use for the same frame: direct sparse solvers on the nodal matrix, badcrossbar, ngspice.

All answer the same question, the current in A into each column (N, M) for 1 V on each row, on the arrays of
:func:`._measurement.board`: one resistance for every segment and every lead. Assembly counts as part of their work, as
it does for ohmskin. None is needed to use ohmskin; the direct ones come with the extra ``peers``.
"""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from ..circuits import Design
from ..circuits.spice import command_available, run_command
from ..common.arrays import FloatArray, IntArray
from ..common.extras import install_command


class Peer(NamedTuple):
    """Another way to read a frame."""

    name: str
    missing: Callable[[], str | None]
    """why it cannot run here"""
    solve: Callable[[Design, FloatArray], FloatArray]
    """design and cells in ohm to currents in A"""
    largest: int
    """side of the largest grid that is waited for unasked"""


class Nodal(NamedTuple):
    """The nodal equations ``matrix @ volts = injected`` of a grid, one right-hand side per row, in SI units."""

    ends: NDArray[np.int32]
    """(branches, 2) nodes"""
    branch: FloatArray
    """S"""
    to_ground: FloatArray
    """S (nodes,)"""
    injected: FloatArray
    """A (nodes, N)"""
    last: IntArray
    """(M,) nodes ahead of the amplifiers"""
    exit: float
    """S from these to the amplifiers"""

    @classmethod
    def of(cls, design: Design, cells: FloatArray) -> Nodal:
        rows, columns = cells.shape
        row = np.arange(rows * columns).reshape(rows, columns)
        column = row + rows * columns
        wire, lead = 1.0 / np.max(design.array.row_segment), 1.0 / np.max(design.array.row_lead)
        pairs = [(row[:, :-1], row[:, 1:]), (column[:-1], column[1:]), (row, column)]
        values = [np.full(row[:, 1:].size, wire), np.full(column[1:].size, wire), 1.0 / cells.ravel()]
        to_ground, injected = np.zeros(2 * rows * columns), np.zeros((2 * rows * columns, rows))
        to_ground[row[:, 0]] = to_ground[column[-1]] = lead
        injected[row[:, 0], np.arange(rows)] = lead
        ends = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=-1) for a, b in pairs])
        return cls(ends.astype(np.int32), np.concatenate(values), to_ground, injected, column[-1], float(lead))

    def matrix(self) -> csc_array:
        a, b = self.ends.T
        nodes = np.arange(len(self.to_ground), dtype=np.int32)  # KLU knows no other
        total = self.to_ground + np.bincount(a, self.branch, len(nodes)) + np.bincount(b, self.branch, len(nodes))
        values = np.concatenate([total, -self.branch, -self.branch])
        return csc_array((values, (np.concatenate([nodes, a, b]), np.concatenate([nodes, b, a]))))

    def currents(self, volts: NDArray[np.floating[Any]]) -> FloatArray:
        return np.asarray(self.exit * volts[self.last].T, dtype=np.float64)


def reference(design: Design, cells: FloatArray) -> FloatArray:
    """Currents to the last digit or two: a sparse solution refined with residuals from branch currents in extended
    precision. Shares nothing with :mod:`ohmskin.circuits`.
    """
    nodal = Nodal.of(design, cells)
    factor = _superlu(nodal)
    a, b = nodal.ends.T
    branch, to_ground = (part.astype(np.longdouble)[:, None] for part in (nodal.branch, nodal.to_ground))
    volts: NDArray[np.longdouble] = np.zeros(nodal.injected.shape, dtype=np.longdouble)
    for _ in range(4):
        flow = branch * (volts[a] - volts[b])
        residual = nodal.injected - to_ground * volts
        np.subtract.at(residual, a, flow)
        np.add.at(residual, b, flow)
        volts += factor.solve(residual.astype(np.float64))
    return nodal.currents(volts)


def _superlu(nodal: Nodal) -> Any:
    options = {"SymmetricMode": True}
    return splu(nodal.matrix(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def _by_superlu(design: Design, cells: FloatArray) -> FloatArray:
    nodal = Nodal.of(design, cells)
    return nodal.currents(_superlu(nodal).solve(nodal.injected))


def _by_cholmod(design: Design, cells: FloatArray) -> FloatArray:
    from scipy.sparse import csc_matrix
    from sksparse.cholmod import cholesky

    nodal = Nodal.of(design, cells)
    return nodal.currents(np.asarray(cholesky(csc_matrix(nodal.matrix()), mode="simplicial")(nodal.injected)))


def _by_klu(design: Design, cells: FloatArray) -> FloatArray:
    from PyKLU import Klu
    from scipy.sparse import csc_matrix

    nodal = Nodal.of(design, cells)
    return nodal.currents(np.asarray(Klu(csc_matrix(nodal.matrix())).solve(np.asfortranarray(nodal.injected))))


def _by_badcrossbar(design: Design, cells: FloatArray) -> FloatArray:
    with _untouched_logging():
        import badcrossbar

        logging.getLogger("badcrossbar").setLevel(logging.ERROR)
        solution = badcrossbar.compute(np.eye(len(cells)), cells, r_i=float(np.max(design.array.row_segment)))
    return np.asarray(solution.currents.output, dtype=np.float64)


def _by_ngspice(design: Design, cells: FloatArray) -> FloatArray:
    """One ``.dc`` sweep that selects the rows: ngspice then orders its matrix once, which is its fastest way."""
    nodal = Nodal.of(design, cells)
    rows, columns = cells.shape
    deck = ["* a frame", "Vrow index 0 DC 0", f".dc Vrow 0 {rows - 1} 1"]
    branches = zip(*(1 + nodal.ends.T).tolist(), (1.0 / nodal.branch).tolist(), strict=True)
    deck += [f"R{number} {a} {b} {ohm!r}" for number, (a, b, ohm) in enumerate(branches)]
    lead = 1.0 / nodal.exit
    for row in range(rows):
        deck.append(f"Bdrive{row} drive{row} 0 V = abs(v(index)-{row})<0.5 ? 1 : 0")
        deck.append(f"Rrow{row} drive{row} {1 + row * columns} {lead!r}")
    ends = (1 + nodal.last).tolist()
    deck += [f"Rcolumn{node} {node} 0 {lead!r}\n.save v({node})" for node in ends]
    found = run_command("\n".join([*deck, ".end", ""]))
    currents: FloatArray = nodal.exit * np.column_stack([found[str(node)] for node in ends])
    return currents


@contextmanager
def _untouched_logging() -> Iterator[None]:
    """badcrossbar configures the root logger when it is imported."""
    root = logging.getLogger()
    level, handlers = root.level, list(root.handlers)
    try:
        yield
    finally:
        root.setLevel(level)
        root.handlers[:] = handlers


def _needs(module: str) -> Callable[[], str | None]:
    def missing() -> str | None:
        found = importlib.util.find_spec(module) is not None
        return None if found else f"{module} is not installed: {install_command('peers')}"

    return missing


PEERS = (
    Peer("SuperLU (scipy)", lambda: None, _by_superlu, 256),
    Peer("CHOLMOD simplicial", _needs("sksparse"), _by_cholmod, 256),
    Peer("KLU", _needs("PyKLU"), _by_klu, 256),
    Peer("badcrossbar", _needs("badcrossbar"), _by_badcrossbar, 256),
    Peer("ngspice", command_available, _by_ngspice, 32),
)
