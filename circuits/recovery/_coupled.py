"""Live recovery of coupled boards: regularised Gauss-Newton steps with derivatives that are kept while they serve.

A frame goes through the stages of :meth:`CoupledLive._read`:

======================================  ================================================================
leave out readings at limits            :mod:`._readings_at_limits`
correct for lines that broke            :mod:`._broken_lines`
choose a start                          the last frame's cells, or :mod:`._closed_start`
steps within the frame's budget         :mod:`._gauss_newton`, :mod:`._linearised`, :mod:`._frame_budget`
judge the misfit of the readings        :meth:`CoupledLive._judge_misfit`
uncertainty                             :mod:`._fit_uncertainty`, :mod:`._column_scales`,
                                        :mod:`._follower_solutions`, :mod:`._below_range`
cells that possible shorts disturb      :mod:`._possible_shorts`
values, validity, and reasons           :meth:`CoupledLive._reading`
======================================  ================================================================

The constant parts of a board, and its circuit model, are in :mod:`._coupled_board`.
"""

from __future__ import annotations

from functools import partial
from math import hypot, inf
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from .._board import Board
from ._below_range import BelowRange
from ._broken_lines import BrokenLines
from ._closed_start import ClosedStart
from ._column_scales import ColumnScales
from ._coupled_board import Compared, CoupledBoard, Frame, Known
from ._fit_uncertainty import ALIKE, FitUncertainty
from ._follower_solutions import FollowerSolutions
from ._frame_account import Account
from ._frame_budget import FIRST_EFFORT, Budget
from ._gauss_newton import Convergence, Fit, GaussNewton
from ._linearised import Linearised
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
from ._lost_rows import LostRows
from ._possible_shorts import PossibleShorts
from ._readings_at_limits import ReadingLimits, Selection

_MOST_FAILURES = 3  # frames in a row until the design is taken for wrong: other starts may lead to a fit
_ROUGHLY = 0.05  # change of a logarithm that matters for cells which only load others
_JUMP = 20.0  # half steps between readings and the last frame's cells: beyond, closed formulas are nearer


class _Open(NamedTuple):
    """Uncertainties that a frame leaves in its cells, relative to their conductances; (n,) each."""

    others: FloatArray
    """by cells without a reading, and by columns that are left out or have an unknown scale"""
    fitted: FloatArray
    """by everything but those columns"""
    all: FloatArray
    """by everything"""

    def besides(self, change: FloatArray | None) -> _Open:
        """The same if other columns may change the cells by ``change`` (n,) in addition; None: they do not."""
        return self if change is None else self._replace(others=self.others + change, all=self.all + change)


class CoupledLive:
    """Live recovery of boards on which each reading depends on many cells."""

    def __init__(self, board: Board, rule: ValidityRule) -> None:
        """For a board with a converter.

        Raises:
            InputError: the board is too large.

        """
        self._rule = rule
        self._parts = parts = CoupledBoard(board)
        self._linearised = Linearised(parts)
        columns = self._linearised.columns
        self._start = ClosedStart(parts, columns)
        self._rows = LostRows(parts)
        self._limits = ReadingLimits(parts, nearly_independent=columns.applies, loses_rows=self._rows.applies)
        self._is_divider = not (board.floating or board.circuit.has_amplifiers)
        self.scales_columns = self._is_divider and columns.applies and not board.turned
        self._uncertainty = FitUncertainty(parts, scales_columns=self.scales_columns)
        self._prices = prices = self._linearised.prices
        self._scales = ColumnScales(parts, prices)
        self._solutions = FollowerSolutions(parts, prices.solutions)
        self._shorts = PossibleShorts(parts, prices.imitated)
        self._below = BelowRange(parts)
        self._broken = BrokenLines(parts, prices.compare)
        self._convergence = Convergence()
        self._steps = GaussNewton(parts, self._linearised, self._convergence)
        self._known: Known | None = None  # the result of the last frame
        self._settled: FloatArray | None = None  # (n,) logarithms of the conductances of the last frame that settled
        self._has_begun = False  # whether there has been a frame
        self._any_gone = bool(parts.gone.any())
        self._all_valid = np.ones(parts.shape, dtype=np.bool_), np.zeros(parts.shape, dtype=np.int8)
        for shared in self._all_valid:
            shared.flags.writeable = False

    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        faint: BoolArray | None = None,
    ) -> LiveReading:
        """As :class:`.LiveRecovery`. Faint readings are fitted; :class:`.BelowRange` finds those below the range."""
        del faint
        turn = self._parts.board.turn
        found = self._read(turn(volts), None if limited is None else turn(limited), noise)
        return LiveReading(
            turn(found.resistance),
            turn(found.valid),
            turn(found.reason),
            lambda: (turn(found.uncertainty), turn(found.own)),
            found.covered,
            found.alike,
            lambda: turn(found.by_readings),
        )

    def _read(self, volts: FloatArray, limited: BoolArray | None, noise: float) -> LiveReading:
        """Recover one frame in line coordinates."""
        budget = self._budget_of_frame()
        signal, error = np.abs(volts - self._parts.board.level), self._parts.half_step + SIGMAS * noise
        selection = self._limits.select(signal, limited, error, self._convergence)
        if not selection.tells:
            return self._nothing(selection.at_limit)
        read = volts
        if self._broken.applies and self._settled is not None and self._broken.change_notably(signal):
            spread = self._linearised.spread * hypot(1.0, noise / self._parts.noise)
            corrected = self._broken.without(read, self._settled, spread, budget)
            if corrected is None:
                return self._nothing(selection.at_limit, UNSETTLED)
            volts, signal = corrected, np.abs(corrected - self._parts.board.level)
        frame = self._parts.frame(volts, signal, noise, selection.ignored)
        usual = self._usual_start(frame, selection, budget)
        if usual is None:
            return self._nothing(selection.at_limit, UNSETTLED)
        known, by_lost = usual
        start = self._nearer_start(frame, known, budget)
        if not self._linearised.begin(start.known, budget):
            return self._nothing(selection.at_limit, UNSETTLED)
        fit, doubt = self._fit(frame, start, budget)
        short = self._shorts.as_good_as_short(fit.known)
        self._judge_misfit(fit, short)
        if fit.none and short is not None:  # readings hardly distinguish such a cell from a short
            return self._nothing(short)
        self._steps.settle(fit)
        if not self._convergence.astray:
            self._settled = fit.known.log
            if self._broken.applies:
                self._broken.remember(read, error)
        astray = self._convergence.astray
        if selection.lost_rows is not None and not astray and budget.judge(self._prices.lost_rows):
            conductance = 1.0 / fit.known.cells
            by_lost = self._rows.change(frame, selection.lost_rows, selection.at_limit, conductance)
        left = self._left_open(frame, fit, by_lost, doubt, budget)
        beside = self._disturbed(frame, fit, selection, left.fitted, short, budget)
        # Other sets of cells are enclosed only if the result can make some cell valid.
        if not self._convergence.astray and np.any((left.all <= 1.0) & ~beside.ravel()):
            left = left.besides(self._other_cells(frame, fit, budget))
        return self._reading(
            frame, fit, selection, left, beside, settled=budget.suffices and not self._convergence.astray
        )

    def _budget_of_frame(self) -> Budget:
        """The budget of a new frame. The first frame alone has the large budget, even if it determines no cell."""
        if self._has_begun:
            most = self._prices.most(looks=self._shorts.usually_looks)
            account = Account(most if self._parts.sheet is None else inf)
            account.spend(self._prices.reading)
            return Budget(self._linearised.usual_effort(anew=self._known is None or self._convergence.fresh), account)
        self._has_begun = True
        return Budget(FIRST_EFFORT, Account(inf))

    def _at(self, log: FloatArray, budget: Budget, more: float = 0.0) -> Known | None:
        """Evaluate the model at the logarithms (n,) of the conductances from which a frame starts.

        None if the frame cannot pay for this evaluation and ``more``.
        """
        return self._parts.at(log) if budget.start(self._parts.price(log) + more) else None

    def _usual_start(
        self, frame: Frame, selection: Selection, budget: Budget
    ) -> tuple[Known, FloatArray | float] | None:
        """The last frame's cells, or a new start; cells that the frame does not determine get usual values.

        If the last frame's cells lead nowhere, starts alternate between closed formulas and the cells of the last frame
        that settled.

        Returns:
            The cells, and the relative change (n,) of all others by columns that are left out. None if the frame cannot
            pay for its start.
        """
        start: Known | None = self._known
        if start is None:
            settled = self._settled if self._convergence.starts % 2 else None
            log = self._start(frame.volts) if settled is None else settled
            start = self._at(log, budget, self._prices.start)
            if start is None:
                return None
            self._steps.begin_anew()
            self._linearised.begin_anew(start, budget)
        beside = selection.beside.ravel()
        if selection.lost is not None or selection.lost_rows is not None:
            usual = np.where(beside, np.median(start.log[~beside]), start.log)
            if np.abs(usual - start.log).max() > 0.0:
                start = self._at(usual, budget)
            if start is None:
                return None
            if selection.lost is None:
                return start, 0.0
            conductance = np.exp(usual).reshape(self._parts.shape)
            prices = self._prices
            budget.spend(prices.lost + prices.each_lost * np.count_nonzero(selection.lost))
            return start, self._limits.by_lost_columns(frame, selection.lost, conductance)
        if np.count_nonzero(beside):
            apparent = np.where(beside, self._start(frame.volts), start.log)
            if np.abs(apparent - start.log).max() > _ROUGHLY:
                start = self._at(apparent, budget, self._prices.start)
        return None if start is None else (start, 0.0)

    def _nearer_start(self, frame: Frame, known: Known, budget: Budget) -> Compared:
        """The start or, after a jump of the readings, the cells by closed formulas if these are nearer."""
        start = frame.compared(known)
        goes_on = self._linearised.columns.applies and known is self._known
        if goes_on and start.half_steps > _JUMP * frame.coarser:
            log = self._start(frame.volts)
            if not budget.evaluate(self._parts.price(log) + self._prices.start):
                return start
            anew = frame.compared(self._parts.at(log))
            if anew.half_steps < start.half_steps:
                start = anew
                self._linearised.rebase(start.known, budget)
        return start

    def _fit(self, frame: Frame, start: Compared, budget: Budget) -> tuple[Fit, float]:
        """The fitted cells, and the relative error of their conductances by a continuous sheet."""
        fit, sheet = self._steps.fit(frame, start, budget), self._parts.sheet
        if sheet is None:
            return fit, 0.0
        while not sheet.serves(fit.known.log, SIGMAS * frame.coarser * self._linearised.base.std):
            if not budget.solve(self._parts.price(fit.known.log)):
                break
            sheet.solve(fit.known.log)
            fit = self._steps.fit(frame, frame.compared(self._parts.at(fit.known.log)), budget)
        return fit, sheet.doubt(fit.known.log)

    def _judge_misfit(self, fit: Fit, short: BoolArray | None) -> None:
        """Decide from which cells the next frame starts.

        Args:
            fit: of this frame.
            short: (N, M) cells of the fit that are as good as shorts; None: there are none.

        Raises:
            SolverError: no cells give the readings, frame after frame.

        """
        convergence = self._convergence
        convergence.count(fit)
        elsewhere = fit.none or convergence.in_vain
        self._known = None if elsewhere else fit.known  # None: the next frame starts anew
        if elsewhere:
            convergence.give_up_start()
        self._linearised.end_frame()
        if convergence.stuck:
            self._linearised.give_up_columns()
        if fit.none and short is None and not self._shorts.joins_lines(fit.known):
            convergence.failures += 1
            if convergence.fresh and convergence.failures > _MOST_FAILURES:
                raise SolverError("no cell resistances give these readings; check that the design is that of the board")

    def _left_open(self, frame: Frame, fit: Fit, by_lost: FloatArray | float, doubt: float, budget: Budget) -> _Open:
        """Uncertainties of the fitted cells.

        Args:
            frame: the readings.
            fit: the cells found for the readings.
            by_lost: relative change (n,) by columns that are left out.
            doubt: relative error by a continuous sheet.
            budget: of the frame.

        """
        base = self._linearised.base
        own = self._uncertainty.by_own_reading(frame)
        by_shifts = self._uncertainty.by_shifts(frame, base)
        by_readings = self._uncertainty.by_readings(frame, fit, base, own, by_shifts)
        others: FloatArray = base.others
        by_columns = by_lost
        if self._convergence.astray:  # no cell of the frame is valid, however certain it is
            fitted = by_readings + others + doubt
            return _Open(others + by_columns, fitted, fitted + by_columns)
        if self._is_divider and isinstance(by_columns, np.ndarray):
            # This is a change of crosspoints; beside heavy leads the cell is a small part of its crosspoint.
            leads = np.where(np.isfinite(self._parts.leads), self._parts.leads, 0.0)
            with np.errstate(over="ignore"):  # infinite values stay infinite
                by_columns = by_columns * (1.0 + leads / fit.known.cells).ravel()
        if frame.bottom is not None:
            others = others + self._below(frame, fit.known, base, budget, self._linearised.step_price)
        if self._broken.beyond is not None:
            others = others + self._broken.change(frame.volts, base)
        fitted = by_readings + others + doubt
        return _Open(others + by_columns, fitted, fitted + by_columns)

    def _other_cells(self, frame: Frame, fit: Fit, budget: Budget) -> FloatArray | None:
        """Largest relative change (n,) from these cells to others, far away, with the same readings; None: none."""
        base = self._linearised.base
        if self._scales.applies:
            return self._scales.disturb(frame, fit.known, base, self._uncertainty.covered(frame), budget)
        if self._solutions.applies:
            return self._solutions.change(frame, fit.known, base, budget)
        return None

    def _disturbed(
        self,
        frame: Frame,
        fit: Fit,
        selection: Selection,
        uncertainty: FloatArray,
        short: BoolArray | None,
        budget: Budget,
    ) -> BoolArray:
        """(N, M) cells that the frame does not determine, or whose values shorts would make wrong.

        Args:
            frame: the readings.
            fit: the cells found for the readings.
            selection: readings that are left out.
            uncertainty: (n,) of the fit, without the effect of columns that are left out or have an unknown scale.
            short: (N, M) cells of the fit that are as good as shorts; None: there are none.
            budget: of the frame.

        """
        beside = selection.beside
        if self._broken.beyond is not None:  # signals that still pass a break are not readings of cells
            beside = beside | (self._broken.beyond & (frame.signal > frame.error))
        if short is not None:  # derivatives do not describe the currents on its lines
            beside = beside | short.any(axis=1, keepdims=True) | short.any(axis=0, keepdims=True)
        if not self._convergence.astray:
            disturbed = self._shorts.disturb(frame, fit.known, uncertainty, selection.lost, selection.lost_rows, budget)
            if disturbed is not None:
                beside = beside | disturbed
        return beside

    def _reading(
        self, frame: Frame, fit: Fit, selection: Selection, left: _Open, beside: BoolArray, *, settled: bool
    ) -> LiveReading:
        """Values, uncertainties, validity, and reasons.

        Args:
            frame: the readings.
            fit: the cells found for the readings.
            selection: readings that are left out.
            left: uncertainties of the cells.
            beside: (N, M) cells that are disturbed.
            settled: whether the frame's budget sufficed, and the cells give the readings.

        """
        shape, gone, disturbed = self._parts.shape, self._parts.gone, beside.ravel()
        open_cells, counted = frame.signal.ravel() <= frame.error, (self._uncertainty.covered(frame), ALIKE)
        uncertainty = left.all
        # The derivatives themselves are large, and whoever keeps the reading would keep them, too.
        by_readings = partial(self._by_readings, frame, self._linearised.base.std, fit.steeper, uncertainty)
        most = uncertainty.item(uncertainty.argmax())
        if (
            settled
            and self._all_known(selection, beside)
            and not np.count_nonzero(open_cells)
            and most <= self._rule.limit
        ):
            return LiveReading(
                fit.known.cells.copy(),
                *self._all_valid,
                partial(self._uncertainties, frame, uncertainty),
                *counted,
                by_readings,
            )
        reason = np.full(len(uncertainty), UNCERTAIN, dtype=np.int8)
        reason[left.others > 0.5 * uncertainty] = DISTURBED
        reason[open_cells] = NO_CURRENT
        if not settled:
            reason[:], uncertainty[:] = UNSETTLED, inf
        uncertainty[disturbed] = inf
        reason[disturbed] = DISTURBED
        reason[selection.at_limit.ravel()] = SATURATED
        reason[gone] = HIDDEN
        uncertainty[gone | (uncertainty > 1.0)] = inf
        valid = self._rule.accepts(uncertainty) & ~open_cells
        reason[valid] = 0
        resistance = fit.known.cells.ravel().copy()
        resistance[gone] = np.nan
        resistance[open_cells & ~gone] = inf
        if selection.lost is not None or selection.lost_rows is not None:
            resistance[disturbed] = np.nan
        return LiveReading(
            resistance.reshape(shape),
            valid.reshape(shape),
            reason.reshape(shape),
            partial(self._uncertainties, frame, uncertainty),
            *counted,
            by_readings,
        )

    def _all_known(self, selection: Selection, beside: BoolArray) -> bool:
        """Whether only its own uncertainty can keep a cell from being valid, as in nearly all frames."""
        left_out = beside is not self._limits.nowhere or selection.at_limit is not self._limits.nowhere
        return not (left_out or self._any_gone)

    def _uncertainties(self, frame: Frame, uncertainty: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Relative uncertainties (N, M) of a frame's cells, and the part by a cell's own reading."""
        own = self._uncertainty.of_own_reading(frame, uncertainty)
        return uncertainty.reshape(self._parts.shape), own.reshape(self._parts.shape)

    def _by_readings(self, frame: Frame, std: FloatArray, steeper: FloatArray, uncertainty: FloatArray) -> FloatArray:
        """Relative change (N, M) of a frame's cells by random errors of all readings."""
        by_all = self._uncertainty.of_all_readings(frame, std, steeper, uncertainty)
        return by_all.reshape(self._parts.shape)

    def _nothing(self, at_limit: BoolArray, why: int = DISTURBED) -> LiveReading:
        """A frame that determines no cell.

        Args:
            at_limit: (N, M) readings at a limit.
            why: the reason at the other cells.

        """
        shape = self._parts.shape
        reason = np.full(shape, why, dtype=np.int8)
        reason[at_limit] = SATURATED
        reason[self._parts.gone.reshape(shape)] = HIDDEN
        unknown, nowhere = np.full(shape, inf), np.zeros(shape, dtype=np.bool_)
        return LiveReading(np.full(shape, np.nan), nowhere, reason, lambda: (unknown, np.ones(shape)))
