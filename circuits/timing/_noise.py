"""Noise of the readings from a Lyapunov equation: amplifiers, resistors and quantisation, per cell.

The column amplifiers are a linear system (:mod:`._circuit`) driven by white noise. The covariance P of the state then
solves the continuous Lyapunov equation ``A P + P A' + B W B' = 0``, where A is the state matrix, B the input matrix and
W the intensity of the noise (Astrom, "Introduction to Stochastic Control Theory", 1970). This method needs neither an
integral over frequency nor an assumed noise bandwidth.

The thermal noise of the grid follows from Nyquist's theorem for multiports (Twiss 1955): the noise currents at the
ports have the spectral density 4 k T Y, whatever the circuit inside.

Densities are one-sided, in V/sqrt(Hz) and A/sqrt(Hz), as in data sheets. Low-frequency (1/f) noise is not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import FloatArray, IntArray
from ...common.constants import BOLTZMANN
from ...errors import InputError, SolverError
from .._design import Design
from .._population import Boards
from .._tuning import LEAST_SIEMENS
from ..ends import Scan
from ._circuit import Circuit, ColumnNetworks, require_amplifiers, sampler_delay
from ._events import EventScan

_ORIGINS = ("amplifier voltage", "amplifier current", "grid", "reference resistor")


@dataclass(frozen=True)
class Noise:
    """Standard deviations of one frame's readings in V, each (rows, columns)."""

    parts: dict[str, FloatArray]
    """Standard deviations by origin.

    The origins are "amplifier voltage", "amplifier current", "grid", "reference resistor", "sampling" and
    "quantisation". Origins that the design does not name are missing. Of networks at the lines' ends and of ``[scan]``
    they are "circuit" and "quantisation", of the mean of a reading's conversions.
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
    if design.is_described or design.scan is not None:
        try:
            timed = EventScan(design, resistance, design.scan or Scan())
            return Noise({"circuit": timed.circuit_noise, "quantisation": timed.quantisation}, design.array.shape)
        except SolverError as error:  # diodes and limits have no linear noise
            raise InputError(str(error)) from error
    if board.circuit.has_amplifiers and not board.circuit.virtual_ground:
        require_amplifiers(board)
    cells = design.resistance(resistance)
    part, adc = design.readout, design.adc
    parts: dict[str, FloatArray] = {}
    thermal_energy = BOLTZMANN * part.temperature  # k T, in J
    if board.circuit.has_amplifiers:
        if part.voltage_noise or part.current_noise or thermal_energy:
            parts |= _amplifier_noise(design, cells, thermal_energy)
    elif thermal_energy and not (adc and adc.sampling_capacitance):
        raise InputError(
            "noise of the resistors has no bandwidth limit and so no finite size; give adc.sampling_capacitance"
        )
    if thermal_energy and adc and adc.sampling_capacitance:  # kT/C, independent of the resistance of the switch
        parts["sampling"] = np.full(board.shape, np.sqrt(thermal_energy / adc.sampling_capacitance))
    if adc:
        parts["quantisation"] = np.full(board.shape, adc.step / np.sqrt(12))
    return Noise({name: board.transpose(part) for name, part in parts.items()}, design.array.shape)


def _amplifier_noise(design: Design, cells: FloatArray, thermal_energy: float) -> dict[str, FloatArray]:
    """Standard deviations (N, M) in V by origin: amplifiers, grid and resistors.

    One amplifier behind a switch has long been at the column that it reads.
    """
    board = design.board
    columns = board.shape[1]
    every = np.arange(columns)
    readings = every[:, None] if board.multiplexed else every[None]
    parts: dict[str, FloatArray] = {}
    networks = ColumnNetworks.of(design, Boards.of(design), cells[None])
    groups = networks.conductance.shape[1]
    for group in range(groups):
        rows = slice(None) if groups == 1 else group
        for loaded in readings:
            for name, variance in _variances(networks, group, loaded, thermal_energy).items():
                parts.setdefault(name, np.zeros(board.shape))[rows, loaded] = np.sqrt(variance)
    return parts


def _variances(networks: ColumnNetworks, group: int, loaded: IntArray, thermal_energy: float) -> dict[str, FloatArray]:
    """Variances in V^2 of the readings of the columns ``loaded`` (A,) at amplifiers, by the name of the noise.

    Args:
        networks: of one board.
        group: number of the grid that the column ends see.
        loaded: columns at an amplifier.
        thermal_energy: k T in J.

    Raises:
        InputError: nothing limits the bandwidth of a noise.

    """
    from scipy.linalg import solve_continuous_lyapunov

    board, network = networks.board, networks.conductance[0, group]
    part, columns, count = board.readout, len(network), len(loaded)
    outputs = np.arange(columns, columns + count)
    samples = count if sampler_delay(board) else 0
    circuit = Circuit.of(networks, group, loaded, outputs[:samples].tolist())
    read = circuit.rest.shape[1] - count + np.arange(count)  # the capacitors, or the outputs
    at_loads = np.arange(columns) if board.idle_columns == "load" else loaded
    # The intensity of white noise is its two-sided density, half the one-sided density.
    intensities = {name: np.zeros(circuit.entry.shape[2] * np.array([1, 1])) for name in _ORIGINS}
    intensities["amplifier voltage"][outputs, outputs] = part.voltage_noise**2 / 2
    intensities["amplifier current"][loaded, loaded] = part.current_noise**2 / 2
    intensities["grid"][:columns, :columns] = 2 * thermal_energy * network
    intensities["reference resistor"][at_loads, at_loads] = 2 * thermal_energy / board.reference[0, 0, at_loads]
    found = {}
    for name, intensity in intensities.items():
        if not (np.abs(intensity) > LEAST_SIEMENS * thermal_energy).any():
            continue
        if (circuit.feedthrough[0, read] @ intensity).any():
            raise InputError(
                f"noise of the {name} has no bandwidth limit and so no finite size; give readout.gain_bandwidth, "
                "or adc.switch_resistance with adc.sampling_capacitance"
            )
        covariance = solve_continuous_lyapunov(circuit.matrix[0], -circuit.entry[0] @ intensity @ circuit.entry[0].T)
        output = circuit.back[0, read]
        found[name] = np.maximum(np.einsum("js,st,jt->j", output, covariance, output), 0.0)
    return found
