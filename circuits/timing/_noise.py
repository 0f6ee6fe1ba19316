"""Noise of the readings from a Lyapunov equation: amplifiers, resistors and quantisation, per cell.

The column amplifiers are a linear system (:mod:`._dynamics`) driven by white noise. The covariance P of the state then
solves the continuous Lyapunov equation ``A P + P A' + B W B' = 0``, where A is the state matrix, B the input matrix and
W the intensity of the noise (Astrom, "Introduction to Stochastic Control Theory", 1970). This method needs neither an
integral over frequency nor an assumed noise bandwidth.

The thermal noise of the grid follows from Nyquist's theorem for multiports (Twiss 1955): the noise currents at the
ports have the spectral density 4 k T Y, whatever the circuit inside.

Densities are one-sided, in V/sqrt(Hz) and A/sqrt(Hz), as in data sheets. Low-frequency (1/f) noise is not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import ArrayLike
from scipy.constants import Boltzmann
from scipy.linalg import solve_continuous_lyapunov

from ...common.arrays import FloatArray
from ...errors import InputError
from .._board import Board
from .._design import Design
from ._dynamics import Dynamics, column_conductances, column_dynamics, require_amplifiers
from ._shared_amplifier import SharedAmplifier
from ._switched import column_networks


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one frame's readings in V, each (rows, columns)."""

    parts: dict[str, FloatArray]
    """Standard deviations by origin.

    The origins are "amplifier voltage", "amplifier current", "grid", "reference resistor", "sampling" and
    "quantisation". Origins that the design does not name are missing.
    """
    shape: tuple[int, int]

    @property
    def volts(self) -> FloatArray:
        """Root sum of squares of all origins, quantisation included."""
        return self._root_sum_of_squares(self.parts)

    @property
    def before_adc(self) -> FloatArray:
        """Root sum of squares of all origins except quantisation: the noise at the input of the ADC."""
        return self._root_sum_of_squares({name: part for name, part in self.parts.items() if name != "quantisation"})

    def samples(self, volts: ArrayLike, frames: int, seed: int) -> FloatArray:
        """Draw noisy readings before quantisation, (frames, rows, columns) in V.

        The noise is Gaussian and independent between cells and frames. The weak correlation of columns that share line
        resistance is left out.

        Args:
            volts: (rows, columns) V, the readings without noise.
            frames: number of frames.
            seed: of the random generator.

        Raises:
            InputError: ``volts`` has a wrong shape.

        """
        centre = np.asarray(volts, dtype=np.float64)
        if centre.shape != self.shape:
            raise InputError(f"volts have shape {centre.shape}, expected {self.shape} (rows, columns)")
        random = np.random.default_rng(seed)
        return random.normal(centre, self.before_adc, (frames, *self.shape))

    def _root_sum_of_squares(self, parts: dict[str, FloatArray]) -> FloatArray:
        total = np.zeros(self.shape)
        for part in parts.values():
            total = np.hypot(total, part)
        return total


def noise(design: Design, resistance: ArrayLike) -> Noise:
    """Standard deviation of each reading, by origin of the noise.

    The sources of noise are ``readout.voltage_noise`` and ``readout.current_noise`` of the amplifiers,
    ``readout.temperature`` for all resistors, and the quantisation by the ADC. All are absent by default.

    A divider has no amplifiers. The noise of its resistors on the sampling capacitor has the variance kT/C, whatever
    the resistances (equipartition theorem).

    Args:
        design: the board.
        resistance: (rows, columns) ohm of the cells.

    Raises:
        InputError: the cells do not fit the design; the circuit uses a follower; or nothing limits the bandwidth of a
            noise, so that its variance is infinite.

    """
    board = design.board
    shared = board.circuit.virtual_ground and board.multiplexed
    if board.circuit.has_amplifiers and not shared:
        require_amplifiers(board)
    cells = board.turn(design.resistance(resistance))
    part, adc = design.readout, design.adc
    parts: dict[str, FloatArray] = {}
    thermal_energy = Boltzmann * part.temperature  # k T, in J
    if board.circuit.has_amplifiers:
        if part.voltage_noise or part.current_noise or thermal_energy:
            parts |= (_shared_noise if shared else _amplified_noise)(board, cells, thermal_energy)
    elif thermal_energy and not (adc and adc.sampling_capacitance):
        raise InputError(
            "noise of the resistors has no bandwidth limit and so no finite size; give adc.sampling_capacitance"
        )
    if thermal_energy and adc and adc.sampling_capacitance:  # kT/C, independent of the resistance of the switch
        parts["sampling"] = np.full(board.shape, np.sqrt(thermal_energy / adc.sampling_capacitance))
    if adc:
        parts["quantisation"] = np.full(board.shape, adc.step / np.sqrt(12))
    return Noise({name: board.turn(part) for name, part in parts.items()}, design.array.shape)


def _amplified_noise(board: Board, cells: FloatArray, thermal_energy: float) -> dict[str, FloatArray]:
    """Standard deviations (N, M) in V by origin: amplifiers, grid and reference resistors."""
    part, one = board.readout, np.eye(board.shape[1])
    rows = []
    for conductance in column_conductances(board, cells):
        # The intensity of white noise is its two-sided density, half the one-sided density.
        voltage = {"amplifier voltage": part.voltage_noise**2 / 2 * one}
        current = {
            "amplifier current": part.current_noise**2 / 2 * one,
            "grid": 2 * thermal_energy * conductance,
            "reference resistor": 2 * thermal_energy / board.reference * one,
        }
        rows.append(_variances(board, column_dynamics(board, conductance), voltage, current))
    parts = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        variance = [row.get(name, np.zeros(board.shape[1])) for row in rows]
        parts[name] = np.sqrt(np.broadcast_to(variance, board.shape))
    return parts


def _shared_noise(board: Board, cells: FloatArray, thermal_energy: float) -> dict[str, FloatArray]:
    """As :func:`_amplified_noise`, for one amplifier behind a switch that has long been at the column it reads.

    Raises:
        InputError: nothing limits the bandwidth.

    """
    part, columns = board.readout, board.shape[1]
    if part.gain_bandwidth == inf:
        raise InputError(
            "noise of one amplifier behind a switch has no bandwidth limit and so no finite size; "
            "give readout.gain_bandwidth"
        )
    parts: dict[str, FloatArray] = {}
    known: dict[tuple[int, int], dict[str, float]] = {}
    networks = [network for network, _ in column_networks(board, cells)]  # all alive: their identities differ
    for (row, column), network in np.ndenumerate(np.repeat(np.arange(len(networks))[:, None], columns, axis=1)):
        seen = networks[network]
        if (id(seen), column) not in known:
            known[id(seen), column] = _shared_variances(board, seen, column, thermal_energy)
        for name, variance in known[id(seen), column].items():
            parts.setdefault(name, np.zeros(board.shape))[row, column] = np.sqrt(variance)
    return parts


def _shared_variances(board: Board, network: FloatArray, column: int, thermal_energy: float) -> dict[str, float]:
    """Variances in V^2 of the reading of one column, by the name of the noise."""
    part, count = board.readout, board.shape[1]
    circuit = SharedAmplifier.of(board, network, column, sampling=True)
    intensities = {name: np.zeros((count + 2, count + 2)) for name in ("amplifier voltage", "amplifier current")}
    intensities |= {name: np.zeros((count + 2, count + 2)) for name in ("grid", "reference resistor")}
    # The intensity of white noise is its two-sided density, half the one-sided density.
    intensities["amplifier voltage"][count, count] = part.voltage_noise**2 / 2
    intensities["amplifier current"][column, column] = part.current_noise**2 / 2
    intensities["grid"][:count, :count] = 2 * thermal_energy * network
    ends = np.arange(count) if board.idle_columns == "load" else [column]
    intensities["reference resistor"][ends, ends] = 2 * thermal_energy / board.reference[column]
    output, found = circuit.back[-1], {}
    for name, intensity in intensities.items():
        if intensity.any():
            covariance = solve_continuous_lyapunov(circuit.matrix, -circuit.entry @ intensity @ circuit.entry.T)
            found[name] = max(float(output @ covariance @ output), 0.0)
    return found


def _variances(
    board: Board, dynamics: Dynamics, voltage: dict[str, FloatArray], current: dict[str, FloatArray]
) -> dict[str, FloatArray]:
    """Variances (M,) in V^2 of the sampled outputs, by the name of the noise.

    Args:
        board: its converter's sampling capacitor filters the noise.
        dynamics: of the column amplifiers.
        voltage: intensities (M, M) of white noise voltages at the non-inverting inputs, by name.
        current: intensities (M, M) of white noise currents into the inverting inputs, by name.

    Raises:
        InputError: nothing limits the bandwidth of a noise.

    """
    adc = board.adc
    sampling = adc.switch_resistance * adc.sampling_capacitance if adc else 0.0
    matrix, output = dynamics.matrix, dynamics.output
    states, columns = len(matrix), len(output)
    if sampling:  # the sampling capacitor adds one state y per column: y' = (v - y)/tau
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
