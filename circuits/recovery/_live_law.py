"""Live recovery of boards whose idle lines are driven, or whose amplifiers hold all columns: the stages of a frame.

=======================  ============================================================================
:mod:`._law`             port conductances and cells by Kirchhoff's laws of columns and rows
:mod:`._law_errors`      their errors by ADC steps and noise
:mod:`._factors`         everything beyond these laws, as one factor for each cell
:mod:`._enclosure`       cells beside others whose readings do not determine them
=======================  ============================================================================
"""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...errors import SolverError
from .._board import Board, broken_off, cell_alone
from .._exact import read_exactly
from ._answers import MOST_WIRE, Answers, are_one, several_answers
from ._enclosure import Enclosed, Enclosure, Unknowns
from ._factors import EVALUATIONS, OPEN, Factors
from ._law import Law, Ports
from ._law_errors import ALIKE, LawErrors, Steps
from ._law_kernels import LEAST, OPEN_SCALE
from ._lines import LineResistance
from ._live_fit import MOST_BESIDE, FitLive
from ._live_reading import (
    DISTURBED,
    HIDDEN,
    NO_CURRENT,
    SATURATED,
    UNCERTAIN,
    UNSETTLED,
    LiveReading,
    UsualReading,
    ValidityRule,
    undetermined,
)
from ._quick_model import COMPLETE_SHORT, QuickModel, with_resistance
from ._usual_frames import BEYOND, UsualFrames

_SHEET_EVALUATIONS = 1  # of a continuous sheet in a frame, a hundred times as dear as that of a sliced one
_DOMINATED = 0.1  # share of the drive at a column over the largest one, up to which a cell is small beside another
_MOST_HIDDEN = 10.0  # conductance of a cell behind a named break over the median of others, if no range is known
_HIDDEN_MARGIN = 2.0  # for some of the cells behind a break that conduct well, where the effects of all at once cancel
_OFTEN = 3  # frames with readings that no cells give, after which the design is taken for wrong


class LawLive:
    """Live recovery of boards whose circuits state a :class:`..readouts.PortLaw`."""

    def __init__(self, board: Board, rule: ValidityRule, least_ohm: float) -> None:
        """For a board with a converter, whose cells have at least so many ohm, shorts apart."""
        whole = replace(board, supply=(-inf, inf), faults=tuple(map(with_resistance, board.faults)))
        self._board = sliced = replace(whole, continuous=False)
        self._sheet = whole if board.continuous else None
        self._rule, self._turn, self._shape = rule, board.turn, board.shape
        self.scales_columns = not (board.circuit.has_amplifiers or board.turned)
        lines = LineResistance(sliced)
        to_driver, to_end, column_lead = (
            np.where(np.isfinite(ohms), ohms, 0.0) for ohms in (lines.to_driver, lines.to_end, board.column_lead)
        )
        wire = column_lead + to_end.mean(axis=0)
        law = board.circuit.port_law(sliced, wire)
        assert law is not None
        hidden = broken_off(board) | np.isinf(board.series_ohms)
        self._gone, self._hidden = hidden.copy(), hidden
        self._shorted = np.zeros(board.shape, dtype=np.bool_)
        self._shunt = np.zeros(board.shape)  # S
        for fault, present in zip(board.shorts, sliced.shorts, strict=True):
            self._shorted[fault.place] |= fault.ohms == 0
            self._shunt[fault.place] += 1.0 / present.ohms
        self._gone |= self._shorted
        self._some_hidden = bool(hidden.any() and not hidden.all())
        self._by_hidden: FloatArray | float = 0.0
        self._most_hidden = 1.0 / least_ohm if least_ohm else inf  # S
        self._present = None if not self._gone.any() else np.ascontiguousarray(~self._gone)
        self._faulty = bool(self._shunt.any() or board.series_ohms.any())
        lost = hidden.any() or (board.floating and self._shorted.any())
        one_by_one = board.circuit.columns_one_by_one(board)
        # Cells behind a break join lines, which no current passes where all lines but the read one are held.
        held = not (board.circuit.mixes_cells or board.floating)
        if board.circuit.drives_idle_lines:  # as the column that is read, which the selected row is not
            held &= bool((np.count_nonzero(hidden, axis=0) <= 1).all())
        else:
            held &= not (one_by_one and bool(board.idle_resistance.any()))
        self._tells = held or not lost
        self._steps = Steps.of(board)
        lead = to_driver.mean(axis=1)
        segments = np.where(np.isfinite(board.row_ohms), board.row_ohms, 0.0)
        shared = np.where(np.isfinite(lines.row), lines.row, 0.0)
        for ohms in (lead, segments, shared):  # a complete short leaves a row no drive
            ohms[self._shorted.any(axis=1)] = 0.0
        shorts = np.where(self._shorted, 1.0 / (to_driver + COMPLETE_SHORT), 0.0)
        self._whole_wires = to_driver + to_end + column_lead
        self._law = Law(
            *(law, lead, segments, wire, to_end - to_end.mean(axis=0)),
            *(hidden, shorts, self._steps.half),
            one_by_one=one_by_one,
            floating=board.floating,
            virtual_ground=board.circuit.virtual_ground,
        )
        self._answers = Answers(sliced, least_ohm) if several_answers(board) else None
        self._enclosure = Enclosure(board, self._law, shared, to_driver, to_end)
        self._wires = np.abs(to_driver - lead[:, None]) + np.abs(to_end - to_end.mean(axis=0))
        self._any_wire = bool(self._wires.any())
        self._model = QuickModel(sliced, lines)
        self._beside_short = self._shorted.any(axis=1, keepdims=True) & np.ones_like(self._shorted)
        self._beside_short |= self._shorted.any(axis=0)
        exact = board.plain and not (board.floating or self._law.has_leads or board.column_ohms.any())
        evaluations = _SHEET_EVALUATIONS if board.continuous else EVALUATIONS
        self._factors = None
        if not exact:
            self._factors = Factors(board.shape, self._law_of_model, self._enclosure.coupling, evaluations)
        beside_end = np.abs(to_end - to_end.mean(axis=0)).max(axis=0)
        rest = np.maximum(self._law.behind, beside_end + LEAST)
        self._beside_law = beside_end / rest  # relative change of a column's share by segments
        self._fit = None
        small = board.shape[0] * board.shape[1] <= MOST_BESIDE
        mixes = (board.circuit.mixes_cells and self._answers is None) or not self._tells
        if board.bridges or (mixes and small):
            self._fit = FitLive(board, rule, least_ohm)
        self.usual: UsualReading | None = self._usual_frames(board)
        self._impossible = 0
        self._every = np.ones(board.shape, dtype=np.bool_), np.zeros(board.shape, dtype=np.int8)
        for shared in self._every:
            shared.flags.writeable = False

    def _usual_frames(self, board: Board) -> UsualFrames | None:
        """What measures the usual frames; None if there are none on this board."""
        law, steps = self._law, self._steps
        assert board.adc is not None
        if self._faulty or self._present is not None or not self._tells or self._answers is not None or board.faults:
            return None
        constants = {
            "step": board.adc.step,
            "half": steps.half,
            "random": steps.random,
            "shared": steps.shared,
            "alike": ALIKE if steps.alike else 1.0,
            "accuracy": self._rule.limit,
            "averages": self._rule.averages,
            "scales_columns": self.scales_columns,
            "mixes": law.has_potential,
            "has_leads": law.has_leads,
            "one_by_one": law.one_by_one,
            "floating": board.floating,
            "factors": self._factors is not None,
            "fits": self._fit is not None and self._factors is not None,
            "turned": board.turned,
        }
        return UsualFrames(
            law, self._factors, self._enclosure, self._beside_law, (self._wires, self._whole_wires), constants
        )

    @np.errstate(all="ignore")
    def __call__(
        self,
        volts: FloatArray,
        limited: BoolArray | None = None,
        noise: float = 0.0,
        *,
        under_range: BoolArray | None = None,
    ) -> LiveReading:
        """As :class:`.LiveRecovery`."""
        turn = self._turn
        unknowns = None
        if limited is not None or under_range is not None:
            limited, under_range = (
                None if cells is None else turn(cells) & ~self._shorted for cells in (limited, under_range)
            )
            unknowns = Unknowns.of(self._shape, limited, under_range)
        volts = np.array(turn(volts), order="C")
        # An output at a limit does not hold its line, nor what a bridge or hidden cells join with it.
        joined = bool(self._board.bridges) or not self._tells
        if joined and unknowns is not None and self._enclosure.unheld(unknowns):
            return self._nothing(unknowns)
        if not self._tells:
            return self._nothing(unknowns) if self._fit is None else self._fit.read(volts, limited, under_range, noise)
        unknown = None if unknowns is None else np.ascontiguousarray(unknowns.any)
        ports = self._law(volts, unknown)
        errors = LawErrors(self._law, self._steps, ports, volts, noise, unknown)
        self._count_impossible(ports, errors, unknowns)
        cells, settled, limit = ports.cells, True, self._rule.limit
        answers = None
        if self._answers is not None:
            answers = self._answers(volts, errors.error, unknowns)
        opened, enclosed = unknowns is not None or errors.opens, None
        bridged = bool(self._board.bridges)  # no law of single lines holds
        if (opened or bridged) and self._fit is not None and self._factors is not None and _lone(ports, errors):
            return self._fit.read(volts, limited, under_range, noise, ports.cells)
        if bridged:
            return self._nothing(unknowns)
        if self._factors is None:
            enclosed = self._enclosure(ports, errors, cells, unknowns, volts) if opened else None
            return self._reading(errors, cells, errors.relative(cells), enclosed, unknowns, answers, settled=True)
        # What others leave open is found first: factors need be no better than that.
        by_others: FloatArray | float = 0.0
        if opened:
            estimate = np.maximum(self._factors.estimate(cells), OPEN)
            enclosed = self._enclosure(ports, errors, estimate, unknowns, volts)
            by_others = enclosed.change
        counted = self._every[0] if self._present is None else self._present
        if unknown is not None:
            counted = counted & ~unknown
        cells, left, settled = self._factors(
            cells,
            lambda found: errors.relative(found) + by_others,
            errors.linear + by_others,
            counted,
            limit,
        )
        if enclosed is not None and self._factors.renewed:
            enclosed = self._enclosure(ports, errors, cells, unknowns, volts)
        if not settled and self._fit is not None and _lone(ports, errors):
            return self._fit.read(volts, limited, under_range, noise, cells)
        uncertainty = errors.relative(cells)
        moved = self._factors.moved(np.minimum(uncertainty, 1.0) * np.abs(cells), cells, uncertainty <= limit)
        if self._some_hidden and self._factors.renewed and settled:
            self._by_hidden = self._of_hidden(cells)
        uncertainty = uncertainty + moved + self._by_hidden + (left if settled else 0.0)
        return self._reading(errors, cells, uncertainty, enclosed, unknowns, answers, settled=settled)

    def _of_hidden(self, cells: FloatArray) -> FloatArray:
        """Relative change (N, M) of ``cells`` in S over all conductances of those behind a named break."""
        assert self._factors is not None
        usual = self._law_of_model(np.maximum(cells, OPEN))
        change = np.zeros(self._shape)
        for hidden in (OPEN, min(self._most_hidden, _MOST_HIDDEN * float(np.median(cells[~self._hidden])))):
            try:
                moved = self._law_of_model(np.maximum(cells, OPEN), hidden)
            except (SolverError, np.linalg.LinAlgError):
                return np.full(self._shape, inf)
            change = np.fmax(change, np.abs(moved - usual) / np.maximum(np.abs(usual), OPEN))
        # As in the factors, a cell changes by more than what the law makes of it where lines take most of a drive.
        grown: FloatArray = _HIDDEN_MARGIN * change * np.maximum(self._factors.rho, 1.0) ** 2
        return grown

    def _law_of_model(self, conductance: FloatArray, hidden: float | None = None) -> FloatArray:
        """What the laws make of the readings of cells (N, M) in S in the full model, in S.

        Cells behind a break conduct ``hidden`` S; None: as the median of the others.
        """
        own = conductance
        if self._faulty:
            own = np.maximum(cell_alone(self._board, conductance, self._shunt), OPEN)
        if self._some_hidden:  # cells behind a break tie other lines to each other, whatever they are
            own = np.where(self._hidden, np.median(own[~self._hidden]) if hidden is None else hidden, own)
        cells = 1.0 / own
        volts = self._model(cells) if self._sheet is None else read_exactly(self._sheet, cells)[0].volts
        return self._law(np.array(volts, order="C")).cells

    def _count_impossible(self, ports: Ports, errors: LawErrors, unknowns: Unknowns | None) -> None:
        """Raise SolverError for readings that no cells give, frame after frame."""
        by_segments = self._beside_law * np.maximum(1.0 - ports.left, 1.0)
        impossible = unknowns is None and bool((ports.left < -BEYOND * errors.of_left - by_segments).any())
        self._impossible = self._impossible + 1 if impossible else 0
        if self._impossible > _OFTEN:
            raise SolverError("no cell resistances give these readings; check that the design is that of the board")

    def _reading(
        self,
        errors: LawErrors,
        conductance: FloatArray,
        uncertainty: FloatArray,
        enclosed: Enclosed | None,
        unknowns: Unknowns | None,
        answers: tuple[FloatArray, FloatArray] | None,
        *,
        settled: bool,
    ) -> LiveReading:
        """Values, uncertainties, validity, and reasons."""
        turn, own, cells, grown = self._turn, errors.own, conductance, np.array(1.0)
        by_others = None if enclosed is None else enclosed.change
        if self._faulty:
            cells = cell_alone(self._board, np.maximum(conductance, 0.0), self._shunt)
            grown = np.where(cells > 0.0, conductance / cells * (1.0 + self._board.series_ohms * cells) ** 2, inf)
            grown = np.maximum(grown, 1.0)
            uncertainty, own = uncertainty * grown, own * grown
            by_others = None if by_others is None else np.where(by_others > 0.0, by_others * grown, 0.0)
        total = uncertainty if by_others is None else uncertainty + by_others
        if answers is not None:
            (low, high), by_law = answers, errors.cells
            total = np.maximum(total, np.maximum(high - by_law, by_law - low) / np.abs(by_law))
            total = np.where(are_one(low, high), total, inf)
        valid = self._rule.accepts(total)
        short = cells * self._wires > MOST_WIRE if self._any_wire else None
        resistance = 1.0 / np.maximum(cells, 0.0)
        usual = settled and unknowns is None and self._present is None and (short is None or not short.any())
        every = usual and np.count_nonzero(valid) == valid.size
        if every:
            valid, reason = self._every
        else:
            reason = self._reasons(cells, own, total, by_others, unknowns, short, valid, settled=settled)
            total = np.where(valid | ((reason == UNCERTAIN) & settled), total, inf)
        bounds = None if enclosed is None else (enclosed.least, enclosed.greatest)
        if answers is not None:
            bounds = answers if bounds is None else (np.maximum(bounds[0], low), np.minimum(bounds[1], high))
        bounds = None if bounds is None else (turn(bounds[0]), turn(bounds[1]))
        return LiveReading(
            turn(resistance),
            turn(valid),
            turn(reason),
            lambda: turn(total),
            lambda: errors.per_volt(turn, grown),
            every=every or None,
            bounds=bounds,
        )

    def _reasons(
        self,
        cells: FloatArray,
        own: FloatArray,
        total: FloatArray,
        by_others: FloatArray | None,
        unknowns: Unknowns | None,
        short: BoolArray | None,
        valid: BoolArray,
        *,
        settled: bool,
    ) -> NDArray[np.int8]:
        """Why cells are not valid, 0 for valid ones; takes cells for which a reason is found out of ``valid``."""
        reason: NDArray[np.int8] = np.full(self._shape, UNCERTAIN, dtype=np.int8)
        if by_others is not None:
            reason[by_others > 0.5 * total] = DISTURBED
        # A cell far below its wires reads like a short, whatever its own error is.
        like_short = (cells * self._whole_wires > MOST_WIRE) & ~valid
        none = ((own >= 1.0) | ~(cells > 0.0)) & ~like_short
        beside = False if short is None else bool(short.any())  # a short keeps others from settling
        # What others leave open does not wait for the next frames.
        unsettled = None if settled else ~none if beside else valid.copy()
        if short is not None:
            none &= ~short
        for where, why in (
            (unsettled, DISTURBED if beside else UNSETTLED),
            (short, SATURATED),
            (none, NO_CURRENT),
            (like_short, SATURATED),
        ):
            if where is not None:
                reason[where], valid[where] = why, False
        if unknowns is not None:
            reason[unknowns.limited], reason[unknowns.under_range] = SATURATED, NO_CURRENT
            valid[unknowns.any] = False
        reason[self._beside_short], valid[self._beside_short] = DISTURBED, False
        reason[self._gone], valid[self._gone] = HIDDEN, False
        reason[valid] = 0
        return reason

    def _nothing(self, unknowns: Unknowns | None) -> LiveReading:
        """A frame that determines no cell."""
        reason: NDArray[np.int8] = np.full(self._shape, DISTURBED, dtype=np.int8)
        if unknowns is not None:
            reason[unknowns.limited], reason[unknowns.under_range] = SATURATED, NO_CURRENT
        reason[self._gone] = HIDDEN
        return undetermined(self._turn(reason))


def _lone(ports: Ports, errors: LawErrors) -> bool:
    """Whether in each column of open scale a single cell takes nearly all of the current.

    Else derivatives do not tell what the cells of the column change together, since their scale is anywhere.
    """
    if ports.share.shape[0] == 1:
        return True
    among = np.partition(ports.share[:, errors.column_open > OPEN_SCALE], -2, axis=0)
    return bool((among[-2] <= _DOMINATED * among[-1]).all())
