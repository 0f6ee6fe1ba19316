"""Live recovery of boards whose amplifiers hold all sensed lines: line attenuation, relinearised about a base frame.

With T the transfer conductances of the grid, the outputs are

    V_ij = output_j + slope_j (drive T_ij - s_j sum_k T_kj + c_j).

The s_j are the sources behind the columns' ends, and c_j is the current between columns whose sources differ, to first
order in the row resistance. T follows from the outputs by a few operations per cell. A transfer conductance is the
conductance of its cell times an attenuation by its two lines, which changes little from frame to frame:

    G = gain(G) T + shift,      gain(G) = gain_base (1 + (G - G_base) K_row + K_column (G - G_base) + ...).

K are the resistances of shared wire of :mod:`..solvers._attenuation`; the sum in brackets is the derivative of the
attenuation for light lines. A *base* is one evaluation of line attenuation, corrected by what it misses of an exact
solution nearby. The base serves as long as the terms left out stay below a share of an ADC step; otherwise the present
conductances become the new base, within the frame's budget (:data:`EVALUATIONS`, :data:`EXACT_EVALUATIONS`).
"""

from __future__ import annotations

from functools import partial
from math import inf
from typing import NamedTuple, TypeVar

import numpy as np

from ...arrays import BoolArray, FloatArray
from .._adc import adc_error
from .._board import Board, cell_alone
from ..solvers import Attenuated, Lines, Wires, attenuate, exact_transfer, port_conductances, siemens
from ._heavy_leads import LeadFit, Propagation, invert_leads
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

T = TypeVar("T", float, FloatArray)

# Evaluations of the models in one frame, at most. Eight usual frames of 8 x 8 cells take as long, and six of 64 x 64.
EVALUATIONS = 2
"""of line attenuation"""
EXACT_EVALUATIONS = 1
"""of the exact transfer conductances; where leads are heavy, two more check what Kirchhoff's laws say"""
FIRST_EVALUATIONS = 8, 3
"""of both in the first frame of all, before which nothing is known"""
_SHARE_OF_STEP = 0.25  # of an ADC step that the model may leave as its own error
_SECOND_ORDER = 2.0  # terms beyond the first order over the first order times the loss; 1 to 1.5 on boards tried
_FAR = 0.5  # relative change of a gain beyond which the first order says nothing
_MARGIN = 2.0  # by which intervals from first-order bounds on unknown cells are widened
_LEAST_SHARE = 1e-9  # of the largest conductance: an open cell's stand-in, so that every ratio is defined
_BOUNDLESS = 1e6  # relative change of a conductance that counts for any larger one
_SIMILAR = 0.1  # relative change of conductances up to which bounds on unknown cells are kept
_SIMILAR_MARGIN = 1.25  # by which kept bounds are widened: two conductances have changed by 1.1 against each other
_HEAVY = 0.5  # share of a cell's current that its lines take, from which on attenuation may not come to its end
_LEAD_LIKE = 0.5  # most resistance of segments over that of leads, for which a grid is taken for one without segments
_NONE = np.array(0.0)  # as an array, since NumPy makes one of a float in every call
_GUARD = 6.0  # standard deviations of the noise within which an output may stand at a limit of its swing


class _Base(NamedTuple):
    """What frames are compared with. Arrays are (N, M) in line coordinates."""

    conductance: FloatArray
    """S"""
    gain: FloatArray
    """conductance per transfer conductance, as far as the lines take the cell's own current"""
    shift: FloatArray | None
    """S, conductance that the current of other cells feigns; None where it is far below an ADC step"""
    loss: float
    """largest share of a cell's own current that its lines take"""
    missing: float
    """S, largest part of a transfer conductance that is other cells' current"""
    off: FloatArray | None
    """S by which the model may be wrong; None where that is below the tolerance"""
    propagation: Propagation | None = None
    """of errors of the readings, where the leads are heavy; else :meth:`AmplifiedLive._by_lines` says enough"""

    def own_part(self, transfer: FloatArray) -> FloatArray:
        """S (N, M) of transfer conductances that is the cells' own current: an ADC step is a share of that."""
        return transfer if self.shift is None else np.maximum(transfer + self.shift / self.gain, 0.0)


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


class _Levels(NamedTuple):
    """How well readings of a certain noise are known. Arrays broadcast to (N, M) in line coordinates."""

    noise: float
    """V, standard deviation of the readings"""
    gain: FloatArray
    """conductance per transfer conductance, for which the levels hold"""
    own: FloatArray
    """S by which a cell's own transfer conductance may be off: half a step, noise, and what the model leaves"""
    others: FloatArray
    """relative uncertainty by the readings of other cells on light lines"""
    by_leads: FloatArray
    """S by which a transfer conductance may be off for the readings of other cells, where leads are heavy; else 0"""
    least: FloatArray
    """S, transfer conductance from which on a cell is valid"""
    propagation: Propagation | None
    """the base's, with which this was worked out"""


class _Beside(NamedTuple):
    """What cells at limits make of the others. Arrays are (N, M)."""

    limited: BoolArray
    more: BoolArray
    """at the high end: the cell conducts more than the reading says"""
    conductance: FloatArray
    """S, for which this was worked out"""
    floor: float
    """S, least conductance that a relative change refers to"""
    fixed: FloatArray
    """relative change whatever the conductances"""
    added: FloatArray
    """S, current of other cells that may appear in a reading, per volt"""
    by_lines: FloatArray
    """relative change because lines are loaded otherwise"""

    def holds(self, conductance: FloatArray, limited: BoolArray, more: BoolArray) -> bool:
        """Whether the same cells are at the same limits and the lines' other cells have not changed by much."""
        if not (np.array_equal(limited, self.limited) and np.array_equal(more, self.more)):
            return False
        return _similar(np.where(limited, self.conductance, conductance), self.conductance)


class AmplifiedLive:
    """Amplifiers that hold all columns of a plain grid, rows grounded."""

    def __init__(self, board: Board, rule: ValidityRule) -> None:
        """For a board whose circuit has ends (:meth:`.ReadoutCircuit.ends`) and whose design has a converter."""
        adc, ends = board.adc, board.circuit.ends(board)
        assert adc is not None
        assert ends is not None
        self._board, self._rule = board, rule
        rows = board.shape[0]
        self._source = ends.source
        self._per_volt = 1.0 / ends.slope  # A/V
        self._has_sources = bool(ends.source.any())
        self._spread = 2.0 * float(np.ptp(ends.source)) / abs(board.drive)
        self._alike = bool((ends.source == ends.source[0]).all())
        # T = scale V + constant + per_sum (sum of that over the rows); without currents between columns
        self._scale = self._per_volt / board.drive
        self._constant = -ends.output * self._scale
        # The same for all cells: operations on arrays of one shape take a third of the time.
        self._scale_of_all, self._constant_of_all = (
            np.ascontiguousarray(np.broadcast_to(part, board.shape)) for part in (self._scale, self._constant)
        )
        self._per_sum = ends.source / (board.drive - rows * ends.source)
        self._ones = np.ones(rows)
        resistance = ends.resistance + board.column_lead
        with np.errstate(divide="ignore"):
            self._lines = Lines(board.lines.row, board.lines.column, 1.0 / resistance)
        self._wires = Wires.of(self._lines)
        self._to_driver = np.cumsum(board.row_ohms, axis=1)
        self._behind = np.concatenate([board.column_ohms[1:], resistance[None]])  # ohm (N, M) of wire
        self._to_amplifier = np.cumsum(self._behind[::-1], axis=0)[::-1]
        self._farthest_driver = self._to_driver.max(axis=0)  # (M,) ohm
        self._farthest_amplifier = self._to_amplifier.max(axis=1)  # (N,) ohm
        self._row_lead, self._column_lead = self._to_driver.mean(axis=1), self._to_amplifier.mean(axis=0)  # ohm
        along_rows, along_columns = (
            np.ptp(self._to_driver, axis=1),
            np.ptp(self._to_amplifier, axis=0),
        )  # ohm of segments
        leads = float(self._row_lead.mean() + self._column_lead.mean())
        self._lead_like = float(along_rows.max() + along_columns.max()) <= _LEAD_LIKE * leads
        self._heavy = False  # the leads take so much that cells are found by Kirchhoff's laws
        self._has_segments = bool(along_rows.any() or along_columns.any())
        self._by_segments = np.zeros(board.shape)  # S, of T, that segments add to what leads would give
        self._along_row = _shared_wire(self._to_driver)
        self._along_column = _shared_wire(self._to_amplifier.T)
        self._step, self._middle = adc.step, sum(adc.range) / 2
        self._near = adc_error(board) + adc.step / 2  # V within which an output stands at a limit of its swing
        self._half_step = adc_error(board) * np.abs(self._scale)  # S (M,), of T
        self._tolerance = _SHARE_OF_STEP * adc.step * np.abs(self._scale)  # S (M,), of T
        self._least_tolerance = float(self._tolerance.min())
        swing = max((abs(limit - board.level) for limit in board.supply if np.isfinite(limit)), default=inf)
        self._most_per_ohm = (1.0 + swing / abs(board.drive)) / board.reference  # S (M,) into a saturated column's end
        self._ideal = not (self._to_driver.any() or board.column_ohms.any())
        self._shunt = np.zeros(board.shape)
        shunts = [fault for fault in board.shorts if fault.ohms > 0]
        for fault in shunts:
            self._shunt[fault.place] += siemens(fault.ohms)
        self._faulty = bool(board.series_ohms.any() or shunts)
        self._hidden = np.isinf(board.series_ohms)
        self._base: _Base | None = None
        self._anchor: _Anchor | None = None
        self._levels: _Levels | None = None
        self._unknown: _Beside | None = None
        self._between: FloatArray | None = None  # S (M,), of T
        self._model_error = self._tolerance  # S (M,), of T
        self._exact_left = 0  # evaluations in the present frame
        self._propagated_at: FloatArray | None = None  # S (N, M) of the base's propagation
        self._all = np.ones(board.shape, dtype=np.bool_)
        self._no_reason = np.zeros(board.shape, dtype=np.int8)
        self._turned_all = np.ascontiguousarray(board.turn(self._all))
        self._turned_no_reason = np.ascontiguousarray(board.turn(self._no_reason))
        for shared in (self._all, self._no_reason, self._turned_all, self._turned_no_reason):
            shared.flags.writeable = False

    def __call__(self, volts: FloatArray, limited: BoolArray | None = None, noise: float = 0.0) -> LiveReading:
        """As :class:`.LiveRecovery`."""
        if not self._board.turned:
            return self._read(volts, limited, noise)
        turn = self._board.turn
        found = self._read(
            np.ascontiguousarray(turn(volts)), None if limited is None else np.ascontiguousarray(turn(limited)), noise
        )
        every = found.valid is self._all
        return LiveReading(
            np.ascontiguousarray(turn(found.resistance)),  # what follows is faster in the usual order
            self._turned_all if every else turn(found.valid),
            self._turned_no_reason if every else turn(found.reason),
            lambda: (turn(found.uncertainty), turn(found.own)),
        )

    def _read(self, volts: FloatArray, limited: BoolArray | None, noise: float) -> LiveReading:
        transfer = self._transfer(volts)
        if self._ideal:
            conductance, gain = self._of_independent_columns(transfer)
            off = None
        else:
            if self._base is None:
                transfer = self._begin(volts, transfer)
            conductance, off = self._settle(volts, transfer)
            assert self._base is not None
            gain = self._base.gain
            transfer = self._base.own_part(transfer)
        levels = self._levels_at(gain, noise)
        if limited is None and off is None and not self._faulty:
            valid = transfer >= levels.least
            if np.count_nonzero(valid) == valid.size:
                return LiveReading(
                    np.reciprocal(conductance), self._all, self._no_reason, partial(_uncertainties, transfer, levels)
                )
        return self._examined(transfer, conductance, levels, off, volts, limited)

    def _begin(self, volts: FloatArray, transfer: FloatArray) -> FloatArray:
        """Make the first base, and return the transfer conductances (N, M) in S again that it makes known better."""
        self._exact_left = FIRST_EVALUATIONS[1]
        for _ in range(FIRST_EVALUATIONS[0] - EVALUATIONS):
            self._base = self._based_on(transfer if self._base is None else self._from_base(transfer)[0])
            transfer = self._transfer(volts)
            if self._from_base(transfer)[1] is None:
                break
        return transfer

    def _transfer(self, volts: FloatArray) -> FloatArray:
        """S (N, M): transfer conductances from outputs in V; 0 where the current has the wrong sign."""
        transfer: FloatArray = volts * self._scale_of_all
        transfer += self._constant_of_all
        if self._has_sources:
            if self._between is not None:
                transfer -= self._between
            transfer += self._per_sum * (self._ones @ transfer)
        np.maximum(transfer, _NONE, out=transfer)
        return transfer

    def _between_columns(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """S (M,) that currents between columns of different sources add to each T of a column, and how far that is off.

        The columns' sources drive these currents through the rows that the columns share, which lifts the rows. To
        first order in the resistance of the rows; what is left out is smaller by the loss in the lines.
        """
        source, known = self._source, transfer
        given = (self._drop_along_rows(known * source) * known).sum(axis=0) / self._board.drive
        taken = source * (self._drop_along_rows(known) * known).sum(axis=0) / self._board.drive
        left: FloatArray = 2.0 * (np.abs(given) + np.abs(taken))
        return given - taken, left

    def _of_independent_columns(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Conductances (N, M) in S and gains (M,) where only the columns' ends have resistance, in closed form.

        T = G / (1 + R sum G), R the resistance of a column's end.
        """
        gain = 1.0 / np.maximum(1.0 - self._to_amplifier[0] * (self._ones @ transfer), _LEAST_SHARE)
        return transfer * gain, gain

    def _settle(self, volts: FloatArray, transfer: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Conductances (N, M) in S.

        Where the frame's budget did not suffice, also the S (N, M) by which the model may be wrong.
        """
        self._exact_left = max(self._exact_left, EXACT_EVALUATIONS)
        if self._heavy and self._by_leads(volts):
            assert self._base is not None
            return self._base.conductance, self._base.off
        conductance, off = self._from_base(transfer)
        for _ in range(EVALUATIONS):
            if off is None:
                break
            self._base = self._based_on(conductance)
            conductance, off = self._from_base(transfer)
        assert self._base is not None
        if self._base.loss > _HEAVY:
            self._heavy = self._lead_like
            if self._heavy and self._by_leads(volts):
                conductance, off = self._base.conductance, self._base.off
            elif off is not None and self._lead_like:  # a bound of first order says nothing
                off = np.full_like(off, inf)
            elif off is not None:
                gain = self._base.gain
                off = self._within_linear_range(off * gain / max(1.0 - self._base.loss, _LEAST_SHARE)) / gain
        self._exact_left = 0
        return conductance, off

    def _by_leads(self, volts: FloatArray) -> bool:
        """Make the present cells the base by :func:`.invert_leads`, checked by an exact evaluation; both at most twice.

        Returns:
            False where this is not possible, and the base is as before.

        """
        assert self._base is not None
        current = volts * self._scale + self._constant  # A per volt of drive
        fit = self._fit_leads(current, self._base.conductance)
        if fit is None:
            self._heavy = False
            return False
        transfer, off = self._apart(current, fit.conductance)
        if self._has_segments and fit.settled and (np.abs(off) > self._tolerance).any():
            self._by_segments = self._by_segments + off
            corrected = self._fit_leads(current, fit.conductance)
            if corrected is not None:
                fit = corrected
                transfer, off = self._apart(current, fit.conductance)
        propagation = self._propagation_of(fit)
        conductance, gain = self._above_floor(fit.conductance), fit.gain
        own = fit.conductance / gain
        off = np.abs(off)
        settled = bool((off <= self._tolerance).all())
        self._model_error = self._tolerance
        self._base = _Base(
            conductance=conductance,
            gain=gain,
            shift=(own - transfer) * gain,
            loss=max(1.0 - 1.0 / float(gain.max()), 1e-9),
            missing=max(float((transfer - own).max()), 0.0),
            off=None if settled else _MARGIN * self._moved_by(propagation, off) / gain,
            propagation=propagation,
        )
        self._heavy = self._base.loss > 0.5 * _HEAVY
        return True

    def _propagation_of(self, fit: LeadFit) -> Propagation:
        """How errors of the readings come through; kept from frame to frame while no conductance has changed much."""
        at, kept = self._propagated_at, None if self._base is None else self._base.propagation
        if kept is not None and at is not None and _similar(fit.conductance, at):
            return kept
        self._propagated_at = fit.conductance
        return fit.propagation()

    def _moved_by(self, propagation: Propagation, readings: FloatArray) -> FloatArray:
        """S (N, M) by which conductances may be off where readings may be off by these S (N, M)."""
        return self._within_linear_range(_SIMILAR_MARGIN * propagation(readings))

    def _within_linear_range(self, change: FloatArray) -> FloatArray:
        """Bounds (N, M) in S of first order on changes of conductances; inf if they move the gains too far for that.

        What the lines take of a cell's current makes gains of about one and the resistance of the lines over that of
        their cells.
        """
        assert self._base is not None
        allowed = _FAR * (1.0 + self._by_lines(self._base.conductance))
        known: FloatArray = change if (self._by_lines(change) <= allowed).all() else np.full_like(change, inf)
        return known

    def _fit_leads(self, current: FloatArray, start: FloatArray) -> LeadFit | None:
        """Cells with these currents (N, M) into the amplifiers in A per volt, from ``start`` (N, M) in S on."""
        current = current + self._by_segments
        potential = current * self._column_lead + self._source / self._board.drive
        return invert_leads(current, potential, self._row_lead, self._column_lead, start)

    def _source_currents(self, conductance: FloatArray) -> FloatArray:
        """A (M,) per volt that the columns' sources drive into their amplifiers through cells (N, M) in S."""
        if self._has_segments:
            rows = len(conductance)
            ports, _ = port_conductances(self._above_floor(conductance), self._board.lines)
            among = np.diag(ports.sum(axis=1))[rows:, rows:] - ports[rows:, rows:]
        else:
            idle = self._row_lead / (1.0 + self._row_lead * conductance.sum(axis=1))
            among = np.diag(conductance.sum(axis=0)) - (conductance.T * idle) @ conductance
        lines = np.eye(len(among)) + among * self._behind[-1]
        current: FloatArray = -np.linalg.solve(lines, among @ (self._source / self._board.drive))
        return current

    def _apart(self, current: FloatArray, conductance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Transfer conductances (N, M) in S by the readings, and how far they are from the cells' exact ones.

        Args:
            current: (N, M) A into the amplifiers per volt of drive.
            conductance: (N, M) S.

        """
        exact, _ = exact_transfer(self._above_floor(conductance), self._lines)
        if not self._has_sources:
            return current, current - exact
        by_sources = self._source_currents(conductance)
        self._between = by_sources + self._source / self._board.drive * exact.sum(axis=0)
        transfer = current - by_sources
        return transfer, transfer - exact

    def _from_base(self, transfer: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Conductances (N, M) in S, and the S by which T may be off for them; None where that is small enough."""
        base = self._base
        assert base is not None
        conductance = base.gain * transfer
        if base.shift is not None:
            conductance += base.shift
            np.maximum(conductance, _NONE, out=conductance)
        change = conductance - base.conductance
        size = np.abs(change)
        by_row, by_column = size.dot(self._farthest_driver), self._farthest_amplifier.dot(size)
        most = by_row.item(by_row.argmax()) + by_column.item(by_column.argmax())
        if base.off is None and most <= _FAR:
            # No cell is off by more than one with the largest reading would be on the lines that have changed most.
            left_out = self._left_out(base, most, transfer.item(transfer.argmax()))
            if left_out <= self._least_tolerance:
                return self._relinearised(conductance, change), None
        by_lines = by_row[:, None] + by_column
        if most <= _FAR:
            conductance = self._relinearised(conductance, change)
            off = self._left_out(base, by_lines, transfer)
        else:
            off = transfer * by_lines
        if base.off is not None:
            off = off + base.off
        return conductance, None if (off <= self._tolerance).all() else off

    def _left_out(self, base: _Base, moved: T, transfer: T) -> T:
        """S that the relinearised model leaves out of T, where changed conductances move gains by the share ``moved``.

        The terms beyond the first order of the attenuation; currents between columns, which are those of the base; and
        other cells' current, which changes about as the losses of its lines do.
        """
        share = _SECOND_ORDER * (base.loss + moved) + self._spread
        left_out = transfer * moved * share
        if base.shift is not None:
            left_out = left_out + moved * (2.0 * base.missing / base.loss)
        return left_out

    def _relinearised(self, conductance: FloatArray, change: FloatArray) -> FloatArray:
        """Conductances (N, M) in S with the gains after a ``change`` (N, M) in S from the base, to first order."""
        gain = self._drop_along_rows(change)
        gain += self._drop_along_columns(change)
        gain *= conductance
        gain += conductance
        return gain

    def _drop_along_rows(self, current: FloatArray) -> FloatArray:
        """V (N, M) along the rows for currents (N, M) in A that leave them at the crosspoints."""
        if self._along_row is not None:
            drop: FloatArray = current.dot(self._along_row)
            return drop
        flow = np.cumsum(current[:, ::-1], axis=1)[:, ::-1]
        return np.cumsum(self._board.row_ohms * flow, axis=1)

    def _drop_along_columns(self, current: FloatArray) -> FloatArray:
        """V (N, M) along the columns for currents (N, M) in A into them at the crosspoints."""
        if self._along_column is not None:
            drop: FloatArray = self._along_column.dot(current)
            return drop
        flow = np.cumsum(current, axis=0)
        return np.cumsum((self._behind * flow)[::-1], axis=0)[::-1]

    def _based_on(self, conductance: FloatArray) -> _Base:
        """One evaluation of the circuit model: attenuation, with what it misses taken from an exact solution nearby."""
        conductance = self._above_floor(conductance)
        known = None if self._wires is None else attenuate(conductance, self._wires)
        missing, off = None, None
        if known is None:  # lines so heavy that the drive underflows before their end
            own, _ = exact_transfer(conductance, self._lines)
        else:
            own = known.transfer
            missing, off = self._missing(conductance, known)
        gain = conductance / np.maximum(own, _LEAST_SHARE * conductance)
        if self._has_sources and not self._alike:
            self._between, left = self._between_columns(own)
            self._model_error = self._tolerance + left
        return _Base(
            conductance=conductance,
            gain=gain,
            shift=None if missing is None else -gain * missing,
            loss=max(1.0 - 1.0 / float(gain.max()), 1e-9),
            missing=0.0 if missing is None else float(missing.max()),
            off=off,
        )

    def _above_floor(self, conductance: FloatArray) -> FloatArray:
        """Conductances (N, M) in S with stand-ins for open cells."""
        floor = _LEAST_SHARE * max(float(conductance.max()), 1e-12)
        return np.maximum(conductance, floor)

    def _missing(self, conductance: FloatArray, known: Attenuated) -> tuple[FloatArray | None, FloatArray | None]:
        """S (N, M) that attenuation misses, other cells' current; None where that is below the tolerance.

        Where the frame has no exact evaluation left, also the S (N, M) by which this may be off.
        """
        bound = known.error
        if (bound <= self._tolerance).all():
            return None, None
        scaled, off = (None, bound) if self._anchor is None else self._anchor.scaled(bound)
        if (off <= self._tolerance).all():
            return scaled, None
        if self._exact_left == 0:
            return scaled, off
        self._exact_left -= 1
        transfer, _ = exact_transfer(conductance, self._lines)
        self._anchor = _Anchor(transfer - known.transfer, bound)
        return self._anchor.missing, None

    def _levels_at(self, gain: FloatArray, noise: float) -> _Levels:
        """How well readings are known at these gains and with noise of this standard deviation in V."""
        levels = self._levels
        propagation = None if self._base is None else self._base.propagation
        if (
            levels is not None
            and 0.6 * levels.noise <= noise <= levels.noise
            and (levels.propagation is propagation if propagation is not None else self._holds(levels.gain, gain))
        ):
            return levels
        noise *= 1.2  # so that a noise that moves about does not call for new levels in every frame
        own_noise = SIGMAS * noise * np.abs(self._scale)
        own = self._half_step + own_noise + self._model_error
        others, by_leads = _NONE, _NONE
        if propagation is None:
            others = self._others_of_light_lines(gain, own_noise)
        else:
            by_leads = self._others_of_heavy_leads(propagation, gain, own, own_noise)
        least = self._rule.least_reading(own + by_leads, others)
        own = np.ascontiguousarray(np.broadcast_to(own, self._board.shape))  # see _scale_of_all
        self._levels = _Levels(noise, gain, own, others, by_leads, least, propagation)
        return self._levels

    def _others_of_light_lines(self, gain: FloatArray, own_noise: FloatArray) -> FloatArray:
        """Relative uncertainty (N, M) by other readings, whose noise is ``own_noise`` (M,) in S."""
        # Quantisation errors of neighbours may all have the same sign; noise adds up by its squares.
        others = self._by_lines(self._half_step * gain)
        if own_noise.any():
            squares = np.broadcast_to((own_noise * gain) ** 2, self._board.shape)
            others = others + np.sqrt(
                np.einsum("ij,ij->i", self._to_driver**2, squares)[:, None]
                + np.einsum("ij,ij->j", self._to_amplifier**2, squares)
            )
        return others

    def _others_of_heavy_leads(
        self, propagation: Propagation, gain: FloatArray, own: FloatArray, own_noise: FloatArray
    ) -> FloatArray:
        """S (N, M) by which a transfer conductance may seem to be off for other readings.

        Args:
            propagation: of errors.
            gain: (N, M) conductance per transfer conductance.
            own: (M,) S that readings may be off by, noise included.
            own_noise: (M,) S, the noise in that.

        """
        shape = self._board.shape
        spread = propagation(np.broadcast_to(own - own_noise, shape))
        if own_noise.any():
            spread = spread + np.sqrt(propagation.squared()(np.broadcast_to(own_noise**2, shape)))
        spread = self._within_linear_range(_SIMILAR_MARGIN * spread)
        by_leads: FloatArray = np.maximum(spread / gain - own, 0.0)
        return by_leads

    def _holds(self, before: FloatArray, gain: FloatArray) -> bool:
        """Whether what was worked out for the gains ``before`` holds for ``gain``."""
        return before is gain or (self._ideal and bool((np.abs(gain - before) <= 0.05 * before).all()))

    def _by_lines(self, change: FloatArray) -> FloatArray:
        """Bound on the relative change of each T_ij, to first order, by what lines take of changed conductances."""
        change = np.broadcast_to(change, self._board.shape)
        row: FloatArray = np.einsum("ij,ij->i", self._to_driver, change)
        column: FloatArray = np.einsum("ij,ij->j", self._to_amplifier, change)
        return row[:, None] + column

    def _examined(
        self,
        transfer: FloatArray,
        conductance: FloatArray,
        levels: _Levels,
        off: FloatArray | None,
        volts: FloatArray,
        limited: BoolArray | None,
    ) -> LiveReading:
        """A frame with cells that are not valid, and why they are not. Arrays are (N, M), as in :meth:`_read`."""
        uncertainty, own = _uncertainties(transfer, levels)
        by_readings = uncertainty
        reason = np.full(self._board.shape, UNCERTAIN, dtype=np.int8)
        if off is not None:
            uncertainty = uncertainty + off / np.maximum(transfer, levels.own)
            reason[(uncertainty > by_readings * 1.5)] = UNSETTLED
        if limited is not None:
            disturbance = self._disturbance(conductance, volts, limited, levels.noise)
            reason[disturbance > 0.5 * uncertainty] = DISTURBED
            uncertainty = uncertainty + disturbance
        reason[transfer <= levels.own] = NO_CURRENT
        if self._faulty:
            conductance, uncertainty, own = self._without_faults(conductance, uncertainty, own)
            reason[conductance == 0.0] = NO_CURRENT
        if limited is not None:
            uncertainty[limited], reason[limited] = inf, SATURATED
        if self._faulty:
            uncertainty[self._hidden], reason[self._hidden] = inf, HIDDEN
        valid = self._rule.accepts(uncertainty)
        valid &= conductance > 0.0
        reason[valid] = 0
        resistance = np.divide(1.0, conductance, out=np.full_like(conductance, inf), where=conductance > 0)
        resistance[np.isinf(uncertainty)] = np.nan
        return LiveReading(resistance, valid, reason, lambda: (uncertainty, own))

    def _without_faults(
        self, conductance: FloatArray, uncertainty: FloatArray, own: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Conductances (N, M) in S and relative uncertainties of the cells without known faults beside them."""
        cells = cell_alone(self._board, conductance, self._shunt)
        uncertainty = np.minimum(uncertainty, _BOUNDLESS)
        most = cell_alone(self._board, conductance * (1.0 + uncertainty), self._shunt)
        least = cell_alone(self._board, conductance * np.maximum(1.0 - uncertainty, 0.0), self._shunt)
        with np.errstate(divide="ignore", invalid="ignore"):
            alone = np.maximum(most - cells, cells - least) / cells
            grown = np.maximum(alone / uncertainty, 1.0)
        alone = np.where(np.isfinite(alone), alone, inf)
        return cells, alone, np.where(np.isfinite(alone), own * grown, 1.0)

    def _disturbance(self, conductance: FloatArray, volts: FloatArray, limited: BoolArray, noise: float) -> FloatArray:
        """Relative change (N, M) of each cell while those whose reading is at a limit take any value they can have.

        Kept from frame to frame while the same cells are at the same limits and no conductance has changed much.
        """
        low, high = self._board.supply
        near = self._near + _GUARD * noise
        at_high, at_low = volts >= high - near, volts <= low + near
        upper = at_high | ((volts > self._middle) & ~at_low)
        more_current = upper == ((self._board.drive > 0) != self._board.circuit.inverts)
        conducts_more = limited & more_current
        kept = self._unknown
        if kept is None or not kept.holds(conductance, limited, conducts_more):
            kept = self._beside(conductance, limited, conducts_more, conducts_more & (at_high | at_low))
            self._unknown = kept
        return kept.fixed + _SIMILAR_MARGIN * (kept.added / np.maximum(conductance, kept.floor) + kept.by_lines)

    def _beside(self, conductance: FloatArray, limited: BoolArray, more: BoolArray, saturated: BoolArray) -> _Beside:
        """What cells at limits make of the others, to first order in the lines' losses, all effects added up.

        A cell at the low end of the range takes any conductance up to the present one; what its column's source drives
        through it is in the column's readings in all steps. A cell at the high end takes any conductance from the
        present one up to a short, which has these effects:

        * along its row, a short takes the drive from all cells: to_driver / to_amplifier, like a divider. Where its
          output is at a limit, its column ends in the reference resistor instead, which leaves it little current;
        * down its column, a short into an idle row takes their current: to_amplifier / to_driver;
        * a column that the current of row k lifts also lifts the short's row, whose cells then add to row k's readings;
        * the offset of its column's amplifier drives a current through it, in all steps alike, and lifts its row, whose
          cells feed the other columns; these offsets drive currents through those cells, which seem to conduct less;
        * two shorts on one row join their columns: the currents of other rows into the one reach the other amplifier,
          and the difference of the amplifiers' offsets drives a current;
        * in its own step, the short lifts its column, and that the other rows, whose cells add to its row's readings.

        Args:
            conductance: (N, M) S.
            limited: (N, M) all cells at limits.
            more: (N, M) those that conduct more than the reading says.
            saturated: (N, M) those of them whose amplifier, not only the converter, is at a limit.

        """
        floor = _LEAST_SHARE * max(float(conductance.max()), 1e-12)
        less = np.where(limited & ~more, conductance, 0.0)
        if self._base is None or self._base.propagation is None:
            by_lines = self._by_lines(less)
        else:
            moved = self._moved_by(self._base.propagation, less / self._base.gain)
            by_lines = moved / np.maximum(conductance, floor)
        offset = np.abs(self._source / self._board.drive)
        fixed, added = np.zeros(self._board.shape), offset * less.sum(axis=0) + np.zeros(self._board.shape)
        if more.any():
            with np.errstate(divide="ignore", invalid="ignore"):
                along = np.where(more, np.nan_to_num(self._to_driver / self._to_amplifier, nan=0.0, posinf=inf), 0.0)
                down = np.where(more, np.nan_to_num(self._to_amplifier / self._to_driver, nan=0.0, posinf=inf), 0.0)
                short = np.where(more, 1.0 / (self._to_driver + self._to_amplifier), 0.0)
            # The cells of a column that a short takes the current from conduct more than they seem to.
            column = (conductance * (1.0 + np.minimum(down.sum(axis=0), _BOUNDLESS))).sum(axis=0)
            with np.errstate(invalid="ignore"):
                held = np.where(saturated, np.fmin(along, self._to_driver * (self._most_per_ohm + column)), 0.0)
            fixed = _MARGIN * (np.where(saturated, 0.0, along).sum(axis=1)[:, None] + down.sum(axis=0))
            fixed = fixed + held.sum(axis=1)[:, None]
            most = np.where(more, np.minimum(short, _BOUNDLESS), conductance)
            lifts = most @ np.where(more, self._to_amplifier, 0.0).T
            takes = more @ (self._to_driver * most).T
            np.fill_diagonal(lifts, 0.0)
            np.fill_diagonal(takes, 0.0)
            # A lifted row feeds the columns of its cells, and above all the column that a short of its own joins it to.
            added += lifts @ np.where(more, 0.0, conductance)
            added += self._through_joined_columns(more, conductance)
            added += takes @ most
            with np.errstate(invalid="ignore"):
                added += np.nan_to_num(offset * short.sum(axis=0), nan=0.0, posinf=inf)
            added += self._between_shorts(more)
            # Cells that conduct more than they seem to pass on what lifts their row.
            misjudged = conductance * (1.0 + np.minimum(fixed, _BOUNDLESS))
            added += offset * (more.any(axis=1) @ misjudged)
            added += np.where(more, offset, 0.0).max(axis=1) @ misjudged
            added *= _MARGIN
            # Misjudged cells load their lines otherwise than the model has it, and that concerns all cells there.
            direct = fixed + added / np.maximum(conductance, floor)
            by_lines += self._by_lines(np.where(more, 0.0, np.minimum(direct, _BOUNDLESS) * conductance))
        return _Beside(limited, more, conductance, floor, fixed, added, by_lines)

    def _through_joined_columns(self, more: BoolArray, conductance: FloatArray) -> FloatArray:
        """S (N, M) that each reading may gain from the columns that shorts (N, M) join its column to, row by row.

        A current into one column divides between its own amplifier, the row's driver and the other column's amplifier,
        as between three resistors. With a third column joined, less of it arrives in each.
        """
        added = np.zeros_like(conductance)
        for row in np.flatnonzero(more.sum(axis=1) > 1):
            joined = np.flatnonzero(more[row])
            into, driver = self._to_amplifier[row, joined], self._to_driver[row, joined]
            there = np.minimum.outer(driver, driver)  # ohm of the row's wire that both share
            across = there * into[:, None]  # from a column ...
            with np.errstate(divide="ignore", invalid="ignore"):  # ... to another one
                share = np.nan_to_num(across / (across + np.outer(into, into) + there * into), nan=0.0)
            np.fill_diagonal(share, 0.0)
            gained = conductance[:, joined] @ share
            gained[row] = 0.0  # in its own step, the row is driven
            added[:, joined] += gained
        return added

    def _between_shorts(self, more: BoolArray) -> FloatArray:
        """S (M,) that a column may add to each of its readings for the columns that shorts (N, M) join it to."""
        source, added = self._source / self._board.drive, np.zeros(self._board.shape[1])
        if self._alike:
            return added
        for row in np.flatnonzero(more.sum(axis=1) > 1):
            joined = np.flatnonzero(more[row])
            wire = np.add.outer(self._to_amplifier[row, joined], self._to_amplifier[row, joined])
            wire += np.abs(np.subtract.outer(self._to_driver[row, joined], self._to_driver[row, joined]))
            apart = np.abs(np.subtract.outer(source[joined], source[joined]))
            current = np.divide(apart, wire, out=np.full(wire.shape, inf), where=wire > 0)
            added[joined] += np.where(apart > 0, current, 0.0).sum(axis=1)
        return added


def _uncertainties(transfer: FloatArray, levels: _Levels) -> tuple[FloatArray, FloatArray]:
    """Relative uncertainties (N, M) of the cells, and what of them is by their own readings."""
    reading = np.maximum(transfer, levels.own)
    own = levels.own / reading
    return own + levels.by_leads / reading + levels.others, own


def _similar(conductance: FloatArray, before: FloatArray) -> bool:
    """Whether conductances (N, M) in S have changed so little that bounds on them hold but for a small margin."""
    change = np.abs(conductance - before)
    return bool((change <= _SIMILAR * (before + float(before.mean()))).all())


def _shared_wire(ohms: FloatArray) -> FloatArray | None:
    """Resistance of the wire that two places of a line share on the way to the line's end: the matrix K.

    Args:
        ohms: (lines, places) from each place to the line's end.

    Returns:
        (places, places) ohm, or None if the lines are not alike.

    """
    return np.minimum.outer(ohms[0], ohms[0]) if (ohms == ohms[0]).all() else None
