"""First-order error budget of a scan: the effects that are modelled, those that are not, and the size of each.

An effect is absent, and costs no computing time, until the design gives its part a value. The size of each effect is a
first-order estimate. The estimate uses the value in the design or, without one, an assumed value (:data:`ORDINARY`).
:func:`.scan` itself computes none of these estimates.

Virtual-ground amplifiers with grounded idle rows have closed formulas for the relative change of a signal (G in S; the
sums run over a row i or a column j):

* leads and segments: ``R_row sum_k G_ik + R_col sum_k G_kj``; a segment counts with the cells beyond it only;
* finite gain A: ``(1 + Rref sum_k G_kj) abs(Vout / (Vout - Vref)) / A``;
* offset voltage: ``Vos (1 + Rref sum_k G_kj) / (Vin Rref G_ij)``;
* bias current: ``Ib R_ij / Vin``.

Other circuits have no closed formulas. Their estimates come from the derivatives of :func:`.sensitivity`, for at most
32 x 32 cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import BoolArray, FloatArray
from ._adc import adc_error
from ._board import Board
from ._design import Design
from ._grid import exact_ports
from ._sections import Adc
from ._sensitivity import board_sensitivity

EffectSize = Callable[[str, object], float | None]
"""Function of a design key and its value; returns the largest relative change of a signal, or None if unknown."""

ORDINARY = {
    "row_lead": 10.0,  # ohm: an analog switch and some wire
    "column_lead": 10.0,
    "row_segment": 0.254,  # ohm: fabric of 0.1 ohm/cm (paper, VII) on a pitch of 1 inch
    "column_segment": 0.254,
    "open_loop_gain": 1e5,
    "offset_voltage": 1e-3,  # V
    "bias_current": 1e-9,  # A
    "gain_bandwidth": 1e6,  # Hz
    "voltage_noise": 20e-9,  # V/sqrt(Hz)
    "period": 100e-6,  # s per row
}
"""Values assumed for parts that the design does not name; the project's own choice."""
SWING = 3.3
"""V on each side of the reference: assumed supply if the design names none."""
_ORDINARY_ADC = Adc(bits=12, range=(0.0, 3.3))
_MOST_CELLS = 32 * 32  # larger arrays: the derivatives take too long for an estimate


@dataclass(frozen=True)
class Effect:
    """One deviation of a real board from equation (10)."""

    name: str
    modelled: bool
    """whether the volts of a scan include the effect"""
    estimate: float | None
    """largest relative change of a cell's signal; None if there is no simple formula"""
    basis: str
    """the value of the part on which the estimate is based"""


def effects(design: Design, resistance: ArrayLike) -> tuple[Effect, ...]:
    """List every effect that this package knows, modelled or not, with its size.

    Args:
        design: any.
        resistance: (rows, columns) ohm; the estimates leave out open and shorted cells.

    Raises:
        InputError: the cells do not fit the design.

    """
    board = design.board
    return tuple(_effects(design, board.turn(design.resistance(resistance))))


def _effects(design: Design, cells: FloatArray) -> Iterator[Effect]:
    """Yield the effects for cells (N, M) in ohm, in line coordinates.

    Line coordinates call the driven lines rows. The keys are those of the design, so on a board that drives columns the
    key of a row part is looked up under columns.
    """
    board = design.board
    estimate = _effect_size(board, cells)
    of_row, of_column = board.line_kinds
    for table, key, part_key, ideal in (
        (design.array, f"{of_row}_lead", "row_lead", 0.0),
        (design.array, f"{of_column}_lead", "column_lead", 0.0),
        (design.array, f"{of_row}_segment", "row_segment", 0.0),
        (design.array, f"{of_column}_segment", "column_segment", 0.0),
        (design.readout, "open_loop_gain", "open_loop_gain", inf),
        (design.readout, "offset_voltage", "offset_voltage", 0.0),
        (design.readout, "bias_current", "bias_current", 0.0),
    ):
        if table is design.readout and not board.circuit.has_amplifiers:
            continue
        value = getattr(table, key)
        modelled = bool(np.any(np.asarray(value) != ideal))
        used = value if modelled else ORDINARY[key]
        by_line = used[::-1] if board.turned and isinstance(used, tuple) else used
        yield Effect(key, modelled, estimate(part_key, by_line), _basis(key, used, named=modelled))
    yield from _limits(board, cells)
    yield from _dynamic_effects(board, cells)
    if design.fault:
        change = _change_against(board, design.replace(fault=()).board, cells)
        yield Effect("fault", True, change, f"{len(design.fault)} named, against the same scan without")
    if board.continuous:
        sliced = design.replace(array={"sheet": "sliced"}).board
        yield Effect("sheet", True, _change_against(board, sliced, cells), "against the same scan, sliced")


class _ClosedFormulas:
    """Closed formulas for virtual-ground amplifiers with grounded idle rows."""

    def __init__(self, board: Board, cells: FloatArray) -> None:
        self.live = _ordinary_cells(cells)
        with np.errstate(divide="ignore"):
            self.conductance = np.where(self.live, 1.0 / cells, 0.0)
        self.board, self.drive, self.sign = board, abs(board.drive), np.sign(board.drive)

    def __call__(self, key: str, value: object) -> float:
        part = np.abs(np.asarray(value, dtype=np.float64))
        conductance, reference = self.conductance, self.board.reference
        along, down = conductance[:, ::-1].cumsum(axis=1)[:, ::-1], conductance.cumsum(axis=0)
        of_row = part[:, None] if part.ndim else part
        noise_gain = 1.0 + reference * down[-1]
        signal = self.drive * reference * conductance
        match key:
            case "row_lead":
                change = of_row * along[:, :1] + np.zeros_like(conductance)
            case "column_lead":
                change = part * down[-1] + np.zeros_like(conductance)
            case "row_segment":
                change = of_row * (along.cumsum(axis=1) - along[:, :1])
            case "column_segment":
                change = part * (down[::-1].cumsum(axis=0)[::-1] - down[-1])
            case "open_loop_gain":
                # The error at the input is Vout / A, where Vout includes the reference voltage.
                output = np.divide(self.board.level, -self.sign * signal, out=np.zeros_like(signal), where=self.live)
                change = noise_gain / part * np.abs(1.0 + output)
            case _:
                volts = noise_gain if key == "offset_voltage" else reference
                change = np.divide(part * volts, signal, out=np.zeros_like(signal), where=self.live)
        return float(np.max(change, where=self.live, initial=0.0))


class _DerivativeEstimates:
    """First-order estimates from the derivatives of the readings by the parts (adjoint method)."""

    def __init__(self, board: Board, cells: FloatArray) -> None:
        self.found = board_sensitivity(board, cells)
        self.signal = np.abs(self.found.volts - board.level)
        self.live = _ordinary_cells(cells) & (self.signal > 0)

    def __call__(self, key: str, value: object) -> float:
        found, part = self.found, np.asarray(value, dtype=np.float64)
        match key:
            case "row_segment":
                by_line = found.row_segment.sum(axis=-1)
            case "column_segment":
                by_line = found.column_segment.sum(axis=-2)
            case "open_loop_gain":
                by_line, part = found.inverse_gain, 1.0 / part
            case _:
                by_line = getattr(found, key)
        return _largest_relative(np.abs((by_line * part).sum(axis=-1)), self.signal, self.live)


def _effect_size(board: Board, cells: FloatArray) -> EffectSize:
    """The estimate that suits the board, or one that always returns None."""
    if board.virtual_grounds and not board.floating:
        return _ClosedFormulas(board, cells)
    if not board.continuous and cells.size <= _MOST_CELLS:
        return _DerivativeEstimates(board, cells)
    return lambda key, value: None


def _limits(board: Board, cells: FloatArray) -> Iterator[Effect]:
    """Limits of the signal chain: the amplifiers' supply and the converter."""
    live, level = _ordinary_cells(cells), board.level
    volts = board.circuit.ideal_volts(board, np.where(live, cells, inf))
    signal = np.abs(volts - level)
    if board.circuit.has_amplifiers:
        low, high = board.supply
        named = bool(np.isfinite([low, high]).any())
        if not named:
            low, high = level - SWING, level + SWING
        beyond = np.maximum(np.maximum(volts - high, low - volts), 0.0)
        yield Effect(
            "supply", named, _largest_relative(beyond, signal, live), _basis("supply", [low, high], named=named)
        )
    adc = board.adc or _ORDINARY_ADC
    error = np.full_like(signal, adc_error(replace(board, adc=adc)))
    basis = f"{adc.bits} bits over {list(adc.range)} V, " + ("by adc_codes()" if board.adc else "assumed")
    yield Effect("converter", False, _largest_relative(error, signal, live), basis)


def _dynamic_effects(board: Board, cells: FloatArray) -> Iterator[Effect]:
    """Effects of time: noise and settling. A scan has neither; :mod:`.timing` models both."""
    part, live = board.readout, _ordinary_cells(cells)
    if not board.virtual_grounds:
        yield Effect("noise", False, None, "no simple law")
        yield Effect("settling", False, None, "no simple law")
        return
    with np.errstate(divide="ignore"):
        conductance = np.where(live, 1.0 / cells, 0.0)
    signal = abs(board.drive) * board.reference * conductance
    noise_gain = 1.0 + board.reference * conductance.sum(axis=0)
    fast = bool(np.isfinite(part.gain_bandwidth))
    product = part.gain_bandwidth if fast else ORDINARY["gain_bandwidth"]
    bandwidth = product / noise_gain
    density = part.voltage_noise or ORDINARY["voltage_noise"]
    scatter = density * noise_gain * np.sqrt(pi / 2 * bandwidth) + np.zeros_like(signal)
    basis = "amplifier voltage, by noise(); " + _basis("voltage_noise", density, named=part.voltage_noise > 0)
    yield Effect("noise", False, _largest_relative(scatter, signal, live), basis)
    left = np.exp(-2 * pi * bandwidth * ORDINARY["period"]) * signal.max(axis=0) + np.zeros_like(signal)
    basis = f"{ORDINARY['period']} s per row, by Settling; " + _basis("gain_bandwidth", product, named=fast)
    yield Effect("settling", False, _largest_relative(left, signal, live), basis)


def _change_against(board: Board, without: Board, cells: FloatArray) -> float:
    """Largest relative change of a signal between scans of two boards."""
    with_it, bare = (each.circuit.read(each, exact_ports(each, cells).value).volts for each in (board, without))
    return _largest_relative(np.abs(with_it - bare), np.abs(bare - board.level), _ordinary_cells(cells))


def _ordinary_cells(cells: FloatArray) -> BoolArray:
    """Cells that are neither open nor shorted."""
    return np.logical_and(np.isfinite(cells), cells > 0)


def _largest_relative(change: FloatArray, signal: FloatArray, live: BoolArray) -> float:
    """Largest ratio of ``change`` to ``signal``, among live cells with a signal."""
    relative = np.divide(change, signal, out=np.zeros_like(signal), where=live & (signal > 0))
    return float(relative.max(initial=0.0))


def _basis(key: str, value: object, *, named: bool) -> str:
    """Text for :attr:`Effect.basis`."""
    return f"{key} = {value}" + ("" if named else " assumed")
