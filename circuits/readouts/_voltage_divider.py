"""Voltage dividers: each column ends in a load resistor (paper, VII and figure 13).

The other cells change each reading (crosstalk). Idle rows are grounded or open. Idle columns are open, or end in their
loads as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf

import numpy as np
from scipy.sparse.csgraph import connected_components

from ...common.arrays import FloatArray, IntArray
from .._parts import Parts
from ..solvers import Rounded, inverted
from ._adjoint import SensitivityGroup, TerminatedColumns, terminated_groups
from ._cards import CardWriter
from ._circuit import Reading, ReadoutCircuit, rounding_floor
from ._ends import Ends, column_currents, currents_one_by_one, terminate
from ._inverting_amplifier import drive_over_signal
from ._port_law import PortLaw
from ._quick import (
    QuickFields,
    QuickNetwork,
    open_column_fields,
    open_column_outputs,
    pulled_column_fields,
    pulled_column_outputs,
    terminated_fields,
    terminated_outputs,
)

_FULL_RATIO = 1 - 1e-9  # of signal to drive; beyond this ratio a divider cannot distinguish the cell from a short


class VoltageDivider(ReadoutCircuit):
    """A load resistor on each column, and nothing else."""

    name = "voltage-divider"
    has_amplifiers = False
    mixes_cells = True
    in_populations = True

    def read(self, board: Parts, ports: FloatArray) -> Reading:
        rows, columns = board.shape
        load, behind = board.reference, board.reference + board.column_lead
        one_by_one = self.columns_one_by_one(board)
        if not one_by_one or board.pulled or board.idle_columns == "ground":
            if one_by_one:
                currents = currents_one_by_one(board, ports, _loads(board))
            else:
                currents = column_currents(board, terminate(ports, rows + board.pulled, behind), np.zeros(columns))
            signal, relative = load * currents.value, currents.relative
        elif not board.floating:
            inner, relative = inverted(ports[..., rows:, rows:], ports[..., :rows, rows:].sum(axis=-2), rows)
            open_circuit = board.drive * ports[..., :rows, rows:] @ inner
            source_resistance = np.einsum("...jj->...j", inner)[..., None, :]
            signal = open_circuit * load / (behind + source_resistance)
        else:
            between, relative = effective_resistance(ports, rows)
            signal = board.drive * load / (behind + between)
        return Reading(
            volts=board.level + signal,
            saturated=np.zeros(signal.shape, dtype=np.bool_),
            magnitude=np.abs(signal),  # a quotient of sums of one sign
            cancelled=np.zeros_like(signal),
            relative=float(relative.max(initial=0.0)),
        )

    def quick_outputs(self, board: Parts, network: QuickNetwork) -> FloatArray | None:
        if board.idle_columns == "ground":
            return None
        if self.columns_one_by_one(board):
            return pulled_column_outputs(board, network) if board.pulled else open_column_outputs(board, network)
        return board.level + terminated_outputs(board, network, _loads(board))

    def quick_fields(self, board: Parts, network: QuickNetwork) -> QuickFields | None:
        if board.idle_columns == "ground":
            return None
        if self.columns_one_by_one(board):
            return pulled_column_fields(board, network) if board.pulled else open_column_fields(board, network)
        return terminated_fields(board, network, _loads(board))

    def port_law(self, board: Parts, wire: FloatArray) -> PortLaw | None:
        if board.floating:
            return None
        loads = _loads(board)._replace(output=np.full(board.shape[1], board.level))
        return PortLaw.of_ends(loads, wire, board.drive, floating=False)

    def end_resistance(self, board: Parts) -> FloatArray:
        return np.minimum(board.reference, board.idle_resistance)

    def columns_one_by_one(self, board: Parts) -> bool:
        return board.idle_columns != "load"

    def domain(self, board: Parts) -> tuple[float, float]:
        return board.level, board.level + board.drive

    def ideal_volts(self, board: Parts, cells: FloatArray) -> FloatArray:
        volts: FloatArray = board.level + board.drive * board.reference / (board.reference + cells)
        return volts

    def apparent_resistance(self, board: Parts, volts: FloatArray) -> FloatArray:
        return board.reference * (drive_over_signal(board, volts) - 1.0)

    def apparent_conductance(self, board: Parts, signal: FloatArray) -> FloatArray:
        ratio = signal / board.drive
        conductance: FloatArray = np.where(ratio > rounding_floor(board), ratio, 0.0) / board.reference
        return conductance / (1.0 - np.minimum(ratio, _FULL_RATIO))

    def conductance_slope(self, board: Parts, signal: FloatArray) -> FloatArray:
        steepness = 1.0 / (board.drive * board.reference)
        return steepness / (1.0 - np.minimum(signal / board.drive, _FULL_RATIO)) ** 2

    def log_conductance_slope(self, board: Parts, signal: FloatArray) -> FloatArray:
        slope = signal * (1.0 - signal / board.drive)
        if np.count_nonzero(slope) == slope.size:  # nearly always
            return np.reciprocal(slope)
        return np.divide(1.0, slope, out=np.zeros_like(signal), where=slope != 0)

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
    """The loads as Thevenin equivalents; outputs are relative to the reference voltage."""
    nothing = np.zeros(board.shape[1])
    return Ends(resistance=board.reference, source=nothing, output=nothing, slope=board.reference)


def _by_loads(some: IntArray, current: FloatArray, adjoint: FloatArray) -> dict[str, FloatArray]:
    """Derivatives by the loads. A load is part of its column's end, and also converts the column's current to volts."""
    load = current * adjoint
    load[:, np.arange(len(some)), some] += current[:, 0, some]
    return {"reference_resistance": load}


def _by_load_alone(some: IntArray, current: FloatArray, adjoint: FloatArray) -> dict[str, FloatArray]:
    """As :func:`_by_loads` for columns that are read one by one: idle columns have no load."""
    load = _by_loads(some, current, adjoint)["reference_resistance"]
    return {"reference_resistance": np.where(np.isin(np.arange(load.shape[-1]), some), load, 0.0)}


def effective_resistance(ports: FloatArray, rows: int) -> Rounded:
    """Ohm (..., N, M) between each row terminal and each column terminal with all other terminals open.

    The selected row is grounded in each step. Grounding one node for all pairs would cancel digits of nearby pairs.
    """
    size = ports.shape[-1]
    result = np.empty((*ports.shape[:-2], rows, size - rows))
    flat, out = ports.reshape(-1, size, size), result.reshape(-1, rows, size - rows)
    relative = np.zeros(len(flat))  # each row of each frame is solved on its own
    for frame, network in enumerate(flat):
        _, island = connected_components(network > 0, directed=False)
        for row in range(rows):
            others = np.delete(np.arange(size), row)
            inner, error = inverted(network[np.ix_(others, others)], network[row, others])
            relative[frame] = max(relative[frame], float(error))
            ohms = np.where(island[others] == island[row], np.diagonal(inner), inf)
            out[frame, row] = ohms[rows - 1 :]
    return Rounded(result, relative.reshape(ports.shape[:-2]))
