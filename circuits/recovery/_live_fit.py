"""Live recovery where all cells take part in every reading: Gauss-Newton steps with exact derivatives.

On dividers with floating rows no law of single columns holds. The unknowns are the logarithms x of the conductances, so
that none becomes negative. With the derivatives J of the readings, in standard deviations of an ADC step's error, and a
broad prior of standard deviation s, a step is (J'J + 1/s^2)^-1 J' r (Levenberg, Marquardt): what the readings determine
follows them, the rest stays. The same inverse is the covariance of x. It is kept as long as steps by it converge.

The derivatives are a matrix on small arrays, and on others a diagonal with two numbers for each line
(:mod:`._node_blocks`). A frame takes at most a fixed number of steps and of new derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...errors import InputError, SolverError
from .._adc import adc_error
from .._board import Board, broken_off, cell_alone
from .._grid import exact_ports
from ._lines import LineResistance
from ._live_reading import (
    DISTURBED,
    HIDDEN,
    NO_CURRENT,
    SATURATED,
    SIGMAS,
    UNCERTAIN,
    UNSETTLED,
    Errors,
    LiveReading,
    ValidityRule,
    undetermined,
)
from ._node_blocks import NodeBlocks, beyond_linear
from ._quick_model import QuickModel
from ._sheet_model import SheetModel

STEPS, FIRST_STEPS = 5, 60
"""evaluations of the model in one frame, and in the first one of all"""
RENEWALS, FIRST_RENEWALS = 2, 20
"""new derivatives in one frame, and in the first one of all"""
LARGEST_MATRIX = 4096
"""cells up to which a matrix of all readings by all cells is made: 0.3 GB"""
_SMALL = 100  # cells up to which the derivatives are a matrix
_PRIOR = 3.0  # standard deviation of a logarithm before anything is read: a factor of 20
_ALIKE = 2.0  # as of grounded rows, see Errors
_BY_STEPS, _BY_NOISE = 4.5, 3.5  # standard deviations by ADC steps and by noise that an uncertainty covers
_FITS, _NO_FIT, _MISFIT = 0.8, 3.0, 8.0  # half steps: by rounding alone, no fit yet, no cells give these readings
_FAR, _NEAR = 0.5, 0.02  # change of a logarithm for which derivatives no longer serve, and for which new ones are alike
_SETTLED = 0.3  # standard deviations, step that does not matter
_STRIDE = 1.5  # largest step of a logarithm
_SHORTER = 0.4  # factor on a step that leads away from the readings
_SLOW = 0.2  # length of a step over the one before, above which derivatives are to blame
_STEEPER = 3.0  # largest ratio of slopes by which derivatives are adapted
_JUMP = 20.0  # half steps from which on closed formulas may be a nearer start
_LEAST_READING = 0.03  # half steps: reading of the least conductance alone; below, nothing would lead back
_LARGEST = 50.0  # logarithm that is as good as infinite
_SHORT, _SHORT_SHARE = 8.0, 0.998  # half steps, and share of a short's reading, from which on a cell may be one
_AS_SHORT = 0.05  # cell over the resistance of its leads, below which it is as good as a short
_TIE = 0.02  # cell over the reference resistor, below which it ties lines to each other
_NO_CELLS = "no cell resistances give these readings; check that the design is that of the board"
_OFTEN = 3  # frames with readings that no cells give, after which the design is taken for wrong
_TYPICAL = 1e-5  # S, of a cell if no reading shows a conductance


class _Linear(NamedTuple):
    """Derivatives and their regularised inverse at some cells; n = N M, flattened."""

    log: FloatArray
    """(n,) logarithms of the conductances"""
    solve: Callable[[FloatArray], FloatArray]
    """from readings (n,) in V to changes (n,) of the logarithms"""
    std: FloatArray
    """(n,) standard deviation of the logarithms by ADC steps"""
    slope: FloatArray
    """(n,) 1/V, of each logarithm by its own reading if the cell were alone"""

    def distance(self, log: FloatArray) -> FloatArray:
        """(n,) change of the logarithms since then, of which their own errors do not count."""
        return np.abs(log - self.log) / np.maximum(4.0 / _FAR * self.std, 1.0)


class FitLive:
    """Live recovery of dividers whose rows float."""

    scales_columns = False

    def __init__(self, board: Board, rule: ValidityRule) -> None:
        """For a board with a converter.

        Raises:
            InputError: the board is too large.

        """
        self._rule, self._shape, self._turn = rule, board.shape, board.turn
        self._board = replace(board, supply=(-inf, inf), continuous=False)
        self._half_step = adc_error(board)
        self._std = self._half_step / sqrt(3.0)
        self._gone = broken_off(board) | np.isinf(board.series_ohms)
        for fault in board.shorts:
            self._gone[fault.place] |= fault.ohms == 0
        lines = LineResistance(self._board)
        self._leads = lines.to_ends + board.column_lead
        self._quick = QuickModel(self._board, lines)
        self._sheet = SheetModel(replace(board, supply=(-inf, inf)), self._quick) if board.continuous else None
        self._model = self._quick if self._sheet is None else self._sheet
        cells = board.shape[0] * board.shape[1]
        nodes = NodeBlocks(self._board, self._quick, self._std) if cells > _SMALL else None
        self._nodes = nodes if nodes is not None and nodes.applies else None
        if cells > LARGEST_MATRIX and self._nodes is None:
            raise InputError(
                "the live recovery of boards with floating rows and bridged or broken lines is for at most "
                f"{LARGEST_MATRIX} cells, and the array has {cells}; expected a smaller array, or no such fault"
            )
        self._shunt = np.zeros(board.shape)
        for fault in board.shorts:
            self._shunt[fault.place] += 1.0 / fault.ohms if fault.ohms > 0 else 0.0
        ideal, most = (
            np.abs(board.circuit.ideal_volts(board, ohms) - board.level)
            for ohms in (self._leads, board.row_ohms[:, :1] + board.column_lead)
        )
        self._short, self._most = np.where(self._gone, inf, ideal), np.where(self._gone, inf, most)  # V, of a short
        per_volt = np.abs(board.circuit.conductance_slope(board, np.zeros(board.shape)))
        self._least = np.log(_LEAST_READING * self._half_step * per_volt).ravel()
        self._log: FloatArray | None = None
        self._linear: _Linear | None = None
        self._damping, self._astray, self._in_vain, self._begun = 1.0, False, 0, False

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        faint: BoolArray | None = None,
    ) -> LiveReading:
        """As :class:`.LiveRecovery`. A cell that may be a short, or is hidden, changes all others."""
        turn = self._turn
        volts = np.ascontiguousarray(turn(volts))
        signal, error = np.abs(volts - self._board.level), self._half_step + SIGMAS * noise
        short = signal >= np.minimum(self._short - _SHORT * error, _SHORT_SHARE * self._short)
        if limited is not None:
            short |= turn(limited)
        if faint is not None:  # a reading near zero is one like any other
            short |= turn(faint) & (signal > error)
        if short.any() or self._gone.any():
            self._in_vain = self._in_vain + 1 if (signal > self._most + _SHORT * error).any() else 0
            if self._in_vain > _OFTEN:  # no way between two lines conducts better than a short of their own
                raise SolverError(_NO_CELLS)
            return self._nothing(DISTURBED, short)
        coarser = hypot(1.0, noise / self._std)
        found = self._fit(volts.ravel(), coarser)
        if found is None:
            return self._nothing(UNSETTLED)
        return self._reading(signal, error, noise, *found)

    def _closed_start(self, volts: FloatArray) -> FloatArray:
        """Logarithms (n,) as if each cell were alone."""
        signal = volts.reshape(self._shape) - self._board.level
        apparent = self._board.circuit.apparent_conductance(self._board, signal)
        apparent = cell_alone(self._board, apparent, self._shunt)
        conducting = apparent[apparent > 0.0]
        typical = float(np.median(conducting)) if conducting.size else _TYPICAL
        start: FloatArray = np.log(np.where(apparent > 1e-3 * typical, apparent, 0.1 * typical)).ravel()
        return start

    def _at(self, log: FloatArray) -> FloatArray:
        """V (n,), readings of the model."""
        return self._model(np.exp(-log).reshape(self._shape)).ravel()

    def _misfit(self, apart: FloatArray, coarser: float) -> float:
        """Half steps and noise: root mean square, or half of the largest if that is more."""
        most = float(np.abs(apart).max())
        return max(sqrt(float(apart @ apart) / len(apart)), 0.5 * most) / self._half_step / coarser

    def _fit(self, volts: FloatArray, coarser: float) -> tuple[FloatArray, FloatArray, float] | None:
        """Logarithms (n,), their standard deviation by ADC steps (n,), and the misfit; None: not settled."""
        steps, renewals = (STEPS, RENEWALS) if self._begun else (FIRST_STEPS, FIRST_RENEWALS)
        self._begun = True
        slope = np.abs(
            self._board.circuit.log_conductance_slope(self._board, volts.reshape(self._shape) - self._board.level)
        ).ravel()
        try:
            log = self._closed_start(volts) if self._log is None else self._log
            apart = volts - self._at(log)
            misfit = self._misfit(apart, coarser)
            if self._log is not None and misfit > _JUMP:
                other = self._closed_start(volts)
                other_apart = volts - self._at(other)
                steps -= 1
                if self._misfit(other_apart, coarser) < misfit:
                    log, apart, misfit = other, other_apart, self._misfit(other_apart, coarser)
            settled, before = False, inf
            while True:
                linear = self._linear
                if linear is None or linear.distance(log).max() > _FAR:
                    if renewals == 0:
                        break
                    linear, renewals = self._renewed(log), renewals - 1
                step = self._step(linear, apart, slope)
                known = linear.std * coarser <= 0.15
                small = np.abs(step) <= np.maximum(_SETTLED * coarser * linear.std, 1e-6)
                if misfit <= _NO_FIT and (small | ~known).all() and (misfit <= _FITS or not self._astray):
                    settled = misfit <= _NO_FIT
                    break
                length = float(np.abs(step).max())
                near = linear.distance(log).max() <= _NEAR
                if length > _SLOW * before and not near and renewals and misfit > _FITS:
                    self._linear = None
                    before = inf
                    continue
                if steps <= 0:
                    break
                steps -= 1
                trial = np.maximum(log + self._damping * step, self._least)
                ahead = volts - self._at(trial)
                now = self._misfit(ahead, coarser)
                if now > max(misfit, _FITS) and ahead @ ahead > apart @ apart:
                    if not near and renewals:
                        self._linear = None
                    else:
                        self._damping *= _SHORTER
                    before = inf
                    continue
                self._damping = min(self._damping / _SHORTER, 1.0)
                log, apart, misfit, before = trial, ahead, now, length
        except np.linalg.LinAlgError:
            self._log = self._linear = None
            return None
        if self._sheet is not None and settled:
            settled = self._follow_sheet(log)
        self._log, self._astray = log, not settled
        self._in_vain = self._in_vain + 1 if misfit > _MISFIT else 0
        if self._in_vain > _OFTEN:
            self._log = None
            # Cells of a few ohm tie lines to each other: then other cells, far from these, may give the readings.
            ties = float(np.exp(-log).min()) < _TIE * float(self._board.reference.min())
            if self._in_vain > 3 * _OFTEN and not ties:
                raise SolverError(_NO_CELLS)
        if not settled or self._linear is None:
            return None
        moved = np.exp(np.minimum(np.abs(log - self._linear.log), 1.0))
        return log, self._linear.std * moved, misfit

    def _follow_sheet(self, log: FloatArray) -> bool:
        """Solve the continuous sheet anew if its cells have moved; False: the fit goes on in the next frame."""
        assert self._sheet is not None
        assert self._linear is not None
        if self._sheet.serves(log, SIGMAS * self._linear.std):
            return True
        self._sheet.solve(log)
        return False

    def _step(self, linear: _Linear, apart: FloatArray, slope: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms. A cell's own nonlinearity is known in closed form, and scales its reading."""
        both = (linear.slope > 0.0) & (slope > 0.0)
        steeper = np.divide(slope, linear.slope, out=np.ones(len(slope)), where=both)
        step = linear.solve(apart * np.clip(steeper, 1.0 / _STEEPER, _STEEPER))
        return np.clip(step, -_STRIDE, _STRIDE)

    def _renewed(self, log: FloatArray) -> _Linear:
        """Make derivatives at these cells.

        Raises:
            numpy.linalg.LinAlgError: parts of the grid have no connection.

        """
        from scipy.linalg.lapack import dpotrf, dpotri

        cells = np.exp(-np.clip(log, -_LARGEST, _LARGEST)).reshape(self._shape)
        volts = self._quick(cells)
        slope = np.abs(self._board.circuit.log_conductance_slope(self._board, volts - self._board.level)).ravel()
        if self._nodes is not None:
            by_nodes = self._nodes.at(cells, np.full(self._shape, _PRIOR))
            self._linear = _Linear(log, by_nodes.solve, by_nodes.std.ravel(), slope)
            return self._linear
        in_series = 1.0 / (cells + self._board.series_ohms).ravel()
        jacobian = self._derivatives(cells) * (in_series**2 * cells.ravel() / self._std)
        normal = jacobian.T @ jacobian
        normal.flat[:: len(normal) + 1] += _PRIOR**-2.0
        factor, failed = dpotrf(normal, lower=1)
        if failed:
            raise np.linalg.LinAlgError("the normal matrix is not positive definite")
        half, _ = dpotri(factor.copy(), lower=1)
        covariance = np.tril(half) + np.tril(half, -1).T
        variance = np.maximum(np.diagonal(covariance), np.finfo(np.float64).tiny)
        more = beyond_linear(np.sqrt(variance)) / variance
        std = np.sqrt(variance + (covariance * covariance) @ more)

        def solve(apart: FloatArray) -> FloatArray:
            from scipy.linalg.lapack import dpotrs

            step: FloatArray = dpotrs(factor, jacobian.T @ (apart / self._std), lower=1)[0]
            return step

        self._linear = _Linear(log, solve, std, slope)
        return self._linear

    def _derivatives(self, cells: FloatArray) -> FloatArray:
        """V/S (n, n) of all readings by all crosspoints."""
        size = cells.size
        by_rows = self._quick.derivatives(cells)
        if by_rows is not None:
            return np.concatenate(list(by_rows)).reshape(size, size)
        board, (rows, columns) = self._board, self._shape
        held = np.arange(rows, rows + board.pulled)  # the reference behind pull-downs, at 0 V
        ports = exact_ports(board, cells).value
        branches, result = self._quick.branches(cells), np.zeros((rows, columns, rows, columns))
        for group in board.circuit.sensitivity_groups(board, ports, board.circuit.read(board, ports)):
            forward, adjoint = (
                branches.across(np.delete(field, held, axis=-1).reshape(-1, rows + columns)).reshape(
                    *field.shape[:-1], rows, columns
                )
                for field in (group.forward, group.adjoint)
            )
            result[np.ix_(group.rows, group.columns)] = -forward * adjoint
        return result.reshape(size, size)

    def _reading(
        self, signal: FloatArray, error: float, noise: float, log: FloatArray, std: FloatArray, misfit: float
    ) -> LiveReading:
        """Values, uncertainties, validity and reasons of cells that give the readings."""
        board, shape, turn = self._board, self._shape, self._turn
        cells, std = np.exp(-log).reshape(shape), std.reshape(shape)
        slope = np.abs(board.circuit.log_conductance_slope(board, signal * np.sign(board.drive)))
        own = np.where(slope > 0.0, error * slope, 1.0)
        sigmas = hypot(_BY_STEPS, _BY_NOISE * noise / self._std) * max(misfit, 1.0)
        uncertainty = own + np.expm1(np.minimum(np.maximum(sigmas * std - own, 0.0), _LARGEST))
        if self._sheet is not None:
            uncertainty = uncertainty + self._sheet.doubt(log)
        valid = self._rule.accepts(uncertainty) & (signal > error)
        reason: NDArray[np.int8] = np.full(shape, UNCERTAIN, dtype=np.int8)
        reason[signal <= error] = NO_CURRENT
        short = cells < _AS_SHORT * self._leads
        if short.any():  # derivatives do not describe the currents on its lines
            beside = short.any(axis=1, keepdims=True) | short.any(axis=0, keepdims=True)
            valid &= ~beside
            reason[beside] = DISTURBED
        reason[valid] = 0
        total = np.where(valid | (reason == UNCERTAIN), uncertainty, inf)
        of_own = np.where(slope > 0.0, slope, inf)
        none, every = np.zeros(shape), np.maximum(std / self._std, of_own)
        return LiveReading(
            turn(cells),
            turn(valid),
            turn(reason),
            lambda: turn(total),
            lambda: Errors(turn(of_own), turn(none), turn(every), _ALIKE),
        )

    def _nothing(self, why: int, short: BoolArray | None = None) -> LiveReading:
        """A frame that determines no cell; ``short`` (N, M): readings at a limit."""
        reason: NDArray[np.int8] = np.full(self._shape, why, dtype=np.int8)
        if short is not None:
            reason[short] = SATURATED
        reason[self._gone] = HIDDEN
        return undetermined(self._turn(reason))
