"""Linearised model of a coupled board: derivatives, their regularised inverse and its posterior standard deviations.

A :class:`Base` is the linear model about some cells. A live recovery keeps it while it serves, usually for many frames.
:class:`Linearised` makes new ones: at once where derivatives have a closed form (column by column, or node by node),
and in instalments where they are a matrix of all readings by all cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import inf
from typing import NamedTuple

import numpy as np

from ...common import compiled
from ...common.arrays import BoolArray, FloatArray
from ...errors import InputError
from . import _coupled_loops as loops
from ._column_blocks import ColumnBlocks, beyond_linear
from ._coupled_board import CoupledBoard, Known
from ._coupled_loops import ColumnSteps
from ._coupled_prices import CoupledPrices
from ._derivatives import derivatives
from ._frame_budget import ANEW_EFFORT, LARGE_EFFORT, NODE_EFFORT, SHEET_EVALUATIONS, USUAL_EFFORT, Budget, Effort
from ._node_blocks import NodeBlocks
from ._normal_matrix import DEAR, Meter, NormalMatrix

_PRIOR = 3.0  # standard deviation of the logarithm of a conductance before anything is read: a factor of 20
_UNKNOWN = 8.0  # the same for a cell that a fault hides
_FAR = 0.5  # change of a logarithm since the derivatives were made, beyond which they no longer serve
_BY_NOISE = 4.0  # standard deviations by which noise and rounding move a cell without new derivatives being due
_STUCK = 300  # frames until steps column by column are tried again
_STEEPER = 3.0  # largest ratio of slopes by which derivatives are adapted
_STRIDE = 1.5  # largest change of the logarithm of a conductance in one step
_LINEAR_STRIDE = 1e3  # largest change of a conductance that counts linearly, in multiples of its reading's resolution
_LARGEST = 50.0  # logarithm that is as good as infinite
_LEAST_CELL = 1e-9  # ohm per ohm of leads, least cell for derivatives: below, rounding hides the leads
_NEXT_TO_NONE = 0.01  # share of the least conductance that a reading tells, below which a cell may as well be open
_LEAST_READING = 0.03  # half steps: reading of the least conductance alone; from below, nothing would lead back
_LIGHT = 0.3  # share of a voltage lost in the lines, up to which derivatives in closed form are as good as any
_HEAVY = 3.0  # the same, up to which steps by them converge
_SMALL = 100  # cells up to which an instalment is a whole renewal
_SOME_OHM = 1e4
_PER_SQUARE = 16  # multiplications of a matrix product that take as long as the square of one entry

LARGEST_MATRIX = 4096
"""cells up to which a matrix of all readings by all cells is made: 0.3 GB"""
LARGEST_BESIDE = 1024
"""the same where columns are nearly independent: beyond, a step by that matrix costs ten without it"""


class Moved(NamedTuple):
    """Distance of cells from those of a base, as changes of logarithms."""

    counted: float
    """largest change, of which noise counts less"""
    largest: float
    """largest change"""

    @property
    def far(self) -> bool:
        """Whether the derivatives no longer serve there."""
        return self.counted > _FAR


@dataclass(eq=False)
class Base:
    """The linear model about some cells; n = N M, flattened."""

    log: FloatArray
    """(n,) logarithm of the conductances"""
    step: Callable[[FloatArray], FloatArray]
    """regularised inverse of the derivatives, from readings (n,) in V to changes (n,) of ``log``"""
    std: FloatArray
    """(n,) posterior standard deviation of ``log``"""
    slope: FloatArray
    """(n,) 1/V: change of ``log`` per volt if each cell were alone; 0 where its reading tells nothing"""
    others: FloatArray
    """(n,) change of ``log`` if all hidden cells change by _UNKNOWN"""
    floor: FloatArray
    """(n,) ``log`` of the least conductance that a cell's own reading tells from zero; below, cells count linearly"""
    linear: BoolArray | None
    """(n,) cells that count linearly; None: none ever does, and ``floor`` bounds the logarithms"""
    whole: bool
    """whether made by the matrix of all readings by all cells, not column by column"""
    coarse: bool
    """made column by column, which is good for convergence, but overstates the uncertainty of the cells"""
    by_columns: ColumnSteps | None = None
    """``step`` as machine code; None: there is none"""
    compiled: bool = False
    """whether the loops are machine code"""
    _told: FloatArray = field(init=False)
    """(n,) ``log``, raised to ``floor`` where it is below"""
    _any_linear: bool = field(init=False)

    def __post_init__(self) -> None:
        """Compute what every comparison with other cells needs."""
        self._told = np.maximum(self.log, self.floor)
        self._any_linear = self.linear is not None and bool(self.linear.any())

    def moved(self, log: FloatArray, scale: float) -> Moved:
        """Changes from the base to logarithms (n,), for readings ``scale`` times as uncertain as by rounding."""
        if self.compiled:
            return Moved(*loops.moved.code(log, self.floor, self._told, self.std, _BY_NOISE * scale / _FAR))
        change = np.maximum(log, self.floor)
        change -= self._told
        np.abs(change, out=change)
        largest = float(change.max())
        change /= np.maximum((_BY_NOISE * scale / _FAR) * self.std, 1.0)
        return Moved(float(change.max()), largest)

    def is_far(self, log: FloatArray) -> bool:
        """Whether the model is from too far away to serve at logarithms (n,), whatever the noise is."""
        return self.moved(log, 1.0).largest > _FAR

    def advanced(self, log: FloatArray, step: FloatArray) -> FloatArray:
        """Logarithms (n,) after a step.

        Below the least conductance that its own reading tells from zero, the unknown of a cell is the conductance
        instead of its logarithm. Readings depend linearly on the conductance there, and whether it is 1 % or 10 % of
        that least conductance makes no difference to any reading.
        """
        floor, linear = self.floor, self.linear
        after: FloatArray = log + step
        if linear is None:
            return np.maximum(after, floor)
        below = (after < floor) | (log < floor)
        if self._any_linear:
            below |= linear
        if not below.any():
            return after
        above_floor = np.where(linear, np.exp(np.minimum(log - floor, _LARGEST)), 1.0 + log - floor)
        relative = np.where(log < floor, np.exp(np.minimum(log - floor, 0.0)), above_floor) + step
        logarithm = np.log(np.maximum(relative, _NEXT_TO_NONE))
        return np.where(below, floor + np.where(linear | (relative < 1.0), logarithm, relative - 1.0), after)

    def change(self, volts: FloatArray, steeper: FloatArray) -> FloatArray:
        """Change (n,) of the logarithms for a difference (n,) of the readings in V.

        A cell's own nonlinearity is known in closed form. Each reading is therefore scaled by ``steeper``: its present
        slope, as if the cell were alone, over the slope when the derivatives were made.
        """
        if self.by_columns is not None:
            return self.by_columns.change(volts, steeper)
        change = self.step(volts * steeper)
        if max(change.item(change.argmax()), -change.item(change.argmin())) > _STRIDE:
            most = _STRIDE if self.linear is None else np.where(self.linear, _LINEAR_STRIDE, _STRIDE)
            np.clip(change, -_STRIDE, most, out=change)
        return change

    def steeper(self, slope: FloatArray) -> FloatArray:
        """Slopes (n,) in 1/V over those at the base, limited to a factor of _STEEPER; 1 where there is none."""
        if self.compiled:
            found = np.empty(len(slope))
            loops.steeper_each.code(slope, self.slope, _STEEPER, found)
            return found
        both = (self.slope > 0) & (slope > 0)
        ratio = np.divide(slope, self.slope, out=np.ones(len(slope)), where=both)
        np.minimum(ratio, _STEEPER, out=ratio)
        return np.maximum(ratio, 1.0 / _STEEPER, out=ratio)


class Renewal(NamedTuple):
    """The next piece of work of a renewal of derivatives."""

    at: Known
    """cells at which the new derivatives are made"""
    loss: float
    """share of a voltage lost in the lines"""
    columns_serve: bool
    """whether steps by single lines converge"""
    by_lines: bool
    """whether derivatives by single lines are made"""
    at_once: bool
    """whether nothing else is made"""
    price: float
    """price, see :mod:`._frame_account`"""


class Linearised:
    """The present base of one board, and its renewal."""

    def __init__(self, parts: CoupledBoard) -> None:
        """Choose the kind of derivatives.

        Raises:
            InputError: the board is too large.

        """
        board, cells = parts.board, parts.shape[0] * parts.shape[1]
        self._parts = parts
        self._tells = ~parts.gone
        tells = self._tells.reshape(parts.shape)
        self.columns = ColumnBlocks(board, parts.lines.to_driver, parts.lines.to_end, parts.noise, tells)
        """derivatives in closed form, where columns hardly load each other"""
        nodes = NodeBlocks(board, parts.quick, parts.noise) if board.floating and cells > _SMALL else None
        self._nodes = nodes if nodes is not None and nodes.applies else None
        if cells > LARGEST_MATRIX and not (self.columns.applies or self._nodes):
            raise InputError(
                "the live recovery of boards with bridged lines, or with floating rows and broken lines, is for at "
                f"most {LARGEST_MATRIX} cells, and the array has {cells}; expected a smaller array, or no such fault"
            )
        nearly_independent = self.columns.applies and not parts.shorted.any()
        self._has_matrix = cells <= (LARGEST_BESIDE if nearly_independent else LARGEST_MATRIX)
        self._small_matrix = cells <= _SMALL and parts.quick.derivatives(np.full(parts.shape, _SOME_OHM)) is not None
        self._prior = np.where(parts.hidden, _UNKNOWN, _PRIOR)
        per_volt = np.abs(board.circuit.conductance_slope(board, np.zeros(parts.shape)))
        self._least = np.log(_LEAST_READING * parts.half_step * per_volt).ravel()  # of the logarithms
        self._series = (parts.leads + board.series_ohms).ravel()  # ohm of leads and faults, for each cell
        self._compiled = compiled.load(*loops.ALL)
        self.prices = CoupledPrices(parts, by_nodes=self._nodes is not None, by_columns=self.columns.applies)
        """of the board's steps"""
        self._meter = Meter(cells, beside=self.columns.applies)
        self._base: Base | None = None
        self._renewal: Iterator[Base | None] | None = None
        self._stuck = 0

    def usual_effort(self, *, anew: bool) -> Effort:
        """Effort of a frame after the first; ``anew``: the frame began with closed formulas, without a fit since."""
        bridged = not self.columns.applies and len(self._prior) > _SMALL
        if self._nodes is not None:
            effort = NODE_EFFORT
        elif bridged:
            effort = LARGE_EFFORT
        else:
            effort = ANEW_EFFORT if anew else USUAL_EFFORT
        if self._parts.sheet is None:
            return effort
        return effort._replace(evaluations=SHEET_EVALUATIONS, solutions=1)

    @property
    def base(self) -> Base:
        """The present linear model; there is one after :meth:`begin`."""
        assert self._base is not None
        return self._base

    @property
    def step_price(self) -> float:
        """Price of a step by the present linear model, see :mod:`._frame_account`."""
        return self.prices.by_matrix if self.base.whole else self.prices.by_lines

    @property
    def spread(self) -> FloatArray | float:
        """(n,) standard deviations of the logarithms by rounding, by the linear model; 0: no model yet."""
        return 0.0 if self._base is None else self._base.std

    @property
    def under_way(self) -> bool:
        """Whether some instalments of a new base have been made, and more are to come."""
        return self._renewal is not None

    @property
    def upgrade_due(self) -> bool:
        """Whether steps column by column did not reach a fit, so that the whole matrix is due instead."""
        return self._stuck > 0 and not self.base.whole

    def give_up_columns(self) -> None:
        """Use the whole matrix for some frames, if there is one, since steps column by column do not reach a fit."""
        if self._has_matrix and not self.base.whole:
            self._stuck = _STUCK

    def end_frame(self) -> None:
        """Count the frames until steps column by column are tried again."""
        self._stuck = max(self._stuck - 1, 0)

    def begin(self, at: Known, budget: Budget) -> bool:
        """Make the first base at these cells, or further instalments of it. False until there is one."""
        if self._base is None and self._renewal is None:
            self._renewal = self._first(at)
        while self._base is None and self._renewal is not None and budget.renew(self._first_price(at)):
            self._base = next(self._renewal)
            if self._base is not None:
                self._renewal = None
        return self._base is not None

    def begin_anew(self, at: Known, budget: Budget) -> None:
        """Drop derivatives made elsewhere, and continue from cells by closed formulas."""
        if self._base is not None and not self.rebase(at, budget):
            # With derivatives from elsewhere the first step may lead away, in this and all frames that begin anew.
            self._base = self._renewal = None

    def rebase(self, at: Known, budget: Budget) -> bool:
        """Make derivatives at these cells at once, if columns give them in closed form; else return False."""
        loss = self._loss(at)
        if not (self.columns.applies and loss <= _HEAVY and budget.start(self._lines_price(at))):
            return False
        self._base, self._renewal = self._by_lines(at, loss), None
        return True

    def renewal(self, at: Known) -> Renewal:
        """The work that :meth:`renew` would do next at these cells."""
        base, loss = self.base, self._loss(at)
        columns_serve = loss <= _HEAVY and not self._stuck
        by_lines = (columns_serve or not self._has_matrix) and (not base.whole or base.is_far(at.log))
        at_once = by_lines and not self._is_coarse(loss)
        price = self.step_price
        if by_lines and (at_once or not self._is_one_instalment(at)):
            price += self._lines_price(at)
        if not at_once:
            price += self._instalment_price(at)
        return Renewal(at, loss, columns_serve, by_lines, at_once, price)

    def renew(self, renewal: Renewal) -> bool:
        """Make derivatives, or a further instalment of them. True if the base has just become new."""
        at, loss, columns_serve, by_lines, at_once, _ = renewal
        if at_once:
            self._base, self._renewal = self._by_lines(at, loss), None
            return True
        if self._renewal is None:
            self._renewal = self._by_matrix(at)
        made = next(self._renewal)
        if made is not None:
            self._renewal = None
            if not (columns_serve and made.is_far(at.log)):  # otherwise made for cells that have moved away
                self._base = made
                return True
        if by_lines:
            self._base = self._by_lines(at, loss)
        return by_lines

    def _is_one_instalment(self, at: Known) -> bool:
        """Whether the next instalment is a whole matrix, which makes derivatives by single lines unnecessary."""
        return self._renewal is None and self._small_matrix and self._parts.quick.branch_price(at.cells) <= DEAR

    def _instalment_price(self, at: Known) -> float:
        """Price of the next instalment of the whole matrix; the first one begins with the network at these cells."""
        if self._renewal is None:
            self._meter = Meter(len(at.log), beside=self.columns.applies)
            return self._meter.price + self._parts.price(at.log)
        return self._meter.price

    def _first_price(self, at: Known) -> float:
        """Price of the next instalment of the first base."""
        by_lines = self._loss(at) <= _HEAVY or not self._has_matrix
        return self._lines_price(at) if by_lines else self._meter.price

    def _lines_price(self, at: Known) -> float:
        """Price of derivatives by single lines; with nodes they begin with potentials within the lines."""
        return self.prices.lines + (0.0 if self._nodes is None else self._parts.quick.branch_price(at.cells))

    def _is_coarse(self, loss: float) -> bool:
        """Whether the whole matrix must follow derivatives by single lines, which neglect such a loss."""
        return loss > _LIGHT and self._has_matrix

    def _loss(self, at: Known) -> float:
        """Share of a voltage lost in the lines that steps by single lines neglect; inf: there are no such steps."""
        if self._nodes is not None:
            return 0.0
        if not self.columns.applies:
            return inf
        return self.columns.loss(self._parts.board.cell_conductance(at.cells))

    def _first(self, at: Known) -> Iterator[Base | None]:
        """Derivatives and their regularised inverse at these cells, in instalments; None until the last."""
        loss = self._loss(at)
        if loss <= _HEAVY or not self._has_matrix:
            yield self._by_lines(at, loss)
        else:
            yield from self._by_matrix(at)

    def _by_lines(self, at: Known, loss: float) -> Base:
        """Derivatives at these cells by single lines, without the matrix of all readings by all cells."""
        shape, slope = self._parts.shape, self._parts.slope(at.volts)
        prior = self._prior.reshape(shape)
        if self._nodes is not None:
            by_nodes = self._nodes.at(at.cells, prior)
            none, std = np.zeros(len(at.log)), by_nodes.std.ravel()
            return Base(
                *(at.log, by_nodes.solve, std, slope, none, self._least, None),
                whole=False,
                coarse=False,
                compiled=self._compiled,
            )
        step = self.columns.at(at.cells, prior, self._parts.hidden.reshape(shape))
        std, others, floor = step.std.ravel(), step.others.ravel(), step.floor.ravel()
        linear = at.log < floor
        steps = ColumnSteps.of(step, linear, _STRIDE, _LINEAR_STRIDE) if self._compiled else None
        return Base(
            *(at.log, step.solve, std, slope, others, floor, linear),
            whole=False,
            coarse=self._is_coarse(loss),
            by_columns=steps,
            compiled=self._compiled,
        )

    def _by_matrix(self, at: Known) -> Iterator[Base | None]:
        """Derivatives and their regularised inverse at these cells, in instalments; None until the last."""
        parts, size = self._parts, len(at.log)
        jacobian, cells, noise = np.empty((size, size)), at.cells.ravel(), parts.noise
        meter = self._meter = Meter(size, beside=self.columns.applies)
        # A cell whose fit ran away is as good as a short, for which derivatives are not made.
        no_shorts = np.maximum(at.cells, np.maximum(_LEAST_CELL * parts.leads, np.exp(-_LARGEST)))
        for _ in derivatives(parts.board, no_shorts, parts.quick, meter, out=jacobian):
            yield None
        in_series = 1.0 / (cells + parts.board.series_ohms.ravel())  # S of the cell and an open-cell fault
        scale = in_series**2 * cells / noise
        # If its reading hardly tells a cell from an open one, the unknown is the conductance itself, see advanced().
        own = np.abs(np.diagonal(jacobian))
        least = np.divide(1.0, own, out=np.zeros(size), where=self._tells & (own > 0))
        floor = np.log(np.maximum(least * noise, np.finfo(np.float64).tiny))
        jacobian *= np.where((scale < least) & (cells > self._series), least, scale)
        normal = NormalMatrix(jacobian, self._prior)
        for _ in normal.instalments(meter):
            yield None
        variance = np.maximum(np.diagonal(normal.inverse), np.finfo(np.float64).tiny)
        if meter.is_full(_PER_SQUARE * normal.inverse.size):
            yield None
        more = beyond_linear(np.sqrt(variance)) / variance
        std = np.sqrt(variance + np.einsum("ij,ij,j->i", normal.inverse, normal.inverse, more))
        # By the covariance with the hidden cells: change of each cell when all hidden ones go to their ends.
        hidden, others = parts.hidden, np.zeros(size)
        if parts.any_hidden:
            others = np.abs(normal.inverse[:, hidden] / std[hidden] ** 2).sum(axis=1) * _UNKNOWN

        def step(volts: FloatArray) -> FloatArray:
            return normal.step(volts / noise)

        slope = parts.slope(at.volts)
        yield Base(
            *(at.log, step, std, slope, others, floor, at.log < floor),
            whole=True,
            coarse=False,
            compiled=self._compiled,
        )
