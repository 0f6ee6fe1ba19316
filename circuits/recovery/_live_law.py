"""Live recovery by Kirchhoff's laws of columns and rows, and one factor per cell for everything beyond them.

G = rho law(y), where ``law`` is :mod:`._law` and rho = G / law(F(G)) with the full model F of the board: segments,
bridges, currents that return by way of the rows, floating rows. rho changes little from frame to frame. It is renewed
when its estimated error exceeds a share of the uncertainty; a fixed-point iteration with the acceleration of Anderson
(1965) of depth two, and a fixed number of evaluations of F in a frame. Cells that have not settled then are not valid,
and the next frame goes on.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from .._adc import adc_error
from .._board import Board, broken_off, cell_alone
from .._exact import read_exactly
from .._sections import Fault
from ._enclosure import Enclosure, Unknowns
from ._law import LEAST, Law, Ports, Sensitivity
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
from ._quick_model import QuickModel

EVALUATIONS, FIRST_EVALUATIONS = 4, 30
"""of the full model in one frame, and in the first one of all"""
_FRESH = 0.1  # share of an uncertainty that an old factor may be off by
_STEPS, _NOISE = 4.5, 3.5  # standard deviations by ADC steps and by noise of other readings that are covered
_OPEN = 1e-14  # S, of an open cell in the model
_COMPLETE_SHORT = 1e-5  # ohm that stands for a short of 0 ohm
_MOST_WIRE = 2.0  # resistance of a cell's lines over its own from which on it reads like a short
_MOST_COUPLED = 0.7  # share of a voltage that goes by other ways than the law's from which on cells are not known
_OFTEN = 3  # frames with readings that no cells give, after which the design is taken for wrong
_EXPONENT = 40.0


class LawLive:
    """Live recovery of boards whose idle rows are driven, or whose amplifiers hold all columns."""

    def __init__(self, board: Board, rule: ValidityRule) -> None:
        """For a board with a converter, whose circuit has a :meth:`.ReadoutCircuit.port_law`."""
        whole = replace(board, supply=(-inf, inf), faults=tuple(map(_with_resistance, board.faults)))
        self._board = sliced = replace(whole, continuous=False)
        self._sheet = whole if board.continuous else None
        self._rule, self._turn, self._shape = rule, board.turn, board.shape
        self.scales_columns = not (board.circuit.has_amplifiers or board.turned)
        lines = LineResistance(sliced)
        to_driver, to_end = (np.where(np.isfinite(ohms), ohms, 0.0) for ohms in (lines.to_driver, lines.to_end))
        column_lead = np.where(np.isfinite(board.column_lead), board.column_lead, 0.0)
        wire = column_lead + to_end.mean(axis=0)
        law = board.circuit.port_law(sliced, wire)
        assert law is not None
        hidden = broken_off(board) | np.isinf(board.series_ohms)
        self._gone = hidden.copy()
        for fault in board.shorts:
            self._gone[fault.place] |= fault.ohms == 0
        self._law = Law(law, to_driver.mean(axis=1), self._gone, adc_error(board))
        self._wires = to_driver + to_end + column_lead
        self._heaviest = float(self._wires.max())
        self._model = QuickModel(sliced, lines)
        self._exact = not (
            self._law.has_leads or board.column_ohms.any() or board.row_ohms[:, 1:].any() or not board.plain
        ) and not board.floating
        self._shunt = np.zeros(board.shape)  # S
        for fault in sliced.shorts:
            self._shunt[fault.place] += 1.0 / fault.ohms
        self._any_gone, self._faulty = bool(self._gone.any()), bool(self._shunt.any() or board.series_ohms.any())
        self._tells = not ((board.circuit.mixes_cells or board.floating) and hidden.any())
        adc = board.adc
        assert adc is not None
        self._half_step = adc_error(board)
        self._random = (0.5 + abs(adc.inl_steps)) * adc.step  # V, the part that differs from reading to reading
        self._shift = self._half_step - self._random  # V, the part that all readings share
        self._enclosure = Enclosure(board, self._law, law, wire, to_driver, to_end)
        self._rho, self._added = np.ones(board.shape), np.zeros(board.shape)
        self._base: FloatArray | None = None
        self._astray = True  # whether the last frame did not settle
        self._begun, self._impossible = False, 0
        self._every = np.ones(board.shape, dtype=np.bool_), np.zeros(board.shape, dtype=np.int8)
        for shared in self._every:
            shared.flags.writeable = False

    @np.errstate(all="ignore")
    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        faint: BoolArray | None = None,
    ) -> LiveReading:
        """As :class:`.LiveRecovery`."""
        turn = self._turn
        limited, faint = (None if cells is None else turn(cells) & ~self._gone for cells in (limited, faint))
        unknowns = None if limited is None and faint is None else Unknowns.of(self._shape, limited, faint)
        volts = turn(volts)
        if not self._tells:
            return self._nothing(unknowns)
        ports = self._law(volts)
        errors = _Errors(self, ports, volts, noise)
        conductance, unsettled = ports.cells, None
        if not self._exact:
            conductance, unsettled = self._beyond(ports, errors, unknowns)
        relative = errors.relative(conductance, self._scale)
        if self._base is not None:
            relative = relative + self._moved(
                np.minimum(relative, 1.0) * np.abs(conductance), relative <= self._rule.limit
            )
        by_others = None
        if unknowns is not None or errors.opens_scales:
            by_others = self._enclosure(ports, errors, conductance, unknowns)
        self._debug = by_others, ports, errors
        self._count_impossible(ports, errors, unknowns)
        return self._reading(ports, errors, conductance, relative, by_others, unknowns, unsettled)

    # -- beyond the law

    _scale = 1.0

    def _beyond(self, ports: Ports, errors: _Errors, unknowns: Unknowns | None) -> tuple[FloatArray, BoolArray | None]:
        """Cells (N, M) in S with everything beyond the law; and which of them have not settled, None: all have."""
        conductance = self._rho * ports.cells
        if self._added.any():
            conductance += self._added
        if self._base is not None and not self._astray and not self._is_stale(conductance, errors):
            return conductance, None
        return self._renew(conductance, ports, errors, unknowns)

    def _is_stale(self, conductance: FloatArray, errors: _Errors) -> bool:
        """Whether the factors may be off by more than a share of a valid cell's uncertainty."""
        uncertainty = errors.relative(conductance, self._scale)
        matters = uncertainty <= self._rule.limit
        self._coupling = np.maximum(self._coupling, self._enclosure.coupling(np.maximum(conductance, 0.0)))
        off = self._moved(np.abs(conductance - self._base), matters)
        return bool(((off > _FRESH * uncertainty) & matters).any())

    def _moved(self, change: FloatArray, matters: BoolArray) -> FloatArray:
        """Relative change (N, M) of the factors, to first order, by a ``change`` (N, M) in S of the cells."""
        beyond, by_column = self._beyond_law, self._coupling
        if np.count_nonzero(matters) < matters.size:
            beyond = beyond * matters
        in_row, in_column = change.sum(axis=1) / self._row_sums, change.sum(axis=0) / self._column_sums
        off: FloatArray = (beyond.max(axis=1) * in_row)[:, None] + np.maximum(beyond.max(axis=0), by_column) * in_column
        off += np.minimum(change / self._base, 1.0) * self._beyond_law
        return off

    def _renew(
        self, conductance: FloatArray, ports: Ports, errors: _Errors, unknowns: Unknowns | None
    ) -> tuple[FloatArray, BoolArray | None]:
        """Iterate to the cells whose readings in the full model are those of the frame."""
        most = EVALUATIONS if self._begun else FIRST_EVALUATIONS
        self._begun = True
        counted = ~self._gone if unknowns is None else ~(self._gone | unknowns.any)
        before: list[tuple[FloatArray, FloatArray]] = []
        for _ in range(most):
            cells = np.maximum(conductance, _OPEN)
            try:
                other = self._law(self._evaluate(cells)).cells
            except (SolverError, np.linalg.LinAlgError):
                self._base, self._astray = None, True
                return conductance, counted
            ratio = cells / np.where(other > 0.0, other, inf)
            usual = (ratio > 0.2) & (ratio < 5.0) & (ports.cells > 0.0)
            self._rho, self._added = np.where(usual, ratio, 1.0), np.where(usual, 0.0, cells - other)
            new = self._rho * ports.cells + self._added
            log = np.log(cells)
            step = np.log(np.maximum(new, 1e-3 * cells)) - log
            uncertainty = errors.relative(new, 1.0)
            matters = counted & (uncertainty <= self._rule.limit)
            roughly = 0.5 * np.minimum(errors.linear, 1.0) * np.maximum(np.abs(ports.cells), cells)
            change = np.abs(new - cells)
            self._remember(cells)
            off = self._moved(change * counted, matters)
            if not (counted & np.where(matters, off > _FRESH * uncertainty, change > roughly)).any():
                self._astray = not matters.any()
                return new, None
            better = _accelerated(log, step, before, matters)
            better = np.where(matters, better, 0.5 * np.clip(step, -1.0, 1.0))
            conductance = np.where(counted, np.exp(np.clip(log + better, -_EXPONENT, 7.0)), new)
            before.append((log, step))
        self._remember(conductance)
        self._astray = True
        return conductance, counted

    def _evaluate(self, conductance: FloatArray) -> FloatArray:
        """V (N, M) of the full model."""
        own = conductance
        if self._faulty:
            own = np.maximum(cell_alone(self._board, conductance, self._shunt), _OPEN)
        cells = 1.0 / own
        if self._sheet is not None:
            return read_exactly(self._sheet, cells)[0].volts
        return self._model(cells)

    def _remember(self, conductance: FloatArray) -> None:
        """Keep the cells for which the factors were found, and how strongly the factors depend on lines."""
        base = np.maximum(conductance, _OPEN)
        self._base = base
        self._row_sums, self._column_sums = base.sum(axis=1), base.sum(axis=0)
        self._beyond_law = np.abs(self._rho - 1.0)
        self._coupling = self._enclosure.coupling(base)

    # -- results

    def _count_impossible(self, ports: Ports, errors: _Errors, unknowns: Unknowns | None) -> None:
        """Raise SolverError for readings that no cells give, frame after frame."""
        impossible = bool((ports.left < -3.0 * errors.of_left).any())
        self._impossible = self._impossible + 1 if impossible and unknowns is None else 0
        if self._impossible > _OFTEN:
            raise SolverError("no cell resistances give these readings; check that the design is that of the board")

    def _reading(
        self,
        ports: Ports,
        errors: _Errors,
        conductance: FloatArray,
        uncertainty: FloatArray,
        by_others: FloatArray | None,
        unknowns: Unknowns | None,
        unsettled: BoolArray | None,
    ) -> LiveReading:
        turn, own = self._turn, errors.own
        cells = conductance
        if self._faulty:
            cells = cell_alone(self._board, np.maximum(conductance, 0.0), self._shunt)
            with np.errstate(divide="ignore", invalid="ignore"):
                scale = np.where(cells > 0.0, conductance / cells * (1.0 + self._board.series_ohms * cells) ** 2, inf)
            scale = np.maximum(scale, 1.0)
            uncertainty, own = uncertainty * scale, own * scale
            by_others = None if by_others is None else np.where(by_others > 0.0, by_others * scale, 0.0)
        total = uncertainty if by_others is None else uncertainty + by_others
        with np.errstate(divide="ignore"):
            resistance = 1.0 / np.maximum(cells, 0.0)
        valid = self._rule.accepts(total)
        short = cells * self._wires > _MOST_WIRE if self._heaviest else None
        usual = unsettled is None and unknowns is None and not self._any_gone and (short is None or not short.any())
        if usual and np.count_nonzero(valid) == valid.size:
            every, no_reason = self._every
            return LiveReading(
                turn(resistance),
                turn(every),
                turn(no_reason),
                lambda: (turn(total), turn(own)),
                by_readings=lambda: turn(errors.by_readings(total)),
                every=True,
            )
        reason: NDArray[np.int8] = np.full(self._shape, UNCERTAIN, dtype=np.int8)
        if by_others is not None:
            reason[by_others > 0.5 * total] = DISTURBED
        none = own >= 1.0
        reason[none] = NO_CURRENT
        valid &= ~none & (cells > 0.0)
        if unsettled is not None:
            reason[unsettled & ~none] = UNSETTLED
            valid &= ~unsettled
        if short is not None:
            reason[short & ~none] = SATURATED
            valid &= ~short
        if unknowns is not None:
            reason[unknowns.limited], reason[unknowns.faint] = SATURATED, NO_CURRENT
            valid &= ~unknowns.any
        reason[self._gone] = HIDDEN
        valid &= ~self._gone
        reason[valid] = 0
        total = np.where(valid | (reason == UNCERTAIN), total, inf)
        total[~np.isfinite(total)] = inf
        return LiveReading(
            turn(resistance),
            turn(valid),
            turn(reason),
            lambda: (turn(total), turn(own)),
            by_readings=lambda: turn(errors.by_readings(total)),
        )

    def _nothing(self, unknowns: Unknowns | None) -> LiveReading:
        """A frame that determines no cell."""
        turn = self._turn
        reason: NDArray[np.int8] = np.full(self._shape, DISTURBED, dtype=np.int8)
        if unknowns is not None:
            reason[unknowns.limited], reason[unknowns.faint] = SATURATED, NO_CURRENT
        reason[self._gone] = HIDDEN
        nothing = np.full(self._shape, inf)
        return LiveReading(
            turn(np.full(self._shape, np.nan)),
            turn(np.zeros(self._shape, dtype=np.bool_)),
            turn(reason),
            lambda: (turn(nothing), turn(nothing)),
        )


class _Errors:
    """Errors of one frame's cells by ADC steps and noise."""

    def __init__(self, live: LawLive, ports: Ports, volts: FloatArray, noise: float) -> None:
        self._live, self._ports, self._noise = live, ports, noise
        self.error = live._half_step + SIGMAS * noise
        law = live._law
        self.sensitivity = at = law.sensitivity(ports)
        rows = len(volts)
        self._by_steps, self._by_noise = live._random * _STEPS / np.sqrt(3.0), _NOISE * noise
        self.size = size = np.maximum(np.abs(ports.driven), np.finfo(np.float64).tiny)
        slope = np.broadcast_to(at.slope, size.shape)
        self.weight = 1.0 / size + at.by_row  # relative change of a cell per change of its own D
        self.own: FloatArray = self.error * slope * np.abs(1.0 + at.by_column) * self.weight
        squares = slope * slope
        random = hypot(self._by_steps, self._by_noise)
        self.of_left = np.zeros(size.shape[1])
        others: FloatArray | float = 0.0
        shifted: FloatArray | float = 0.0
        moved = squares  # squared change of D, in V^2 of a reading
        if law.has_potential:
            in_column = squares.sum(axis=0)
            per_reading = self._alike(volts)
            beside = at.by_column * self.weight
            others = beside * beside * (in_column * per_reading - squares * random**2)
            np.maximum(others, 0.0, out=others)
            moved = squares * (1.0 + 2.0 * np.abs(at.by_column)) + at.by_column**2 * in_column
            if live._shift:
                shifted = np.abs(beside) * slope.sum(axis=0) * live._shift
            # The share of the drive that is left may itself be within its error.
            (_, _), (_, c1), (_, w1) = law.law
            by = np.broadcast_to((c1 - w1 * ports.share) / ports.drive, size.shape)
            self.of_left = np.sqrt((by * by).sum(axis=0) * per_reading) + np.abs(by).sum(axis=0) * live._shift
            self.of_left = np.where(live._enclosure.in_question(ports, self.of_left), inf, self.of_left)
        self.sums = np.sqrt(moved.sum(axis=1)) * random  # (N,) S, error of a row's sum
        if law.has_leads:
            in_row = moved.sum(axis=1)[:, None] - moved
            others = others + at.by_row**2 * np.maximum(in_row, 0.0) * random**2
            if live._shift:
                shifted = shifted + at.by_row * (slope * np.abs(1.0 + at.by_column)).sum(axis=1)[:, None] * live._shift
        self._others = np.sqrt(others)
        own_random = slope * np.abs(1.0 + at.by_column) * self.weight * random
        together = np.minimum(self.own + self._others, np.maximum(self.own, np.sqrt(own_random**2 + others)))
        self._std = np.sqrt(own_random**2 + others) / random
        self.linear = together + shifted
        # Beyond linear errors: what is left of a drive is known to this part only.
        self.column_open = np.abs(self.of_left) / np.maximum(ports.left, LEAST)
        self.row_open = self.sums * live._law.lead / np.maximum(ports.row_left, LEAST)
        self.opens_scales = bool(self.row_open.max() > 0.3) or (
            live._law.has_leads and bool(self.column_open.max() > 0.2)
        )
        self.opens_scales = self.opens_scales or bool(np.isinf(self.of_left).any())
        self.drive_open = None if not live._law.law.drive[1].any() else (
            np.abs(ports.drive) < 3.0 * self.error * np.abs(live._law.law.drive[1])
        ) | (ports.drive * live._law.law.drive[0] < 0.0)
        if self.drive_open is not None:
            self.drive_open = self.drive_open | live._enclosure.may_follow(ports, volts)
        if self.drive_open is not None and self.drive_open.any():
            self.opens_scales = True
            self.linear = np.where(self.drive_open, inf, self.linear)

    def _alike(self, volts: FloatArray) -> FloatArray | float:
        """V^2 (M,), squared error of a reading that counts in its column: equal readings are rounded alike."""
        live, rows = self._live, len(volts)
        independent = hypot(self._by_steps, self._by_noise) ** 2
        if not live.scales_columns or 3.0 * rows <= _STEPS**2 or self._noise > live._half_step:
            return independent
        alike = np.count_nonzero(volts == np.sort(volts, axis=0)[rows // 2], axis=0)
        steps = np.maximum((3.0 * alike**2 + _STEPS**2 * (rows - alike)) / rows, _STEPS**2) * live._random**2 / 3.0
        per_reading: FloatArray = steps + self._by_noise**2
        return per_reading

    def relative(self, conductance: FloatArray, scale: float) -> FloatArray:
        """Relative uncertainty (N, M) of the cells."""
        opened = self.column_open + self.row_open[:, None]
        u = self.linear / np.maximum(1.0 - opened, LEAST)
        u = np.where(opened < 1.0, u, inf)
        more = self._ports.cells / np.where(conductance > 0.0, conductance, np.finfo(np.float64).tiny)
        return u * np.maximum(more, 1.0)

    def by_readings(self, total: FloatArray) -> FloatArray:
        """Relative change (N, M) by errors of all readings, of half a step and :data:`SIGMAS` of the noise each."""
        return np.maximum(np.minimum(np.minimum(self._std * self.error, total), 1.0), np.minimum(self.own, 1.0))


def _accelerated(
    log: FloatArray, step: FloatArray, before: list[tuple[FloatArray, FloatArray]], counted: BoolArray
) -> FloatArray:
    """The step (N, M) of a fixed-point iteration by the last ones (Anderson 1965, of depth two)."""
    recent = before[-2:]
    if not recent:
        return step
    moves = [log - place for place, _ in recent]
    changes = [step - old for _, old in recent]
    weighted = np.array([np.where(counted, change, 0.0).ravel() for change in changes])
    square = weighted @ weighted.T
    square.flat[:: len(square) + 1] += 1e-12 * np.trace(square) + 1e-300
    try:
        share = np.clip(np.linalg.solve(square, weighted @ step.ravel()), -10.0, 10.0)
    except np.linalg.LinAlgError:
        return step
    better = step.copy()
    for part, move, change in zip(share, moves, changes, strict=True):
        better -= part * (move + change)
    return better


def _with_resistance(fault: Fault) -> Fault:
    """The fault, with a resistance far below that of any wire where it has none."""
    return fault.replace(resistance=_COMPLETE_SHORT) if fault.kind == "shorted-cell" and fault.ohms == 0 else fault
