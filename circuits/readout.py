"""What each column ends in: port conductances to output volts, for a whole frame at once.

A finite-gain amplifier is a resistor. With the output eliminated, its column sees Rref / (1 + A) in series with a
source (A E - Rref Ib) / (1 + A), where E = Vref + Vos, so no indefinite matrix and no loss of digits with A = 1e12
arise. A saturated output S is another resistor and source, Rref and S - Rref Ib: its column has lost the virtual
ground. Which outputs saturate is a linear complementarity problem with a P-matrix, solved by principal pivoting.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from ..errors import SolverError
from .design import Design
from .ports import IDEAL_WIRE, eliminate_leading, impedance

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Reading(NamedTuple):
    """Output volts (..., rows, columns) and which outputs stand at a supply limit."""

    volts: FloatArray
    saturated: BoolArray


def read(design: Design, ports: FloatArray) -> Reading:
    """The outputs of all columns in all scan steps.

    Args:
        ports: (..., N + M, N + M) port conductances of the grid in S, row terminals first, row leads included.

    """
    if design.readout.circuit == "inverting-amplifier":
        return _read_amplifiers(design, ports)
    volts = _read_divider(design, ports)
    return Reading(volts, np.zeros(volts.shape, dtype=np.bool_))


def apparent_resistance(design: Design, volts: FloatArray) -> FloatArray:
    """Cell resistances (rows, columns) in ohm that would give these outputs in the ideal circuit, equation (10).

    Infinite where the output stands at the reference. Offsets may make it negative for open cells: the value is
    what the reading says, not what a cell can be.
    """
    signal = np.asarray(volts, dtype=np.float64) - design.readout.reference_voltage
    reference, drive = design.readout.reference_resistance, design.drive.voltage
    with np.errstate(divide="ignore"):
        ratio = np.where(signal == 0, inf, drive / np.where(signal == 0, 1.0, signal))
    if design.readout.circuit == "inverting-amplifier":
        return np.where(np.isinf(ratio), inf, -reference * ratio)
    return reference * (ratio - 1.0)


def ideal_volts(design: Design, resistance: FloatArray) -> FloatArray:
    """Outputs if every cell were alone with ideal parts: equation (10), or the single-cell divider.

    Shorts give an infinite amplifier output.
    """
    reference, drive, zero = (
        design.readout.reference_resistance,
        design.drive.voltage,
        design.readout.reference_voltage,
    )
    if design.readout.circuit == "inverting-amplifier":
        with np.errstate(divide="ignore"):
            return zero - drive * reference / resistance
    return zero + drive * reference / (reference + resistance)


class _Columns(NamedTuple):
    """The Thevenin equivalent that each column (M,) of one step ends in, and its output as a function of current."""

    resistance: FloatArray
    source: FloatArray
    output: FloatArray
    """V at zero current"""
    slope: FloatArray
    """V/A"""


def _amplifier_columns(design: Design, state: NDArray[np.int8]) -> _Columns:
    """``state`` (M,): 0 linear, -1 at the lower and +1 at the upper supply limit."""
    part = design.readout
    gain, reference, bias = part.open_loop_gain, part.reference_resistance, part.bias_current
    level = part.reference_voltage + part.offset_voltage
    share = 1.0 if gain == inf else gain / (1.0 + gain)
    limit = np.where(state < 0, part.supply[0], part.supply[1])
    linear = state == 0
    return _Columns(
        resistance=np.where(linear, reference / (1.0 + gain), reference),
        source=np.where(linear, share * level - reference * bias / (1.0 + gain), limit - reference * bias),
        output=np.where(linear, share * (level + reference * bias), limit),
        slope=np.where(linear, -share * reference, 0.0),
    )


def _terminate(ports: FloatArray, rows: int, resistance: FloatArray) -> FloatArray:
    """Put ``resistance`` (M,) behind the column terminals: the network of the N row terminals and the M far ends."""
    if not resistance.any():
        return ports
    columns = len(resistance)
    wire = IDEAL_WIRE * max(float(ports.max(initial=0.0)), float(1.0 / resistance[resistance > 0].min()))
    with np.errstate(divide="ignore"):
        behind = np.minimum(1.0 / resistance, wire)
    network = np.zeros((*ports.shape[:-2], rows + 2 * columns, rows + 2 * columns))
    near, row, far = (
        slice(0, columns),
        slice(columns, columns + rows),
        np.arange(columns + rows, rows + 2 * columns),
    )
    network[..., near, near] = ports[..., rows:, rows:]
    network[..., near, row] = ports[..., rows:, :rows]
    network[..., row, near] = ports[..., :rows, rows:]
    network[..., row, row] = ports[..., :rows, :rows]
    network[..., np.arange(columns), far] = network[..., far, np.arange(columns)] = behind
    return eliminate_leading(network, columns)


def _column_currents(design: Design, network: FloatArray, source: FloatArray) -> FloatArray:
    """Current (..., N, M) into the column terminations in every scan step, for one set of sources (M,)."""
    rows, columns = design.array.shape
    drive, level = design.drive.voltage, design.readout.reference_voltage
    between = network[..., rows:, rows:]
    if design.drive.idle_rows == "ground":
        transfer = network[..., :rows, rows:]
        idle = transfer.sum(axis=-2) * (level - source) + between @ source - between.sum(axis=-1) * source
        grounded: FloatArray = drive * transfer + idle[..., None, :]
        return grounded
    currents = np.empty((*network.shape[:-2], rows, columns))
    for row in range(rows):
        order = np.r_[np.delete(np.arange(rows), row), row, rows : rows + columns]
        alone = eliminate_leading(network[..., order[:, None], order], rows - 1)
        transfer, between = alone[..., 0, 1:], alone[..., 1:, 1:]
        currents[..., row, :] = transfer * (drive + level - source) + between @ source - between.sum(axis=-1) * source
    return currents


def _read_amplifiers(design: Design, ports: FloatArray) -> Reading:
    rows, columns = design.array.shape
    parts = _amplifier_columns(design, np.zeros(columns, dtype=np.int8))
    network = _terminate(ports, rows, parts.resistance + design.array.column_lead)
    currents = _column_currents(design, network, parts.source)
    volts = parts.output + parts.slope * currents
    low, high = design.readout.supply
    saturated = (volts < low) | (volts > high)
    if saturated.any():
        frames = ports.reshape(-1, *ports.shape[-2:])
        stacked, flags = volts.reshape(-1, rows, columns), saturated.reshape(-1, rows, columns)
        for frame in np.flatnonzero(flags.any(axis=(1, 2))):
            stacked[frame], flags[frame] = _read_saturated(design, frames[frame], stacked[frame])
    return Reading(volts, saturated)


def _read_saturated(design: Design, ports: FloatArray, volts: FloatArray) -> Reading:
    """One frame in which some output hits its limit: find for each step which columns do (principal pivoting)."""
    rows, columns = design.array.shape
    low, high = design.readout.supply
    level, gain = (
        design.readout.reference_voltage + design.readout.offset_voltage,
        design.readout.open_loop_gain,
    )
    state = (volts > high).astype(np.int8) - (volts < low).astype(np.int8)
    volts = volts.copy()
    pending: BoolArray = np.atleast_1d(state.any(axis=1))
    for attempt in range(50 + 4 * columns):
        patterns, which = np.unique(state, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            steps = np.flatnonzero((which.ravel() == number) & pending)
            if not len(steps):
                continue
            parts = _amplifier_columns(design, pattern)
            network = _terminate(ports, rows, parts.resistance + design.array.column_lead)
            currents = _column_currents(design, network, parts.source)[steps]
            volts[steps] = parts.output + parts.slope * currents
            wanted = (volts[steps] > high).astype(np.int8) - (volts[steps] < low).astype(np.int8)
            # A clamped output stays so while the amplifier's input still drives it outwards.
            error = level - (parts.source + parts.resistance * currents)
            held = ((pattern > 0) & (error >= high / gain)) | ((pattern < 0) & (error <= low / gain))
            wanted = np.where(pattern == 0, wanted, np.where(held, pattern, 0)).astype(np.int8)
            if attempt >= 50:  # Murty: one column at a time cannot cycle
                first = np.argmax(wanted != pattern, axis=1)[:, None] == np.arange(columns)
                wanted = np.where(first, wanted, pattern).astype(np.int8)
            pending[steps] = (wanted != pattern).any(axis=1)
            state[steps] = wanted
        if not pending.any():
            return Reading(volts, state != 0)
    raise SolverError("no consistent set of saturated outputs was found; check supply and reference_voltage")


def _read_divider(design: Design, ports: FloatArray) -> FloatArray:
    """Volts across the load of the sensed column, every (row, column) pair a measurement."""
    rows, columns = design.array.shape
    load, lead = design.readout.reference_resistance, design.array.column_lead
    drive, level = design.drive.voltage, design.readout.reference_voltage
    if design.readout.idle_columns == "load":
        network = _terminate(ports, rows, np.full(columns, load + lead))
        currents = _column_currents(design, network, np.full(columns, level))
        return level + load * currents
    if design.drive.idle_rows == "ground":
        inner = impedance(ports[..., rows:, rows:], ports[..., :rows, rows:].sum(axis=-2))
        open_circuit = drive * ports[..., :rows, rows:] @ inner
        source_resistance = np.einsum("...jj->...j", inner)[..., None, :]
        volts: FloatArray = level + open_circuit * load / (load + lead + source_resistance)
        return volts
    return level + drive * load / (load + lead + _effective_resistance(ports, rows))


def _effective_resistance(ports: FloatArray, rows: int) -> FloatArray:
    """Ohm (..., N, M) between each row and each column terminal with all others left open."""
    size = ports.shape[-1]
    result = np.empty((*ports.shape[:-2], rows, size - rows))
    flat, out = ports.reshape(-1, size, size), result.reshape(-1, rows, size - rows)
    for frame, network in enumerate(flat):
        _, island = connected_components(network > 0, directed=False)
        for row in range(rows):  # grounding the driven row, not a common node, keeps nearby pairs free of cancellation
            others = np.delete(np.arange(size), row)
            inner = impedance(network[np.ix_(others, others)], network[row, others])
            ohms = np.where(island[others] == island[row], np.diagonal(inner), inf)
            out[frame, row] = ohms[rows - 1 :]
    return result
