"""What each column ends in: port conductances to output volts, for a whole frame at once.

A finite-gain amplifier is a resistor. With the output eliminated, its column sees Rref / (1 + A) in series with a
source (A E - Rref Ib) / (1 + A), where E = Vref + Vos, so no indefinite matrix and no loss of digits with A = 1e12
arise. A saturated output S is another resistor and source, Rref and S - Rref Ib: its column has lost the virtual
ground. Which outputs saturate is a linear complementarity problem with a P-matrix, solved by principal pivoting.
"""

from __future__ import annotations

from math import inf, isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from ..arrays import BoolArray, FloatArray
from ..errors import SolverError
from ._design import Design
from ._parts import Parts, siemens
from .solvers._elimination import Rounded, eliminate_leading, inverted
from .solvers._ports import IDEAL_WIRE


class Reading(NamedTuple):
    """Output volts (..., rows, columns) and which outputs stand at a supply limit."""

    volts: FloatArray
    saturated: BoolArray
    relative: float = 0.0
    """bound on the rounding errors of the eliminations behind it, relative to the conductances they leave"""


def read(design: Design, ports: FloatArray) -> Reading:
    """The outputs of all columns in all scan steps.

    Args:
        ports: (..., N + M, N + M) port conductances of the grid in S, row terminals first, row leads included.

    """
    if design.readout.circuit == "inverting-amplifier":
        return _read_amplifiers(design, ports)
    if design.readout.circuit == "voltage-feedback":
        return _read_feedback(design, ports)
    volts, relative = _read_divider(design, ports)
    return Reading(volts, np.zeros(volts.shape, dtype=np.bool_), float(relative.max(initial=0.0)))


def apparent_resistance(design: Design, volts: FloatArray) -> FloatArray:
    """Cell resistances (rows, columns) in ohm that would give these outputs in the ideal circuit, equation (10).

    Infinite where the output stands at the reference. Offsets may make it negative for open cells: the value is
    what the reading says, not what a cell can be.
    """
    signal = np.asarray(volts, dtype=np.float64) - design.readout.reference_voltage
    reference, drive = Parts.of(design).reference, design.drive.voltage
    with np.errstate(over="ignore"):  # a signal as small as that is none
        ratio = np.where(signal == 0, inf, drive / np.where(signal == 0, 1.0, signal))
        ohms = reference * (-ratio if design.readout.circuit == "inverting-amplifier" else ratio - 1.0)
    return np.where(np.isinf(ohms), inf, ohms)


def ideal_volts(design: Design, resistance: FloatArray) -> FloatArray:
    """Outputs if every cell were alone with ideal parts: equation (10), or the single-cell divider.

    Shorts give an infinite amplifier output.
    """
    reference = Parts.of(design).reference
    drive, zero = design.drive.voltage, design.readout.reference_voltage
    if design.readout.circuit == "inverting-amplifier":
        with np.errstate(divide="ignore"):
            return zero - drive * reference / resistance
    return zero + drive * reference / (reference + resistance)


class Ends(NamedTuple):
    """The Thevenin equivalent that each column (M,) of one step ends in, and its output as a function of current.

    Sources count from the reference voltage, so that a mid-supply reference costs no digits.
    """

    resistance: FloatArray
    source: FloatArray
    output: FloatArray
    """V at zero current"""
    slope: FloatArray
    """V/A"""


def amplifier_ends(design: Design, state: NDArray[np.int8] | None = None) -> Ends:
    """What the columns end in.

    Args:
        design: the amplifiers, none of them necessarily equal to another.
        state: (M,): 0 linear (as if not given), -1 at the lower and +1 at the upper supply limit.

    """
    parts = Parts.of(design)
    if state is None:
        state = np.zeros(design.array.columns, dtype=np.int8)
    level, inverse = design.readout.reference_voltage, 1.0 / (1.0 + parts.gain)
    share = 1.0 / (1.0 + 1.0 / parts.gain)
    limit = np.where(state < 0, design.readout.supply[0], design.readout.supply[1])
    linear, lift = state == 0, parts.reference * parts.bias
    return Ends(
        resistance=np.where(linear, parts.reference * inverse, parts.reference),
        source=np.where(linear, share * parts.offset - inverse * (level + lift), limit - level - lift),
        output=np.where(linear, share * (level + parts.offset + lift), limit),
        slope=np.where(linear, -share * parts.reference, 0.0),
    )


def _terminate(ports: FloatArray, rows: int, resistance: FloatArray) -> Rounded:
    """Put ``resistance`` (M,) behind the column terminals: the network of the N row terminals and the M far ends."""
    if not resistance.any():
        return Rounded(ports, np.zeros(ports.shape[:-2]))
    columns = len(resistance)
    behind = siemens(resistance)
    largest = np.max(behind, where=np.isfinite(behind), initial=ports.max(initial=0.0))
    behind = np.minimum(behind, IDEAL_WIRE * largest)
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


def _column_currents(design: Design, terminated: Rounded, source: FloatArray) -> Rounded:
    """Current (..., N, M) in A into the column terminations in every scan step, for one set of sources (M,).

    The relative error (...,) is that of ``terminated``'s conductances and of the eliminations that follow.
    """
    network, relative = terminated
    rows, columns = design.array.shape
    drive = design.drive.voltage
    difference = source - source[:, None]  # of equal sources exactly zero, so that nothing large has to cancel
    if design.drive.idle_rows == "ground":
        transfer = network[..., :rows, rows:]
        idle = (network[..., rows:, rows:] * difference).sum(axis=-1) - transfer.sum(axis=-2) * source
        grounded: FloatArray = drive * transfer + idle[..., None, :]
        return Rounded(grounded, relative)
    currents = np.empty((*network.shape[:-2], rows, columns))
    worst = np.zeros(relative.shape)  # each step is solved on its own
    for row in range(rows):
        order = np.r_[np.delete(np.arange(rows), row), row, rows : rows + columns]
        alone, step = eliminate_leading(network[..., order[:, None], order], rows - 1)
        worst = np.maximum(worst, step)
        currents[..., row, :] = alone[..., 0, 1:] * (drive - source) + (alone[..., 1:, 1:] * difference).sum(axis=-1)
    return Rounded(currents, relative + worst)


def _read_amplifiers(design: Design, ports: FloatArray) -> Reading:
    rows, columns = design.array.shape
    parts, ends = Parts.of(design), amplifier_ends(design)
    network = _terminate(ports, rows, ends.resistance + parts.column_lead)
    currents, errors = _column_currents(design, network, ends.source)
    volts, relative = ends.output + ends.slope * currents, float(errors.max(initial=0.0))
    low, high = design.readout.supply
    saturated = (volts < low) | (volts > high)
    if saturated.any():
        frames = ports.reshape(-1, *ports.shape[-2:])
        stacked, flags = volts.reshape(-1, rows, columns), saturated.reshape(-1, rows, columns)
        for frame in np.flatnonzero(flags.any(axis=(1, 2))):
            stacked[frame], flags[frame], own = _read_saturated(design, parts, frames[frame], stacked[frame])
            relative = max(relative, own)
    return Reading(volts, saturated, relative)


def _read_saturated(design: Design, parts: Parts, ports: FloatArray, volts: FloatArray) -> Reading:
    """One frame in which some output hits its limit: find for each step which columns do (principal pivoting)."""
    rows, columns = design.array.shape
    low, high = design.readout.supply
    # What the amplifier's input must exceed to hold its output at a limit; a missing limit is never reached.
    at_low, at_high = (
        np.where(np.isinf(parts.gain), 0.0, end / parts.gain) if isfinite(end) else 0.0 for end in (low, high)
    )
    state = (volts > high).astype(np.int8) - (volts < low).astype(np.int8)
    volts = volts.copy()
    pending: BoolArray = np.atleast_1d(state.any(axis=1))
    relative = 0.0
    for attempt in range(50 + 4 * columns):
        patterns, which = np.unique(state, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            steps = np.flatnonzero((which.ravel() == number) & pending)
            if not len(steps):
                continue
            ends = amplifier_ends(design, pattern)
            network = _terminate(ports, rows, ends.resistance + parts.column_lead)
            every_current, error = _column_currents(design, network, ends.source)
            currents, relative = every_current[steps], max(relative, float(error))
            volts[steps] = ends.output + ends.slope * currents
            wanted = (volts[steps] > high).astype(np.int8) - (volts[steps] < low).astype(np.int8)
            # A clamped output stays so while the amplifier's input still drives it outwards.
            input_volts = parts.offset - (ends.source + ends.resistance * currents)
            held = ((pattern > 0) & (input_volts >= at_high)) | ((pattern < 0) & (input_volts <= at_low))
            wanted = np.where(pattern == 0, wanted, np.where(held, pattern, 0)).astype(np.int8)
            if attempt >= 50:  # Murty: one column at a time cannot cycle
                first = np.argmax(wanted != pattern, axis=1)[:, None] == np.arange(columns)
                wanted = np.where(first, wanted, pattern).astype(np.int8)
            pending[steps] = (wanted != pattern).any(axis=1)
            state[steps] = wanted
        if not pending.any():
            return Reading(volts, state != 0, relative)
    raise SolverError("no consistent set of saturated outputs was found; check supply and reference_voltage")


def _read_divider(design: Design, ports: FloatArray) -> Rounded:
    """Volts across the load of the sensed column, every (row, column) pair a measurement."""
    rows, columns = design.array.shape
    parts = Parts.of(design)
    load, behind = parts.reference, parts.reference + parts.column_lead
    drive, level = design.drive.voltage, design.readout.reference_voltage
    if design.readout.idle_columns == "load":
        currents, relative = _column_currents(design, _terminate(ports, rows, behind), np.zeros(columns))
        return Rounded(level + load * currents, relative)
    if design.drive.idle_rows == "ground":
        inner, relative = inverted(ports[..., rows:, rows:], ports[..., :rows, rows:].sum(axis=-2), rows)
        open_circuit = drive * ports[..., :rows, rows:] @ inner
        source_resistance = np.einsum("...jj->...j", inner)[..., None, :]
        return Rounded(level + open_circuit * load / (behind + source_resistance), relative)
    between, relative = _effective_resistance(ports, rows)
    return Rounded(level + drive * load / (behind + between), relative)


def _read_feedback(design: Design, ports: FloatArray) -> Reading:
    """Output of the follower that drives all idle lines, every (row, column) pair a measurement.

    With V and F the potentials of the sensed column's end and of the follower (both against the reference), Y the
    network behind the column leads and S = sum of Y from the column to all idle lines:
    ``Y (drive - V) + S (F - V) = V / Rref + Ib`` and ``F = A (V + Vos - F)``. The second one eliminated, V meets S
    only through S / (1 + A): that is how far the idle lines are kept away, and no large numbers are subtracted.
    """
    rows, _ = design.array.shape
    parts = Parts.of(design)
    drive, level = design.drive.voltage, design.readout.reference_voltage
    network, relative = _terminate(ports, rows, parts.column_lead)
    driven = network[..., :rows, rows:]
    # Sums of what is left beside the driven row: from above and from below, since subtracting it would cost digits.
    idle = np.zeros_like(driven)
    np.cumsum(driven[..., :-1, :], axis=-2, out=idle[..., 1:, :])
    idle[..., :-1, :] += np.cumsum(driven[..., :0:-1, :], axis=-2)[..., ::-1, :]
    idle += network[..., rows:, rows:].sum(axis=-1)[..., None, :]
    inverse = 1.0 / (1.0 + parts.gain)
    share = 1.0 / (1.0 + 1.0 / parts.gain)
    lift = share * parts.offset - inverse * level
    injected = driven * drive - parts.bias
    column = (injected + idle * lift) / (driven + idle * inverse + siemens(parts.reference))
    volts = share * (level + column + parts.offset)
    low, high = design.readout.supply
    saturated = (volts < low) | (volts > high)
    return Reading(np.clip(volts, low, high), saturated, float(relative.max(initial=0.0)))


def _effective_resistance(ports: FloatArray, rows: int) -> Rounded:
    """Ohm (..., N, M) between each row and each column terminal with all others left open."""
    size = ports.shape[-1]
    result = np.empty((*ports.shape[:-2], rows, size - rows))
    flat, out = ports.reshape(-1, size, size), result.reshape(-1, rows, size - rows)
    relative = np.zeros(len(flat))  # each row of each frame is solved on its own
    for frame, network in enumerate(flat):
        _, island = connected_components(network > 0, directed=False)
        for row in range(rows):  # grounding the driven row, not a common node, keeps nearby pairs free of cancellation
            others = np.delete(np.arange(size), row)
            inner, error = inverted(network[np.ix_(others, others)], network[row, others])
            relative[frame] = max(relative[frame], float(error))
            ohms = np.where(island[others] == island[row], np.diagonal(inner), inf)
            out[frame, row] = ohms[rows - 1 :]
    return Rounded(result, relative.reshape(ports.shape[:-2]))
