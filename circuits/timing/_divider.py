"""Dividers in time: the RC network of columns, loads and sampling capacitors over a repeated scan.

The nodes are the M column ends and, where a switch resistance separates them, the sampling capacitors. Each column end
has the capacitance of its line. The grid, reduced to its terminals, and the loads are the source resistances that
charge the capacitors. With the conductance matrix L and the diagonal matrix C of capacitances, the deviation d of the
node voltages from their settled values obeys ``C d' = -L d``. The matrix ``C^(-1/2) L C^(-1/2)`` is symmetric, so its
eigenvalues give the propagator for any stiffness (modal analysis of RC networks; Vlach and Singhal, "Computer Methods
for Circuit Analysis and Design"). Nodes without capacitance follow at once and are eliminated. A switch without
resistance joins its two nodes, which then share their charges. :mod:`._switched` has the phases of a step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import FloatArray, IntArray
from .._board import Board
from ._modes import Modes
from ._switched import SLOWEST, SwitchedScan, SwitchState

_GROUNDED = 1e8
"""of the largest conductance: stands for the switch that keeps an idle column at the reference"""


class _Capacitors(NamedTuple):
    """The capacitors of columns and converter, and the switches between them."""

    columns: FloatArray
    """(M,) F"""
    sampling: float
    """F"""
    switch: float
    """ohm"""
    shared: bool
    """whether one sampling capacitor serves all columns"""

    def read_at(self, columns: IntArray) -> IntArray:
        """Nodes whose voltages are converted when these columns are read."""
        if not self.sampling or (not self.shared and not self.switch):
            return columns
        count = len(self.columns)
        return np.full(len(columns), count) if self.shared else count + columns

    def joined(self, conductance: FloatArray, connected: int | None) -> tuple[FloatArray, FloatArray, IntArray]:
        """The network (S, S) of all nodes, their capacitances (S,), and the node (S,) that each one is part of."""
        count = len(self.columns)
        if not self.sampling or (not self.shared and not self.switch):
            return conductance, self.columns + (0.0 if self.shared else self.sampling), np.arange(count)
        extra = 1 if self.shared else count
        network = np.zeros((count + extra, count + extra))
        network[:count, :count] = conductance
        capacitance = np.concatenate([self.columns, np.full(extra, self.sampling)])
        part_of = np.arange(count + extra)
        if not self.shared:
            pairs = [(column, count + column) for column in range(count)]
        else:
            pairs = [] if connected is None else [(connected, count)]
        for column, sample in pairs:
            if self.switch:
                through = 1.0 / self.switch
                network[[column, sample], [column, sample]] += through
                network[[column, sample], [sample, column]] -= through
            else:
                part_of[sample] = column
        return network, capacitance, part_of


class _Phase(NamedTuple):
    """A network that does not change for some time, by its modes: ``d(t) = back exp(-rates t) into d(0)``."""

    rates: FloatArray
    """(D,) 1/s"""
    into: FloatArray
    """(D, S) from the deviations of all nodes"""
    back: FloatArray
    """(S, D) to the deviations of all nodes"""
    response: FloatArray
    """(S, S) ohm: settled voltages by currents into the nodes"""

    @classmethod
    def of(cls, network: FloatArray, capacitance: FloatArray, part_of: IntArray) -> _Phase:
        """Args: conductance matrix (S, S), capacitances (S,), and the node (S,) that each node is part of."""
        own = np.unique(part_of)
        expand = (part_of[:, None] == own).astype(float)  # (S, own nodes): voltages of all nodes
        joint, charge = expand.T @ network @ expand, capacitance @ expand
        moving, at_once = np.flatnonzero(charge > 0), np.flatnonzero(charge <= 0)
        held = np.flatnonzero(np.diagonal(joint) > 0)
        response = np.zeros(joint.shape)
        response[np.ix_(held, held)] = np.linalg.inv(joint[np.ix_(held, held)])
        follow = np.zeros((len(own), len(moving)))
        follow[moving, np.arange(len(moving))] = 1.0
        if len(at_once):
            follow[at_once] = -np.linalg.solve(joint[np.ix_(at_once, at_once)], joint[np.ix_(at_once, moving)])
        root = np.sqrt(charge[moving])
        rates, shapes = np.linalg.eigh(follow.T @ joint @ follow / root / root[:, None])
        share = expand.T[moving] * capacitance / charge[moving, None]
        return cls(
            rates=np.maximum(rates, 0.0),
            into=shapes.T @ (root[:, None] * share),
            back=expand @ follow @ (shapes / root[:, None]),
            response=expand @ response @ expand.T,
        )

    def carry(self, seconds: float) -> FloatArray:
        """Propagator (S, S) of the deviations over a time in s."""
        return self.back @ (np.exp(-self.rates * seconds)[:, None] * self.into)

    def settled(self, current: FloatArray) -> FloatArray:
        """Settled voltages (S,) with these currents (M,) into the column ends."""
        return self.response[:, : len(current)] @ current


class DividerScan(SwitchedScan[_Phase]):
    """The repeated scan of constant cells by loads without amplifiers (:class:`._modes.RepeatedScan`)."""

    def __init__(self, board: Board, cells: FloatArray, settled: FloatArray) -> None:
        """See :class:`._switched.SwitchedScan`."""
        adc = board.adc
        self._capacitors = _Capacitors(
            columns=np.full(board.shape[1], board.readout.column_capacitance),
            sampling=adc.sampling_capacitance if adc else 0.0,
            switch=adc.switch_resistance if adc else 0.0,
            shared=bool(adc and adc.acquisition_time),
        )
        super().__init__(board, cells, settled)

    def modes(self) -> Modes:
        """See :meth:`._modes.RepeatedScan.modes`."""
        rates = np.concatenate([phase.rates for phases, _ in self._rows for phase in phases])
        rates = np.unique(rates[rates > SLOWEST * rates.max(initial=0.0)])
        share = self._board.shape[1] if self._one_by_one else 1  # of the waiting time
        return Modes(-rates.astype(np.complex128) / share, np.full(len(rates), 2.0 * self._signal))

    def _phase(self, network: FloatArray, state: SwitchState) -> _Phase:
        conductance = network.copy()
        conductance[state.loaded, state.loaded] += 1.0 / self._board.reference[state.loaded]
        if self._board.idle_columns == "ground":
            idle = np.delete(np.arange(len(network)), state.loaded)
            np.add.at(conductance, (idle, idle), _GROUNDED * conductance.max())
        return _Phase.of(*self._capacitors.joined(conductance, state.connected))

    def _read_at(self, columns: IntArray) -> IntArray:
        return self._capacitors.read_at(columns)

    @property
    def _stored(self) -> slice:
        return slice(self._board.shape[1], None)
