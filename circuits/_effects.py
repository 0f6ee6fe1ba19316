"""What a scan models, what it leaves out, and how large each effect is.

An effect is off, and costs nothing, until the design names its part. Its size is estimated to first order, with the
design's own part or, where it names none, with an ordinary one (:data:`ORDINARY`); nothing of this is computed by
:func:`.scan` itself.

For amplifiers over grounded idle rows the laws are closed (G in S, sums over a row or a column):

* leads and segments: ``R_row sum_k G_ik + R_col sum_k G_kj``, a segment counting with the cells beyond it;
* gain: ``(1 + Rref sum_k G_kj) abs(Vout / (Vout - Vref)) / A``;
* offset: ``Vos (1 + Rref sum_k G_kj) / (Vin Rref G_ij)``; bias current: ``Ib R_ij / Vin``.

Other circuits have no such laws; theirs come from :func:`.sensitivity`, up to 32 x 32 cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import BoolArray, FloatArray
from ._adc import adc_error
from ._board import Board
from ._design import Adc, Design
from ._grid import exact_ports
from ._sensitivity import board_sensitivity

Law = Callable[[str, object], float | None]
"""From a design key and its value to the largest relative change of a signal"""

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
"""Parts that are assumed where a design names none; the project's own choice"""
SWING = 3.3
"""V on each side of the reference, where no supply is named"""
_ORDINARY_ADC = Adc(bits=12, range=(0.0, 3.3))
_MOST_CELLS = 32 * 32  # beyond, sensitivities cost more than an estimate is worth


@dataclass(frozen=True)
class Effect:
    """One deviation of a real board from equation (10)."""

    name: str
    modelled: bool
    """whether it is in the volts of a scan"""
    estimate: float | None
    """largest relative change of a cell's signal; None where there is no simple law"""
    basis: str
    """the part that the estimate is for"""


def effects(design: Design, resistance: ArrayLike) -> tuple[Effect, ...]:
    """Every effect this package knows, modelled or not.

    Args:
        design: any.
        resistance: (rows, columns) ohm; open and shorted cells do not count in the estimates.

    Raises:
        InputError: the cells do not fit the design.

    """
    board = design.board
    return tuple(_effects(board, board.turn(design.resistance(resistance))))


def _effects(board: Board, cells: FloatArray) -> Iterator[Effect]:
    """Cells (N, M) in line coordinates. Keys are the design's, so a turned board has its rows' keys under columns."""
    design, law = board.design, _law(board, cells)
    of_row, of_column = board.line_kinds
    for table, key, law_key, ideal in (
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
        yield Effect(key, modelled, law(law_key, by_line), _basis(key, used, named=modelled))
    yield from _limits(board, cells)
    yield from _time(board, cells)
    if design.fault:
        change = _change(board, design.replace(fault=()).board, cells)
        yield Effect("fault", True, change, f"{len(design.fault)} named, against the same scan without")
    if board.continuous:
        sliced = design.replace(array={"sheet": "sliced"}).board
        yield Effect("sheet", True, _change(board, sliced, cells), "against the same scan, sliced")


class _ClosedLaw:
    """First order, for amplifiers over grounded idle rows."""

    def __init__(self, board: Board, cells: FloatArray) -> None:
        self.live = _live(cells)
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
                # The input is off by the whole output over A, the reference voltage included.
                output = np.divide(self.board.level, -self.sign * signal, out=np.zeros_like(signal), where=self.live)
                change = noise_gain / part * np.abs(1.0 + output)
            case _:
                volts = noise_gain if key == "offset_voltage" else reference
                change = np.divide(part * volts, signal, out=np.zeros_like(signal), where=self.live)
        return float(np.max(change, where=self.live, initial=0.0))


class _LawByDerivatives:
    """First order, from the derivatives of the readings by the parts."""

    def __init__(self, board: Board, cells: FloatArray) -> None:
        self.found = board_sensitivity(board, cells)
        self.signal = np.abs(self.found.volts - board.level)
        self.live = _live(cells) & (self.signal > 0)

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
        return _largest(np.abs((by_line * part).sum(axis=-1)), self.signal, self.live)


def _law(board: Board, cells: FloatArray) -> Law:
    if board.circuit.virtual_ground and not board.floating:
        return _ClosedLaw(board, cells)
    if not board.continuous and cells.size <= _MOST_CELLS:
        return _LawByDerivatives(board, cells)
    return lambda key, value: None


def _limits(board: Board, cells: FloatArray) -> Iterator[Effect]:
    """What stands behind the signal: the amplifiers' supply and the converter."""
    live, level = _live(cells), board.level
    volts = board.circuit.ideal_volts(board, np.where(live, cells, inf))
    signal = np.abs(volts - level)
    if board.circuit.has_amplifiers:
        low, high = board.supply
        named = bool(np.isfinite([low, high]).any())
        if not named:
            low, high = level - SWING, level + SWING
        beyond = np.maximum(np.maximum(volts - high, low - volts), 0.0)
        yield Effect("supply", named, _largest(beyond, signal, live), _basis("supply", [low, high], named=named))
    adc = board.design.adc or _ORDINARY_ADC
    error = np.full_like(signal, adc_error(board.design.replace(adc=adc)))
    basis = f"{adc.bits} bits over {list(adc.range)} V, " + ("by adc_codes()" if board.design.adc else "assumed")
    yield Effect("converter", False, _largest(error, signal, live), basis)


def _time(board: Board, cells: FloatArray) -> Iterator[Effect]:
    """A scan gives settled outputs without noise; both are modelled elsewhere."""
    part, live = board.design.readout, _live(cells)
    if not board.circuit.virtual_ground:
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
    yield Effect("noise", False, _largest(scatter, signal, live), basis)
    left = np.exp(-2 * pi * bandwidth * ORDINARY["period"]) * signal.max(axis=0) + np.zeros_like(signal)
    basis = f"{ORDINARY['period']} s per row, by Settling; " + _basis("gain_bandwidth", product, named=fast)
    yield Effect("settling", False, _largest(left, signal, live), basis)


def _change(board: Board, without: Board, cells: FloatArray) -> float:
    """Largest relative change of a signal, by two scans."""
    with_it, bare = (each.circuit.read(each, exact_ports(each, cells).value).volts for each in (board, without))
    return _largest(np.abs(with_it - bare), np.abs(bare - board.level), _live(cells))


def _live(cells: FloatArray) -> BoolArray:
    return np.logical_and(np.isfinite(cells), cells > 0)


def _largest(change: FloatArray, signal: FloatArray, live: BoolArray) -> float:
    relative = np.divide(change, signal, out=np.zeros_like(signal), where=live & (signal > 0))
    return float(relative.max(initial=0.0))


def _basis(key: str, value: object, *, named: bool) -> str:
    return f"{key} = {value}" + ("" if named else " assumed")
