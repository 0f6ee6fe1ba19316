"""Error budget of a scan: the effects that are modelled, those that are not, and the size of each.

An effect is absent, and costs no computing time, until the design gives its part a value. The size of the effect of a
part is the largest relative difference of a signal between two exact readings, with the part and with an ideal one. A
part that the design does not name has an ordinary value there (:data:`ORDINARY`). Noise and settling are
those that :mod:`.timing` gives. :func:`.scan` itself computes none of these estimates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import BoolArray, FloatArray
from ..errors import SolverError
from ._adc import adc_error
from ._board import Board
from ._design import Design
from ._exact import read_exactly
from ._population import Boards
from ._sections import Adc
from .timing import BoardsInTime, noise

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


@dataclass(frozen=True)
class Effect:
    """One deviation of a real board from equation (10)."""

    name: str
    modelled: bool
    """whether the volts of a scan include the effect"""
    estimate: float | None
    """largest relative change of a cell's signal; None if it is not known"""
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
    return tuple(_effects(design, board.transpose(design.resistance(resistance))))


def _effects(design: Design, cells: FloatArray) -> Iterator[Effect]:
    """Yield the effects for cells (N, M) in ohm, in line coordinates.

    The effects of parts are those on a sliced sheet, whose readings cost little.
    """
    board, sliced = design.board, design.replace(array={"sheet": "sliced"})
    of_row, of_column = board.line_kinds
    lines = [f"{line}_{part}" for part in ("lead", "segment") for line in (of_row, of_column)]
    amplifiers = ["open_loop_gain", "offset_voltage", "bias_current"] if board.circuit.has_amplifiers else []
    for section, keys in (("array", lines), ("readout", amplifiers)):
        for key in keys:
            value, ideal = getattr(getattr(design, section), key), inf if key == "open_loop_gain" else 0.0
            modelled = bool(np.any(np.asarray(value) != ideal))
            used = value if modelled else ORDINARY[key]
            real, bare = (sliced.replace(**{section: {key: part}}) for part in (used, ideal))
            yield Effect(key, modelled, _difference(real, bare, cells), _basis(key, used, named=modelled))
    yield from _limits(board, cells)
    yield from _dynamic_effects(sliced, cells)
    if design.fault:
        change = _difference(design, design.replace(fault=()), cells)
        yield Effect("fault", True, change, f"{len(design.fault)} named, against the same scan without")
    if board.continuous:
        yield Effect("sheet", True, _difference(design, sliced, cells), "against the same scan, sliced")


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


def _dynamic_effects(design: Design, cells: FloatArray) -> Iterator[Effect]:
    """Effects of time, noise and settling, which a scan leaves out; :mod:`.timing` models both."""
    board, part, live = design.board, design.readout, _ordinary_cells(cells)
    if not board.virtual_grounds:
        yield Effect("noise", False, None, "no simple law")
        yield Effect("settling", False, None, "no simple law")
        return
    fast, noisy = bool(np.isfinite(part.gain_bandwidth)), part.voltage_noise > 0
    product = part.gain_bandwidth if fast else ORDINARY["gain_bandwidth"]
    density = part.voltage_noise or ORDINARY["voltage_noise"]
    real = design.replace(readout={"gain_bandwidth": product, "voltage_noise": density}, adc=None)
    only = board.transpose(np.where(live, cells, inf))
    signal = np.abs(board.circuit.ideal_volts(board, board.transpose(only)) - board.level)
    by_voltage = board.transpose(noise(real, only).parts["amplifier voltage"])
    basis = "amplifier voltage, by noise(); " + _basis("voltage_noise", density, named=noisy)
    yield Effect("noise", False, _largest_relative(by_voltage, signal, live), basis)
    left = board.transpose(BoardsInTime(real, Boards.of(real), only[None]).deviations(ORDINARY["period"]).from_rest[0])
    basis = f"{ORDINARY['period']} s per row, by Settling; " + _basis("gain_bandwidth", product, named=fast)
    yield Effect("settling", False, _largest_relative(np.abs(left), signal, live), basis)


def _difference(design: Design, without: Design, cells: FloatArray) -> float | None:
    """Largest relative difference of a signal between two designs without supply limits; None if one is undetermined.

    Cells (N, M) in ohm, in line coordinates; shorts are left open, since ideal lines would join their sources.
    """
    cells = np.where(_ordinary_cells(cells), cells, inf)
    try:
        with_it, bare = (
            read_exactly(each.replace(readout={"supply": (-inf, inf)}).board, cells)[0].volts
            for each in (design, without)
        )
    except SolverError:
        return None
    signal = np.abs(bare - design.board.level)
    return _largest_relative(np.abs(with_it - bare), signal, _ordinary_cells(cells))


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
