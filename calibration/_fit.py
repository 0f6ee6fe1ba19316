"""Rest resistance and gain of each cell by nonlinear least squares (Gauss-Newton) on windows of steady readings.

A cell under the load p is modelled as the common cell under p/gain, with its own rest resistance R0. The model is
simulated over all presses of the cell, so that creep under a held load, and the remainder of earlier presses, are not
mistaken for a gain. The two parameters are fitted to ln R of all windows with equal weights: averaging leaves little
noise, and the remaining error is that of the model, which is relative.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from ..cell import Cell
from ..common.arrays import BoolArray, FloatArray, IntArray
from ._presses import Press, Rest
from ._tuning import ENOUGH, LARGEST_MOVE, ROUNDS, STEP


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Fitted parameters and statistics of each cell. Arrays are (rows, columns); NaN for cells never pressed."""

    rest_ohm: FloatArray
    gain: FloatArray
    gain_std: FloatArray
    """relative standard deviation of the gain, by the scatter of the presses and by noise"""
    rest_std_kpa: FloatArray
    """standard deviation of pressure by the readings at rest"""
    residual_kpa: FloatArray
    """rms residual over the presses of a cell"""
    residual_share: FloatArray
    """rms of residual over load, over the presses of a cell"""
    rest_change: FloatArray
    """largest relative departure of a reading at rest from the fitted model, with its sign"""
    effect: FloatArray
    """largest relative change of the resistance under a load, as a magnitude"""
    noise: FloatArray
    """relative standard deviation of the mean of a window under load"""
    presses: IntArray
    """number of presses with a reading"""
    unread: BoolArray
    """whether the cell lacked a valid reading in one of its presses"""
    reversed: BoolArray
    """whether a clearly larger load changed the resistance by less than a smaller load"""

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> Fit:
        """A fit without results."""
        numbers = {item.name: np.full(shape, np.nan) for item in fields(cls) if item.type == "FloatArray"}
        unread, reversed_ = (np.zeros(shape, dtype=np.bool_) for _ in range(2))
        return cls(**numbers, presses=np.zeros(shape, dtype=np.intp), unread=unread, reversed=reversed_)


def fit_cells(cell: Cell, rest: Rest, presses: Sequence[Press]) -> Fit:
    """Fit every cell that was pressed.

    Args:
        cell: the common cell model.
        rest: the skin before the first press.
        presses: in the order of time. Presses with a fault are simulated, but their readings are not used.

    """
    fit = Fit.empty(_shape(rest))
    for cells, borne in _alike(presses):
        if any(not press.fault for press in borne):
            _Group(cell, rest, cells, borne).fit_into(fit)
    return fit


def _shape(rest: Rest) -> tuple[int, int]:
    rows, columns = rest.resistance_ohm.shape
    return rows, columns


def _alike(presses: Sequence[Press]) -> Iterator[tuple[IntArray, list[Press]]]:
    """Groups of cells (k,) with the same presses, and these presses."""
    borne: dict[int, list[int]] = {}
    for number, press in enumerate(presses):
        for index in press.cells.tolist():
            borne.setdefault(index, []).append(number)
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, numbers in borne.items():
        groups.setdefault(tuple(numbers), []).append(index)
    for numbers_of_group, cells in groups.items():
        yield np.array(sorted(cells)), [presses[number] for number in numbers_of_group]


class _Group:
    """Cells with the same history of loads."""

    def __init__(self, cell: Cell, rest: Rest, cells: IntArray, presses: list[Press]) -> None:
        self._cell, self._cells, self._presses = cell, cells, presses
        used = [press for press in presses if not press.fault]
        self._used = used
        # Observations: the first rest, then for each press the window before it and those while it was held.
        self._time_s = np.concatenate([[rest.time_s], *(press.window_s for press in used)])
        self._of_press = np.concatenate([[-1], *(np.full(len(press.window_s), k) for k, press in enumerate(used))])
        self._held = np.concatenate([[False], *(np.arange(len(press.window_s)) > 0 for press in used)])
        self._first_rest_ohm = rest.resistance_ohm.ravel()[cells]
        readings = [press.resistance_ohm[:, np.searchsorted(press.cells, cells)] for press in used]
        resistance = np.concatenate([self._first_rest_ohm[None], *readings])
        self._known = resistance > 0
        self._log_ohm = np.log(np.where(self._known, resistance, 1.0))

    def fit_into(self, fit: Fit) -> None:
        """Fit the group's cells, and write the results into the arrays of ``fit``."""
        start_ohm = np.where(self._first_rest_ohm > 0, self._first_rest_ohm, self._cell.rest_resistance_ohm)
        log_rest, log_gain = np.log(start_ohm), np.zeros(len(self._cells))
        by_rest = by_gain = error = np.zeros_like(self._log_ohm)
        for _ in range(ROUNDS):
            model = self._log_model(log_rest, log_gain)
            by_rest = np.where(self._known, (self._log_model(log_rest + STEP, log_gain) - model) / STEP, 0.0)
            by_gain = np.where(self._known, (self._log_model(log_rest, log_gain + STEP) - model) / STEP, 0.0)
            error = np.where(self._known, self._log_ohm - model, 0.0)
            rest_move, gain_move = _two_unknowns(by_rest, by_gain, error)
            log_rest, log_gain = log_rest + rest_move, log_gain + gain_move
            if max(np.abs(rest_move).max(), np.abs(gain_move).max()) < ENOUGH:
                break
        self._write(fit, np.exp(log_rest), np.exp(log_gain), by_gain, error)

    def _log_model(self, log_rest: FloatArray, log_gain: FloatArray) -> FloatArray:
        """(observations, k) ln R."""
        corners = np.concatenate([press.time_s for press in self._presses])
        # A held load must be constant to the last bit, since the paper's model treats any fall as a release. Every
        # corner is therefore a time step, and the load is interpolated between corners.
        times = np.unique(np.concatenate([self._time_s, corners]))
        load = np.zeros(len(times))
        for press in self._presses:
            load += np.interp(times, press.time_s, press.load_kpa, left=0.0, right=0.0)
        forward = self._cell.forward(log_rest.shape, rest_resistance_ohm=np.exp(log_rest))
        resistance = forward.run(np.diff(times, prepend=times[0]), load[:, None] / np.exp(log_gain))
        return np.log(resistance[np.searchsorted(times, self._time_s)])

    def _write(self, fit: Fit, rest: FloatArray, gain: FloatArray, by_gain: FloatArray, error: FloatArray) -> None:
        place = np.unravel_index(self._cells, fit.gain.shape)
        fit.rest_ohm[place], fit.gain[place] = rest, gain
        known = self._known
        held_known = known & self._held[:, None]
        loads = np.array([press.held_kpa for press in self._used])
        # A relative error of the load by e changes ln R by -by_gain e.
        share = np.divide(-error, by_gain, out=np.zeros_like(error), where=held_known & (by_gain != 0))
        of_press = np.stack([_mean(share, held_known & (self._of_press == k)[:, None]) for k in range(len(loads))])
        read = np.stack([(held_known & (self._of_press == k)[:, None]).any(axis=0) for k in range(len(loads))])
        count = read.sum(axis=0)
        fit.presses[place] = count
        fit.unread[place] = (~read).any(axis=0)
        fit.residual_share[place] = _rms(of_press, read)
        fit.residual_kpa[place] = _rms(of_press * loads[:, None], read)
        scatter = fit.residual_share[place] * np.sqrt(count / np.maximum(count - 1, 1))

        resistance = np.exp(self._log_ohm)
        change = np.where(held_known, resistance / rest - 1, 0.0)
        noise_ohm = np.stack([press.std_ohm[np.searchsorted(press.cells, self._cells)] for press in self._used])
        frames = np.array([press.frames for press in self._used])
        noise = np.nanmax(np.where(read, noise_ohm / np.sqrt(frames)[:, None], 0.0), axis=0) / rest
        fit.effect[place] = np.abs(change).max(axis=0)
        fit.noise[place] = noise
        slope = np.abs(_mean(by_gain, held_known))
        noise_share = np.divide(noise, slope, out=np.full_like(noise, np.inf), where=slope > 0)
        fit.gain_std[place] = np.hypot(scatter, noise_share)

        at_rest = known & ~self._held[:, None]
        worst = np.argmax(np.abs(np.where(at_rest, error, 0.0)), axis=0)
        fit.rest_change[place] = error[worst, np.arange(len(self._cells))]
        kpa_per_share = np.divide(loads.mean(), slope, out=np.zeros_like(slope), where=slope > 0)
        fit.rest_std_kpa[place] = np.hypot(_rms(error, at_rest), noise) * kpa_per_share
        fit.reversed[place] = self._reversed(change, held_known, noise, loads)

    def _reversed(self, change: FloatArray, held: BoolArray, noise: FloatArray, loads: FloatArray) -> BoolArray:
        """(k,) whether a load above 1.2 times another changed R by less, beyond noise, or the opposite way."""
        found = np.zeros(len(self._cells), dtype=np.bool_)
        means = [_mean(change, held & (self._of_press == k)[:, None]) for k in range(len(loads))]
        for low, low_kpa in enumerate(loads):
            for high in np.flatnonzero(loads > 1.2 * low_kpa):
                both = (means[low] != 0) & (means[high] != 0)
                opposite = means[low] * means[high] < 0
                smaller = np.abs(means[high]) < np.abs(means[low]) - 5 * noise
                found |= both & (opposite | smaller)
        return found


def _two_unknowns(by_first: FloatArray, by_second: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares solution (k,), (k,) of ``by_first`` x + ``by_second`` y = ``error``, all (observations, k)."""
    a, b, c = (by_first**2).sum(axis=0), (by_first * by_second).sum(axis=0), (by_second**2).sum(axis=0)
    d, e = (by_first * error).sum(axis=0), (by_second * error).sum(axis=0)
    determinant = a * c - b * b
    solvable = determinant > 1e-12 * a * c
    second = np.divide(a * e - b * d, determinant, out=np.zeros_like(a), where=solvable)
    second = np.clip(second, -LARGEST_MOVE, LARGEST_MOVE)
    first = np.divide(d - b * second, a, out=np.zeros_like(a), where=a > 0)
    return first, second


def _mean(values: FloatArray, where: BoolArray) -> FloatArray:
    """(k,) mean over the first axis of the values selected by ``where``; 0 if none is selected."""
    total = np.where(where, values, 0.0).sum(axis=0)
    mean: FloatArray = total / np.maximum(where.sum(axis=0), 1)
    return mean


def _rms(values: FloatArray, where: BoolArray) -> FloatArray:
    return np.sqrt(_mean(values**2, where))
