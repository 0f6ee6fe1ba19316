"""Live recovery of boards whose amplifiers hold all sensed lines: the stages of a frame, from outputs to cells.

==========================  ===================================================================================
:mod:`._amplified_board`    lines, amplifiers and converter: transfer conductances T from outputs
:mod:`._amplified_base`     cells from T by line attenuation, relinearised about a base, with a certificate
:mod:`._amplified_leads`    bases by Kirchhoff's laws, where leads take much of the voltage
:mod:`._amplified_errors`   uncertainties by quantisation, noise and the model's own error
:mod:`._amplified_limits`   effect of cells at limits on the others; :mod:`._joined_columns`: through two shorts
:mod:`._amplified_loops`    machine code for the usual frame; :mod:`._amplified_short_loops`: for cells at limits
==========================  ===================================================================================

A base serves as long as the certificate stays below a share of an ADC step. Otherwise the present conductances become
the new base, as far as the frame's account allows (:mod:`._frame_account`, :mod:`._amplified_prices`). Cells that have
not settled then are not valid, and the next frame continues from there.
"""

from __future__ import annotations

from functools import partial
from math import inf

import numpy as np

from ...common.arrays import BoolArray, FloatArray
from .._board import Board, cell_alone
from ..solvers import siemens
from ._amplified_base import AttenuationBases, Base, Relinearisation
from ._amplified_board import BOUNDLESS, HEAVY, LEAST_SHARE, AmplifiedBoard
from ._amplified_errors import Levels, ReadingErrors
from ._amplified_leads import LeadBases
from ._amplified_limits import CellsAtLimits
from ._amplified_loops import UsualFrames
from ._amplified_prices import AmplifiedPrices
from ._frame_account import Account
from ._live_reading import (
    DISTURBED,
    HIDDEN,
    NO_CURRENT,
    SATURATED,
    UNCERTAIN,
    UNSETTLED,
    LiveReading,
    ValidityRule,
)

EVALUATIONS = 2
"""largest number of evaluations of line attenuation in one frame"""
FIRST_EVALUATIONS = 8
"""the same in the first frame of all, before which nothing is known"""


class AmplifiedLive:
    """Live recovery of a plain grid whose columns are all held by amplifiers, with grounded idle rows."""

    scales_columns = False

    def __init__(self, board: Board, rule: ValidityRule) -> None:
        """For a board whose circuit has ends (:meth:`.ReadoutCircuit.ends`) and whose design has a converter."""
        self._rule = rule
        self._board = AmplifiedBoard(board)
        self._prices = AmplifiedPrices(self._board)
        self._relinearised = Relinearisation(self._board)
        self._by_attenuation = AttenuationBases(self._board, self._prices)
        self._by_leads = LeadBases(self._board, self._prices)
        self._errors = ReadingErrors(self._board, rule)
        self._at_limits = CellsAtLimits(self._board, self._prices)
        self._faults = _Faults(board)
        self._loops = UsualFrames(self._board)
        self._base: Base | None = None
        self._heavy = False  # whether the leads take so much voltage that cells are found by Kirchhoff's laws
        self._usually_heavy = True  # whether all frames so far were like that
        self._turned, self._turn = board.turned, board.turn
        self._all = np.ones(board.shape, dtype=np.bool_)
        self._no_reason = np.zeros(board.shape, dtype=np.int8)
        self._turned_all = np.ascontiguousarray(board.turn(self._all))
        self._turned_no_reason = np.ascontiguousarray(board.turn(self._no_reason))
        for shared in (self._all, self._no_reason, self._turned_all, self._turned_no_reason):
            shared.flags.writeable = False

    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        faint: BoolArray | None = None,
    ) -> LiveReading:
        """As :class:`.LiveRecovery`."""
        if not self._turned:
            return self._read(volts, limited, faint, noise)
        turn = self._turn
        limited, faint = (None if cells is None else np.ascontiguousarray(turn(cells)) for cells in (limited, faint))
        found = self._read(np.ascontiguousarray(turn(volts)), limited, faint, noise)
        every = found.valid is self._all
        return LiveReading(
            np.ascontiguousarray(turn(found.resistance)),  # what follows is faster in the usual order
            self._turned_all if every else turn(found.valid),
            self._turned_no_reason if every else turn(found.reason),
            lambda: (turn(found.uncertainty), turn(found.own)),
            every=every or None,
            bounds=None if found.bounds is None else (turn(found.bounds[0]), turn(found.bounds[1])),
        )

    def _read(self, volts: FloatArray, limited: BoolArray | None, faint: BoolArray | None, noise: float) -> LiveReading:
        """Recover a frame in line coordinates: cells, uncertainties, cells at limits, and reasons for the rest."""
        if limited is None and faint is None and self._loops.compiled and not self._faults.any:
            usual = self._usual(volts, noise)
            if usual is not None:
                return usual
        # The first frame of all is recovered nevertheless: it may take its time, later ones may not.
        if limited is not None and self._base is not None and (limited | self._faults.hidden).all():
            return self._without_any()
        account = self._account_of_frame()
        transfer, conductance, gain, off = self._cells(volts, noise, account)
        levels = self._errors(gain, noise, self._base)
        unknown = limited if faint is None else _with_faint(limited, faint, transfer, levels)
        if unknown is None and off is None and not self._faults.any:
            valid = transfer >= levels.least
            if np.count_nonzero(valid) == valid.size:
                return LiveReading(
                    np.reciprocal(conductance),
                    self._all,
                    self._no_reason,
                    partial(levels.uncertainties, transfer),
                    every=True,
                )
        disturbance = None
        if unknown is not None:
            disturbance = self._at_limits(conductance, volts, unknown, levels.noise, self._base, account)
        return self._examined(transfer, conductance, levels, off, limited, disturbance)

    def _without_any(self) -> LiveReading:
        """The result for a frame whose readings are all at limits, except for those of hidden cells."""
        shape = self._faults.hidden.shape
        reason = np.where(self._faults.hidden, HIDDEN, SATURATED).astype(np.int8)
        boundless = np.full(shape, inf)
        return LiveReading(
            np.full(shape, np.nan), np.zeros(shape, dtype=np.bool_), reason, lambda: (boundless, boundless)
        )

    def _usual(self, volts: FloatArray, noise: float) -> LiveReading | None:
        """A frame in which all cells are valid and nothing is kept anew, by machine code; None for any other frame."""
        levels, base = self._errors.kept_for(noise), self._base
        if levels is None:
            return None
        volts = np.ascontiguousarray(volts, dtype=np.float64)  # of exactly the type that the loops take
        if not volts.flags.writeable:
            volts = volts.copy()
        if self._board.independent_columns:
            found = self._loops.independent(levels, volts)
        elif base is None or base.off is not None or self._heavy or base.loss > HEAVY or levels.gain is not base.gain:
            return None
        else:
            found = self._loops.about(base, levels, volts)
        if found is None:
            return None
        resistance, uncertainties = found
        return LiveReading(resistance, self._all, self._no_reason, uncertainties, every=True)

    def _account_of_frame(self) -> Account:
        """The account of a new frame, from which the fixed cost of a frame is already paid."""
        is_first = self._base is None and not self._board.independent_columns
        account = Account(self._prices.first if is_first else self._prices.most(heavy=self._usually_heavy))
        account.spend(self._prices.reading)
        return account

    def _cells(
        self, volts: FloatArray, noise: float, account: Account
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
        """Cells from a frame's outputs (N, M) in V, as far as the frame's account goes.

        Returns:
            S (N, M), the cells' own parts of the transfer conductances; S (N, M), conductances; gains, which broadcast
            to (N, M); and the certificate as by :class:`.Relinearisation`, None if the account sufficed.

        """
        board, base = self._board, self._base
        if board.independent_columns:
            transfer = board.transfer(volts, None)
            conductance, gain = board.of_independent_columns(transfer)
            return transfer, conductance, gain, None
        if base is None:
            base, transfer = self._begin(volts, account)
        else:
            transfer = board.transfer(volts, base.between)
            if not self._errors.holds(base.propagation, noise):
                base = base._replace(propagation=None)  # to be computed again, with levels for the noise
        before = base
        conductance, off, base = self._settle(before, volts, transfer, account)
        self._usually_heavy = self._usually_heavy and self._heavy
        if base.between is not before.between:
            transfer = board.transfer(volts, base.between)
        self._base = base
        return base.own_part(transfer), conductance, base.gain, off

    def _begin(self, volts: FloatArray, account: Account) -> tuple[Base, FloatArray]:
        """The first base, and the transfer conductances (N, M) in S that the outputs (N, M) in V give with it."""
        conductance = self._board.transfer(volts, None)  # as if the lines had no resistance
        found: Base | None = None
        for _ in range(FIRST_EVALUATIONS - EVALUATIONS):
            made = self._by_attenuation(conductance, account)
            if made is None:
                break
            found, transfer = made, self._board.transfer(volts, made.between)
            conductance, off = self._relinearised(made, transfer)
            if off is None:
                break
        assert found is not None, "the first frame can pay for its first base"
        return found, transfer

    def _settle(
        self, base: Base, volts: FloatArray, transfer: FloatArray, account: Account
    ) -> tuple[FloatArray, FloatArray | None, Base]:
        """Conductances (N, M) in S, their certificate, and the base that gave them.

        The base moves to the present conductances as long as the certificate requires it and the account allows it.

        Args:
            base: of the last frame.
            volts: (N, M) V, outputs.
            transfer: (N, M) S, transfer conductances with the currents between columns of that base.
            account: of the frame.

        """
        if self._heavy:
            found = self._settle_by_leads(volts, base, account)
            if found is not None:
                return found
        conductance, off = self._relinearised(base, transfer)
        for _ in range(EVALUATIONS):
            if off is None:
                break
            made = self._by_attenuation(conductance, account)
            if made is None:
                break
            base = made
            if base.between is not None:
                transfer = self._board.transfer(volts, base.between)
            conductance, off = self._relinearised(base, transfer)
            if self._board.asks_for_leads(base.loss):
                break
        if base.loss > HEAVY:
            return self._settle_on_heavy_lines(base, volts, conductance, off, account)
        return conductance, off, base

    def _settle_on_heavy_lines(
        self, base: Base, volts: FloatArray, conductance: FloatArray, off: FloatArray | None, account: Account
    ) -> tuple[FloatArray, FloatArray | None, Base]:
        """As :meth:`_settle`, after attenuation has given these conductances and this certificate.

        Kirchhoff's laws are more accurate if the lines are hardly more than leads; else the certificate is widened.
        """
        if self._board.lead_like:
            found = self._settle_by_leads(volts, base, account)
            if found is not None:
                return found
            off = None if off is None else np.full_like(off, inf)  # a first-order bound does not hold here
        elif off is not None:
            most = off * base.gain / max(1.0 - base.loss, LEAST_SHARE)
            off = self._board.within_linear_range(most, base.conductance) / base.gain
        return conductance, off, base

    def _settle_by_leads(
        self, volts: FloatArray, base: Base, account: Account
    ) -> tuple[FloatArray, FloatArray | None, Base] | None:
        """As :meth:`_settle`, by Kirchhoff's laws; None if these have no solution.

        Also decides whether the next frame begins with them.
        """
        found = self._by_leads(volts, base, account)
        self._heavy = found is not None and found.loss > 0.5 * HEAVY
        return None if found is None else (found.conductance, found.off, found)

    def _examined(
        self,
        transfer: FloatArray,
        conductance: FloatArray,
        levels: Levels,
        off: FloatArray | None,
        limited: BoolArray | None,
        disturbance: FloatArray | None,
    ) -> LiveReading:
        """The result for a frame with cells that are not valid, with the reasons. Arrays are (N, M), line coordinates.

        Args:
            transfer: S, the cells' own transfer conductances.
            conductance: S.
            levels: errors of the readings.
            off: S by which the transfer conductances may be off because of the model; None: negligible.
            limited: where a reading is at a limit; None: nowhere.
            disturbance: relative change by the cells at limits; None without such cells.

        """
        uncertainty, own = levels.uncertainties(transfer)
        by_readings = uncertainty
        reason = np.full(transfer.shape, UNCERTAIN, dtype=np.int8)
        if off is not None:
            uncertainty = uncertainty + off / np.maximum(transfer, levels.own)
            reason[uncertainty > by_readings * 1.5] = UNSETTLED
        if disturbance is not None:
            reason[disturbance > 0.5 * uncertainty] = DISTURBED
            uncertainty = uncertainty + disturbance
        reason[transfer <= levels.own] = NO_CURRENT
        if self._faults.any:
            conductance, uncertainty, own = self._faults.taken_out(conductance, uncertainty, own)
            reason[conductance == 0.0] = NO_CURRENT
        if limited is not None:
            uncertainty[limited], reason[limited] = inf, SATURATED
        if self._faults.any:
            uncertainty[self._faults.hidden], reason[self._faults.hidden] = inf, HIDDEN
        valid = self._rule.accepts(uncertainty)
        valid &= conductance > 0.0
        reason[valid] = 0
        bounds = None
        if limited is not None:
            off = np.minimum(own if disturbance is None else own + disturbance, 1.0)
            least = np.where(limited & (off < 1.0), conductance, 0.0) * (1.0 - off)
            bounds = least, np.full_like(conductance, inf)
        resistance = np.divide(1.0, conductance, out=np.full_like(conductance, inf), where=conductance > 0)
        resistance[np.isinf(uncertainty)] = np.nan
        return LiveReading(resistance, valid, reason, lambda: (uncertainty, own), bounds=bounds)


def _with_faint(limited: BoolArray | None, faint: BoolArray, transfer: FloatArray, levels: Levels) -> BoolArray | None:
    """Cells at limits, and those faint ones that may conduct more than a reading's error covers; None: no cells.

    An offset may push the outputs of open cells thousands of steps below the range. Arrays are (N, M).

    Args:
        limited: where a reading is at a limit; None: nowhere.
        faint: where a reading is at the limit of no current.
        transfer: S, the cells' own transfer conductances.
        levels: errors of the readings.

    """
    open_cells = faint & (transfer > levels.own)
    if not open_cells.any():
        return limited
    return open_cells if limited is None else limited | open_cells


class _Faults:
    """Known faults of the design: resistances in series with cells or in parallel with them."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._shunt = np.zeros(board.shape)  # S
        shunts = [fault for fault in board.shorts if fault.ohms > 0]
        for fault in shunts:
            self._shunt[fault.place] += siemens(fault.ohms)
        self.hidden = np.isinf(board.series_ohms)
        self.any = bool(board.series_ohms.any() or shunts)

    def taken_out(
        self, conductance: FloatArray, uncertainty: FloatArray, own: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Conductances (N, M) in S and relative uncertainties of the cells alone, without the known faults."""
        cells = cell_alone(self._board, conductance, self._shunt)
        uncertainty = np.minimum(uncertainty, BOUNDLESS)
        most = cell_alone(self._board, conductance * (1.0 + uncertainty), self._shunt)
        least = cell_alone(self._board, conductance * np.maximum(1.0 - uncertainty, 0.0), self._shunt)
        with np.errstate(divide="ignore", invalid="ignore"):
            alone = np.maximum(most - cells, cells - least) / cells
            grown = np.maximum(alone / uncertainty, 1.0)
        alone = np.where(np.isfinite(alone), alone, inf)
        return cells, alone, np.where(np.isfinite(alone), own * grown, 1.0)
