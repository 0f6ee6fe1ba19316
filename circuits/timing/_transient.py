"""Transient response of the column amplifiers to a scan whose switching times are not known in advance.

:class:`~._settling.Settling` is for scans of constant row period. A program on a microcontroller selects rows and
starts conversions at arbitrary times; :class:`Transient` follows the program event by event.

Between events the circuit is linear and time-invariant. Its state is propagated by the modal form of the matrix
exponential, exp(A t) = V exp(D t) V^-1 (Moler and Van Loan, "Nineteen dubious ways", method 14). If the matrix V of
eigenvectors is ill-conditioned, the exponential itself is computed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from ...common.arrays import FloatArray
from .._design import Design
from ._dynamics import Dynamics, column_conductances, column_dynamics, require_amplifiers

_WORST_CONDITION = 1e8
"""largest condition number of the matrix of eigenvectors; the modal form then still has eight correct digits"""
_SLOW_ENOUGH = 1e-6
"""relative distance of two time constants below which their difference quotient is replaced by its limit"""


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
        self._design = design
        self._board = board = design.board
        require_amplifiers(board)
        adc = design.adc
        self._sampling_s = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0
        self._settled: FloatArray = np.full(board.shape[1], board.level)
        self._held = board.level
        self._connected: int | None = None
        self._row = 0
        self._load(resistance)
        self._deviation: FloatArray = np.zeros(len(self._present.matrix))

    def change(self, design: Design, resistance: ArrayLike) -> None:
        """Change cells or lines; the outputs stay continuous. Call :meth:`aim` with the new settled outputs next.

        Args:
            design: with the same amplifiers as before; its lines, faults and drive may differ.
            resistance: (rows, columns) ohm.

        """
        self._design, self._board = design, design.board
        self._load(resistance)

    def aim(self, settled: FloatArray, row: int = 0) -> None:
        """Set the outputs that the circuit approaches from now on.

        Args:
            settled: (columns,) V.
            row: the selected row; matters only with floating idle rows, where the dynamics depend on it.

        """
        self._row = row if len(self._modes) > 1 else 0
        self._deviation = self._deviation + self._present.lift @ (self._settled - settled)
        self._settled = np.array(settled, dtype=np.float64)

    def advance(self, seconds: float) -> None:
        """Let time pass."""
        if seconds <= 0:
            return
        mode = self._modes[self._row]
        if self._connected is not None:
            self._held = self._charged(mode, seconds)
        self._deviation = mode.carry(self._deviation, seconds)

    def connect(self, column: int) -> None:
        """Begin a conversion: the sampling capacitor is connected to the output of ``column``."""
        self._connected = column

    def disconnect(self) -> float:
        """End the acquisition; returns the voltage in V that the capacitor keeps."""
        if self._sampling_s == 0 and self._connected is not None:
            self._held = float(self.outputs()[self._connected])
        self._connected = None
        return self._held

    def outputs(self) -> FloatArray:
        """(columns,) V now."""
        low, high = self._design.readout.supply
        present: FloatArray = np.clip(self._settled + self._present.output @ self._deviation, low, high)
        return present

    @property
    def _present(self) -> Dynamics:
        return self._modes[self._row].dynamics

    def _load(self, resistance: ArrayLike) -> None:
        board = self._board
        conductances = column_conductances(board, board.turn(self._design.resistance(resistance)))
        self._modes = [_Modes(column_dynamics(board, conductance)) for conductance in conductances]

    def _charged(self, mode: _Modes, seconds: float) -> float:
        """V of the connected capacitor after ``seconds``, by C v' = (output - v) / R and the modes of the output."""
        assert self._connected is not None
        if self._sampling_s == 0:
            return self._held
        final = float(self._settled[self._connected])
        kept = np.exp(-seconds / self._sampling_s)
        transferred = mode.filtered(self._deviation, self._connected, self._sampling_s, seconds)
        low, high = self._design.readout.supply
        return float(np.clip(final + kept * (self._held - final) + transferred, low, high))


class _Modes:
    """One linear system, and its modal form if that form is accurate."""

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics = dynamics
        self._rates: NDArray[Any] = np.zeros(0)
        self._vectors: NDArray[Any] | None = None
        if not dynamics.matrix.size:
            return
        rates, vectors = np.linalg.eig(dynamics.matrix)
        if np.linalg.cond(vectors) < _WORST_CONDITION:
            self._rates, self._vectors = rates, vectors
            self._inverse = np.linalg.inv(vectors)

    def carry(self, state: FloatArray, seconds: float) -> FloatArray:
        """State after ``seconds`` without a new event."""
        if not state.size:
            return state
        if self._vectors is None:
            carried: FloatArray = expm(self.dynamics.matrix * seconds) @ state
            return carried
        modal: FloatArray = (self._vectors @ (np.exp(self._rates * seconds) * (self._inverse @ state))).real
        return modal

    def filtered(self, state: FloatArray, column: int, time_constant: float, seconds: float) -> float:
        """Deviation in V of one output after a first-order low-pass filter that was at zero ``seconds`` ago."""
        if not state.size:
            return 0.0
        if self._vectors is None:
            size = len(state)
            joint = np.zeros((size + 1, size + 1))
            joint[:size, :size] = self.dynamics.matrix
            joint[size, :size] = self.dynamics.output[column] / time_constant
            joint[size, size] = -1 / time_constant
            return float((expm(joint * seconds)[size, :size] @ state).item())
        amplitudes = (self.dynamics.output[column] @ self._vectors) * (self._inverse @ state)
        slowness = 1 + self._rates * time_constant
        decayed = np.exp(-seconds / time_constant)
        alike = np.abs(slowness) < _SLOW_ENOUGH
        quotient = np.where(
            alike,
            seconds / time_constant * decayed,
            (np.exp(self._rates * seconds) - decayed) / np.where(alike, 1.0, slowness),
        )
        return float((amplitudes @ quotient).real)
