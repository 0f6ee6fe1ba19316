"""Live recovery of coupled boards: regularised Gauss-Newton steps with derivatives that are kept while they serve."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import exp, inf, sqrt
from typing import NamedTuple

import numpy as np

from ...arrays import BoolArray, FloatArray
from ...errors import InputError, SolverError
from .._adc import adc_error
from .._board import Board, broken_off, cell_alone
from .._sections import Fault
from ..solvers import siemens
from ._column_blocks import ColumnBlocks, beyond_linear
from ._derivatives import derivatives
from ._lines import LineResistance
from ._live_reading import (
    DISTURBED,
    HIDDEN,
    NO_CURRENT,
    SATURATED,
    SIGMAS,
    UNCERTAIN,
    UNSETTLED,
    LiveReading,
    ValidityRule,
)
from ._node_blocks import NodeBlocks
from ._normal_matrix import Meter, NormalMatrix
from ._quick_model import QuickModel
from ._sheet_model import SheetModel

_SHORT = 8.0  # half steps and noise from the reading of a short within which a cell may be one
_SHORT_SHARE = 0.998  # of the reading of a short, likewise
_PRIOR = 3.0  # standard deviation of the logarithm of a conductance before anything is read: a factor of 20
_UNKNOWN = 8.0  # the same for a cell that a fault hides
_SETTLED = 0.3  # posterior standard deviations that a further step would change a cell by
_NO_FIT = 3.0  # half steps between readings and model beyond which a fit says nothing yet
_MISFIT = 8.0  # half steps between readings and model beyond which no cells give these readings
_FAR = 0.5  # change of a logarithm since the derivatives were made from which on they no longer serve
_BY_NOISE = 4.0  # standard deviations by which noise and rounding move a cell without new derivatives being due
_TOO_FAR = 1.0  # the same from which on they no longer tell what a misfit means for the cells
_SLOW = 0.2  # length of a step over the one before from which on the derivatives are to blame
_MOVED = 0.02  # the same where they have not served: closer, new ones would be no better
_STEEPER = 3.0  # most ratio of slopes by which derivatives are adapted
_SIGMAS = 4.5  # posterior standard deviations by ADC steps that an uncertainty covers: a bound on the error
_NOISE_SIGMAS = 3.5  # the same by noise: a fifth more, a factor of two at the limit of validity, is 5 of them
_MOST_FAILURES = 3  # frames in a row until the design is not believed: other starts may lead to a fit
_MOST_WITHOUT_FIT = 6  # frames in a row until steps column by column are given up
_STUCK = 300  # frames until they are tried again
_PER_SQUARE = 16  # multiplications of a matrix product that take as long as the square of one entry
_SMALL = 100  # cells up to which an instalment is a whole renewal
_AT_REST = 0.3  # most change by a further step after a fresh start
_LOOSE = 0.1  # standard deviation of a cell that the readings do not determine: where it is does not matter
_NEXT_TO_NONE = 0.01  # share of the least conductance that a reading tells, below which a cell may as well be open
_SAME = 1e-3  # relative change of the misfit by a step that gained nothing
_COMPLETE_SHORT = 1e-5  # ohm that stands for a short of 0 ohm
_ROUGHLY = 0.05  # change of a logarithm that matters for cells which only load others
_FAR_BELOW = 0.05  # share of its leads' resistance below which a cell is as good as a short
_TIES = 1.0  # share of its leads' resistance below which a cell may join lines with each other
_ALIKE = 0.125  # least share of a column's largest reading that a short in the column has
_RESOLVED = 4.0  # half steps and noise of a reading that is far from none
_JUMP = 20.0  # half steps between readings and the last frame's cells from which on closed formulas are nearer
_FITS = 0.8  # half steps between readings and model that rounding alone makes
_CONVERGED = 0.2  # the same after steps that have come to their end
_STALLED = 10.0  # steps that a fit may still be from its end where the misfit no longer tells
_LIGHT = 0.3  # share of a voltage in the lines up to which derivatives in closed form are as good as any
_HEAVY = 3.0  # the same up to which steps by them converge
_SHORTER = 0.4  # of a step that led away from the readings: what is taken next
_PATIENCE = 3  # frames that do not settle, after which steps that lead away from the readings are not taken
_HEAVY_CELL = 0.8  # of what a short reads, from which on a column is left out where the last frame did not settle
_ONE_OF_SOME = 0.2  # the same where two frames did not, since cells of a few ohm share a reading
_BY_LEADS = 1.5  # times the share of a voltage that leads lose, what they may change
_LEAST_READING = 0.03  # half steps that the least conductance would read alone: from below, nothing would lead back
_STRIDE = 1.5  # most change of the logarithm of a conductance in one step
_LINEAR_STRIDE = 1e3  # most change of a conductance that counts linearly, in multiples of what its reading can tell
_LARGEST = 50.0  # logarithm that is as good as infinite


LARGEST_MATRIX = 4096
"""cells up to which a matrix of all readings by all cells is made: 0.3 GB"""
LARGEST_BESIDE = 1024
"""the same where columns are nearly independent: beyond, a step by that matrix costs ten without it"""


class _Base(NamedTuple):
    """Where a coupled board's frames start from, in line coordinates; n = N M, flattened."""

    log: FloatArray
    """(n,) logarithm of the conductances"""
    step: Callable[[FloatArray], FloatArray]
    """regularised inverse of the derivatives, from readings (n,) in V to changes (n,) of ``log``"""
    std: FloatArray
    """(n,) posterior standard deviation of ``log``"""
    slope: FloatArray
    """(n,) 1/V: change of ``log`` per volt if each cell were alone; 0 where its reading says nothing"""
    others: FloatArray
    """(n,) change of ``log`` if all hidden cells change by _UNKNOWN"""
    floor: FloatArray
    """(n,) ``log`` of the conductance that a cell's own reading can just tell from none; below, cells count linearly"""
    linear: BoolArray | None
    """(n,) cells that count linearly; None: none ever does, and ``floor`` is where logarithms end"""
    whole: bool
    """by the matrix of all readings by all cells, not column by column"""
    coarse: bool
    """column by column where that is good for convergence, but makes cells less certain than they are"""


class _Effort(NamedTuple):
    """What a frame may cost."""

    evaluations: int
    """of the circuit model"""
    instalments: int
    """of the renewal of the derivatives, each about as much as one to five evaluations"""
    solutions: int
    """of a continuous sheet"""


USUAL_EFFORT = _Effort(evaluations=4, instalments=1, solutions=1)
LARGE_EFFORT = _Effort(evaluations=4, instalments=4, solutions=1)
"""of boards on which a step by the matrix of all readings by all cells is most of a usual frame"""
NODE_EFFORT = _Effort(evaluations=6, instalments=3, solutions=1)
"""of boards with floating rows and many cells, where a renewal is one inversion of a matrix with a row per line"""
FIRST_EFFORT = _Effort(evaluations=40, instalments=700, solutions=4)
"""in the first frame of all, before which nothing is known"""


class _Known(NamedTuple):
    """Cells for which the model has been evaluated."""

    log: FloatArray
    """(n,) logarithms of the conductances"""
    volts: FloatArray
    """(n,) V, the readings that the model gives for them"""


class _Fit(NamedTuple):
    """Cells that give the readings, more or less."""

    known: _Known
    """the cells"""
    step: FloatArray
    """(n,) change that a further step would make"""
    misfit: float
    """half steps and noise between readings and model"""
    stalled: bool
    """the last step has hardly changed that"""
    proven: bool
    """no further step would change what matters, by derivatives from cells like these"""
    lost: bool
    """it does not serve, and the derivatives are from too far away to tell how uncertain it is"""
    stale: float
    """times its length that the remaining step may have, since the derivatives are from cells that were different"""
    steeper: FloatArray
    """(n,) present slopes over those at the base"""


def _with_resistance(fault: Fault) -> Fault:
    """The fault, with a resistance far below that of any wire where it has none."""
    return fault.replace(resistance=_COMPLETE_SHORT) if fault.kind == "shorted-cell" and fault.ohms == 0 else fault


def _apart(base: _Base, log: FloatArray) -> FloatArray:
    """Change (n,) of logarithms since the base was made."""
    change: FloatArray = np.maximum(base.log, base.floor) - np.maximum(log, base.floor)
    return np.abs(change, out=change)


def _advanced(base: _Base, log: FloatArray, step: FloatArray) -> FloatArray:
    """Logarithms (n,) after a step.

    Below what its own reading can tell from none, a cell's conductance is the unknown instead of its logarithm.
    Readings depend on it linearly, and whether it is 1 % or 10 % of that makes no difference to any of them.
    """
    floor, linear = base.floor, base.linear
    after: FloatArray = log + step
    if linear is None:
        return np.maximum(after, floor)
    below = linear | (after < floor) | (log < floor)
    if below.any():
        above_floor = np.where(linear, np.exp(np.minimum(log - floor, _LARGEST)), 1.0 + log - floor)
        relative = np.where(log < floor, np.exp(np.minimum(log - floor, 0.0)), above_floor) + step
        logarithm = np.log(np.maximum(relative, _NEXT_TO_NONE))
        after = np.where(below, floor + np.where(linear | (relative < 1.0), logarithm, relative - 1.0), after)
    return after


def _far(base: _Base, at: _Known) -> bool:
    """Whether the base is from too far away to serve at these cells."""
    return float(_apart(base, at.log).max()) > _FAR


class CoupledLive:
    """Regularised Gauss-Newton steps for boards on which each reading depends on many cells.

    Unknowns are the logarithms x of the conductances, so that none becomes negative. Readings count in standard
    deviations of an ADC step's error: r = (measured - model) / (half step / sqrt 3). With J = dr/dx and the prior's
    standard deviation s, a step is (J'J + 1/s^2)^-1 J' r (Levenberg, Marquardt; the Bayesian update of a linear model
    with a broad prior about the last estimate). What the readings determine follows them; what they do not stays. The
    covariance (J'J + 1/s^2)^-1 says which is which.
    """

    def __init__(self, board: Board, rule: ValidityRule) -> None:
        """For a board with a converter.

        Raises:
            InputError: the board is too large.

        """
        # Readings at a limit are not fitted. A model without limits has derivatives wherever the fit passes through.
        whole = replace(board, supply=(-inf, inf))
        self._board = board = replace(whole, continuous=False, faults=tuple(map(_with_resistance, board.faults)))
        self._rule = rule
        self._half_step = adc_error(board)
        self._noise = self._half_step / np.sqrt(3.0)  # V, standard deviation of an error within a step
        self._shape = board.shape
        self._mixes = board.circuit.mixes_cells or board.floating
        self._hidden = (broken_off(board) | np.isinf(board.series_ohms)).ravel()
        self._shunt = np.zeros(board.shape)  # S
        for fault in board.shorts:
            self._shunt[fault.place] += siemens(fault.ohms)
        self._prior = np.where(self._hidden, _UNKNOWN, _PRIOR)
        self._lines = LineResistance(board)
        self._shorted = np.zeros(board.shape, dtype=np.bool_)  # by faults of 0 ohm
        for fault in whole.shorts:
            self._shorted[fault.place] |= fault.ohms == 0
        self._gone = self._hidden | self._shorted.ravel()  # cells that no reading tells of
        self._tells = ~self._gone
        tells = self._tells.reshape(self._shape)
        self._columns = ColumnBlocks(board, self._lines.to_driver, self._lines.to_end, self._noise, tells)
        cells = board.shape[0] * board.shape[1]
        self._quick = QuickModel(board, self._lines)
        self._nodes = NodeBlocks(board, self._quick, self._noise) if board.floating and cells > _SMALL else None
        if self._nodes is not None and not self._nodes.applies:
            self._nodes = None
        if cells > LARGEST_MATRIX and not (self._columns.applies or self._nodes):
            raise InputError(
                "the live recovery of boards with bridged lines, or with floating rows and broken lines, is for at "
                f"most {LARGEST_MATRIX} cells, and the array has {cells}; expected a smaller array, or no such fault"
            )
        nearly_independent = self._columns.applies and not self._shorted.any()
        self._has_matrix = cells <= (LARGEST_BESIDE if nearly_independent else LARGEST_MATRIX)
        self._usual_effort = USUAL_EFFORT
        if self._nodes is not None:
            self._usual_effort = NODE_EFFORT
        elif cells > _SMALL and not self._columns.applies:
            self._usual_effort = LARGE_EFFORT
        self._sheet = SheetModel(whole, self._quick) if whole.continuous else None
        self._model = self._quick if self._sheet is None else self._sheet
        leads = board.row_ohms[:, :1] + board.column_lead
        self._leads = self._lines.to_ends + board.column_lead  # ohm in series with each cell
        # V of a short that is alone, inf with ideal lines and amplifiers; and the most that any cells can make of it
        self._short_signal, self._most_signal = (
            np.abs(board.circuit.ideal_volts(board, ohms) - board.level)
            for ohms in (self._leads, np.broadcast_to(leads, board.shape))
        )
        self._most_signal = self._most_signal + 2.0 * np.abs(board.offset)
        per_volt = np.abs(board.circuit.conductance_slope(board, np.zeros(board.shape)))
        self._least = np.log(_LEAST_READING * self._half_step * per_volt).ravel()  # of the logarithms
        self._series = (self._leads + board.series_ohms).ravel()  # the same with the faults there
        self._row_lead = np.where(np.isfinite(self._lines.to_driver), self._lines.to_driver, 0.0)
        self._least_signal = self._half_step + (0.0 if board.adc is None else board.adc.step)
        self._tie = np.where(self._gone | (self._leads.ravel() == 0.0), -inf, _TIES * self._leads.ravel())
        self._loses_columns = (
            self._columns.applies and self._quick.is_quick and not board.circuit.has_amplifiers and not board.faults
        )  # where a cell at its limit leaves other columns as they are, but for the leads of the rows
        self._left_out = np.zeros(board.shape[1], dtype=np.bool_)  # columns
        self._leaves_out = 0  # frames for which they stay so
        self._base: _Base | None = None
        self._renewal: Iterator[_Base | None] | None = None  # under way, an instalment per frame
        self._known: _Known | None = None  # where the last frame ended
        self._ignored: BoolArray | None = None  # (n,) readings of cells that faults hide
        self._damping = 1.0  # share of a step that is taken
        # An offset may push the output of an open cell below the converter's range, however far.
        self._lowest = -inf
        if board.circuit.has_amplifiers and board.adc is not None:
            self._lowest = board.adc.range[0] + board.adc.step
        adc = board.adc
        self._random = 1.0  # share of the converter's error that differs from reading to reading
        self._shifts: tuple[float, float, float] | None = None  # V and relative, errors of all readings; V of code 0
        if adc is not None and (adc.offset_voltage or adc.gain_error):
            self._shifts = abs(adc.offset_voltage), abs(adc.gain_error), adc.range[0]
            self._random = (0.5 + abs(adc.inl_steps)) * adc.step / self._half_step
        self._bottom: BoolArray | None = None  # (n,) readings at the lower end of the range, which may lie below
        self._begun = False
        self._from_fresh_start = False  # and not come to a fit since
        self._failures = 0  # frames in a row at whose end no cells gave the readings
        self._stuck = 0  # frames for which steps column by column are not tried, since they led to no fit
        self._without_fit = 0  # frames
        self._astray = False  # the last frame did not settle
        self._astray_for = 0  # frames in a row that did not

    def __call__(self, volts: FloatArray, limited: BoolArray | None = None, noise: float = 0.0) -> LiveReading:
        """As :class:`.LiveRecovery`."""
        turn = self._board.turn
        found = self._read(turn(volts), None if limited is None else turn(limited), noise)
        return LiveReading(
            turn(found.resistance),
            turn(found.valid),
            turn(found.reason),
            lambda: (turn(found.uncertainty), turn(found.own)),
        )

    def _read(self, volts: FloatArray, limited: BoolArray | None, noise: float) -> LiveReading:
        gone = self._gone.reshape(self._shape)
        known_limits = None if limited is None else limited & gone
        if self._mixes and self._hidden.any():
            return self._nothing(limited)
        signal, margin = np.abs(volts - self._board.level), _SHORT * (self._half_step + SIGMAS * noise)
        at_limit = np.zeros(self._shape, dtype=np.bool_) if limited is None else limited & ~gone
        if ((signal > self._most_signal + margin) & ~gone & ~at_limit).any():
            raise SolverError("readings above that of a short; check that the design is that of the board")
        at_limit |= (signal >= np.minimum(self._short_signal - margin, _SHORT_SHARE * self._short_signal)) & ~gone
        # A cell at its limit may be a short, and what that does to all others no derivative at the limit tells.
        lost = np.logical_or.reduce(at_limit, axis=0)
        if self._loses_columns:
            self._leave_out(signal)
            if not (lost | self._left_out).all():
                lost = lost | self._left_out
        if lost.any() and not (self._loses_columns and not lost.all()):
            return self._nothing(at_limit)
        beside = np.repeat(lost[None], len(at_limit), axis=0)
        self._ignored = self._hidden if self._hidden.any() else None
        if lost.any():
            self._ignored = beside.ravel() | self._hidden
        if known_limits is not None:
            if self._board.circuit.has_amplifiers:
                # While a known short's amplifier stands at its limit, it does not hold its column: others notice.
                beside |= np.any(known_limits & self._shorted, axis=1, keepdims=True)
                if self._board.floating and beside.any():
                    return self._nothing(limited)
            self._ignored = (known_limits | beside).ravel() | self._hidden
        by_lost: FloatArray | float = 0.0
        measured = volts.ravel()
        bottom = measured < self._lowest
        self._bottom = bottom if bottom.any() else None
        # Noise makes readings less certain, and readings and model differ by as much more.
        coarser = float(np.hypot(1.0, noise / self._noise))
        start = self._known
        if start is None:
            start, self._renewal, self._damping = self._known_at(self._start(volts)), None, 1.0
            self._from_fresh_start = True
            self._rebase(start)
        if lost.any():
            usual = np.where(beside.ravel(), np.median(start.log[~beside.ravel()]), start.log)
            if np.abs(usual - start.log).max() > 0.0:
                start = self._known_at(usual)
            by_lost = self._by_lost_columns(lost, signal, np.exp(usual), self._half_step + SIGMAS * noise)
        elif beside.any():
            apparent = np.where(beside.ravel(), self._start(volts), start.log)
            if np.abs(apparent - start.log).max() > _ROUGHLY:
                start = self._known_at(apparent)
        effort = self._usual_effort if self._begun else FIRST_EFFORT
        if self._columns.applies and start is self._known and self._distance(measured, start) > _JUMP * coarser:
            anew = self._known_at(self._start(volts))
            effort = effort._replace(evaluations=effort.evaluations - 1)
            if self._distance(measured, anew) < self._distance(measured, start):
                start = anew
                self._rebase(start)
        if self._base is None:
            self._base = self._based_on(start)
        slope = self._slope(volts)
        fit, doubt = self._solve(measured, start, slope, coarser, effort), 0.0
        if self._sheet is not None:
            for _ in range(effort.solutions):
                if self._sheet.serves(fit.known.log, SIGMAS * coarser * self._base.std):
                    break
                self._sheet.solve(fit.known.log)
                fit = self._solve(measured, self._known_at(fit.known.log), slope, coarser, effort)
            doubt = self._sheet.doubt(fit.known.log)
        x, misfit = fit.known.log, fit.misfit
        self._begun, self._known, base = True, fit.known, self._base
        fresh = self._from_fresh_start
        self._without_fit = 0 if misfit <= _NO_FIT else self._without_fit + 1
        self._stuck = max(self._stuck - 1, 0)
        if self._has_matrix and not base.whole and self._without_fit >= _MOST_WITHOUT_FIT:
            self._stuck = _STUCK
        if misfit <= _NO_FIT:
            self._from_fresh_start, self._failures = False, 0
        elif misfit > _MISFIT and fit.stalled:
            self._known = None  # the next frame starts anew
            short = self._as_good_as_short(x)
            if short.any():  # readings hardly tell such a cell from a short
                return self._nothing(short)
            self._failures += 1
            if self._from_fresh_start and self._failures > _MOST_FAILURES:
                raise SolverError("no cell resistances give these readings; check that the design is that of the board")
        signal = signal.ravel()
        own = (self._half_step + SIGMAS * noise) * slope
        own[slope == 0] = 1.0
        spread = base.std * np.maximum(fit.steeper, 1.0)
        # Readings that fit worse than an ADC step lets them make the whole fit less certain, by as much.
        by_noise = _NOISE_SIGMAS * noise / self._noise
        sigmas = max(float(np.hypot(_SIGMAS * self._random, by_noise)), misfit * float(np.hypot(_SIGMAS, by_noise)))
        by_readings = np.maximum(sigmas * spread, own)
        by_readings += np.abs(fit.step) * (_STALLED if fit.stalled and misfit > _FITS else fit.stale)
        if self._shifts is not None:
            by_readings += self._by_shifts(measured)
        others = base.others + by_lost
        uncertainty = by_readings + others + doubt
        open_cells = signal <= self._half_step + SIGMAS * noise
        reason = np.full(len(measured), UNCERTAIN, dtype=np.int8)
        reason[others > 0.5 * uncertainty] = DISTURBED
        reason[open_cells] = NO_CURRENT
        # After a frame that did not settle, nothing is valid before derivatives from near by confirm the cells.
        self._astray = misfit > _NO_FIT or fit.lost or ((self._astray or fresh) and not fit.proven)
        self._astray_for = self._astray_for + 1 if self._astray else 0
        if not self._astray:
            self._damping = 1.0
        if self._astray:  # the frame's budget did not suffice, or no cells give quite these readings
            reason[:], uncertainty[:] = UNSETTLED, inf
        short = self._as_good_as_short(x)
        if short.any():  # its lines carry what no derivative tells
            beside = beside | short.any(axis=1, keepdims=True) | short.any(axis=0, keepdims=True)
        if not self._astray:
            board = self._board
            excess = signal - _RESOLVED * (self._half_step + SIGMAS * noise)
            if lost.any():  # what these make of their rows is in by_lost
                excess[np.tile(lost, self._shape[0])] = 0.0
            tied = self._tied(x, uncertainty - by_lost, excess)
            if tied is not None:
                beside = beside | tied
            least = self._least_signal + SIGMAS * noise
            imitated = board.circuit.imitated_by_shorts(board, self._row_lead, volts - board.level, least)
            if imitated is not None:
                beside = beside | imitated
        uncertainty[beside.ravel()] = inf
        reason[beside.ravel()] = DISTURBED
        reason[at_limit.ravel()] = SATURATED
        gone = self._gone
        reason[gone] = HIDDEN
        uncertainty[gone | (uncertainty > 1.0)] = inf
        valid = self._rule.accepts(uncertainty) & ~open_cells
        reason[valid] = 0
        resistance = np.exp(-x)
        resistance[gone] = np.nan
        resistance[open_cells & ~gone] = inf
        if lost.any():
            resistance[beside.ravel()] = np.nan
        shape = self._shape
        return LiveReading(
            resistance.reshape(shape),
            valid.reshape(shape),
            reason.reshape(shape),
            lambda: (uncertainty.reshape(shape), own.reshape(shape)),
        )

    def _leave_out(self, signal: FloatArray) -> None:
        """Choose columns without which a board settles that does not: cells of a few ohm there may keep it from that.

        Args:
            signal: (N, M) V.

        """
        share = (signal / self._short_signal).max(axis=0)
        self._left_out &= share >= _ONE_OF_SOME
        if not self._left_out.any():
            self._leaves_out = 0
        elif self._leaves_out <= 0:
            self._left_out[:] = False  # and try again
        self._leaves_out -= 1
        if self._astray and (self._astray_for > 1 or not self._from_fresh_start):
            found = share >= (_ONE_OF_SOME if self._astray_for > 1 else _HEAVY_CELL)
            if found.any():
                self._left_out |= found
                self._leaves_out = _STUCK

    def _by_lost_columns(self, lost: BoolArray, signal: FloatArray, cells: FloatArray, off: float) -> FloatArray:
        """Relative change (n,) of other columns' cells by columns that are taken for usual ones, whatever these are.

        With driven idle rows columns meet in the rows' leads alone. The readings of a column are to each other as its
        conductances D to the rows' drivers are, and none of these is more than 1/lead. So no D of the column times a
        lead is more than its reading over the largest one, which belongs to the cell at its limit. That is the share of
        a voltage that the leads lose to the column, or bring into other columns by way of it.

        Args:
            lost: (M,) columns with cells at their limits.
            signal: (N, M) V.
            cells: (n,) S as they are taken.
            off: V by which a reading may be wrong.

        """
        board, lead, columns = self._board, self._lines.to_driver, np.flatnonzero(lost)
        conductance, most = cells.reshape(self._shape), float(lead.max())
        readings = signal[:, lost]
        row = readings.argmax(axis=0)  # of the cell at its limit, in each of the columns
        largest = np.maximum(readings.max(axis=0) - off, np.finfo(np.float64).tiny)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_volt = np.nan_to_num(most / lead[row, columns] / largest, nan=0.0)
        steeper = 1.0 + conductance.max(axis=0) / conductance  # what other rows bring in, against the cell's own
        # A row that is selected loses to the column what its own cell passes, which comes out at the cell at its limit.
        passed = (readings + off) * per_volt
        passed[row, np.arange(len(row))] = 0.0
        by_row = passed.sum(axis=1) + most * conductance[:, lost].sum(axis=1)
        share: FloatArray = by_row[:, None] * steeper
        # With that cell's row selected, the column is at the drive, and feeds all other rows.
        for place, each, column in zip(row, per_volt, columns, strict=True):
            fed = signal[:, column] * each
            fed[place] = sqrt(len(fed)) * off * each
            if not board.circuit.columns_one_by_one(board):
                fed[place] += most / (board.reference[column] + board.column_lead[column])
            share[place] += fed.sum() + fed @ conductance / conductance[place]
        changed: FloatArray = _BY_LEADS * share
        return changed.ravel()

    def _solve(self, measured: FloatArray, known: _Known, slope: FloatArray, scale: float, effort: _Effort) -> _Fit:
        """Fit the cells, starting from a point where the model is known.

        Args:
            measured: (n,) V.
            known: where to start.
            slope: (n,) 1/V, as :attr:`_Base.slope`, of these readings.
            scale: half steps that readings and model may differ by, for noise.
            effort: what the frame may cost.

        """
        assert self._base is not None
        apart = self._apart(measured, known)
        misfit, stalled, instalments = self._misfit(apart) / scale, False, effort.instalments
        steeper = self._steeper(slope)
        step, serves, moved = self._step(apart, steeper), False, inf
        doubted = self._astray or self._from_fresh_start  # steps then go on to their end, see :attr:`_Fit.proven`
        # Over strong nonlinearities whole steps are quick as a rule, but may lead too far, back, and so on for ever.
        damped = self._astray_for >= _PATIENCE
        for left in range(effort.evaluations - 1, -1, -1):
            ahead = self._known_at(_advanced(self._base, known.log, self._damping * step))
            apart_ahead = self._apart(measured, ahead)
            last, reached = misfit, self._misfit(apart_ahead) / scale
            stalled = abs(reached - last) <= _SAME * reached
            if damped and reached > _FITS and not stalled and apart_ahead @ apart_ahead > apart @ apart:
                moved = self._moved(known.log, scale)
                if instalments and moved > _MOVED and self._renewal is None:
                    instalments -= 1
                    if self._renew(known):
                        steeper = self._steeper(slope)
                        step, moved = self._step(apart, steeper), 0.0
                        continue
                self._damping *= _SHORTER
                continue
            self._damping = min(self._damping / _SHORTER, 1.0)
            known, apart, misfit = ahead, apart_ahead, reached
            before, step = step, self._step(apart, steeper)
            serves = misfit <= _FITS and self._serves(step, scale)
            moved = self._moved(known.log, scale)
            blamed = not serves and moved > _MOVED and np.abs(step).max() > _SLOW * np.abs(before).max()
            resting = self._from_fresh_start and stalled and misfit > _NO_FIT
            if resting and self._has_matrix and not self._base.whole:
                self._stuck = _STUCK
            due = self._stuck > 0 and not self._base.whole
            if due or moved > _FAR or blamed or self._base.coarse or self._renewal is not None:
                if serves and not self._astray:
                    instalments = min(instalments, 1)  # no need to hurry
                while instalments:
                    instalments -= 1
                    if self._renew(known):
                        steeper = self._steeper(slope)
                        step = self._step(apart, steeper)
                        serves = misfit <= _FITS and self._serves(step, scale)
                        moved = self._moved(known.log, scale)
                        break
            if not left or (serves and (misfit <= _CONVERGED or not doubted)):
                break
        lost = not serves and moved > _TOO_FAR
        proven = (serves and misfit <= _CONVERGED and moved <= _FAR) or (stalled and moved <= _MOVED)
        stale = exp(float(_apart(self._base, known.log).max()))
        return _Fit(known, step, misfit, stalled, proven=proven, lost=lost, stale=stale, steeper=steeper)

    def _by_shifts(self, measured: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms by the converter's offset and gain error, which move all readings together."""
        assert self._base is not None
        assert self._shifts is not None
        offset, gain, lowest = self._shifts
        by_offset = np.abs(self._base.step(np.full(len(measured), offset)))
        by_gain: FloatArray = np.abs(self._base.step(gain * (measured - lowest)))
        by_gain += by_offset
        return by_gain

    def _as_good_as_short(self, x: FloatArray) -> BoolArray:
        """(N, M) where a cell of the logarithm x (n,) is far below its leads and no fault explains that."""
        leads = np.where(self._gone.reshape(self._shape), 0.0, self._leads)
        found: BoolArray = np.exp(-x).reshape(self._shape) < _FAR_BELOW * leads
        return found

    def _tied(self, x: FloatArray, uncertainty: FloatArray, excess: FloatArray) -> BoolArray | None:
        """Cells on lines that two cells, which may be shorts, join with each other by way of a third line.

        Two shorts in a column divide the voltage between their rows' leads, whichever of the two rows is driven. Both
        rows then read alike, and in between a few ohm of the two cells decide how the readings are shared. The law is
        the same for columns.

        Args:
            x: (n,) logarithms of the conductances.
            uncertainty: (n,) of the conductances.
            excess: (n,) V of the readings above those that are hardly any.

        Returns:
            (N, M); None where there are none.

        """
        suspect = ((1.0 - uncertainty) * np.exp(-x) < self._tie) & (excess > 0.0)
        if np.count_nonzero(suspect) < 2:
            return None
        size = excess.reshape(self._shape)
        # Shorts of one column read alike, but for the leads of their rows.
        suspect = suspect.reshape(self._shape) & (size > _ALIKE * size.max(axis=0))
        rows = (suspect & (suspect.sum(axis=0) > 1)).any(axis=1)
        columns = (suspect & (suspect.sum(axis=1, keepdims=True) > 1)).any(axis=0)
        beside: BoolArray = rows[:, None] | columns
        return beside

    def _apart(self, measured: FloatArray, known: _Known) -> FloatArray:
        """V (n,) between readings and model, where the readings count."""
        apart = measured - known.volts
        if self._bottom is not None:
            apart[self._bottom & (apart > 0.0)] = 0.0
        if self._ignored is not None:
            apart[self._ignored] = 0.0
        return apart

    def _distance(self, measured: FloatArray, known: _Known) -> float:
        """Misfit of cells to readings (n,) in V."""
        return self._misfit(self._apart(measured, known))

    def _moved(self, x: FloatArray, scale: float) -> float:
        """Largest change of the logarithms x (n,) since the derivatives were made; what noise does counts less."""
        assert self._base is not None
        change = _apart(self._base, x)
        change /= np.maximum((_BY_NOISE * scale / _FAR) * self._base.std, 1.0)
        return float(change.max())

    def _renew(self, at: _Known) -> bool:
        """Derivatives at these cells, or a further instalment of them. True if the base has just become new."""
        assert self._base is not None
        loss, new = self._loss(at.log), False
        if not self._has_matrix or (loss <= _HEAVY and not self._stuck):
            if not self._base.whole or _far(self._base, at):
                self._base, new = self._based_on_lines(at, loss), True
            if not self._base.whole and not self._base.coarse:
                self._renewal = None
                return new
        if self._renewal is None:
            self._renewal = self._renewed(at)
        base = next(self._renewal)
        if base is None:
            return new
        self._renewal = None
        if loss <= _HEAVY and not self._stuck and _far(base, at):
            return new  # made for cells that are no more
        self._base = base
        return True

    def _nothing(self, limited: BoolArray | None) -> LiveReading:
        """A frame that tells of no cell."""
        reason = np.full(self._shape, DISTURBED, dtype=np.int8)
        if limited is not None:
            reason[limited] = SATURATED
        reason[self._gone.reshape(self._shape)] = HIDDEN
        unknown, nowhere = np.full(self._shape, inf), np.zeros(self._shape, dtype=np.bool_)
        return LiveReading(np.full(self._shape, np.nan), nowhere, reason, lambda: (unknown, np.ones(self._shape)))

    def _misfit(self, apart: FloatArray) -> float:
        """Half steps between readings and model (n,): root mean square, or half of the largest if that is more."""
        most = max(float(apart.max()), -float(apart.min()))
        return max(sqrt(float(apart @ apart) / len(apart)), 0.5 * most) / self._half_step

    def _serves(self, step: FloatArray, scale: float) -> bool:
        """Whether a further step would move no cell that the readings determine by more than its own uncertainty.

        After a fresh start the other cells have to come to rest as well: what they carry shifts the readings of all.
        """
        assert self._base is not None
        if self._from_fresh_start and np.abs(step).max(where=~self._gone, initial=0.0) > _AT_REST:
            return False
        std = scale * self._base.std
        determined = (std <= _LOOSE) & (self._base.others <= _LOOSE)
        return bool(((np.abs(step) <= np.maximum(_SETTLED * std, 1e-6)) | ~determined).all())

    def _step(self, volts: FloatArray, steeper: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms for a difference (n,) of the readings in V.

        A cell's own nonlinearity is known in closed form. Readings therefore count by what they would mean for a cell
        alone at present, ``steeper`` times what they meant when the derivatives were made.
        """
        assert self._base is not None
        change = self._base.step(volts * steeper)
        if max(change.max(), -change.min()) > _STRIDE:
            most = _STRIDE if self._base.linear is None else np.where(self._base.linear, _LINEAR_STRIDE, _STRIDE)
            np.clip(change, -_STRIDE, most, out=change)
        return change

    def _steeper(self, slope: FloatArray) -> FloatArray:
        """Slopes (n,) in 1/V over those at the base, up to a factor of _STEEPER; 1 where there is none."""
        assert self._base is not None
        before = self._base.slope
        both = (before > 0) & (slope > 0)
        ratio = np.divide(slope, before, out=np.ones(len(slope)), where=both)
        np.minimum(ratio, _STEEPER, out=ratio)
        return np.maximum(ratio, 1.0 / _STEEPER, out=ratio)

    def _slope(self, volts: FloatArray) -> FloatArray:
        """As :attr:`_Base.slope`, for readings (N, M) in V."""
        slope = self._board.circuit.log_conductance_slope(self._board, volts - self._board.level)
        return np.abs(slope).ravel()

    def _start(self, volts: FloatArray) -> FloatArray:
        """Logarithms (n,) of the conductances by closed formulas, from readings (N, M) in V.

        Columns that hardly load each other are taken apart exactly, and row leads as by :mod:`._column_blocks`.
        """
        signal = volts - self._board.level
        if self._columns.applies:
            apparent = self._columns.crosspoints(signal)
        else:
            apparent = self._board.circuit.apparent_conductance(self._board, signal)
        typical = float(np.median(apparent[apparent > 0])) if (apparent > 0).any() else 1e-5
        most = 1e3 * float(apparent.max(initial=0.0)) or 1.0
        apparent = np.minimum(cell_alone(self._board, apparent, self._shunt), most)
        start: FloatArray = np.log(np.where(apparent > 1e-3 * typical, apparent, 0.1 * typical)).ravel()
        return start

    def _known_at(self, x: FloatArray) -> _Known:
        """Evaluate the model for the logarithms x (n,) of the conductances."""
        return _Known(x, self._model(np.exp(-x).reshape(self._shape)).ravel())

    def _loss(self, x: FloatArray) -> float:
        """Share of a voltage in the lines at logarithms x (n,), as far as steps by single lines neglect it.

        It is inf where there are no such steps.
        """
        if self._nodes is not None:
            return 0.0
        if not self._columns.applies:
            return inf
        return self._columns.loss(self._board.cell_conductance(np.exp(-x).reshape(self._shape)))

    def _based_on(self, at: _Known) -> _Base:
        """Derivatives and their regularised inverse there, at once."""
        loss = self._loss(at.log)
        if loss <= _HEAVY or not self._has_matrix:
            return self._based_on_lines(at, loss)
        return next(base for base in self._renewed(at) if base is not None)

    def _rebase(self, at: _Known) -> None:
        """Take derivatives from there at once, where columns give them in closed form."""
        loss = self._loss(at.log)
        if self._base is not None and self._columns.applies and loss <= _HEAVY:
            self._base, self._renewal = self._based_on_lines(at, loss), None

    def _based_on_lines(self, at: _Known, loss: float) -> _Base:
        """Derivatives there by what is special about cells of one line: no matrix of all readings by all cells."""
        cells, prior = (values.reshape(self._shape) for values in (np.exp(-at.log), self._prior))
        if self._nodes is not None:
            by_nodes, slope = self._nodes.at(cells, prior), self._slope(at.volts.reshape(self._shape))
            none, std = np.zeros(len(at.log)), by_nodes.std.ravel()
            return _Base(at.log, by_nodes.solve, std, slope, none, self._least, None, whole=False, coarse=False)
        step = self._columns.at(cells, prior, self._hidden.reshape(self._shape))
        slope = self._slope(at.volts.reshape(self._shape))
        coarse = loss > _LIGHT and self._has_matrix
        std, others, floor = step.std.ravel(), step.others.ravel(), step.floor.ravel()
        return _Base(at.log, step.solve, std, slope, others, floor, at.log < floor, whole=False, coarse=coarse)

    def _renewed(self, at: _Known) -> Iterator[_Base | None]:
        """Derivatives and their regularised inverse there, in instalments; None until the last."""
        x = at.log
        cells = np.exp(-x)
        jacobian = np.empty((len(x), len(x)))
        meter = Meter(len(x), beside=self._columns.applies)
        at_cells = cells.reshape(self._shape)
        # A cell that ran away is as good as a short, and the derivatives are not made for shorts.
        no_shorts = np.maximum(at_cells, np.exp(-_LARGEST))
        for _ in derivatives(self._board, no_shorts, self._quick, meter, out=jacobian):
            yield None
        in_series = 1.0 / (cells + self._board.series_ohms.ravel())  # S of the cell and an open-cell fault
        scale = in_series**2 * cells / self._noise
        # Of a cell whose reading hardly tells it from none, the unknown is the conductance itself, see _advanced().
        own = np.abs(np.diagonal(jacobian))
        least = np.divide(1.0, own, out=np.zeros(len(x)), where=self._tells & (own > 0))
        floor = np.log(np.maximum(least * self._noise, np.finfo(np.float64).tiny))
        jacobian *= np.where((scale < least) & (cells > self._series), least, scale)
        normal = NormalMatrix(jacobian, self._prior)
        for _ in normal.instalments(meter):
            yield None
        variance = np.maximum(np.diagonal(normal.inverse), np.finfo(np.float64).tiny)
        if meter.is_full(_PER_SQUARE * normal.inverse.size):
            yield None
        more = beyond_linear(np.sqrt(variance)) / variance
        std = np.sqrt(variance + np.einsum("ij,ij,j->i", normal.inverse, normal.inverse, more))
        loose = self._hidden
        # Of the covariance with the hidden cells: how far each cell follows when all of them go to their ends.
        others = np.zeros(len(x))
        if loose.any():
            others = np.abs(normal.inverse[:, loose] / std[loose] ** 2).sum(axis=1) * _UNKNOWN
        slope = self._slope(at.volts.reshape(self._shape))

        def step(volts: FloatArray) -> FloatArray:
            return normal.step(volts / self._noise)

        yield _Base(x, step, std, slope, others, floor, x < floor, whole=True, coarse=False)
