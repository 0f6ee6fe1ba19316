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
from ._law_kernels import ALIKE, BY_NOISE, BY_STEPS, TINY
from ._live_reading import (
    DISTURBED,
    HIDDEN,
    NO_CURRENT,
    SATURATED,
    SIGMAS,
    UNSETTLED,
    Readings,
    ValidityRule,
)
from ._measured import constants_of
from ._node_blocks import NodeBlocks
from ._sheet_model import SheetModel
from ._usual_fits import (
    FAR,
    HARDLY_KNOWN,
    NO_FIT,
    SETTLED,
    SHORT_SHARE,
    SMALL,
    STRIDE,
    UsualFits,
    each_distance,
    each_tied,
    state_fitted,
)

STEPS, FIRST_STEPS = 5, 60
"""evaluations of the model in one frame, and in the first one of all"""
RENEWALS, FIRST_RENEWALS = 2, 20
"""new derivatives in one frame, and in the first one of all"""
LARGEST_MATRIX = 4096
"""cells up to which a matrix of all readings by all cells is made: 0.3 GB"""
MOST_BESIDE = 256
"""cells up to which they are one beside shorts and cells that nothing reads, which no structure fits"""
_SMALL = 100  # cells up to which the derivatives are a matrix
_PRIOR = 3.0  # standard deviation of a logarithm before anything is read: a factor of 20
_ALIKE_ERRORS = 20.0  # inverse of the relative change of the readings' errors up to which covariances are alike
_GAINS = 0.9  # misfit after a step over the one before, from which on steps bring nothing more
_FITS, _MISFIT = 0.8, 8.0  # half steps: by rounding alone, no cells give these readings
_NEAR = 0.02  # change of a logarithm for which new derivatives are alike
_DAMPED, _UNDAMPED, _MORE_DAMPED = 0.01, 1e-3, 5.0  # first, least and times the damping after steps that lead away
_SLOW = 0.2  # length of a step over the one before, above which derivatives are to blame
_STEEPER = 3.0  # largest ratio of slopes by which derivatives are adapted
_JUMP = 20.0  # half steps from which on closed formulas may be a nearer start
_LEAST_READING = 0.03  # half steps: reading of the least conductance alone; below, nothing would lead back
_LARGEST = 50.0  # logarithm that is as good as infinite
_AS_SHORT = 1e3  # wires of a cell over its own resistance, from which on no reading tells it from a short
_TIE = 0.02  # cell over the reference resistor, below which it ties lines to each other
_NO_CELLS = "no cell resistances give these readings; check that the design is that of the board"
_MOST_BENT = 1.5  # growth of an effect over the linear one, from which on a cell's size is open
_OPEN_SIZE = 3.0  # most by which a conductance may be larger, from which on the scale of its column is open
_BESIDE = 0.01  # conductance over the largest one of a column, from which on a cell of unknown size counts beside it
_OPENS = 0.1  # conductance of cells of unknown size over that of their column's end; derivatives leave its square out
_TIES = 0.1  # share of a row's drive that a cell may take, from which on it ties the row to its column
_MOST_TIED = 3  # cells whose intervals are gone through, corner by corner
_PATH = 4  # points on the way of a cell of unknown size to a short
_CORNER_STEPS, _CORNER_STEP = 8, 0.02  # steps to the cells at a corner, and change of a logarithm in the last one
_TIED_STD = 0.4  # of the logarithm of such a cell: not valid, but derivatives are made anew when it moves
_TIED_MOVES = 2.0  # most by which it may have moved by then
_POWERS = 8  # iterations to the error by which cells together tie their lines most
_SWING, _SINGLY = 0.3, 2.0  # of a logarithm: up to which derivatives hold, and from which on a cell's size is open
_OFTEN = 3  # frames with readings that no cells give, after which the design is taken for wrong
_CONTRACTS = 0.5  # factor of a map that surely has one fixed point, with room for derivatives that change
_CALM = 3  # frames by the same derivatives, after which those of many cells are worth a matrix
_TYPICAL = 1e-5  # S, of a cell if no reading shows a conductance
_NOTHING = np.empty((0, 0))


class _Spread(NamedTuple):
    """What errors of the readings leave open of n logarithms."""

    std: FloatArray
    """(n,) standard deviations; infinite where derivatives do not tell"""
    by_derivatives: FloatArray
    """(n,) the same by derivatives alone: finite, for steps on the way"""
    solve: Callable[[FloatArray], FloatArray] | None
    """from readings (n,) in V to changes (n,) of the logarithms of cells that may have any size; None: not made"""
    follow: FloatArray | None = None
    """(n, n) the matrix of ``solve``, transposed, where it was made"""


class _Linear(NamedTuple):
    """Derivatives and their regularised inverse at some cells; n = N M, flattened."""

    log: FloatArray
    """(n,) logarithms of the conductances"""
    solve: Callable[[FloatArray, float], FloatArray]
    """from readings (n,) in V to changes (n,) of the logarithms, by a factor of damping (Marquardt 1963)"""
    slope: FloatArray
    """(n,) 1/V, of each logarithm by its own reading if the cell were alone"""
    spread_at: Callable[[float], _Spread]
    """by errors of the readings so many times those of ADC steps"""
    behind: FloatArray
    """(n,) ohm, that each cell sees of its lines where nothing drives them"""
    known: dict[float, _Spread]
    """results of ``spread_at``"""
    inverse: FloatArray | None = None
    """(n, n) the matrix of ``solve``, transposed, where it was made"""
    amplified: float = inf
    """largest sum of the derivatives of a logarithm by those of all readings, where several answers are possible"""

    def spread(self, coarser: float) -> _Spread:
        """The same, computed once for errors that are nearly alike."""
        kept = round(_ALIKE_ERRORS * np.log(coarser))
        if kept not in self.known:
            self.known[kept] = self.spread_at(coarser)
        return self.known[kept]

    def std(self, coarser: float) -> FloatArray:
        """(n,) standard deviations of the logarithms."""
        return self.spread(coarser).std

    def of_steps(self, coarser: float) -> FloatArray:
        """(n,) the same, by derivatives where these do not tell: steps end there, too."""
        spread = self.spread(coarser)
        return np.where(np.isfinite(spread.std), spread.std, spread.by_derivatives)

    def left(self, apart: FloatArray, coarser: float) -> FloatArray:
        """(n,) change of the logarithms by readings (n,) in V that are left, if hardly known cells follow them."""
        solve = self.spread(coarser).solve
        return np.zeros(len(apart)) if solve is None else solve(apart)

    def distance(self, log: FloatArray, std: FloatArray) -> FloatArray:
        """(n,) change of the logarithms since then, of which their own errors count only as they tie lines."""
        by = np.empty(len(log))
        each_distance.unchecked(log, self.log, std, self.behind, by)
        return by

    def tied(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """(n,) by how much cells tie their lines at ``other`` logarithms than at ``one``."""
        by = np.empty(len(one))
        each_tied.unchecked(one, other, self.behind, by)
        return by


class _Corners(NamedTuple):
    """What cells of unknown size that tie lines leave of the others; arrays are (n,)."""

    log: FloatArray
    """logarithms of the conductances at which it was found"""
    tied: BoolArray
    """the cells of unknown size"""
    read: FloatArray
    """1 for readings that count"""
    least: FloatArray
    """logarithms at which their intervals begin"""
    coarser: float
    """errors of the readings over those of ADC steps"""
    std: FloatArray
    """standard deviations of the logarithms"""

    def serve(self, log: FloatArray, tied: BoolArray, read: FloatArray, least: FloatArray, coarser: float) -> bool:
        """Whether they do at other cells, whose intervals begin at ``least``."""
        if not np.array_equal(tied, self.tied) or not np.array_equal(read, self.read) or coarser > self.coarser:
            return False
        known = ~tied & ((self.std <= HARDLY_KNOWN) | np.isinf(self.std))
        far = bool((np.abs(log - self.log)[known] > FAR).any())
        return not far and bool((least[tied] >= self.least[tied]).all())


class FitLive:
    """Live recovery of boards without a port law, and of single frames that their law leaves open."""

    def __init__(self, known: KnownBoard, rule: ValidityRule, least_ohm: float) -> None:
        """For a board with a converter, whose cells have at least so many ohm, shorts apart.

        Raises:
            InputError: the board is too large.

        """
        board = known.board
        self._shape, self._turn, self._board = board.shape, board.turn, known.sliced
        self._constants = constants_of(board, rule, alike=ALIKE)
        self._half_step = adc_error(board)
        self._std = self._half_step / sqrt(3.0)
        self._hidden, self._shunt = known.cut_off, known.shunt
        self._gone = self._hidden | np.isinf(board.series_ohms) | known.shorted
        self._present = ~(self._gone & ~self._hidden).ravel()  # else known to conduct nothing, or as a short does
        self._leads: FloatArray = sum(known.wires, np.zeros(board.shape))
        self._quick = known.model
        self._sheet = SheetModel(known.whole, self._quick) if board.continuous else None
        self._model = self._quick if self._sheet is None else self._sheet
        self._cells = cells = board.shape[0] * board.shape[1]
        nodes = NodeBlocks(self._board, self._quick, self._std) if cells > _SMALL else None
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
        at_ends = np.abs(board.circuit.ideal_volts(board, board.row_ohms[:, :1] + board.column_lead) - board.level)
        self._beyond = np.where(self._gone | board.circuit.virtual_ground, inf, at_ends)  # V, no cells read more
        per_volt = np.abs(board.circuit.conductance_slope(board, np.zeros(board.shape)))
        self._least = np.log(_LEAST_READING * self._half_step * per_volt).ravel()
        most = _AS_SHORT / (self._leads + LEAST_SHORT_OHM)
        if least_ohm:
            most = np.where(self._hidden, 1.0 / least_ohm, most)
        self._most = np.log(most).ravel()
        self._several = several_answers(board) and not board.circuit.virtual_ground
        of_row = board.shape[1] / least_ohm if least_ohm else inf
        self._least_ohm = least_ohm
        self._lost = float(np.max(known.lines.to_driver)) * of_row  # share of a drive, at most
        self._log: FloatArray | None = None
        self._linear: _Linear | None = None
        self._read: FloatArray = np.ones(cells)
        self._pinned: FloatArray = np.zeros(board.shape)
        self._wide = False
        self._corners: _Corners | None = None
        self._damping, self._astray, self._in_vain, self._begun = 0.0, False, 0, False
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
        beyond = (signal > self._beyond + _MISFIT * error) & ~unread
        # Several cells of unknown size may join lines whose readings are then alike, whatever the other cells are.
        unsized = np.count_nonzero(unread & ~self._hidden)
        several = unsized + bool(self._hidden.any()) > 1 and (
            unsized > _MOST_TIED or self._cells > _SMALL or bool(self._hidden.any()) or self._sheet is not None
        )
        large = not small and bool(unread.any())
        wide = self._nodes is not None and bool(short.any())  # beyond the structure of the lines
        if beyond.any() or several or large or (wide and not small):
            self._in_vain = self._in_vain + 1 if beyond.any() else 0
            if self._in_vain > _OFTEN:
                raise SolverError(_NO_CELLS)
            return self._nothing(frame, DISTURBED, unread | short)
        read: FloatArray = np.where(unread.ravel(), 0.0, 1.0)
        if wide != self._wide or (read != self._read).any():
            self._linear = None
        self._wide, self._read, lowest = wide, read, self._least.reshape(self._shape)
        self._pinned = np.where(unread & ~self._hidden, self._closed_start(volts.ravel()).reshape(self._shape), lowest)
        found = self._fit(volts.ravel(), hypot(1.0, noise / self._std), start)
        if found is None:
            # Where steps have come to their end beside cells of unknown size, no further frame brings more.
            beside = short.any() or (self._still and unread.any())
            return self._nothing(frame, DISTURBED if beside else UNSETTLED, unread | short)
        log, std, left, misfit = found
        return self._reading(frame, log, std, misfit, self._spread(log, unread) + np.abs(left), unread)

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
        least, most = self._least.reshape(self._shape), self._most.reshape(self._shape)
        return self._short, least, most, self._beyond, wide

    def kept(self, noise: float) -> tuple[FloatArray, ...] | None:
        """As :class:`._usual_fits.Fit`."""
        linear = self._linear
        if linear is None or self._log is None or self._astray or not self._read.all():
            return None
        if linear.inverse is None:
            if self._nodes is not None and self._calm < _CALM:
                return None
            linear = self._linear = self._with_inverse(linear)
            if linear is None or linear.inverse is None:
                return None
        spread = linear.spread(hypot(1.0, noise / self._std))
        follow = _NOTHING
        if spread.solve is not None and (spread.std > HARDLY_KNOWN).any():
            follow = linear.inverse if spread.follow is None else spread.follow
        return self._log, linear.log, linear.behind, linear.inverse, spread.std, follow

    def follow(self, log: FloatArray) -> FloatArray:
        """As :class:`._usual_fits.Fit`."""
        self._log, self._in_vain = log, 0
        return log

    def _spread(self, log: FloatArray, unread: BoolArray) -> FloatArray:
        """Change (n,) of the logarithms over all conductances of the cells ``unread``, from their least to a short.

        The others follow their readings, by steps with the derivatives at hand, through points at which the cell ties
        its lines by equal differences; infinite where steps do not end. Between points they may be beyond them by an
        eighth of their second differences.
        """
        if not unread.any() or np.count_nonzero(unread & ~self._hidden) > 1:  # several: by their corners
            return np.zeros(log.shape)
        assert self._linear is not None
        volts, known = self._at(log), self._linear.std(1.0) <= HARDLY_KNOWN
        cell, behind = np.flatnonzero(unread), self._linear.behind
        first, last = (1.0 / (1.0 + np.exp(-ends[cell]) / behind[cell]) for ends in (log, self._most))
        path, most = [log], np.zeros(log.shape)
        for part in range(1, _PATH + 1):
            there, share = path[-1].copy(), first + (last - first) * part / _PATH
            there[cell] = np.log(share / ((1.0 - share) * behind[cell])) if part < _PATH else self._most[cell]
            for _ in range(_CORNER_STEPS):
                step = self._linear.solve((volts - self._at(there)) * self._read, 0.0)
                there = there + np.clip(step, -STRIDE, STRIDE)
                left = np.abs(step)
                if left[known].max(initial=0.0) < _CORNER_STEP:
                    break
            else:
                return np.full(log.shape, inf)
            path.append(there)
            most = np.maximum(most, np.abs(there - log) + left)
        most += np.abs(np.diff(path, 2, axis=0)).max(axis=0) / 8.0
        return most

    def _closed_start(self, volts: FloatArray) -> FloatArray:
        """Logarithms (n,) as if each cell were alone."""
        signal = volts.reshape(self._shape) - self._board.level
        apparent = self._board.circuit.apparent_conductance(self._board, signal)
        apparent = cell_alone(self._board, apparent, self._shunt)
        conducting = apparent[apparent > 0.0]
        typical = float(np.median(conducting)) if conducting.size else _TYPICAL
        alone = np.log(np.where(apparent > 1e-3 * typical, apparent, 0.1 * typical)).ravel()
        start: FloatArray = np.minimum(alone, self._most)
        return start

    def _at(self, log: FloatArray) -> FloatArray:
        """V (n,), readings of the model."""
        volts: FloatArray = self._model(np.exp(-log).reshape(self._shape)).ravel()
        return volts

    def _misfit(self, apart: FloatArray, coarser: float) -> float:
        """Half steps and noise: root mean square, or half of the largest if that is more."""
        most = float(np.abs(apart).max())
        return max(sqrt(float(apart @ apart) / len(apart)), 0.5 * most) / self._half_step / coarser

    def _fit(
        self, volts: FloatArray, coarser: float, start: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray, float] | None:
        """Logarithms (n,), their standard deviation by ADC steps, change that is left, (n,) each, and the misfit.

        None: not settled.
        """
        steps, renewals = (STEPS, RENEWALS) if self._begun else (FIRST_STEPS, FIRST_RENEWALS)
        self._begun, self._still = True, False
        signal = volts.reshape(self._shape) - self._board.level
        slope = np.abs(self._board.circuit.log_conductance_slope(self._board, signal)).ravel()
        pinned = self._read == 0.0

        def within(log: FloatArray) -> FloatArray:
            return np.where(pinned, self._pinned.ravel(), np.clip(log, self._least, self._most))

        def off(log: FloatArray) -> FloatArray:
            return (volts - self._at(log)) * self._read

        starts = [within(self._closed_start(volts))]
        if start is not None:
            starts.insert(0, within(np.log(np.maximum(start, 1e-30)).ravel()))
        try:
            log = starts.pop(0) if self._log is None else within(self._log)
            apart = off(log)
            misfit = self._misfit(apart, coarser)
            for other in starts if misfit > _JUMP else ():
                other_apart = off(other)
                steps -= 1
                if self._misfit(other_apart, coarser) < misfit:
                    log, apart, misfit = other, other_apart, self._misfit(other_apart, coarser)
            still, before, begun, gains = False, inf, self._linear, True
            while True:
                linear = self._linear
                if linear is None or linear.distance(log, linear.of_steps(coarser)).max() > FAR:
                    if renewals == 0:
                        break
                    linear, renewals = self._renewed(log), renewals - 1
                    self._linear = linear
                std = linear.of_steps(coarser)
                step = within(log + self._step(linear, apart, slope)) - log
                loose = (std > HARDLY_KNOWN) & (linear.tied(log, log + step) <= FAR)
                if misfit <= _FITS:  # cells that readings hardly tell would hop, and carry the others with them
                    step = np.where(loose, 0.0, step)
                small = (np.abs(step) <= np.maximum(SETTLED * std, SMALL)) | loose
                if small.all() and (misfit <= _FITS or not gains):
                    still = misfit <= _FITS or self._damping < _UNDAMPED
                    if still:
                        break
                length = float(np.abs(step).max())
                near = linear.distance(log, std).max() <= _NEAR
                if length > _SLOW * before and not near and renewals and misfit > _FITS:
                    self._linear = None
                    before = inf
                    continue
                if steps <= 0:
                    break
                steps -= 1
                trial = within(log + step)
                ahead = off(trial)
                now = self._misfit(ahead, coarser)
                if now > max(misfit, _FITS) and ahead @ ahead > apart @ apart:
                    if not near and renewals:
                        self._linear = None
                    else:
                        self._damping = max(_MORE_DAMPED * self._damping, _DAMPED)
                    before = inf
                    continue
                self._damping = self._damping / _MORE_DAMPED if self._damping > _UNDAMPED else 0.0
                gains = now < _GAINS * misfit
                if not (gains or near) and renewals:
                    self._linear, gains = None, True
                log, apart, misfit, before = trial, ahead, now, length
        except np.linalg.LinAlgError:
            self._log = self._linear = None
            return None
        settled = still and (misfit <= _FITS or (misfit <= NO_FIT and self._only_loose(apart, coarser)))
        if self._sheet is not None and settled:
            settled = self._follow_sheet(log, coarser)
        self._log, self._astray, self._still = log, not settled, still
        self._calm = self._calm + 1 if settled and self._linear is begun else 0
        self._in_vain = self._in_vain + 1 if misfit > _MISFIT else 0
        if self._in_vain > _OFTEN:
            if not self._in_vain & (self._in_vain - 1):  # begin anew, each time with twice as many frames
                self._log = None
            # Cells of a few ohm tie lines to each other: then other cells, far from these, may give the readings.
            ties = not self._read.all() or float(np.exp(-log).min()) < _TIE * float(self._board.reference.min())
            if still and self._in_vain > 3 * _OFTEN and not ties:
                raise SolverError(_NO_CELLS)
        if not settled or self._linear is None:
            return None
        moved = np.exp(np.minimum(np.abs(log - self._linear.log), 1.0))
        return log, self._linear.std(coarser) * moved, self._linear.left(apart, coarser), misfit

    def _only_loose(self, apart: FloatArray, coarser: float) -> bool:
        """Whether what is ``apart`` (n,) in V is hardly known cells' alone, and leaves the others where they are.

        What a cell at a limit leaves of other readings is not: it stands elsewhere in its interval.
        """
        if self._linear is None or not self._read.all():
            return False
        std = self._linear.std(coarser)
        left = np.abs(self._linear.left(apart, coarser)) > np.maximum(SETTLED * std, SMALL)
        return not (left & (std <= HARDLY_KNOWN)).any()

    def _follow_sheet(self, log: FloatArray, coarser: float) -> bool:
        """Solve the continuous sheet anew if its cells have moved; False: the fit goes on in the next frame."""
        assert self._sheet is not None
        assert self._linear is not None
        if self._sheet.serves(log, SIGMAS * self._linear.std(coarser)):
            return True
        self._sheet.solve(log)
        return False

    def _step(self, linear: _Linear, apart: FloatArray, slope: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms. A cell's own nonlinearity is known in closed form, and scales its reading.

        So scaled, a step may lead away from the readings however short it is: damped ones follow the derivatives.
        """
        if self._damping == 0.0:
            both = (linear.slope > 0.0) & (slope > 0.0)
            steeper = np.divide(slope, linear.slope, out=np.ones(len(slope)), where=both)
            apart = apart * np.clip(steeper, 1.0 / _STEEPER, _STEEPER)
        return np.clip(linear.solve(apart, self._damping), -STRIDE, STRIDE)

    def _renewed(self, log: FloatArray) -> _Linear:
        """Make derivatives at these cells.

        Raises:
            numpy.linalg.LinAlgError: parts of the grid have no connection.

        """
        from scipy.linalg.lapack import dpotrs

        cells = self._cells_at(log)
        volts = self._quick(cells)
        slope = np.abs(self._board.circuit.log_conductance_slope(self._board, volts - self._board.level)).ravel()
        if self._nodes is not None and self._read.all() and not self._wide:
            by_nodes = self._nodes.at(cells, np.full(self._shape, _PRIOR))
            std = by_nodes.std.ravel()

            def spread(coarser: float) -> _Spread:
                return _Spread(coarser * std, coarser * std, by_nodes.solve)

            return _Linear(log, by_nodes.solve, slope, spread, self._behind(cells), {})
        jacobian, factor = self._normal(cells)

        def solve(apart: FloatArray, damping: float = 0.0) -> FloatArray:
            used = _factored(jacobian, damping) if damping else factor
            step: FloatArray = dpotrs(used, jacobian.T @ (apart / self._std), lower=1)[0]
            return step

        amplified = inf
        if self._several and self._read.all():
            by_logs = jacobian * (self._std / (volts - self._board.level).reshape(-1, 1))
            amplified = float(np.abs(np.linalg.inv(by_logs)).sum(axis=1).max())
        behind = self._behind(cells)
        return _Linear(
            log, solve, slope, lambda coarser: self._spread_of(log, jacobian, coarser), behind, {}, None, amplified
        )

    def _behind(self, cells: FloatArray) -> FloatArray:
        """Ohm (n,) that each of the cells (N, M) in ohm sees of its lines.

        What an idle column does without an end matters where rows float: else these hold what it joins.
        """
        board = self._board
        idle_row = 1.0 / board.pull if board.floating else 1.0 / (board.row_lead + LEAST_SHORT_OHM)[:, None]
        adrift = board.floating and board.circuit.columns_one_by_one(board)
        end = 0.0 if adrift else 1.0 / (board.circuit.end_resistance(board) + LEAST_SHORT_OHM)
        conductance = 1.0 / cells
        along, down = conductance.sum(axis=1, keepdims=True) + idle_row, conductance.sum(axis=0) + end
        behind: FloatArray = sum(1.0 / np.maximum(of_line - conductance, TINY) for of_line in (along, down))
        return behind.ravel()

    def _normal(self, cells: FloatArray, read: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Derivatives (n, n) at cells (N, M) in ohm, in errors of a reading, and their normal matrix, factored.

        Raises:
            numpy.linalg.LinAlgError: the derivatives are not finite.

        """
        read = self._read if read is None else read
        in_series = 1.0 / (cells + self._board.series_ohms).ravel()
        jacobian = self._derivatives(cells) * (in_series**2 * cells.ravel() / self._std * read) * read[:, None]
        return jacobian, _factored(jacobian)

    def _with_inverse(self, linear: _Linear) -> _Linear | None:
        """The same with the matrix of ``solve``; None where there is none."""
        from scipy.linalg.lapack import dpotrs

        try:
            jacobian, factor = self._normal(np.exp(-linear.log).reshape(self._shape))
        except np.linalg.LinAlgError:
            return None
        return linear._replace(inverse=np.ascontiguousarray(dpotrs(factor, jacobian.T / self._std, lower=1)[0].T))

    def _spread_of(self, log: FloatArray, jacobian: FloatArray, coarser: float) -> _Spread:
        """Standard deviations (n,) of the logarithms with derivatives (n, n) in errors of a reading, ``coarser`` ones.

        Two cells of unknown size that tie lines to each other, or whose readings say no more than a bound, are beyond
        derivatives. Such cells are moved through their intervals, from corner to corner, while the others follow all
        other readings. The changes of the others count as errors. Infinite where nothing is known of the others.

        Raises:
            numpy.linalg.LinAlgError: the derivatives are not finite.

        """
        std, tied, least, inverse = self._std_within(log, jacobian / coarser, self._read)
        unread = (self._read == 0.0) & ~self._hidden.ravel()
        tied |= unread
        least = np.where(unread, self._pinned.ravel() - _TIED_MOVES, least)
        places = np.flatnonzero(tied)
        by_derivatives: FloatArray = np.sqrt(np.einsum("ij,ij->i", inverse, inverse))
        if len(places) < 2 or not np.isfinite(std).any():
            std = np.hypot(std, self._beyond_linear(log, inverse, jacobian, coarser))
            follow = (jacobian @ inverse) @ inverse.T / (coarser**2 * self._std)
            return _Spread(std, by_derivatives, follow.T.__matmul__, follow)
        if len(places) > _MOST_TIED or self._cells > _SMALL or self._sheet is not None:
            return _Spread(np.full(len(std), inf), by_derivatives, None)
        kept = self._corners
        if kept is None or not kept.serve(log, tied, self._read, least + _TIED_MOVES, coarser):
            beside = self._beside_tied(log, places, least, coarser)
            kept = self._corners = _Corners(log, tied, self._read, least, coarser, beside)
        std = np.where(tied, _TIED_STD, kept.std * np.exp(np.abs(log - kept.log)))
        return _Spread(std, by_derivatives, None)

    def _beside_tied(self, log: FloatArray, places: NDArray[np.intp], least: FloatArray, coarser: float) -> FloatArray:
        """Standard deviations (n,) of the others while cells ``places`` are anywhere from ``least`` (n,) to a short.

        Infinite where the other readings do not determine the others at each corner.
        """
        from scipy.linalg.lapack import dpotrs

        volts, read = self._at(log), self._read.copy()
        read[places] = 0.0
        shift, most = np.zeros((2, len(log)))
        try:
            for ends in product(*zip(least[places], self._most[places], strict=True)):
                there, step = log.copy(), np.full(len(log), inf)
                there[places] = ends
                for _ in range(_CORNER_STEPS):
                    matrix, factor = self._normal(self._cells_at(there), read)
                    apart = (volts - self._at(there)) * read
                    step = dpotrs(factor, matrix.T @ (apart / self._std), lower=1)[0]
                    step *= min(1.0, STRIDE / max(float(np.abs(step).max()), TINY))
                    there = np.clip(there + step, self._least, self._most)
                    there[places] = ends
                    if float(np.abs(step).max()) < _CORNER_STEP:
                        break
                matrix = self._normal(self._cells_at(there), read)[0] / coarser
                at_corner, others = self._std_within(there, matrix, read, positive=True)[:2]
                if others.any() or not self._misfit((volts - self._at(there)) * read, coarser) <= _FITS:
                    return np.full(len(log), inf)
                shift, most = np.maximum(shift, np.abs(there - log) + np.abs(step)), np.maximum(most, at_corner)
        except np.linalg.LinAlgError:
            return np.full(len(log), inf)
        return most + shift / BY_NOISE

    def _cells_at(self, log: FloatArray) -> FloatArray:
        """Ohm (N, M)."""
        cells: FloatArray = np.exp(-np.clip(log, -_LARGEST, _LARGEST)).reshape(self._shape)
        return cells

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def _std_within(
        self, log: FloatArray, jacobian: FloatArray, read: FloatArray, *, positive: bool = False
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """Standard deviations, cells that may tie lines to each other, and least logarithms, (n,) each; inverse (n, n).

        The inverse times its transpose is the covariance of the logarithms.

        With its wire w a cell conducts between nothing and 1/w, whatever its reading: that is all that is known of it
        before. In this range readings are nearly linear in D = G / (1 + w G). What else the cell changes grows with G
        itself, up to a short. Standard deviations are infinite where cells of a column are of unknown size together.

        Args:
            log: logarithms of the conductances.
            jacobian: (n, n) derivatives of the readings in their errors.
            read: (n,) 1 for readings that count, else 0.
            positive: whether cells are also bounded by their own readings, as no other conducts less than nothing.

        Raises:
            numpy.linalg.LinAlgError: the derivatives are not finite.

        """
        from scipy.linalg.lapack import dtrtri

        wire = self._leads.ravel() + LEAST_SHORT_OHM
        wired = np.exp(log) * wire
        prior = (1.0 + wired) * np.maximum(1.0 / wired, 1.0) / BY_STEPS
        square = np.linalg.qr(np.concatenate([jacobian * prior, np.eye(len(log))]), mode="r")
        inverse, failed = dtrtri(square)
        if failed or not np.isfinite(inverse).all():
            raise np.linalg.LinAlgError("derivatives that are not finite")
        inverse *= prior[:, None]
        std: FloatArray = np.sqrt(np.einsum("ij,ij->i", inverse, inverse))
        up = BY_STEPS * std / (1.0 + wired)
        if positive:
            up = np.where(read > 0.0, np.minimum(up, _most_by_own(jacobian * (1.0 + wired), up)), up)
        grown = np.where(up * wired < 1.0, (1.0 + up) / np.maximum(1.0 - up * wired, TINY), inf) - 1.0
        grown = np.minimum(grown, np.exp(self._most - log) - 1.0) / (BY_STEPS * std)
        loose = ((grown > _MOST_BENT) | (up > 1.0)) & (read > 0.0) & self._present
        tied = loose & (wired * (1.0 + up) > _TIES)
        least = wired / (1.0 + wired) * np.maximum(1.0 - up, 0.0)
        least = np.maximum(np.log(np.maximum(least / (1.0 - least) / wire, TINY)) - _TIED_MOVES, self._least)
        conductance, open_size = np.exp(log).reshape(self._shape), (loose & (up > _OPEN_SIZE)).reshape(self._shape)
        most = np.where(open_size, conductance * (1.0 + up.reshape(self._shape)), 0.0)
        alike = np.count_nonzero(most > _BESIDE * conductance.max(axis=0), axis=0)
        alike *= open_size[np.argmax(conductance, axis=0), np.arange(self._shape[1])]
        alike *= np.linalg.norm(most, axis=0) * self._board.reference > _OPENS  # else the column's end holds its scale
        if (alike > 1).any():
            return np.full(len(std), inf), tied, least, inverse
        bent = np.flatnonzero((grown > 1.0) & (read > 0.0) & self._present)
        beside = (inverse @ inverse[bent].T) / std[bent] * np.sqrt(grown[bent] ** 2 - 1.0)
        std = np.sqrt(std**2 + np.einsum("ij,ij->i", beside, beside))
        return std, tied, least, inverse

    def _beyond_linear(self, log: FloatArray, inverse: FloatArray, jacobian: FloatArray, coarser: float) -> FloatArray:
        """Standard deviations (n,) by what derivatives leave out, along the error by which cells tie lines most.

        The readings at the ends of this error differ from those by the derivatives (n, n), and the cells follow these
        differences. Cells of unknown size are bounded one by one.
        """
        std = np.sqrt(np.einsum("ij,ij->i", inverse, inverse))
        counted = (self._read > 0.0) & self._present & (BY_STEPS * std < _SINGLY)
        share = 1.0 / (1.0 + np.exp(-log) / self._behind(self._cells_at(log)))  # that changes the potentials of lines
        weight = np.where(counted, share * (1.0 - share), 0.0)
        most = weight
        for _ in range(_POWERS):  # to the largest eigenvector of the covariance, so weighted
            most = weight * (inverse @ (inverse.T @ (weight * most / max(float(np.linalg.norm(most)), TINY))))
        half = inverse.T @ (weight * most)
        swing = np.where(counted, BY_STEPS * (inverse @ half) / max(float(np.linalg.norm(half)), TINY), 0.0)
        beyond, volts, linear = np.zeros(len(log)), self._at(log), jacobian @ swing
        if not float(np.abs(swing).max()) > _SWING:
            return beyond
        for side in (1.0, -1.0):
            there = np.clip(log + side * swing, self._least, self._most)
            left = (self._at(there) - volts) * self._read / self._std - side * linear
            bent = float(np.linalg.norm(left)) / max(float(np.linalg.norm(linear)), TINY)
            change = inverse @ (inverse.T @ (jacobian.T @ left)) / coarser**2
            # Below 1 a second step changes what the first has left by this factor; beyond, steps lead nowhere.
            beyond = np.maximum(beyond, (1.0 + bent + bent**3) * np.abs(change))
        return beyond / BY_STEPS

    def _one_answer(self, log: FloatArray) -> bool:
        """Whether no other cells give the readings, where idle columns conduct more than those that are read.

        Without leads of the rows there is one answer (:func:`.several_answers`). The selected row's lead takes a share
        of at most L of the drive; the derivative of its logarithm by those of all cells, together, is no larger. If A
        is the largest sum of derivatives of a cell's logarithm by those of all readings, another answer lies within
        A L, where A L < 1/2 makes the map from one's losses to the other's cells a contraction.
        """
        assert self._linear is not None
        in_range = float(np.exp(log.max())) * self._least_ohm <= 1.0
        return in_range and self._linear.amplified * self._lost < _CONTRACTS

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
        log: FloatArray,
        std: FloatArray,
        misfit: float,
        spread: FloatArray,
        unread: BoolArray,
    ) -> Measurement:
        """Values, uncertainties, validity and reasons of cells that give the readings."""
        board, shape = self._board, self._shape
        signal, std = np.abs(frame.volts - board.level), std.reshape(shape)
        slope = np.abs(board.circuit.log_conductance_slope(board, signal * np.sign(board.drive)))
        more = np.expm1(np.minimum(spread.reshape(shape), _LARGEST))
        if self._several and (unread.any() or not self._one_answer(log)):
            more = np.full(shape, inf)
        if self._sheet is not None:
            more = more + self._sheet.doubt(log)
        under_range: BoolArray = np.zeros(shape, dtype=np.bool_)
        if frame.under_range is not None:
            under_range = frame.under_range
        measured, per_volt = Measurement.unknown(frame.each.shape), np.where(slope > 0.0, slope, inf)
        found = frame.volts, board.level, np.exp(log).reshape(shape), std, per_volt, more, misfit
        state_fitted.unchecked(
            *(*found, self._short, unread, under_range, self._gone, self._std, self._constants),
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


def _factored(jacobian: FloatArray, damping: float = 0.0) -> FloatArray:
    """Lower Cholesky factor (n, n) of the normal matrix with the prior, its diagonal raised by a factor of damping.

    Raises:
        numpy.linalg.LinAlgError: the derivatives are not finite.

    """
    from scipy.linalg.lapack import dpotrf

    normal = jacobian.T @ jacobian
    normal.flat[:: len(normal) + 1] *= 1.0 + damping
    normal.flat[:: len(normal) + 1] += _PRIOR**-2.0
    factor, failed = dpotrf(normal, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the normal matrix is not positive definite")
    lower: FloatArray = factor
    return lower


def _most_by_own(derivatives: FloatArray, most: FloatArray) -> FloatArray:
    """Largest relative change (n,) of each cell by its own reading, while none falls below nothing.

    Args:
        derivatives: (n, n) of the readings, in their errors, by relative changes of the cells.
        most: (n,) largest changes by all readings together.

    """
    own = np.diag(derivatives)
    others = derivatives * np.sign(own)[:, None]
    np.fill_diagonal(others, 0.0)
    held_up, held_down = np.maximum(others, 0.0).sum(axis=1), np.maximum(-others, 0.0)
    for _ in range(3):
        most = np.minimum(most, (BY_STEPS + held_up + held_down @ most) / np.maximum(np.abs(own), TINY))
    return most
