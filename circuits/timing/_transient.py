"""Transient response of the column amplifiers to a scan whose switching times are not known in advance.

:class:`~._settling.Settling` is for scans of constant row period. A program on a microcontroller selects rows and
starts conversions at arbitrary times; :class:`Transient` follows the program event by event.

Between events the circuit is linear and time-invariant (:mod:`._circuit`): its modes propagate the deviations from the
settled state.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray
from .._design import Design
from .._population import Boards
from ._circuit import Circuit, ColumnNetworks, require_amplifiers, sampler_delay


class Transient:
    """Outputs of all columns, and voltage of the ADC's sampling capacitor, over time, in V.

    Rows and columns are the driven and the sensed lines (line coordinates, :mod:`.._parts`). Outputs are clipped at the
    supply limits; recovery of an amplifier from saturation is not modelled.

    Example::

        transient = Transient(design, resistance)
        transient.aim(scan(design, resistance).volts[2])  # row 2 is selected now
        transient.advance(50e-6)
        transient.connect(0)  # a conversion of column 0 begins
        transient.advance(12e-6)
        volts = transient.disconnect()
    """

    def __init__(self, design: Design, resistance: ArrayLike) -> None:
        """Start with all outputs and the capacitor settled at the reference voltage.

        Args:
            design: with amplifiers; the ADC's switch and capacitor are those of ``[adc]``.
            resistance: (rows, columns) ohm.

        Raises:
            InputError: cells that do not fit the design, or a readout without amplifiers.

        """
        require_amplifiers(design.board)
        columns = design.board.shape[1]
        self._settled: FloatArray = np.full(columns, design.board.level)
        self._held = design.board.level
        self._connected: int | None = None
        self._row = 0
        self._deviation: FloatArray = np.zeros(2 * columns)  # of ends and outputs from the settled state
        self.change(design, resistance)

    def change(self, design: Design, resistance: ArrayLike) -> None:
        """Change cells or lines; the outputs stay continuous. Call :meth:`aim` with the new settled outputs next.

        Args:
            design: with the same amplifiers as before; its lines, faults and drive may differ.
            resistance: (rows, columns) ohm.

        """
        self._board = board = design.board
        taps = range(board.shape[1], 2 * board.shape[1]) if sampler_delay(board) else ()
        every = np.arange(board.shape[1])
        networks = ColumnNetworks.of(design, Boards.of(design), design.resistance(resistance)[None])
        known = [Circuit.of(networks, group, every, list(taps)) for group in range(networks.conductance.shape[1])]
        self._circuits = known if len(known) > 1 else known * board.shape[0]

    def aim(self, settled: FloatArray, row: int = 0) -> None:
        """Set the outputs that the circuit approaches from now on.

        Args:
            settled: (columns,) V.
            row: the selected row; matters only with floating idle rows, where the dynamics depend on it.

        """
        self._row, moved = row, self._settled - settled
        follow = -moved / self._board.gain  # of an inverting input, 1/A of its output
        self._deviation = self._deviation + np.concatenate([follow, moved])
        self._settled = np.array(settled, dtype=np.float64)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        if seconds <= 0:
            return
        circuit, size = self._circuits[self._row], len(self._deviation)
        nodes = np.concatenate([self._deviation, np.zeros(circuit.rest.shape[1] - size)])
        capacitor, final = None, 0.0
        if self._connected is not None and sampler_delay(self._board):
            capacitor, final = size + self._connected, float(self._settled[self._connected])
            nodes[capacitor] = self._held - final
        nodes = circuit.after(nodes[None, :, None], seconds)[0, :, 0]
        self._deviation = nodes[:size]
        if capacitor is not None:
            self._held = float(np.clip(final + nodes[capacitor], *self._board.supply))

    def connect(self, column: int) -> None:
        """Begin a conversion: the sampling capacitor is connected to the output of ``column``."""
        self._connected = column

    def disconnect(self) -> float:
        """End the acquisition; returns the voltage in V that the capacitor keeps."""
        if self._connected is not None and not sampler_delay(self._board):
            self._held = float(self.outputs()[self._connected])
        self._connected = None
        return self._held

    def outputs(self) -> FloatArray:
        """(columns,) V now."""
        present: FloatArray = np.clip(self._settled + self._deviation[-len(self._settled) :], *self._board.supply)
        return present
