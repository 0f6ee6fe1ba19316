"""An independent judge of readings: modified nodal analysis of a whole board in double precision, for many frames.

The parts of the grid are those of ``bench/_reference.py``, which is exact and slow; this one is accurate to about 1e-9
and quick enough for streams. Nothing is shared with ``ohmskin.circuits`` but the keys of a design. The inner nodes of
the grid are eliminated once per frame; each scan step then has a few dozen unknowns.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import DisjointSet

from ohmskin.bench._reference import REFERENCE, Node, _grid, _of
from ohmskin.circuits import Design
from ohmskin.common.arrays import FloatArray


def nodal_volts(design: Design, cells: FloatArray) -> FloatArray:
    """Outputs (rows, columns) in V of one frame of cells in ohm, none of which is 0."""
    names, network, driven, sensed = _ports(design, cells)
    circuit, idle = design.readout.circuit, design.readout.idle_columns
    alone = (
        circuit == "voltage-feedback"
        or (circuit == "voltage-divider" and idle != "load")
        or design.readout.columns == "multiplexed"
    )
    volts = np.empty((driven, sensed))
    for row in range(driven):
        for read in [[j] for j in range(sensed)] if alone else [list(range(sensed))]:
            volts[row, read] = _step(design, names, network, row, read, (driven, sensed))
    return volts.T if circuit == "row-amplifier" else volts


def _ports(design: Design, cells: FloatArray) -> tuple[dict[Node, int], FloatArray, int, int]:
    """The number of each port's node, and the nodal matrix between these with all other nodes eliminated."""
    (rows, columns), parts = cells.shape, _grid(design, cells)
    turned = design.readout.circuit == "row-amplifier"
    driven, sensed = (columns, rows) if turned else (rows, columns)
    ports: list[Node] = [("drive", i) for i in range(driven)] + [("end", j) for j in range(sensed)] + [REFERENCE]
    joined: DisjointSet = DisjointSet(ports)
    for a, b, ohm in parts:
        joined.add(a)
        joined.add(b)
        if ohm == 0:
            joined.merge(a, b)
    number: dict[Node, int] = {}
    for node in [*ports, *joined]:
        number.setdefault(joined[node], len(number))
    size, kept = len(number), len({joined[node] for node in ports})
    matrix = np.zeros((size, size))
    for a, b, ohm in parts:
        if 0 < ohm < np.inf:
            _stamp(matrix, number[joined[a]], number[joined[b]], 1.0 / ohm)
    inner = matrix[kept:, kept:]
    inner[np.diag_indices(size - kept)] += 1e-18  # nodes that nothing holds
    network = matrix[:kept, :kept] - matrix[:kept, kept:] @ np.linalg.solve(inner, matrix[kept:, :kept])
    return {node: number[joined[node]] for node in ports}, network, driven, sensed


def _stamp(matrix: FloatArray, a: int, b: int, siemens: float) -> None:
    matrix[a, a] += siemens
    matrix[b, b] += siemens
    matrix[a, b] -= siemens
    matrix[b, a] -= siemens


def _step(
    design: Design, names: dict[Node, int], network: FloatArray, row: int, read: list[int], shape: tuple[int, int]
) -> FloatArray:
    """Outputs of the lines ``read`` while line ``row`` is driven; finds the outputs at a limit by trying."""
    low, high = design.readout.supply
    stuck: list[float | None] = [None] * len(read)
    for _ in range(20):
        outputs, wanted = _solved(design, names, network, row, read, stuck, shape)
        now = [high if volts > high else low if volts < low else None for volts in wanted]
        if now == stuck:
            return outputs
        stuck = now
    raise ArithmeticError("no consistent state of the outputs was found")


def _solved(
    design: Design,
    names: dict[Node, int],
    network: FloatArray,
    row: int,
    read: list[int],
    stuck: list[float | None],
    shape: tuple[int, int],
) -> tuple[FloatArray, FloatArray]:
    """Outputs, and what the amplifiers would put out without limits; potentials are against the reference voltage."""
    readout, (driven, sensed) = design.readout, shape
    feedback, divider = readout.circuit == "voltage-feedback", readout.circuit == "voltage-divider"
    ports, outs = len(network), 1 if feedback else 0 if divider else len(read)
    matrix, right = np.zeros((ports + outs, ports + outs)), np.zeros(ports + outs)
    matrix[:ports, :ports] = network
    held: dict[int, tuple[float, bool]] = {names[REFERENCE]: (0.0, False)}  # V, and whether on top of the follower
    for i in range(driven):
        if i == row:
            held[names["drive", i]] = (design.drive.voltage, False)
        elif feedback or design.drive.idle_rows == "ground":
            held[names["drive", i]] = (0.0, feedback)
    for j in range(sensed):
        node = names["end", j]
        if j in read:
            continue
        if feedback or readout.idle_columns == "ground":
            held[node] = (0.0, feedback)
        elif readout.idle_columns == "load":
            matrix[node, node] += 1.0 / _of(readout.reference_resistance, j)
    for place, (j, rail) in enumerate(zip(read, stuck, strict=True)):
        node, load, level = names["end", j], _of(readout.reference_resistance, j), readout.reference_voltage
        gain, offset = _of(readout.open_loop_gain, j), _of(readout.offset_voltage, j)
        matrix[node, node] += 1.0 / load
        if divider:
            continue
        right[node] -= _of(readout.bias_current, j)
        out = ports + place
        if not feedback:
            matrix[node, out] -= 1.0 / load
        if rail is not None:
            matrix[out, out], right[out] = 1.0, rail - level
        elif feedback:  # (F + level) (1 + 1/A) = v + level + offset
            matrix[out, out], matrix[out, node], right[out] = 1.0 + 1.0 / gain, -1.0, offset - level / gain
        else:
            matrix[out, out], matrix[out, node], right[out] = 1.0 / gain, 1.0, offset - level / gain
    for node, (volts, on_follower) in held.items():
        matrix[node] = 0.0
        matrix[node, node], right[node] = 1.0, volts
        if on_follower:
            matrix[node, ports] = -1.0
    loose = np.flatnonzero(~matrix.any(axis=1))
    matrix[loose, loose] = 1.0
    potential = np.linalg.solve(matrix, right)
    ends, level = np.array([potential[names["end", j]] for j in read]), readout.reference_voltage
    if divider:
        return ends + level, np.full(len(read), np.clip(level, *readout.supply))
    offset = np.array([_of(readout.offset_voltage, j) for j in read])
    share = 1.0 / (1.0 + 1.0 / np.array([_of(readout.open_loop_gain, j) for j in read]))
    if feedback:
        return np.full(1, potential[ports] + level), (ends + level + offset) * share
    outputs = potential[ports:] + level
    wanted = (level + offset - (ends - potential[ports:])) * share
    return outputs, wanted
