"""Columns that end in networks which the design describes part by part (:mod:`..ends`).

Ends that are Thevenin equivalents are read like loads and amplifiers, with the same certificates. All others (diodes,
limited amplifiers, a reference that the ends share) are solved node by node (:mod:`._nodal`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._parts import Parts
from .._tuning import CURVE, CURVE_POINTS, PROBES_S
from ..ends import OPEN_OHM, Columns, LineEnds, alone
from ._adjoint import SensitivityGroup
from ._circuit import Alone, Reading, ReadoutCircuit
from ._ends import EndParts, Ends
from ._nodal import node_groups, read_nodes
from ._terminated import SignArray, Terminated


class Networks(ReadoutCircuit):
    """Networks at the ends of all lines."""

    name = "described"

    def __init__(self, *, inverts: bool) -> None:
        """``inverts``: whether a cell that conducts more lowers the output, for a positive drive."""
        self._inverts = inverts

    @property
    def inverts(self) -> bool:
        return self._inverts

    @abstractmethod
    def at_rest(self, board: Parts) -> FloatArray:
        """(M,) or (N, M) V of the outputs without current."""

    def apparent_resistance(self, board: Parts, volts: FloatArray) -> FloatArray:
        """NaN at columns that nothing loads: one cell alone always has the same reading there."""
        ohms = super().apparent_resistance(board, volts)
        return np.where(self.alone(board).span >= OPEN_OHM / 2, np.nan, ohms)

    def ambiguity(self, board: Parts) -> str:
        assert board.line_ends is not None
        return board.line_ends.ambiguity()


class Described(Networks, Terminated):
    """Networks that are Thevenin equivalents."""

    def ends_of(self, board: Parts, parts: EndParts, state: SignArray | None = None) -> Ends:
        ends = _equivalents(board)
        return Ends(ends.resistance, ends.source, ends.output, ends.slope)

    def alone(self, board: Parts) -> Alone:
        # The row's end by itself: driver, lead and pull-down as a Thevenin equivalent.
        ends = _equivalents(board)
        passed = 1.0 / (1.0 + board.row_lead[:, None] / board.pull)
        ohms = passed * board.row_lead[:, None] + ends.resistance
        return Alone(ends.slope * (passed * board.drive - ends.source), ohms, ends.output - board.level)

    def at_rest(self, board: Parts) -> FloatArray:
        return _equivalents(board).output


class ByNodes(Networks):
    """Networks that are solved node by node."""

    def read(self, board: Parts, ports: FloatArray) -> Reading:
        return read_nodes(board, ports)

    def end_resistance(self, board: Parts) -> FloatArray:
        return np.zeros(board.shape[1])

    def energy_bound(self, board: Parts, ports: FloatArray, relative: float) -> FloatArray:
        return np.full((*ports.shape[:-2], *board.shape), np.inf)  # the bound by entries holds

    def alone(self, board: Parts) -> Alone:
        assert board.line_ends is not None
        rest, gain, span = _alone(board.line_ends)
        return Alone(gain, span, rest - board.level)

    def at_rest(self, board: Parts) -> FloatArray:
        assert board.line_ends is not None
        rest: FloatArray = _alone(board.line_ends)[0]
        return rest

    def ideal_volts(self, board: Parts, cells: FloatArray) -> FloatArray:
        ends = board.line_ends
        assert ends is not None
        if ends.is_linear:
            return super().ideal_volts(board, cells)
        with np.errstate(divide="ignore"):
            log = np.log10(1.0 / cells)
        lines = np.broadcast_to(np.clip(log, *CURVE), (*np.shape(cells)[:-2], *board.shape))
        return _each_curve(ends, lines, lambda curve, own: np.interp(own, *curve))

    def apparent_resistance(self, board: Parts, volts: FloatArray) -> FloatArray:
        ends = board.line_ends
        assert ends is not None
        return super().apparent_resistance(board, volts) if ends.is_linear else _each_curve(ends, volts, _from_curve)

    def sensitivity_groups(self, board: Parts, ports: FloatArray, reading: Reading) -> Iterator[SensitivityGroup]:
        return node_groups(board, ports)


def networks(board: Parts, *, inverts: bool) -> Networks:
    """The circuit of a board whose lines end in networks."""
    return (ByNodes if board.described is None else Described)(inverts=inverts)


def _equivalents(board: Parts) -> Columns:
    assert board.described is not None
    return board.described


@lru_cache(maxsize=64)
def _kinds(ends: LineEnds) -> tuple[tuple[int, int, BoolArray], ...]:
    """Row and column of one crosspoint of each kind of ends, and all crosspoints (N, M) of this kind."""
    places: dict[tuple[object, ...], BoolArray] = {}
    for row, column in np.ndindex(ends.shape):
        key = ends.selected[row], ends.idle[row], ends.read[column], ends.unread[column]
        places.setdefault(key, np.zeros(ends.shape, dtype=np.bool_))[row, column] = True
    first = [np.argwhere(own)[0].tolist() for own in places.values()]
    return tuple((row, column, own) for (row, column), own in zip(first, places.values(), strict=True))


@lru_cache(maxsize=64)
def _alone(ends: LineEnds) -> FloatArray:
    """Volts (3, N, M) without a cell, and gain in V ohm and span in ohm of :class:`._circuit.Alone`.

    In a linear circuit the output is a fraction of two linear functions of the cell's conductance, which three
    solutions give.
    """
    found = np.empty((3, *ends.shape))
    for row, column, own in _kinds(ends):
        found[:, own] = np.array(_fraction(ends, row, column))[:, None]
    return found


@lru_cache(maxsize=64)
def _curves(ends: LineEnds) -> tuple[tuple[FloatArray, FloatArray, BoolArray], ...]:
    """Logarithms of a cell's conductance, its output alone in V, and the crosspoints (N, M) that have this curve."""
    log = np.linspace(*CURVE, CURVE_POINTS)
    return tuple((log, alone(ends, row, column, 10.0**log), own) for row, column, own in _kinds(ends))


def _each_curve(
    ends: LineEnds, values: FloatArray, of: Callable[[tuple[FloatArray, FloatArray], FloatArray], FloatArray]
) -> FloatArray:
    """Values (..., N, M) of a function of each crosspoint's curve."""
    found = np.empty(np.shape(values))
    for log, volts, own in _curves(ends):
        found[..., own] = of((log, volts), np.asarray(values)[..., own])
    return found


def _from_curve(curve: tuple[FloatArray, FloatArray], volts: FloatArray) -> FloatArray:
    """Ohm of cells with these outputs; inf at or beyond the output of an open cell."""
    from scipy.interpolate import PchipInterpolator  # takes a third of a second to load

    log, known = curve
    rising = known if known[-1] > known[0] else -known
    wanted = volts if known[-1] > known[0] else -volts
    steps = np.append(
        True, np.diff(np.maximum.accumulate(rising)) > 0
    )  # where a limit makes the curve flat, its first point
    inverse = PchipInterpolator(rising[steps], log[steps])
    least, most = rising[steps][[0, -1]]
    ohms = 10.0 ** -inverse(np.clip(wanted, least, most))
    return np.where(wanted <= least, np.inf, ohms)


def _fraction(ends: LineEnds, row: int, column: int) -> tuple[float, float, float]:
    """Rest, gain and span of one crosspoint."""
    near, far = alone(ends, row, column, np.array(PROBES_S))
    if np.isclose(near, far, rtol=1e-9, atol=0.0):  # nothing loads the column, or a current drives the row
        return 0.0, OPEN_OHM * float(near), OPEN_OHM
    rest = alone(ends, row, column, np.zeros(1))[0]
    first, second = (near - rest) / PROBES_S[0], (far - rest) / PROBES_S[1]
    ohms = (first - second) / (far - near)
    return rest, first + ohms * (near - rest), ohms
