"""Base class of the readout circuits: their interface to the rest of the package.

A circuit is an object without state. Each method takes the board's :class:`.._parts.Parts`, whose arrays are in line
coordinates: N rows are driven, M columns are sensed. To add a circuit, write one module with a subclass and add it to
the table in ``readouts/__init__.py``. docs/design.md lists all other code that depends on the kind of circuit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from math import copysign, inf
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from .._parts import Parts
from .._tuning import ROUNDING
from ._adjoint import SensitivityGroup
from ._ends import Ends
from ._linear import LinearReadout
from ._port_law import PortLaw
from ._quick import QuickFields, QuickNetwork


class Reading(NamedTuple):
    """Outputs of all columns in all scan steps."""

    volts: FloatArray
    """(..., N, M) V"""
    saturated: BoolArray
    """(..., N, M) outputs that stand at a supply limit"""
    magnitude: FloatArray
    """(..., N, M) V: sum of the magnitudes of those terms of an output that are proportional to port conductances, of a
    difference of sources both; terms that do not depend on the grid are left out"""
    relative: float = 0.0
    """bound on the relative rounding error of the conductances after all eliminations"""
    error: FloatArray | float = 0.0
    """V, bound on errors of the circuit's own solution"""


class ReadoutCircuit(ABC):
    """How columns are terminated and read. Subclasses are the circuits that a design file can name."""

    name: ClassVar[str]
    """as in ``readout.circuit``"""
    senses: ClassVar[Literal["columns", "rows"]] = "columns"
    """which of the array's lines are read; the others are driven"""
    virtual_ground: ClassVar[bool] = False
    """whether amplifiers hold all columns at the reference at once, and each output measures its column's current"""
    drives_idle_lines: ClassVar[bool] = False
    """whether an amplifier drives the idle lines, so that ``drive.idle_rows`` does not count"""
    behind_the_load: ClassVar[str] = ""
    """what a circuit without virtual grounds has besides its load, in a few words for the schematic"""

    @property
    def has_amplifiers(self) -> bool:
        """Whether gain, offset voltage, bias current and supply take part."""
        return self.virtual_ground or self.drives_idle_lines

    @property
    def mixes_cells(self) -> bool:
        """Whether other cells change a reading even if all parts are ideal."""
        return not self.has_amplifiers

    # Reading

    @abstractmethod
    def read(self, board: Parts, ports: FloatArray) -> Reading:
        """The outputs in all scan steps.

        Args:
            board: parts of the readout.
            ports: (..., N + M, N + M) S between the grid's row terminals and column terminals, rows first; row leads
                are inside, column leads are not.

        Raises:
            SolverError: no consistent state was found.

        """

    def quick_outputs(self, board: Parts, network: QuickNetwork) -> FloatArray | None:
        """V (N, M) of one frame without supply limits, to about ten digits; None if :mod:`._quick` has no method.

        Args:
            board: parts of the readout.
            network: the grid between its ports.

        """
        return None

    def quick_fields(self, board: Parts, network: QuickNetwork) -> QuickFields | None:
        """Fields of all readings, from which :mod:`..recovery` computes derivatives.

        Arguments, and None, as for :meth:`quick_outputs`.
        """
        return None

    @abstractmethod
    def end_resistance(self, board: Parts) -> FloatArray:
        """(M,) ohm that the circuit presents behind each column lead; the bound on rounding errors uses them."""

    @abstractmethod
    def energy_bound(self, board: Parts, ports: FloatArray, relative: float) -> FloatArray:
        """Bound in V (..., N, M) on output errors by a relative error of all conductances: :mod:`._rounding`."""

    def read_ends(self, board: Parts) -> Ends | None:
        """Thevenin equivalents at the columns' ends while they are read and no output is at a limit.

        None where the end depends on other lines.
        """
        return None

    def ends(self, board: Parts) -> Ends | None:
        """:meth:`read_ends` if all columns are read at once; else None."""
        return None if self.columns_one_by_one(board) else self.read_ends(board)

    def port_law(self, board: Parts, wire: FloatArray) -> PortLaw | None:
        """What a reading says of its own conductance and of its column, without supply limits: :mod:`._port_law`.

        Args:
            board: parts of the readout.
            wire: (M,) ohm along each column up to its end.

        Returns:
            None where rows float and nothing holds the columns: all cells then take part in every reading.

        """
        return None

    def ambiguity(self, board: Parts) -> str:
        """Why readings of such a board do not determine its cells; empty: nothing is known against it."""
        del board
        return ""

    def linear(self, board: Parts) -> LinearReadout | None:
        """The outputs as a linear function of transfer conductances; None where they are not linear."""
        return None

    def reads_together(self, columns: str, idle_columns: str) -> bool:
        """Whether all columns are read at once, for ``readout.columns`` and ``readout.idle_columns``."""
        return columns == "parallel" if self.virtual_ground else idle_columns == "load"

    def columns_one_by_one(self, board: Parts) -> bool:
        """Whether each column is measured on its own, because idle columns end in something else than the read one."""
        return board.shared_by > 1

    def ideal_inputs(self, board: Parts) -> BoolArray:
        """(M,) column ends that the circuit holds like an ideal voltage source."""
        return np.zeros(board.shape[1], dtype=np.bool_)

    def contradiction(self, board: Parts, rows: IntArray, columns: IntArray) -> Contradiction | None:
        """Two ideal sources that parts of 0 ohm connect with each other; None if there are none.

        One driver connected with one ideal amplifier is not reported: the reading is infinite, or at a supply limit.

        An *island* is a set of nodes that parts of 0 ohm connect with each other.

        Args:
            board: the lines.
            rows: (N,) number of each row driver's island.
            columns: (M,) number of the island of each column's end; ends without :meth:`ideal_inputs` have islands of
                their own.

        """
        of_rows, of_columns = board.line_kinds
        pair = _same_island(rows[:1] if board.floating else rows)
        if pair is not None:
            low, high = sorted(map(board.driven_line, pair))
            return Contradiction(f"the {of_rows} drivers {low} and {high}", f"array.{of_rows}_lead")
        alone = self.columns_one_by_one(board) and board.shared_by >= board.shape[1] and board.idle_resistance.all()
        pair = None if alone else _same_island(columns)  # alone: one amplifier is connected at a time
        if pair is not None:
            low, high = sorted(map(board.sensed_line, pair))
            return Contradiction(
                f"the ideal amplifiers of {of_columns}s {low} and {high}",
                f"array.{of_columns}_lead, or readout.open_loop_gain a finite value",
            )
        return None

    def undetermined(self, board: Parts, rows: IntArray, columns: IntArray) -> BoolArray | None:
        """(N, M) outputs that ideal parts of 0 ohm leave undetermined; None if there are none.

        Arguments as for :meth:`contradiction`.
        """
        return None

    def in_the_limit(self, board: Parts, cells: FloatArray, volts: FloatArray) -> FloatArray:
        """``volts`` (..., N, M) with their limits for ideal parts, which the solvers replaced by large conductances."""
        return volts

    def delivered(self, board: Parts, group: SensitivityGroup, row_current: FloatArray) -> FloatArray:
        """A (..., rows, columns) of the readings, that the output of each one's amplifier delivers into the array.

        Args:
            board: parts of the readout.
            group: readings, with their forward fields.
            row_current: (..., rows, columns or 1, N) A out of each driver in these fields.

        """
        return np.zeros((*row_current.shape[:-3], len(group.rows), len(group.columns)))

    # One cell alone, with ideal parts

    @abstractmethod
    def alone(self, board: Parts) -> Alone:
        """The output of one cell that is alone, with ideal parts."""

    def domain(self, board: Parts) -> tuple[float, float]:
        """V of the ideal circuit's output on an open cell, and on a short: the ends of what a reading can say."""
        gain, span, rest = (float(np.mean(part)) for part in self.alone(board))
        open_cell = board.level + rest
        return open_cell, open_cell + gain / span if span else copysign(inf, gain)

    def ideal_volts(self, board: Parts, cells: FloatArray) -> FloatArray:
        """(..., N, M) V if each of the cells, in ohm, were alone and all parts ideal: the paper's equation (10)."""
        alone = self.alone(board)
        with np.errstate(divide="ignore"):  # a short gives an infinite output of an amplifier
            volts: FloatArray = board.level + alone.rest + alone.gain / (alone.span + cells)
        return volts

    def apparent_resistance(self, board: Parts, volts: FloatArray) -> FloatArray:
        """(..., N, M) ohm: the inverse of :meth:`ideal_volts`; inf where no current flows, or so little that the
        quotient overflows.
        """
        alone = self.alone(board)
        signal = np.asarray(volts, dtype=np.float64) - board.level - alone.rest
        with np.errstate(over="ignore"):
            ratio = np.where(signal == 0, inf, alone.gain / np.where(signal == 0, 1.0, signal))
        return ratio - alone.span

    def apparent_conductance(self, board: Parts, signal: FloatArray) -> FloatArray:
        """(..., N, M) S that the ideal circuit would need for a signal in V above the reference; 0 for the wrong sign.

        Signals below a few ulp of the reference voltage are rounding, and count as none.
        """
        alone = self.alone(board)
        ratio = (signal - alone.rest) / alone.gain
        conductance = np.where(ratio > rounding_floor(board) / board.reference, ratio, 0.0)
        return conductance / alone.left(conductance)

    def conductance_slope(self, board: Parts, signal: FloatArray) -> FloatArray:
        """(..., N, M) S/V: derivative of :meth:`apparent_conductance` by the signal."""
        alone = self.alone(board)
        slope: FloatArray = (1.0 / alone.gain) / alone.left((signal - alone.rest) / alone.gain) ** 2
        return slope

    def log_conductance_slope(self, board: Parts, signal: FloatArray) -> FloatArray:
        """(..., N, M) 1/V: derivative of the logarithm of :meth:`apparent_conductance`; 0 where there is no signal."""
        alone = self.alone(board)
        above = signal - alone.rest
        slope = above * (1.0 - above / alone.gain * alone.span)
        if np.count_nonzero(slope) == slope.size:  # nearly always
            return np.reciprocal(slope)
        return np.divide(1.0, slope, out=np.zeros_like(signal), where=slope != 0)

    @property
    def inverts(self) -> bool:
        """Whether more current from a positive drive lowers the output."""
        return False

    # Derivatives

    @abstractmethod
    def sensitivity_groups(self, board: Parts, ports: FloatArray, reading: Reading) -> Iterator[SensitivityGroup]:
        """Forward and adjoint port potentials of all readings, and their derivatives by the circuit's own parts."""


class Alone(NamedTuple):
    """Output of one cell of R ohm, the only one of a board with ideal parts: ``level + rest + gain / (span + R)``.

    (M,) arrays, or numbers.
    """

    gain: FloatArray
    """V ohm"""
    span: FloatArray | float
    """ohm of what the cell is in series with"""
    rest: FloatArray | float = 0.0
    """V above the reference without current"""

    def left(self, ratio: FloatArray) -> FloatArray:
        """Share of the drive that is left across the cell, for a signal over ``gain`` (S); it is never nothing,
        as a divider cannot tell such cells from shorts."""
        if not np.any(self.span):
            return np.ones_like(ratio)
        left: FloatArray = 1.0 - np.minimum(ratio * self.span, 1.0 - ROUNDING)
        return left


class Contradiction(NamedTuple):
    """Ideal sources that are joined by parts of 0 ohm."""

    what: str
    """names of the sources"""
    remedy: str
    """the key of the design that can separate them"""


def _same_island(islands: IntArray) -> tuple[int, int] | None:
    """Indices of the first two equal entries."""
    for one, island in enumerate(islands):
        others = np.flatnonzero(islands[one + 1 :] == island)
        if len(others):
            return one, one + 1 + int(others[0])
    return None


def rounding_floor(board: Parts) -> float:
    """Ratio of signal to drive below which the signal is rounding of the reference voltage."""
    return float(4 * np.finfo(np.float64).eps * (abs(board.level / board.drive) + 1e-12))
