"""Live recovery where all cells take part in every reading: Newton steps on shares with exact derivatives.

On dividers with floating rows no law of single columns holds. The unknown of a cell with the conductance G is its share

    q = G z / (1 + G z),

with the resistance z that its lines show it where nothing drives them: 0 for an open cell, 1 for a short. Readings are
nearly linear in shares from end to end, so that Newton's method takes three to ten steps from readings as if each cell
were alone. As in the laws of columns, cells that hardly conduct may come out below nothing.

With the derivatives J of the readings, in standard deviations of an ADC step's error, a step is (J'J + w)^-1 J' r: what
the readings determine follows them, and the rest stays within its range. For errors that are c times as large, the
covariance of the shares is (J'J / c^2 + w)^-1. One decomposition J'J = V diag(l) V' serves the steps and all c. What
derivatives leave out is computed by the model along the columns of V.

The derivatives are a matrix on small arrays, and on others a diagonal with two numbers for each line
(:mod:`._node_blocks`). A frame takes at most a fixed number of steps and of new derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from math import hypot, inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...common.measurement import Measurement
from ...errors import InputError, SolverError
from .._adc import adc_error
from .._board import cell_alone
from .._grid import exact_ports
from .._parts import LEAST_SHORT_OHM
from ._answers import several_answers
from ._known_board import KnownBoard
from ._law_kernels import TINY
from ._live_reading import DISTURBED, HIDDEN, NO_CURRENT, SATURATED, UNSETTLED, Readings, ValidityRule
from ._measured import constants_of
from ._node_blocks import WITHIN, NodeBlocks
from ._sheet_model import SheetModel
from ._tuning import (
    ALIKE,
    ALIKE_ERRORS,
    BESIDE_SLOW,
    BESIDE_STEP,
    BESIDE_STEPS,
    BY_STEPS,
    CALM,
    CONTRACTS,
    FIRST_RENEWALS,
    FIRST_STEPS,
    FIT_STEPS,
    FITS,
    JUMP,
    LARGE,
    LARGEST_MATRIX,
    LEAST_BEHIND,
    LEAST_CELL,
    LEAST_READING,
    LONGER,
    MISFIT,
    MORE_DAMPING,
    MOST_AXES,
    MOST_BESIDE,
    MOST_DAMPING,
    MOST_TIED,
    MOST_UNREAD,
    NEAR,
    NO_FIT,
    OFTEN,
    PATH_POINTS,
    PROGRESS,
    RENEWALS,
    SETTLED,
    SHARE_BESIDE,
    SHORT_SHARE,
    SHORT_SIEMENS,
    SHORTER,
    SIGMAS,
    SLOW,
    SLOWEST,
    SMALL_MATRIX,
    STUCK,
    SWING,
    TIE,
    TIES_LINES,
    TYPICAL,
    WIRES_AS_SHORT,
)
from ._usual_fits import UsualFits, changes_of, hold_lines, moved_by, shares_of, state_fitted

_NO_CELLS = "no cell resistances give these readings; check that the design is that of the board"


class _Linear(NamedTuple):
    """Derivatives and their regularised inverse at some cells; n = N M, flattened."""

    conductance: FloatArray
    """(n,) S of the cells"""
    share: FloatArray
    """(n,) of the cells"""
    behind: FloatArray
    """(n,) ohm, that each cell sees of its lines"""
    solve: Callable[[FloatArray, float], FloatArray]
    """from readings (n,) in V to changes (n,) of the shares, damped if they are longer than a limit (Levenberg 1944)"""
    std_at: Callable[[float], FloatArray]
    """(n,) standard deviations of the shares, by errors of the readings so many times those of ADC steps"""
    beyond_at: Callable[[float], FloatArray]
    """(n,) largest changes of the shares by what derivatives leave out, likewise"""
    known: dict[tuple[Callable[[float], FloatArray], int], FloatArray]
    """results of these"""
    inverse: FloatArray | None = None
    """(n, n) the matrix of ``solve``, transposed, where it was made"""
    amplified: float = inf
    """largest sum of the derivatives of a logarithm by those of all readings, where several answers are possible"""

    def std(self, coarser: float) -> FloatArray:
        """The same as ``std_at``, computed once for errors that are nearly alike; so too the next one."""
        return self._once(self.std_at, coarser)

    def beyond(self, coarser: float) -> FloatArray:
        return self._once(self.beyond_at, coarser)

    def _once(self, of_errors: Callable[[float], FloatArray], coarser: float) -> FloatArray:
        kept = of_errors, round(ALIKE_ERRORS * np.log(coarser))
        if kept not in self.known:
            self.known[kept] = of_errors(coarser)
        return self.known[kept]

    def changes(self, conductance: FloatArray, std: FloatArray) -> FloatArray:
        """(n,) change of the shares since then, over the largest one for which the derivatives serve."""
        by = np.empty(len(std))
        changes_of.unchecked(conductance, self.share, self.behind, std, by)
        return by

    def moved(self, conductance: FloatArray, step: FloatArray, coarser: float, most: FloatArray) -> FloatArray:
        """(n,) S, cells whose shares have changed by a ``step``; at most ``most`` (N, M)."""
        there = np.empty(most.shape)
        moved_by.unchecked(conductance, step, self.behind, self.std(coarser), most.ravel(), there.ravel())
        hold_lines.unchecked(there)
        return there.ravel()

    def shares(self, conductance: FloatArray) -> FloatArray:
        """(n,) of conductances (n,) in S."""
        return _shares(conductance, self.behind)


class FitLive:
    """Live recovery of boards without a port law, and of single frames that their law leaves open."""

    def __init__(self, known: KnownBoard, rule: ValidityRule, least_ohm: float) -> None:
        """For a board with a converter, whose cells have at least so many ohm, shorts apart.

        Raises:
            InputError: the board is too large.

        """
        board = known.board
        self._shape, self._turn, self._board = board.shape, board.transpose, known.sliced
        self._constants = constants_of(board, rule, alike=ALIKE)
        self._half_step = adc_error(board)
        self._std = self._half_step / sqrt(3.0)
        self._hidden, self._shunt = known.cut_off, known.shunt
        self._gone = self._hidden | np.isinf(board.series_ohms) | known.shorted
        self._present = ~(self._gone & ~self._hidden).ravel()  # else known to conduct nothing, or as a short does
        # What a network at the row's end has before its pull-down is part of the reading of a cell alone.
        of_end = board.row_lead[:, None] if board.described is not None else 0.0
        self._leads: FloatArray = np.maximum(sum(known.wires, np.zeros(board.shape)) - of_end, 0.0)
        self._quick = known.model
        self._sheet = SheetModel(known.whole, self._quick) if board.continuous else None
        self._model = self._quick if self._sheet is None else self._sheet
        self._cells = cells = board.shape[0] * board.shape[1]
        nodes = NodeBlocks(self._board, self._quick, self._std) if cells > SMALL_MATRIX else None
        self._nodes = nodes if nodes is not None and nodes.applies else None
        if cells > LARGEST_MATRIX and self._nodes is None:
            raise InputError(
                "the live recovery of boards with bridged lines, or with floating rows and broken lines, is for at "
                f"most {LARGEST_MATRIX} cells, and the array has {cells}; expected a smaller array, or no such fault"
            )
        ideal, most = (
            np.abs(board.circuit.ideal_volts(board, ohms) - board.level)
            for ohms in (self._leads, np.zeros(board.shape))
        )
        self._short, self._full = np.where(self._gone, inf, ideal), most  # V, of a short with and without leads
        if np.isfinite(board.supply).any():  # at the limit of an output every cell reads alike, if it conducts enough
            self._full = np.full(board.shape, inf)
        at_ends = np.maximum(board.row_ohms[:, :1] - of_end, 0.0) + board.column_lead
        at_ends = np.abs(board.circuit.ideal_volts(board, at_ends) - board.level)
        self._beyond = np.where(self._gone | board.circuit.virtual_ground, inf, at_ends)  # V, no cells read more
        per_volt = np.abs(board.circuit.conductance_slope(board, np.zeros(board.shape)))
        self._open = (LEAST_READING * self._half_step * per_volt).ravel()  # S, as good as open
        most = np.minimum(WIRES_AS_SHORT / (self._leads + LEAST_SHORT_OHM), SHORT_SIEMENS)
        if least_ohm:
            most = np.where(self._hidden, 1.0 / least_ohm, most)
        self._most = most
        self._several = several_answers(board) and not board.circuit.virtual_ground
        of_row = board.shape[1] / least_ohm if least_ohm else inf
        self._least_ohm = least_ohm
        self._lost = float(np.max(known.lines.to_driver)) * of_row  # share of a drive, at most
        self._conductance: FloatArray | None = None
        self._linear: _Linear | None = None
        self._read: FloatArray = np.ones(cells)
        self._pinned: FloatArray = np.zeros(cells)
        self._wide = False
        self._longest, self._gains = inf, True
        self._astray, self._in_vain, self._begun = False, 0, False
        self._still = False
        self.usual: Callable[[Readings], Measurement | None] | None = None
        self._calm = 0
        usual = cells <= MOST_BESIDE and self._sheet is None and not self._several
        if usual and UsualFits.serves(board):
            self.usual = UsualFits(board, self, self._constants, self._std)

    def __call__(self, frame: Readings) -> Measurement:
        """As :class:`.LiveRecovery`."""
        return self.read(frame.in_lines(self._turn))

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def read(self, frame: Readings, start: FloatArray | None = None) -> Measurement:
        """The same in line coordinates, beginning at conductances ``start`` (N, M) in S if they fit better.

        A reading that says no more than a bound does not count. A reading at a limit that no cell can pass, as a
        divider's at the drive, is one like any other.
        """
        volts, noise = frame.volts, frame.noise
        signal, error = np.abs(volts - self._board.level), self._half_step + SIGMAS * noise
        unread = self.unread(frame) | self._hidden
        small = self._cells <= MOST_BESIDE
        short = signal >= SHORT_SHARE * self._short
        # No way between two lines conducts better than a short of their ends.
        beyond = (signal > self._beyond + MISFIT * error) & ~unread
        # Several cells of unknown size may join lines whose readings are then alike, whatever the other cells are.
        unsized = np.count_nonzero(unread & ~self._hidden)
        several = unsized + bool(self._hidden.any()) > 1 and (
            unsized > MOST_UNREAD or self._cells > SMALL_MATRIX or bool(self._hidden.any()) or self._sheet is not None
        )
        large = not small and bool(unread.any())
        wide = self._nodes is not None and bool(short.any())  # beyond the structure of the lines
        if beyond.any() or several or large or (wide and not small):
            self._in_vain = self._in_vain + 1 if beyond.any() else 0
            if self._in_vain > OFTEN:
                raise SolverError(_NO_CELLS)
            return self._nothing(frame, DISTURBED, unread | short)
        read: FloatArray = np.where(unread.ravel(), 0.0, 1.0)
        if wide != self._wide or (read != self._read).any():
            self._linear = None
        self._wide, self._read = wide, read
        self._pinned = np.where((unread & ~self._hidden).ravel(), self._closed_start(volts.ravel()), self._open)
        coarser = hypot(1.0, noise / self._std)
        found = self._fit(volts.ravel(), coarser, start)
        if found is None:
            # Where steps have come to their end beside cells of unknown size, no further frame brings more.
            beside = short.any() or (self._still and unread.any())
            return self._nothing(frame, DISTURBED if beside else UNSETTLED, unread | short)
        conductance, misfit, left = found
        assert self._linear is not None
        std = self._linear.std(coarser)
        try:
            more = left + self._beside(conductance, unread.ravel(), coarser, self._linear, std)
        except np.linalg.LinAlgError:
            more = np.full(self._cells, inf)
        return self._reading(frame, conductance, coarser, misfit, more, unread)

    def unread(self, frame: Readings) -> BoolArray:
        """As :class:`._usual_fits.Fit`."""
        signal, error = np.abs(frame.volts - self._board.level), self._half_step + SIGMAS * frame.noise
        unread: BoolArray = np.zeros(self._shape, dtype=np.bool_)
        if frame.limited is not None:
            unread |= frame.limited & (signal + error < self._full)
        if frame.under_range is not None:  # a reading near zero is one like any other
            unread |= frame.under_range & (signal > error)
        return unread

    def bounds(self) -> tuple[FloatArray, ...]:
        """As :class:`._usual_fits.Fit`."""
        wide = np.full(self._shape, inf) if self._nodes is None else SHORT_SHARE * self._short
        return self._short, self._most, self._beyond, wide

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def kept(self, noise: float) -> tuple[FloatArray, ...] | None:
        """As :class:`._usual_fits.Fit`."""
        linear = self._linear
        if linear is None or self._conductance is None or self._astray or not self._read.all():
            return None
        if linear.inverse is None:
            if self._nodes is not None and self._calm < CALM:
                return None
            linear = self._linear = self._with_inverse(linear)
            if linear is None or linear.inverse is None:
                return None
        coarser = hypot(1.0, noise / self._std)
        found = linear.std(coarser), linear.beyond(coarser)
        return self._conductance, linear.share, linear.behind, linear.inverse, *found

    def follow(self, conductance: FloatArray) -> FloatArray:
        """As :class:`._usual_fits.Fit`."""
        self._conductance, self._in_vain = conductance, 0
        return conductance

    def _beside(
        self, conductance: FloatArray, unread: BoolArray, coarser: float, begun_by: _Linear, std: FloatArray
    ) -> FloatArray:
        """Changes (n,) of the shares while the cells ``unread`` (n,) have any conductance, from their least to a short.

        One cell, or those behind a break, go through points at equal distances of the share; between these the others
        may be beyond them by an eighth of their second differences. Several go through the corners of their intervals,
        many only through those where one or all are shorts, and the standard deviations (n,) there count in excess of
        ``std``. Where steps do not end, as many again count.

        Raises:
            numpy.linalg.LinAlgError: parts of the grid have no connection.

        """
        cells = np.flatnonzero(unread)
        most = np.zeros(len(conductance))
        if not len(cells):
            return most
        volts, begun = self._at(conductance), begun_by.shares(conductance)
        first, last = begun[cells], begun_by.shares(self._most.ravel())[cells]
        on_path = len(cells) == 1 or bool(self._hidden.any())
        each = [(part / PATH_POINTS,) * len(cells) for part in range(1, PATH_POINTS + 1)] if on_path else []
        there, path, linear = conductance, [begun], begun_by
        if len(cells) <= MOST_UNREAD:
            corners = list(product((0.0, 1.0), repeat=len(cells)))
        else:
            corners = [*map(tuple, np.eye(len(cells))), (1.0,) * len(cells)]
        for part in each or corners:
            share = first + (last - first) * np.array(part)
            held = np.minimum(share / (1.0 - share) / begun_by.behind[cells], self._most.ravel()[cells])
            there, linear = (there, linear) if on_path else (conductance, begun_by)
            there, before, step, anew = there.copy(), inf, begun, on_path and part[0] == 1.0
            there[cells] = held
            if anew:  # derivatives beside an open cell may tell nothing of those beside a short
                linear = self._renewed(there, coarser)
            for _ in range(BESIDE_STEPS):
                step = linear.solve((volts - self._at(there)) * self._read, inf)
                length = float(np.abs(step).max())
                if not (anew or length <= BESIDE_SLOW * before):
                    linear, before, anew = self._renewed(there, coarser), inf, True
                    continue
                there, before = linear.moved(there, step, coarser, self._most), length
                there[cells] = held
                enough = BESIDE_STEP * np.maximum(np.abs(begun), 0.0 if on_path else SHARE_BESIDE)
                if (np.abs(step) <= np.maximum(SETTLED * std, enough)).all():
                    break
            else:  # some are hardly determined, or this is beyond what the readings allow
                step *= BESIDE_STEPS
            path.append(begun_by.shares(there))
            change = np.abs(path[-1] - begun) + np.abs(step)
            if not on_path:
                change += BY_STEPS * np.maximum(self._renewed(there, coarser).std(coarser) - std, 0.0)
            most = np.maximum(most, change)
        if on_path:
            most += np.abs(np.diff(path, 2, axis=0)).max(axis=0) / 8.0
        return most

    def _closed_start(self, volts: FloatArray) -> FloatArray:
        """S (n,), as if each cell were alone."""
        signal = volts.reshape(self._shape) - self._board.level
        apparent = self._board.circuit.apparent_conductance(self._board, signal)
        apparent = cell_alone(self._board, apparent, self._shunt)
        conducting = apparent[apparent > 0.0]
        typical = float(np.median(conducting)) if conducting.size else TYPICAL
        alone = np.where(apparent > 1e-3 * typical, apparent, 0.1 * typical).ravel()
        start: FloatArray = np.minimum(alone, self._most.ravel())
        return start

    def _at(self, conductance: FloatArray) -> FloatArray:
        """V (n,), readings of the model at conductances (n,) in S; not finite where there are none."""
        try:
            volts: FloatArray = self._model(1.0 / conductance.reshape(self._shape)).ravel()
        except (SolverError, np.linalg.LinAlgError):
            return np.full(len(conductance), inf)
        return volts

    def _misfit(self, apart: FloatArray, coarser: float) -> float:
        """Half steps and noise: root mean square, or half of the largest if that is more."""
        most = float(np.abs(apart).max())
        return max(sqrt(float(apart @ apart) / len(apart)), 0.5 * most) / self._half_step / coarser

    def _fit(
        self, volts: FloatArray, coarser: float, start: FloatArray | None
    ) -> tuple[FloatArray, float, FloatArray] | None:
        """S (n,) that give the readings, whose errors are ``coarser`` than steps; misfit, and changes that are left.

        None: not settled.
        """
        steps, renewals = (FIT_STEPS, RENEWALS) if self._begun else (FIRST_STEPS, FIRST_RENEWALS)
        self._begun, self._still = True, False
        pinned = self._read == 0.0

        def off(conductance: FloatArray) -> FloatArray:
            return (volts - self._at(conductance)) * self._read

        starts = [self._closed_start(volts)]
        if start is not None:
            starts.insert(0, np.clip(start, LEAST_CELL, self._most).ravel())
        if self._conductance is not None:
            starts.insert(0 if self._gains else len(starts), self._conductance)
        starts = [np.where(pinned, self._pinned, each) for each in starts]
        if not self._gains:
            self._longest, self._linear = inf, None
        here = starts[0]
        apart = off(here)
        misfit = self._misfit(apart, coarser)
        for other in starts[1:] if self._gains and not misfit <= JUMP else ():
            steps -= 1
            if not misfit <= self._misfit(off(other), coarser):
                here, apart = other, off(other)
                misfit = self._misfit(apart, coarser)
        settled, before, begun, at_first = False, inf, self._linear, misfit
        left, further = np.zeros(len(here)), 1.0
        try:
            while np.isfinite(misfit):
                linear = self._linear
                change = inf if linear is None else float(linear.changes(here, linear.std(coarser)).max())
                if linear is None or change > 1.0:
                    if renewals == 0:
                        break
                    self._linear = linear = self._renewed(here, coarser)
                    renewals, change = renewals - 1, 0.0
                step = linear.solve(apart, inf)
                step[pinned] = 0.0
                left, length = np.abs(step), float(np.abs(step).max())
                further = _further(length / before)
                settled = bool((left <= np.minimum(SETTLED * linear.std(coarser), LARGE)).all())
                if settled:
                    break
                if length > self._longest:
                    step = linear.solve(apart, self._longest)
                    step[pinned] = 0.0
                if length > SLOW * before and change > NEAR and renewals:
                    self._linear, before = None, inf
                    continue
                trial = linear.moved(here, step, coarser, self._most)
                ahead, steps = off(trial), steps - 1
                while not ahead @ ahead < apart @ apart and steps > 0 and not (change > NEAR and renewals):
                    self._longest = SHORTER * float(np.abs(step).max())
                    step = linear.solve(apart, self._longest)
                    step[pinned] = 0.0
                    trial = linear.moved(here, step, coarser, self._most)
                    ahead, steps = off(trial), steps - 1
                if ahead @ ahead < apart @ apart:
                    here, apart, before = trial, ahead, length
                    misfit = self._misfit(apart, coarser)
                    self._longest = self._longest * LONGER if self._longest < 1.0 else inf
                elif change > NEAR and renewals:
                    self._linear, before = None, inf
                if steps <= 0:
                    break
        except np.linalg.LinAlgError:
            self._conductance = self._linear = None
            return None
        self._still = settled or self._longest < STUCK
        # Where readings hardly tell, steps need not end: what they have left is part of the uncertainty, as far as
        # derivatives hold.
        left *= further
        ends = settled or (misfit <= FITS and float(left.max()) <= SWING)
        ended, settled = settled, ends and misfit <= NO_FIT and self._linear is not None
        if self._sheet is not None and settled:
            settled = self._follow_sheet(here, coarser)
        self._conductance, self._astray = here, not settled
        # Cells from which steps lead nowhere are left for those of the closed formulas, from which they mostly do.
        self._gains = settled or not self._gains or misfit < PROGRESS * at_first
        self._calm = self._calm + 1 if settled and self._linear is begun else 0
        self._in_vain = self._in_vain + 1 if not misfit <= MISFIT else 0
        if self._in_vain > OFTEN:
            if not self._in_vain & (self._in_vain - 1):  # begin anew, each time with twice as many frames
                self._conductance = None
            # Cells of a few ohm tie lines to each other: then other cells, far from these, may give the readings.
            ties = not self._read.all() or float(here.max()) * TIE * float(self._board.reference.min()) > 1.0
            if self._still and self._in_vain > 3 * OFTEN and not ties:
                raise SolverError(_NO_CELLS)
        return (here, misfit, np.zeros(len(left)) if ended else left) if settled else None

    def _follow_sheet(self, conductance: FloatArray, coarser: float) -> bool:
        """Solve the continuous sheet anew if its cells have moved; False: the fit goes on in the next frame."""
        assert self._sheet is not None
        assert self._linear is not None
        log = np.log(np.maximum(conductance, LEAST_CELL))
        share = self._linear.shares(conductance)
        relative = self._linear.std(coarser) / np.maximum(share * (1.0 - share), TINY)
        if self._sheet.serves(log, SIGMAS * relative):
            return True
        self._sheet.solve(log)
        return False

    def _renewed(self, conductance: FloatArray, coarser: float) -> _Linear:
        """Make derivatives at these cells (n,) in S, for errors so many times those of ADC steps.

        Raises:
            numpy.linalg.LinAlgError: parts of the grid have no connection.

        """
        cells, behind = 1.0 / conductance.reshape(self._shape), self._behind(conductance)
        share = _shares(conductance, behind)
        per_share = self._per_share(cells, behind)
        if self._nodes is not None and self._read.all() and not self._wide:
            by_nodes = self._nodes.at(cells, per_share)
            std, nothing = by_nodes.std.ravel(), np.zeros(len(share))
            if self._cells > MOST_BESIDE or not (BY_STEPS * coarser * std > SWING).any():
                at = conductance, share, behind, by_nodes.solve
                return _Linear(*at, lambda coarser: coarser * std, lambda coarser: nothing, {})
        jacobian = self._jacobian(cells, per_share)
        values, readings, axes = _axes(jacobian)
        roots = values**2

        def solve(apart: FloatArray, longest: float) -> FloatArray:
            along, damping = values * (apart / self._std @ readings), WITHIN
            step: FloatArray = axes @ (along / (roots + damping))
            while not float(np.abs(step).max()) <= longest and damping < MOST_DAMPING * roots[0]:
                damping *= MORE_DAMPING
                step = axes @ (along / (roots + damping))
            return step

        def std_at(coarser: float) -> FloatArray:
            std: FloatArray = np.sqrt(axes**2 @ (1.0 / (roots / coarser**2 + WITHIN)))
            return std

        def beyond_at(coarser: float) -> FloatArray:
            beyond = self._beyond_linear(made, jacobian, roots, axes, coarser)
            # A cell between lines that others join may be as large, but ties nothing that is not tied.
            tied = (share > TIES_LINES) & (share + BY_STEPS * std_at(coarser) + beyond >= 1.0)
            return np.maximum(beyond, self._beside_tied(made, tied & self._present & (self._read > 0.0), coarser))

        amplified = inf
        if self._several and self._read.all():
            by_logs = jacobian * (share * (1.0 - share)) * self._std
            by_logs /= (self._at(conductance) - self._board.level)[:, None]
            amplified = float(np.abs(np.linalg.inv(by_logs)).sum(axis=1).max())
        made = _Linear(conductance, share, behind, solve, std_at, beyond_at, {}, amplified=amplified)
        return made

    def _beyond_linear(
        self, linear: _Linear, jacobian: FloatArray, roots: FloatArray, axes: FloatArray, coarser: float
    ) -> FloatArray:
        """Changes (n,) of the shares by what derivatives leave out, along the longest axes of their covariance.

        At both ends of an axis, as far as no cell falls below nothing, readings differ from those by the derivatives
        (n, n), and the cells follow these differences. Axes are independent, so that squares add up. Where steps do not
        end, as many again count.
        """
        swing, conductance = BY_STEPS / np.sqrt(roots / coarser**2 + WITHIN), linear.conductance
        ends = swing * axes * self._read[:, None]  # cells that are not read go through their own intervals
        longest = np.argsort(np.abs(ends).max(axis=0))[::-1][:MOST_AXES]
        squares, volts = np.zeros(len(roots)), None
        for axis in longest:
            along = ends[:, axis]
            if not float(np.abs(along).max()) > SWING:
                break
            volts = self._at(conductance) if volts is None else volts
            most = np.zeros(len(roots))
            for side in (1.0, -1.0):
                there = linear.moved(conductance, side * along, coarser, self._most)
                there = np.maximum(there, np.minimum(conductance, LEAST_CELL))
                read = volts + jacobian @ (linear.shares(there) - linear.share) * self._std
                steps = []
                for _ in range(2):
                    apart = (read - self._at(there)) * self._read / self._std
                    steps.append(axes @ ((axes.T @ (jacobian.T @ apart)) / (roots + WITHIN * coarser**2)))
                    there = linear.moved(there, steps[-1], coarser, self._most)
                first, second = np.abs(steps)
                slower = float(second.max()) / max(float(first.max()), TINY)
                most = np.maximum(most, first + _further(slower) * second)
            squares += most**2
        return np.sqrt(squares)

    def _beside_tied(self, linear: _Linear, tied: BoolArray, coarser: float) -> FloatArray:
        """Changes (n,) of the shares, with their errors, where two or more cells ``tied`` (n,) may be complete shorts.

        As one that ties lines is larger, readings tell less of the cells between these lines. Infinite where more cells
        may do so than are gone through.
        """
        count = np.count_nonzero(tied)
        if count < 2:
            return np.zeros(len(tied))
        if count > (MOST_TIED if self._cells <= SMALL_MATRIX else MOST_UNREAD) or self._sheet is not None:
            return np.full(len(tied), inf)
        read, self._read = self._read, np.where(tied, 0.0, self._read)
        try:
            begun, std = self._renewed(linear.conductance, coarser), linear.std(coarser)
            beside = self._beside(linear.conductance, tied, coarser, begun, std)
        except np.linalg.LinAlgError:
            beside = np.full(len(tied), inf)
        finally:
            self._read = read
        return beside

    def _behind(self, conductance: FloatArray) -> FloatArray:
        """Ohm (n,) that each of the cells (n,) in S sees of its lines where nothing drives them.

        A row that floats is held by the reading's resistor at most, so that a cell alone on it has a share, too. Lines
        that shorts join show a cell next to nothing: shares by which readings hardly change are no unknowns.
        """
        board, cells = self._board, np.maximum(conductance.reshape(self._shape), 0.0)
        held = 1.0 / board.pull + 1.0 / board.reference.mean()
        if not board.floating:
            held = 1.0 / (board.row_lead + LEAST_SHORT_OHM)
        end = 1.0 / (board.circuit.end_resistance(board) + LEAST_SHORT_OHM)
        along = cells.sum(axis=1, keepdims=True) + np.reshape(held, (-1, 1))
        down = cells.sum(axis=0) + end
        behind: FloatArray = 1.0 / np.maximum(along - cells, TINY) + 1.0 / np.maximum(down - cells, TINY)
        floor = LEAST_BEHIND * float(board.reference.mean())
        return np.maximum(behind, floor).ravel()

    def _per_share(self, cells: FloatArray, behind: FloatArray) -> FloatArray:
        """S (N, M) of the crosspoints by the shares of their cells (N, M) in ohm."""
        alone: FloatArray = (cells / (cells + self._board.series_ohms)) ** 2
        alone *= (1.0 + behind.reshape(self._shape) / cells) ** 2 / behind.reshape(self._shape)
        return alone

    def _jacobian(self, cells: FloatArray, per_share: FloatArray) -> FloatArray:
        """Derivatives (n, n) of readings, in standard deviations of a step's error, by shares; cells (N, M) in ohm."""
        return self._derivatives(cells) * (per_share.ravel() / self._std * self._read) * self._read[:, None]

    def _with_inverse(self, linear: _Linear) -> _Linear | None:
        """The same with the matrix of ``solve``; None where there is none."""
        cells = 1.0 / linear.conductance.reshape(self._shape)
        try:
            jacobian = self._jacobian(cells, self._per_share(cells, linear.behind))
            normal = jacobian.T @ jacobian + WITHIN * np.eye(len(jacobian))
            inverse = np.linalg.solve(normal, jacobian.T / self._std)
        except np.linalg.LinAlgError:
            return None
        return linear._replace(inverse=np.ascontiguousarray(inverse.T))

    def _one_answer(self, conductance: FloatArray) -> bool:
        """Whether no other cells give the readings, where idle columns conduct more than those that are read.

        Without leads of the rows there is one answer (:func:`.several_answers`). The selected row's lead takes a share
        of at most L of the drive; the derivative of its logarithm by those of all cells, together, is no larger. If A
        is the largest sum of derivatives of a cell's logarithm by those of all readings, another answer lies within
        A L, where A L < 1/2 makes the map from one's losses to the other's cells a contraction.
        """
        assert self._linear is not None
        in_range = float(conductance.max()) * self._least_ohm <= 1.0
        return in_range and self._linear.amplified * self._lost < CONTRACTS

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
        self,
        frame: Readings,
        conductance: FloatArray,
        coarser: float,
        misfit: float,
        beside: FloatArray,
        unread: BoolArray,
    ) -> Measurement:
        """Values, uncertainties, validity and reasons of cells (n,) in S that give the readings."""
        board, shape, linear = self._board, self._shape, self._linear
        assert linear is not None
        signal = np.abs(frame.volts - board.level)
        slope = np.abs(board.circuit.log_conductance_slope(board, signal * np.sign(board.drive)))
        more = linear.beyond(coarser) + beside
        if self._several and (unread.any() or not self._one_answer(conductance)):
            more = np.full(len(more), inf)
        if self._sheet is not None:
            share = linear.shares(conductance)
            more = more + self._sheet.doubt(np.log(np.maximum(conductance, LEAST_CELL))) * share * (1.0 - share)
        under_range: BoolArray = np.zeros(shape, dtype=np.bool_)
        if frame.under_range is not None:
            under_range = frame.under_range
        measured, per_volt = Measurement.unknown(frame.each.shape), np.where(slope > 0.0, slope, inf)
        made_at, behind = linear.share.reshape(shape), linear.behind.reshape(shape)
        std, changes = linear.std(coarser).reshape(shape), more.reshape(shape)
        state_fitted.unchecked(
            *(frame.volts, board.level, conductance.reshape(shape), made_at, behind, std, changes, per_volt, misfit),
            *(self._short, unread, under_range, self._gone, self._std, self._constants),
            *(frame.noise, frame.usual, frame.each, measured.block, measured.reason),
        )
        return measured

    def _nothing(self, frame: Readings, why: int, limited: BoolArray) -> Measurement:
        """A frame that determines no cell; ``limited`` (N, M): readings at a limit."""
        reason: NDArray[np.int8] = np.full(self._shape, why, dtype=np.int8)
        reason[limited] = SATURATED
        if frame.under_range is not None:
            reason[frame.under_range] = NO_CURRENT
        reason[self._gone] = HIDDEN
        nothing = Measurement.unknown(frame.each.shape)
        nothing.reason[...] = self._turn(reason)
        return nothing


def _shares(conductance: FloatArray, behind: FloatArray) -> FloatArray:
    """(n,) of conductances (n,) in S, whose lines show them so many ohm (n,)."""
    shares = np.empty(len(conductance))
    shares_of.unchecked(conductance, behind, shares)
    return shares


def _further(slower: float) -> float:
    """What steps have left in all, over the last one, whose ratio to the one before is ``slower``."""
    return 1.0 / (1.0 - slower) if slower < SLOWEST else float(BESIDE_STEPS)


def _axes(jacobian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Singular values (n,) of derivatives (n, n), and the matrices (n, n) of their left and right vectors.

    Raises:
        numpy.linalg.LinAlgError: the derivatives are not finite.

    """
    if not np.isfinite(jacobian).all():
        raise np.linalg.LinAlgError("derivatives that are not finite")
    left, values, right = np.linalg.svd(jacobian)
    return values, left, right.T
