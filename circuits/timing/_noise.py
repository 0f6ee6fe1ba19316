"""Noise of the readings: amplifiers, resistors and the ADC's step, as a standard deviation per cell.

The amplifiers on their columns are a linear system (:mod:`._dynamics`) driven by white noise, so the variance of each
output is the solution of a Lyapunov equation: no integral over frequency, no noise bandwidth to guess. The grid comes
in whole by Nyquist's theorem: whatever is inside, the noise currents at its ports have the density 4 k T Y.

Densities are one-sided, in V/sqrt(Hz) and A/sqrt(Hz), as in data sheets. Noise at low frequencies (1/f) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.constants import Boltzmann
from scipy.linalg import solve_continuous_lyapunov

from ...arrays import FloatArray
from ...errors import InputError
from .._board import Board
from .._design import Design
from ._dynamics import Dynamics, column_conductances, column_dynamics, require_amplifiers


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one frame's readings in V, each (rows, columns)."""

    parts: dict[str, FloatArray]
    """by origin: "amplifier voltage", "amplifier current", "grid", "reference resistor", "sampling", "quantisation";
    those that the design leaves out are missing"""
    shape: tuple[int, int]

    @property
    def volts(self) -> FloatArray:
        """All origins together, quantisation included."""
        return self._together(self.parts)

    @property
    def before_adc(self) -> FloatArray:
        """All origins but quantisation: what is on the output when it is converted."""
        return self._together({name: part for name, part in self.parts.items() if name != "quantisation"})

    def samples(self, volts: ArrayLike, frames: int, seed: int) -> FloatArray:
        """``frames`` noisy readings (frames, rows, columns) of the outputs ``volts``, before the ADC quantises them.

        Gaussian, and independent from cell to cell and frame to frame: the weak correlation of columns that share
        line resistance is left out.
        """
        centre = np.asarray(volts, dtype=np.float64)
        if centre.shape != self.shape:
            raise InputError(f"volts have shape {centre.shape}, expected {self.shape} (rows, columns)")
        random = np.random.default_rng(seed)
        return random.normal(centre, self.before_adc, (frames, *self.shape))

    def _together(self, parts: dict[str, FloatArray]) -> FloatArray:
        total = np.zeros(self.shape)
        for part in parts.values():
            total = np.hypot(total, part)
        return total


def noise(design: Design, resistance: ArrayLike) -> Noise:
    """How much each reading scatters, from the noise parameters that the design names.

    ``readout.voltage_noise`` and ``current_noise``, ``readout.temperature`` for all resistors, and the steps of the
    ADC. All are off by default. A divider has no amplifiers: its sampling capacitor holds kT/C, whatever the resistors
    that it is charged through (the equipartition theorem), and that is all of their noise.

    Raises:
        InputError: cells that do not fit the design; a follower's circuit; or nothing limits the bandwidth of a noise,
            whose variance is then infinite.

    """
    board = design.board
    if board.circuit.has_amplifiers:
        require_amplifiers(board)
    cells = board.turn(design.resistance(resistance))
    part, adc = design.readout, design.adc
    parts: dict[str, FloatArray] = {}
    thermal_energy = Boltzmann * part.temperature  # k T, in J
    if board.circuit.has_amplifiers:
        if part.voltage_noise or part.current_noise or thermal_energy:
            parts |= _amplified_noise(board, cells, thermal_energy)
    elif thermal_energy and not (adc and adc.sampling_capacitance):
        raise InputError(
            "noise of the resistors has no bandwidth limit and so no finite size; give adc.sampling_capacitance"
        )
    if thermal_energy and adc and adc.sampling_capacitance:  # kT/C, whatever the resistance of the switch
        parts["sampling"] = np.full(board.shape, np.sqrt(thermal_energy / adc.sampling_capacitance))
    if adc:
        parts["quantisation"] = np.full(board.shape, adc.step / np.sqrt(12))
    return Noise({name: board.turn(part) for name, part in parts.items()}, design.array.shape)


def _amplified_noise(board: Board, cells: FloatArray, thermal_energy: float) -> dict[str, FloatArray]:
    """Standard deviations (N, M) in V by origin: amplifiers, grid and reference resistors."""
    part, one = board.design.readout, np.eye(board.shape[1])
    rows = []
    for conductance in column_conductances(board, cells):
        # Two-sided densities, which are the intensities of white noise.
        voltage = {"amplifier voltage": part.voltage_noise**2 / 2 * one}
        current = {
            "amplifier current": part.current_noise**2 / 2 * one,
            "grid": 2 * thermal_energy * conductance,
            "reference resistor": 2 * thermal_energy / board.reference * one,
        }
        rows.append(_variances(board.design, column_dynamics(board, conductance), voltage, current))
    parts = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        variance = [row.get(name, np.zeros(board.shape[1])) for row in rows]
        parts[name] = np.sqrt(np.broadcast_to(variance, board.shape))
    return parts


def _variances(
    design: Design, dynamics: Dynamics, voltage: dict[str, FloatArray], current: dict[str, FloatArray]
) -> dict[str, FloatArray]:
    """Variances (M,) in V^2 of what is sampled, for white noises of the given intensities (M, M), by name."""
    adc = design.adc
    sampling = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0
    matrix, output = dynamics.matrix, dynamics.output
    states, columns = len(matrix), len(output)
    if sampling:  # the sampling capacitor is the last link of the chain: x' gets (v - x)/tau
        matrix = np.block([[matrix, np.zeros((states, columns))], [output, -np.eye(columns)]])
        matrix[states:] /= sampling
        output = np.hstack([np.zeros_like(output), np.eye(columns)])
    result: dict[str, FloatArray] = {}
    for intensities, into, through in (
        (voltage, dynamics.voltage, dynamics.feedthrough),
        (current, dynamics.current, dynamics.current_feedthrough),
    ):
        entry = np.vstack([into, through / sampling]) if sampling else into
        for name, intensity in intensities.items():
            if not intensity.any():
                continue
            if not sampling and through.any():
                raise InputError(
                    f"noise of the {name} has no bandwidth limit and so no finite size; give readout.gain_bandwidth, "
                    "or adc.switch_resistance with adc.sampling_capacitance"
                )
            covariance = solve_continuous_lyapunov(matrix, -entry @ intensity @ entry.T)
            variance = np.einsum("js,st,jt->j", output, covariance, output)
            result[name] = np.maximum(variance, 0.0)
    return result
