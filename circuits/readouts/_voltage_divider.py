"""Voltage dividers: each column ends in a load resistor (paper, VII and figure 13).

The other cells change each reading (crosstalk). Idle rows are grounded or open. Idle columns are open, or end in their
loads as well.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.arrays import FloatArray, IntArray
from .._parts import Parts
from ._adjoint import SensitivityGroup, TerminatedColumns, terminated_groups
from ._cards import CardWriter
from ._circuit import Alone, Reading
from ._ends import Ends
from ._linear import LinearReadout
from ._port_law import PortLaw
from ._terminated import Terminated


class VoltageDivider(Terminated):
    """A load resistor on each column, and nothing else."""

    name = "voltage-divider"
    has_amplifiers = False
    mixes_cells = True
    in_populations = True

    def read_ends(self, board: Parts) -> Ends:
        return _loads(board)

    def reads_together(self, columns: str, idle_columns: str) -> bool:
        return idle_columns == "load"

    def ends(self, board: Parts) -> Ends | None:
        return None  # no virtual grounds

    def port_law(self, board: Parts, wire: FloatArray) -> PortLaw | None:
        return None if board.floating else PortLaw.of_ends(_loads(board), wire, board.drive, floating=False)

    def linear(self, board: Parts) -> LinearReadout | None:
        return None

    def alone(self, board: Parts) -> Alone:
        return Alone(board.drive * board.reference, board.reference)

    def sensitivity_groups(self, board: Parts, ports: FloatArray, reading: Reading) -> Iterator[SensitivityGroup]:
        rows, columns = board.shape
        one_by_one = self.columns_one_by_one(board)
        loads = TerminatedColumns(
            rows=np.arange(rows),
            columns=np.arange(columns),
            one_by_one=one_by_one,
            ends=_loads(board),
            own_parts=_by_load_alone if one_by_one else _by_loads,
        )
        yield from terminated_groups(board, ports, loads)

    def column_end(self, j: int) -> str:
        return f"end_{j}"

    def output_node(self, writer: CardWriter, j: int) -> str:
        return writer.name[self.column_end(j)]

    def cards(self, writer: CardWriter) -> Iterator[str]:
        yield "* Loads; what is across them is read."
        for j in range(writer.columns):
            end, ohm = writer.name[self.column_end(j)], float(writer.board.reference[j])
            if end == writer.reference:
                yield f"* end_{j} is shorted to the reference"
            elif writer.one_by_one and writer.board.idle_columns == "ground":
                yield from writer.switched_end(j, end, f"{ohm!r}*i(Vend_{j})")
            elif writer.one_by_one:
                yield f"Bload_{j} {end} {writer.reference} I = {writer.chosen(j)} ? v({end})/{ohm!r} : 0"
            else:
                yield f"Rload_{j} {end} {writer.reference} {ohm!r}"


def _loads(board: Parts) -> Ends:
    """The loads as Thevenin equivalents."""
    nothing = np.zeros(board.shape[1])
    return Ends(resistance=board.reference, source=nothing, output=nothing + board.level, slope=board.reference)


def _by_loads(some: IntArray, current: FloatArray, adjoint: FloatArray) -> dict[str, FloatArray]:
    """Derivatives by the loads. A load is part of its column's end, and also converts the column's current to volts."""
    load = current * adjoint
    load[:, np.arange(len(some)), some] += current[:, 0, some]
    return {"reference_resistance": load}


def _by_load_alone(some: IntArray, current: FloatArray, adjoint: FloatArray) -> dict[str, FloatArray]:
    """As :func:`_by_loads` for columns that are read one by one: idle columns have no load."""
    load = _by_loads(some, current, adjoint)["reference_resistance"]
    return {"reference_resistance": np.where(np.isin(np.arange(load.shape[-1]), some), load, 0.0)}
