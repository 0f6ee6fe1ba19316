"""Cell resistances from the readings of one frame, to the last digits that these determine.

It is the live recovery (:mod:`._live`) of the same board behind a converter whose steps are the errors of double
precision, by the exact model, repeated until its steps have ended. What a cell is off, and whether it is the only
answer, is stated by the same laws and fits. At the end the readings of the recovered cells are computed once more: as
far as they differ from those that were measured, all errors are larger, and the recovery is done again.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, isfinite

import numpy as np
from numpy.typing import ArrayLike

from ...common.arrays import BoolArray, FloatArray
from ...common.measurement import Measurement
from ...errors import InputError, SolverError
from .._adc import adc_error
from .._board import Board
from .._design import Design
from .._exact import read_exactly
from .._parts import LEAST_SHORT_OHM
from .._sections import Adc
from .._tuning import PROBES_S
from ._known_board import KnownBoard
from ._live import live_inverse
from ._live_reading import LiveRecovery, Readings, Reason, ValidityRule
from ._recovered import Recovery, Status
from ._tuning import COARSER, FINER, FRAMES, KNOWN, READ_TOLERANCE, RECOVERY_MARGIN, ROUNDING, SIGMAS

_REFUSED = (
    "no cell resistances were found that give these readings; check that the design is that of the board, and that its "
    "circuit determines the cells"
)
_UNDRIVEN = "no reading depends on the cells; check that a selected row has another potential than the columns"


def recover(
    design: Design,
    volts: ArrayLike,
    *,
    accuracy: float = 1e-11,
    clipped: ArrayLike | None = None,
    least_ohm: float = 0.0,
) -> Recovery:
    """Recover the cell resistances of one frame from its readings.

    For a stream of frames use a :class:`Recoverer`.

    Args:
        design: the board, with the lines, faults, gains, offsets and bias currents that it has.
        volts: (rows, columns) V, as :func:`.scan` returns them.
        accuracy: relative error of the readings. A cell counts as read if its relative error is at most 10,000 times
            this accuracy.
        clipped: (rows, columns) True where the reading is at a limit of the converter. The limit is the nearer end of
            the range. Without an [adc] in the design, the reading may be at either limit. Outputs at a supply limit
            are recognised without this argument.
        least_ohm: lower bound in ohm of all cells; 0: none is known. It tells apart sets of cells with the same
            readings, and narrows what cells at a limit and behind a break leave open of the others.

    Raises:
        InputError: wrong shape, or NaN; or an accuracy or least_ohm out of range.
        SolverError: no cell resistances reproduce these readings, or the design does not determine the cells.

    """
    return Recoverer(design, accuracy=accuracy, least_ohm=least_ohm)(volts, clipped=clipped)


class Recoverer:
    """:func:`recover` for a stream of frames: each starts from the solution of the one before."""

    def __init__(self, design: Design, *, accuracy: float = 1e-11, least_ohm: float = 0.0) -> None:
        """As :func:`recover`."""
        if not 0 <= least_ohm < inf:
            raise InputError(f"least_ohm is {least_ohm}; expected ohm >= 0")
        if not 0 < accuracy < 1:
            raise InputError(f"accuracy is {accuracy}; expected a relative error between 0 and 1")
        self._design, self._board, self._accuracy = design, design.board, accuracy
        behind = _behind_fine_steps(design.board, accuracy)
        self._least_ohm = least_ohm
        self._exact = KnownBoard(behind, exact=True, least_short=max(least_ohm, LEAST_SHORT_OHM))
        try:
            self._live = self._begun()
        except InputError as error:
            raise SolverError(str(error)) from error
        self._error = adc_error(behind)
        self._joined = any(fault.ohms == 0 for fault in behind.shorts + behind.bridges)

    @np.errstate(divide="ignore", invalid="ignore")
    def _begun(self) -> LiveRecovery:
        """The live recovery, before its first frame."""
        return live_inverse(self._exact, ValidityRule(KNOWN, averages=inf), self._least_ohm)

    @np.errstate(divide="ignore", invalid="ignore")
    def __call__(self, volts: ArrayLike, *, clipped: ArrayLike | None = None) -> Recovery:
        """As :func:`recover`."""
        measured = _checked(self._design, volts)
        limited, under_range = self._limits(measured, clipped)
        largest = max(float(np.abs(measured).max()), abs(self._board.drive))
        noise = ROUNDING * largest / SIGMAS
        before = self._exact.model.evaluations
        bounded = np.zeros(measured.shape, dtype=np.bool_) if limited is None else limited
        if under_range is not None:  # an open cell may stand at a limit which is that of no current
            bounded = bounded | (under_range & (np.abs(measured - self._board.level) > self._error + SIGMAS * noise))
        error, found, solved = self._error + SIGMAS * noise, None, False
        while not solved and error <= READ_TOLERANCE * self._accuracy * largest:
            noise = (error - self._error) / SIGMAS
            found = self._repeated(Readings.of(measured, noise, limited=limited, under_range=under_range))
            off = 0.0 if bounded.any() or found is None else self._missed(found, measured)
            solved = found is not None and off <= error
            error = max(off, COARSER * error)
        if found is None:
            raise SolverError(_REFUSED)
        if not solved:  # these cells do not give the readings
            found = Measurement.unknown(measured.shape, Reason.UNCERTAIN)
        evaluations = self._exact.model.evaluations - before
        recovery = self._recovery(found, self._apparent(measured), bounded, evaluations)
        if (recovery.status == Status.OPEN).all():  # or nothing drives them: then other cells give the same readings
            others = np.full(measured.shape, 1.0 / PROBES_S[1])
            if np.abs(self._readings(others) - measured).max() <= self._error + SIGMAS * noise:
                raise SolverError(_UNDRIVEN)
        return recovery

    def _limits(self, volts: FloatArray, clipped: ArrayLike | None) -> tuple[BoolArray | None, BoolArray | None]:
        """Readings (rows, columns) at a limit whose cells conduct at least, and at most, what the readings say."""
        board, adc = self._board, self._design.adc
        top = bottom = np.zeros(volts.shape, dtype=np.bool_)
        if clipped is not None:
            at_limit = np.asarray(clipped, dtype=np.bool_)
            if at_limit.shape != volts.shape:
                raise InputError(f"clipped has shape {at_limit.shape}, expected {volts.shape} (rows, columns)")
            top = at_limit if adc is None else at_limit & (volts > sum(adc.range) / 2)
            bottom = at_limit if adc is None else at_limit & ~top
        low, high = board.supply
        rounding = ROUNDING * max((abs(limit) for limit in (low, high) if isfinite(limit)), default=0.0)
        top, bottom = top | (volts >= high - rounding), bottom | (volts <= low + rounding)
        if (board.drive > 0) == board.circuit.inverts:
            top, bottom = bottom, top
        bottom = bottom & ~top
        return top if top.any() else None, bottom if bottom.any() else None

    def _repeated(self, frame: Readings) -> Measurement | None:
        """The frame after as many repetitions as its steps take; None if they lead to no cells."""
        for _ in range(FRAMES):
            try:
                found = self._live(frame)
            except SolverError:
                self._live = self._begun()
                return None
            if np.isfinite(found.conductance).any() and not (found.reason == Reason.UNSETTLED).any():
                break
        return None if (found.reason == Reason.UNSETTLED).all() else found

    def _apparent(self, volts: FloatArray) -> FloatArray:
        """S (rows, columns), as if each cell were alone."""
        board = self._board
        apparent = board.circuit.apparent_conductance(board, board.transpose(volts) - board.level)
        return np.abs(board.transpose(apparent))

    def _missed(self, found: Measurement, volts: FloatArray) -> float:
        """V that the readings of the recovered cells are off, by the exact model; 0 where some are not known."""
        with np.errstate(divide="ignore"):
            cells = np.where(found.reason == Reason.NO_CURRENT, inf, 1.0 / np.maximum(found.conductance, 0.0))
        if np.isnan(cells).any():
            return 0.0
        return float(np.abs(self._readings(cells) - volts).max())

    def _readings(self, cells: FloatArray) -> FloatArray:
        """V (rows, columns) of cells in ohm, by the exact model."""
        transpose = self._board.transpose
        return transpose(read_exactly(self._board, transpose(cells))[0].volts)

    def _recovery(self, found: Measurement, apparent: FloatArray, bounded: BoolArray, evaluations: int) -> Recovery:
        """Resistances, status and uncertainties.

        Args:
            found: what the live recovery states.
            apparent: (rows, columns) S, as if each cell were alone.
            bounded: (rows, columns) readings that state bounds only.
            evaluations: of the model.

        """
        reason, worth = found.reason, READ_TOLERANCE * self._accuracy
        with np.errstate(invalid="ignore"):
            most = np.fmax(found.conductance, 0.0) * (1.0 + found.uncertainty)  # NaN where nothing is known
        opened = (reason == Reason.UNCERTAIN) & (found.uncertainty >= 1.0) & (most <= worth * apparent.max(initial=0.0))
        opened |= reason == Reason.NO_CURRENT
        known = opened | np.isin(reason, (Reason.VALID, Reason.UNCERTAIN))
        valued = np.isfinite(found.conductance) & (found.uncertainty < 1.0)
        status = np.where(valued & (found.uncertainty <= worth), Status.READ, Status.DISTURBED)
        # Beside cells of unknown size, or parts of 0 ohm, a reading of nothing does not say that its cell is open.
        status[opened & (known.all() and not self._joined)] = Status.OPEN
        status[(reason == Reason.SATURATED) | bounded] = Status.SATURATED
        status[reason == Reason.HIDDEN] = Status.HIDDEN
        valued &= np.isin(status, (Status.READ, Status.DISTURBED))
        opened = status == Status.OPEN
        with np.errstate(divide="ignore", invalid="ignore"):
            resistance = np.where(opened, inf, np.where(valued, 1.0 / found.conductance, np.nan))
        beside = bounded | (reason == Reason.HIDDEN)
        uncertainty = found.uncertainty * (RECOVERY_MARGIN if beside.any() else 1.0)
        uncertainty = np.where(opened, 0.0, np.where(valued, uncertainty, inf))
        return Recovery(resistance, status.astype(np.int8), uncertainty, evaluations)


def _behind_fine_steps(board: Board, accuracy: float) -> Board:
    """The board behind a converter whose largest error is that of a reading; only its step counts."""
    step = 2.0 * max(FINER * accuracy, ROUNDING) * abs(board.drive)
    return replace(board, adc=Adc(bits=1, range=(0.0, 2.0 * step)))


def _checked(design: Design, volts: ArrayLike) -> FloatArray:
    try:
        measured = np.array(volts, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"readings are not numbers: {error}") from error
    if measured.shape != design.array.shape:
        raise InputError(f"readings have shape {measured.shape}, expected {design.array.shape} (rows, columns)")
    if not np.isfinite(measured).all():
        row, column = np.argwhere(~np.isfinite(measured))[0]
        raise InputError(f"reading at row {row}, column {column} is {measured[row, column]}; expected finite volts")
    return measured
