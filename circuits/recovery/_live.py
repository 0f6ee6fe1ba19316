"""Readings to cells at a board's own rate: deferred correction from frame to frame, with a bounded cost per frame.

:mod:`._recover` inverts the circuit model to many digits, whatever it costs. A board that is read a thousand times a
second needs less: its readings come in steps of the converter, and hardly change from one frame to the next. So a
live recovery keeps a *base*: conductances, and what the circuit model makes of them. The cells of a new frame follow
from the base and the change of the readings. The base moves only where the change is so large that the result would be
off by a share of an ADC step, and at most :data:`_EVALUATIONS` times in one frame. When that is not enough, the cells
that are not settled are not valid in this frame, and the next one goes on from where this one ended.

Two kinds of boards have a live recovery of their own (:func:`live_recovery`):

* **amplifiers on plain grids** (:class:`_AmplifiedLive`): a reading is a cell's conductance times an attenuation by
  its lines, and the attenuation changes little. Line attenuation with its certificate is the model, and the exact
  transfer where the certificate asks for it;
* **all others** up to :data:`LARGEST_COUPLED` cells (:class:`_CoupledLive`): regularised Gauss-Newton steps with
  the derivatives of all readings by all cells, kept as long as they serve. The prior keeps what the readings do not
  determine near where it was, and the posterior covariance tells which cells these are.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from ...arrays import BoolArray, FloatArray
from ...errors import InputError, SolverError
from .._adc import adc_error
from .._board import Board, broken_off, cell_alone
from .._design import Design
from .._exact import read_exactly
from .._sensitivity import board_sensitivity
from ..solvers import Attenuated, Lines, Wires, attenuate, exact_transfer, siemens
from ._recover import Recoverer, Status

LARGEST_COUPLED = 1024  # cells; beyond, a matrix of all readings by all cells no longer serves a frame's time
_EVALUATIONS = 4  # of the circuit model in one frame, at most
_SHARE_OF_STEP = 0.25  # of an ADC step that the model may leave as its own error
_MARGIN = 2.0  # by which intervals from first-order bounds on unknown cells are widened
_PRIOR = 3.0  # standard deviation of the logarithm of a conductance before anything is read: a factor of 20
_UNKNOWN = 8.0  # the same for a cell that a fault hides
_SETTLED = 0.3  # posterior standard deviations that a further step would change a cell by
_UNSETTLED = 3.0  # half steps between readings and model beyond which a fit says nothing yet
_MISFIT = 8.0  # half steps between readings and model beyond which no cells give these readings
_LEAST_SHARE = 1e-9  # of the largest conductance: an open cell's stand-in, so that every ratio is defined
_FAR = 0.1  # relative change since the derivatives were made from which on they no longer serve
_FIRST_EFFORT = 40, 8  # evaluations and derivatives that the first frame of all may take
_SIGMAS = 4.0  # posterior standard deviations that an uncertainty covers
_BOUNDLESS = 1e6  # relative change of a conductance that counts for any larger one
_LOOSE = 0.1  # standard deviation of a cell that the readings do not determine: where it is does not matter
_SAME = 1e-3  # relative change of the misfit by a step that gained nothing
_FITS = 0.8  # half steps between readings and model that rounding alone makes
_STRIDE = 1.5  # most change of the logarithm of a conductance in one step


_READ, _OPEN, _SATURATED, _DISTURBED, _HIDDEN = (int(status) for status in Status)  # looking them up takes 1 us each


class LiveReading(NamedTuple):
    """Cells of one frame. Arrays are (rows, columns)."""

    resistance: FloatArray
    """ohm; inf for open cells, NaN where nothing is known"""
    uncertainty: FloatArray
    """relative half-width of the interval that the conductance lies in: half an ADC step of every reading, and what
    cells that are not known can make of this one; inf where nothing is known"""
    own_step: FloatArray
    """relative change of the conductance for half an ADC step of the cell's own reading: no reading tells more"""
    status: NDArray[np.int8]
    """a :class:`Status` each"""


class LiveRecovery(Protocol):
    """Frame after frame of one board."""

    def __call__(self, volts: FloatArray, limited: BoolArray) -> LiveReading:
        """The cells behind readings (rows, columns) in V; ``limited`` where these are at a limit.

        Raises:
            SolverError: no cells give these readings.

        """
        ...


def live_recovery(design: Design) -> LiveRecovery:
    """The recovery that suits a board with a converter.

    Raises:
        InputError: the design has no [adc].

    """
    if design.adc is None:
        raise InputError("the design has no [adc] section; expected bits and range")
    board = design.board
    complete_short = any(fault.ohms == 0 for fault in board.shorts)
    amplified = board.circuit.ends(board) is not None and not board.floating and board.plain and not complete_short
    lines = (board.row_ohms, board.column_ohms, board.column_lead)
    if amplified and all(np.isfinite(part).all() for part in lines):
        return _AmplifiedLive(board)
    if not board.continuous and board.shape[0] * board.shape[1] <= LARGEST_COUPLED and not complete_short:
        return _CoupledLive(board)
    return _ThoroughLive(design)


class _Base(NamedTuple):
    """Where an amplified board's frames start from. Arrays are (N, M) in line coordinates."""

    conductance: FloatArray
    """S"""
    transfer: FloatArray
    """S, transfer conductances by the circuit model"""
    gain: FloatArray
    """change of a conductance per change of its transfer conductance: what the lines take of the cell's own current"""


class _Anchor(NamedTuple):
    """An exact solution: what attenuation misses there, and the certified bound on it. Arrays are (N, M) in S."""

    missing: FloatArray
    bound: FloatArray

    def scaled(self, bound: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What attenuation misses where the bound on it is another one, and about how far that can be off.

        The bound follows what is missed within a factor that depends little on the conductances (1.1 to 3 on ordinary
        boards); half of the change is allowed for what it does not follow.
        """
        missing = self.missing * (bound / self.bound)
        return missing, 0.5 * np.abs(missing - self.missing)


class _AmplifiedLive:
    """Amplifiers that hold all columns of a plain grid, rows grounded.

    With T the transfer conductances, output V_ij = output_j + slope_j (drive T_ij - s_j sum_k T_kj + c_j). The s_j are
    the sources behind the columns' ends, and c_j is the current between columns whose sources differ, to first order in
    the row resistance.
    """

    def __init__(self, board: Board) -> None:
        adc, ends = board.design.adc, board.circuit.ends(board)
        assert adc is not None
        assert ends is not None
        self._board = board
        self._output, self._source = ends.output, ends.source
        self._per_volt = 1.0 / ends.slope  # A/V
        self._alike = bool((ends.source == ends.source[0]).all())
        resistance = ends.resistance + board.column_lead
        with np.errstate(divide="ignore"):
            self._lines = Lines(board.lines.row, board.lines.column, 1.0 / resistance)
        self._wires = Wires.of(self._lines)
        self._to_driver = np.cumsum(board.row_ohms, axis=1)
        behind = np.concatenate([board.column_ohms[1:], resistance[None]])
        self._to_amplifier = np.cumsum(behind[::-1], axis=0)[::-1]
        self._half_step = adc_error(board.design) * np.abs(self._per_volt / board.drive)  # S (M,), of T
        self._tolerance = _SHARE_OF_STEP * adc.step * np.abs(self._per_volt / board.drive)  # S (M,), of T
        self._step, self._middle = adc.step, sum(adc.range) / 2
        swing = max((abs(limit - board.level) for limit in board.supply if np.isfinite(limit)), default=inf)
        self._most_per_ohm = (1.0 + swing / abs(board.drive)) / board.reference  # S (M,) into a saturated column's end
        self._ideal = not (self._to_driver.any() or board.column_ohms.any())
        shunts = [fault for fault in board.shorts if fault.ohms > 0]
        self._shunt = np.zeros(board.shape)
        for fault in shunts:
            self._shunt[fault.place] += siemens(fault.ohms)
        self._faulty = bool(board.series_ohms.any() or shunts)
        self._hidden = np.isinf(board.series_ohms)
        self._base: _Base | None = None
        self._anchor: _Anchor | None = None

    def __call__(self, volts: FloatArray, limited: BoolArray) -> LiveReading:
        if not self._board.turned:
            return self._read(volts, limited)
        turn = self._board.turn
        found = self._read(turn(volts), turn(limited))
        return LiveReading(turn(found.resistance), turn(found.uncertainty), turn(found.own_step), turn(found.status))

    def _read(self, volts: FloatArray, limited: BoolArray) -> LiveReading:
        transfer = np.maximum(self._transfer(volts), 0.0)
        conductance, gain, unsettled = self._settle(transfer)
        half_step = self._half_step * gain  # S of the cell; of T, a part may be other cells' current
        known = np.maximum(conductance, half_step)
        own_step = half_step / known
        uncertainty = self._by_lines(half_step)
        uncertainty += own_step + self._tolerance * gain / known
        status = (conductance == 0).astype(np.int8)  # open, else read
        if unsettled is not None:
            uncertainty += unsettled * gain / known
            status[unsettled > self._tolerance] = _DISTURBED
        if limited.any():
            uncertainty += self._by_unknown(conductance, volts, limited)
            uncertainty[limited] = inf
            status[limited] = _SATURATED
        if self._faulty:
            conductance = cell_alone(self._board, conductance, self._shunt)
            uncertainty[self._hidden] = inf
            status[self._hidden] = _HIDDEN
        resistance = np.divide(1.0, conductance, out=np.full_like(conductance, inf), where=conductance > 0)
        resistance[np.isinf(uncertainty)] = np.nan
        return LiveReading(resistance, uncertainty, own_step, status)

    def _transfer(self, volts: FloatArray) -> FloatArray:
        """S (N, M): transfer conductances from outputs in V."""
        board, source = self._board, self._source
        current: FloatArray = (volts - self._output) * self._per_volt
        if not source.any():
            current /= board.drive
            return current
        rows, between = len(volts), np.zeros_like(source)
        if not self._alike and self._base is not None:
            known = self._base.transfer
            lead = self._to_driver[:, 0]
            lifted = lead * (known @ source)  # V of each row per V of the sources, to first order
            between = lifted @ known - source * ((lead * known.sum(axis=1)) @ known)
        total = (current.sum(axis=0) - rows * between) / (board.drive - rows * source)
        result: FloatArray = (current + source * total - between) / board.drive
        return result

    def _settle(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Conductances (N, M) in S, and their change per change of T.

        Where the frame's budget did not suffice, also the S by which T may be off.
        """
        if self._ideal:  # columns are independent: T = G / (1 + R sum G), R the resistance of a column's end
            gain = 1.0 / np.maximum(1.0 - self._to_amplifier[0] * transfer.sum(axis=0), _LEAST_SHARE)
            return transfer * gain, np.broadcast_to(gain, transfer.shape), None
        if self._base is None:
            self._base = self._based_on(transfer)
        for _ in range(_EVALUATIONS):
            conductance, off = self._from_base(transfer)
            if (off <= self._tolerance).all():
                return conductance, self._base.gain, None
            self._base = self._based_on(conductance)
        conductance, off = self._from_base(transfer)
        return conductance, self._base.gain, off

    def _from_base(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Conductances (N, M) in S, and the S by which T may be off for them."""
        assert self._base is not None
        change = (transfer - self._base.transfer) * self._base.gain
        conductance = np.maximum(self._base.conductance + change, 0.0)
        return conductance, self._moved(transfer, np.abs(change))

    def _moved(self, transfer: FloatArray, change: FloatArray) -> FloatArray:
        """S (N, M) by which T may be off after such a change (N, M) of the conductances in S."""
        return transfer * self._by_lines(change)

    def _by_lines(self, change: FloatArray) -> FloatArray:
        """Bound on the relative change of each T_ij, to first order, by what lines take of changed conductances."""
        row: FloatArray = np.einsum("ij,ij->i", self._to_driver, change)
        column: FloatArray = np.einsum("ij,ij->j", self._to_amplifier, change)
        return row[:, None] + column

    def _based_on(self, conductance: FloatArray) -> _Base:
        """One evaluation of the circuit model: attenuation, with what it misses taken from an exact solution nearby."""
        floor = _LEAST_SHARE * max(float(conductance.max()), 1e-12)
        conductance = np.maximum(conductance, floor)
        known = None if self._wires is None else attenuate(conductance, self._wires)
        transfer = self._by_model(conductance, known)
        own = transfer if known is None else known.transfer  # without the current of other cells
        return _Base(conductance, transfer, conductance / np.maximum(own, 1e-300))

    def _by_model(self, conductance: FloatArray, known: Attenuated | None) -> FloatArray:
        """S (N, M): transfer conductances, by attenuation ``known`` where its error is small or was found before."""
        if known is None:
            return exact_transfer(conductance, self._lines)[0]
        bound = known.error
        if (bound <= self._tolerance).all():
            return known.transfer
        if self._anchor is not None:
            missing, off = self._anchor.scaled(bound)
            if (off <= self._tolerance).all():
                return known.transfer + missing
        transfer, _ = exact_transfer(conductance, self._lines)
        self._anchor = _Anchor(transfer - known.transfer, bound)
        return transfer

    def _by_unknown(self, conductance: FloatArray, volts: FloatArray, limited: BoolArray) -> FloatArray:
        """Relative change of each cell while those whose reading is at a limit take any value that they can have."""
        low, high = self._board.supply
        at_high, at_low = volts >= high - self._step, volts <= low + self._step
        upper = at_high | ((volts > self._middle) & ~at_low)
        more_current = upper == ((self._board.drive > 0) != self._board.circuit.inverts)
        conducts_less = limited & ~more_current
        change = self._by_lines(np.where(conducts_less, conductance, 0.0))
        conducts_more = limited & more_current
        if conducts_more.any():
            change += self._by_shorts(conductance, conducts_more, conducts_more & (at_high | at_low))
        return change

    def _by_shorts(self, conductance: FloatArray, unknown: BoolArray, saturated: BoolArray) -> FloatArray:
        """Relative change of each cell while ``unknown`` ones go from what reaches their limit up to a short.

        ``saturated``: those whose amplifier, not only the converter, is at a limit.

        To first order in the lines' losses, each effect bounded on its own and all of them added up:

        * along its row, a short takes the drive from all cells: to_driver / to_amplifier, like a divider. Where its
          output is at a limit, its column ends in the reference resistor instead, which leaves it little current;
        * down its column, a short into an idle row takes their current: to_amplifier / to_driver;
        * a column that the current of row k lifts also lifts the short's row, whose cells then add to row k's readings;
        * the offset of its column's amplifier drives a current through it, in all steps alike, and lifts its row;
        * in its own step, the short lifts its column, and that the other rows, whose cells add to its row's readings.
        """
        board = self._board
        with np.errstate(divide="ignore", invalid="ignore"):
            along = np.where(unknown, np.nan_to_num(self._to_driver / self._to_amplifier, nan=0.0, posinf=inf), 0.0)
            down = np.where(unknown, np.nan_to_num(self._to_amplifier / self._to_driver, nan=0.0, posinf=inf), 0.0)
        own = np.where(saturated, 0.0, along).sum(axis=1)[:, None] + down.sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            short = np.where(unknown, 1.0 / (self._to_driver + self._to_amplifier), 0.0)
            held = np.where(saturated, np.fmin(along, self._to_driver * self._most_per_ohm), 0.0)
        most = np.where(unknown, np.minimum(short, _BOUNDLESS), conductance)
        lifts = most @ np.where(unknown, self._to_amplifier, 0.0).T
        takes = unknown @ (self._to_driver * most).T
        np.fill_diagonal(lifts, 0.0)
        np.fill_diagonal(takes, 0.0)
        added = (lifts + takes) @ np.where(unknown, 0.0, conductance)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = np.abs(self._source / board.drive)
            added += np.nan_to_num(offset * short.sum(axis=0), nan=0.0, posinf=inf)
        added += offset * (unknown.any(axis=1) @ conductance)
        floor = np.maximum(conductance, _LEAST_SHARE * max(float(conductance.max()), 1e-12))
        direct: FloatArray = _MARGIN * (own + added / floor) + held.sum(axis=1)[:, None]
        # Cells that are misjudged load their lines otherwise than the model has it, and that concerns all cells there.
        misjudged = np.where(unknown, 0.0, np.minimum(direct, _BOUNDLESS) * conductance)
        return direct + self._by_lines(misjudged)


class _CoupledBase(NamedTuple):
    """Where a coupled board's frames start from, in line coordinates; n = N M, flattened."""

    log: FloatArray
    """(n,) logarithm of the conductances"""
    volts: FloatArray
    """(n,) V that the model makes of them"""
    gain: FloatArray
    """(n, n): regularised inverse of the derivatives, from readings in standard deviations to changes of ``log``"""
    std: FloatArray
    """(n,) posterior standard deviation of ``log``"""
    others: FloatArray
    """(n,) change of ``log`` if all hidden cells change by _UNKNOWN"""


class _CoupledLive:
    """Regularised Gauss-Newton steps for boards on which each reading depends on many cells.

    Unknowns are the logarithms x of the conductances, so that none becomes negative. Readings count in standard
    deviations of an ADC step's error: r = (measured - model) / (half step / sqrt 3). With J = dr/dx and the prior's
    standard deviation s, a step is (J'J + 1/s^2)^-1 J' r (Levenberg, Marquardt; the Bayesian update of a linear model
    with a broad prior about the last estimate). What the readings determine follows them; what they do not stays. The
    covariance (J'J + 1/s^2)^-1 says which is which.
    """

    def __init__(self, board: Board) -> None:
        assert board.design.adc is not None
        self._board = board
        self._half_step = adc_error(board.design)
        self._noise = self._half_step / np.sqrt(3.0)  # V, standard deviation of an error within a step
        self._shape = board.shape
        self._mixes = board.circuit.mixes_cells or board.floating
        self._hidden = (broken_off(board) | np.isinf(board.series_ohms)).ravel()
        self._base: _CoupledBase | None = None
        self._x: FloatArray | None = None  # where the last frame ended
        self._begun = False
        self._from_fresh_start = False  # and not come to a fit since

    def __call__(self, volts: FloatArray, limited: BoolArray) -> LiveReading:
        turn = self._board.turn
        found = self._read(turn(volts), turn(limited))
        return LiveReading(turn(found.resistance), turn(found.uncertainty), turn(found.own_step), turn(found.status))

    def _read(self, volts: FloatArray, limited: BoolArray) -> LiveReading:
        if limited.any() or (self._mixes and self._hidden.any()):
            # A cell beyond its limit may be a short, and what that does to all others no derivative at the limit tells.
            return self._nothing(limited)
        measured = volts.ravel()
        start = self._x
        if start is None:
            start = self._start(volts)
            self._from_fresh_start = True
        if self._base is None or self._x is None:
            self._base = self._based_on(start)
        effort = (_EVALUATIONS, 1) if self._begun else _FIRST_EFFORT
        self._begun = True
        x, left, misfit, stalled = self._solve(measured, start, *effort)
        self._x, base = x, self._base
        if misfit <= _UNSETTLED:
            self._from_fresh_start = False
        elif misfit > _MISFIT and stalled:
            self._x = None  # the next frame starts anew
            if self._from_fresh_start:
                raise SolverError("no cell resistances give these readings; check that the design is that of the board")
        conductance = np.exp(x)
        signal = np.abs(measured - self._board.level)
        slope = self._board.circuit.log_conductance_slope(self._board, volts - self._board.level)
        own_step = self._half_step * np.abs(slope).ravel()
        own_step[slope.ravel() == 0] = 1.0
        # Readings that fit worse than an ADC step lets them make the whole fit less certain, by as much.
        uncertainty = np.maximum(_SIGMAS * base.std * max(1.0, misfit), own_step) + np.abs(left) + base.others
        open_cells = signal <= self._half_step
        status = np.where(open_cells, _OPEN, _READ).astype(np.int8)
        if misfit > _UNSETTLED:  # the frame's budget did not suffice, or no cells give quite these readings
            status[:], uncertainty[:] = _DISTURBED, inf
        gone = self._hidden
        status[gone] = _HIDDEN
        uncertainty[gone | (uncertainty > 1.0)] = inf
        with np.errstate(divide="ignore"):
            resistance = 1.0 / conductance
        resistance[gone] = np.nan
        resistance[open_cells & ~gone] = inf
        shape = self._shape
        return LiveReading(
            resistance.reshape(shape), uncertainty.reshape(shape), own_step.reshape(shape), status.reshape(shape)
        )

    def _solve(
        self, measured: FloatArray, x: FloatArray, evaluations: int, renewals: int
    ) -> tuple[FloatArray, FloatArray, float, bool]:
        """Logarithms (n,) of the conductances, the change that a further step would make, the misfit, and whether the
        last step has hardly changed it.

        Args:
            measured: (n,) V.
            x: (n,) where to start.
            evaluations: of the circuit model, at most.
            renewals: of the derivatives, which cost many evaluations, at most.

        """
        assert self._base is not None
        misfit, stalled = inf, False
        for count in range(evaluations):
            volts = self._model(x)
            left = self._step(measured - volts)
            last, misfit = misfit, self._misfit(measured - volts)
            stalled = abs(misfit - last) <= _SAME * misfit
            far = float(np.abs(x - self._base.log).max()) > _FAR
            if misfit <= _FITS and self._serves(left) and not far:
                break
            if count < evaluations - 1:
                if renewals and (far or misfit > _FITS):
                    renewals -= 1
                    self._base = self._based_on(x)
                    left = self._step(measured - volts)
                x = x + left
        return x, left, misfit, stalled

    def _nothing(self, limited: BoolArray) -> LiveReading:
        """A frame that tells of no cell."""
        status = np.where(limited, _SATURATED, _DISTURBED).astype(np.int8)
        status[self._hidden.reshape(self._shape)] = _HIDDEN
        unknown = np.full(self._shape, inf)
        return LiveReading(np.full(self._shape, np.nan), unknown, np.ones(self._shape), status)

    def _misfit(self, apart: FloatArray) -> float:
        """Half steps between readings and model (n,): root mean square, or half of the largest if that is more."""
        steps = np.abs(apart) / self._half_step
        return max(float(np.sqrt(np.mean(steps**2))), 0.5 * float(steps.max()))

    def _serves(self, left: FloatArray) -> bool:
        """Whether a further step would move no cell that the readings determine by more than its own uncertainty."""
        assert self._base is not None
        std = self._base.std
        determined = (std <= _LOOSE) & (self._base.others <= _LOOSE)
        return bool((np.abs(left) <= np.maximum(_SETTLED * std, 1e-6))[determined].all())

    def _step(self, volts: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms for a difference (n,) of the readings in V."""
        assert self._base is not None
        change: FloatArray = self._base.gain @ (volts / self._noise)
        return np.clip(change, -_STRIDE, _STRIDE)

    def _start(self, volts: FloatArray) -> FloatArray:
        apparent = self._board.circuit.apparent_conductance(self._board, volts - self._board.level)
        typical = float(np.median(apparent[apparent > 0])) if (apparent > 0).any() else 1e-5
        start: FloatArray = np.log(np.where(apparent > 1e-3 * typical, apparent, 0.1 * typical)).ravel()
        return start

    def _model(self, x: FloatArray) -> FloatArray:
        """V (n,) of the readings."""
        return read_exactly(self._board, np.exp(-x).reshape(self._shape))[0].volts.ravel()

    def _based_on(self, x: FloatArray) -> _CoupledBase:
        """Derivatives and their regularised inverse at x (n,)."""
        found = board_sensitivity(self._board, np.exp(-x).reshape(self._shape))
        in_series = 1.0 / (np.exp(-x) + self._board.series_ohms.ravel())  # S of the cell and an open-cell fault
        jacobian = found.cell_conductance.reshape(len(x), len(x)) * (in_series**2 * np.exp(-x) / self._noise)
        prior = np.where(self._hidden, _UNKNOWN, _PRIOR)
        normal = jacobian.T @ jacobian
        normal[np.diag_indices_from(normal)] += prior**-2.0
        try:
            inverse = cho_solve(cho_factor(normal, overwrite_a=True), np.eye(len(x)))
        except LinAlgError as error:
            raise SolverError("the readings do not determine the cells at all") from error
        std = np.sqrt(np.maximum(np.diagonal(inverse), 0.0))
        loose = self._hidden
        # Of the covariance with the hidden cells: how far each cell follows when all of them go to their ends.
        others = np.abs(inverse[:, loose] / std[loose] ** 2).sum(axis=1) * _UNKNOWN if loose.any() else np.zeros(len(x))
        return _CoupledBase(x, found.volts.ravel(), inverse @ jacobian.T, std, others)


class _ThoroughLive:
    """By :class:`._recover.Recoverer`, whatever it costs: continuous sheets, complete shorts, large coupled boards."""

    def __init__(self, design: Design) -> None:
        self._design, self._recover = design, Recoverer(design, accuracy=1e-6)
        self._half_step = adc_error(design)

    def __call__(self, volts: FloatArray, limited: BoolArray) -> LiveReading:
        found = self._recover(volts, clipped=limited)
        board = self._design.board
        slope = board.turn(board.circuit.log_conductance_slope(board, board.turn(volts) - board.level))
        own_step = self._half_step * np.abs(slope)
        return LiveReading(found.resistance, found.uncertainty + own_step, own_step, found.status)
