"""Live recovery of boards whose idle lines are driven, or whose amplifiers hold all columns: the stages of a frame.

=======================  ============================================================================
:mod:`._law_frames`      one frame in one kernel, with factors that hold
:mod:`._law`             port conductances and cells by Kirchhoff's laws of columns and rows
:mod:`._factors`         everything beyond these laws, as one factor for each cell
:mod:`._enclosure`       cells beside others whose readings do not determine them
:mod:`._answers`         bounds on all answers, where there may be several
=======================  ============================================================================
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import BoolArray, FloatArray
from ...common.measurement import Measurement
from ...errors import SolverError
from .._adc import adc_error
from .._board import cell_alone
from .._exact import read_exactly
from ._answers import Answers, several_answers
from ._enclosure import Enclosure
from ._factors import Factors
from ._known_board import KnownBoard
from ._law import Law
from ._law_frames import IMPOSSIBLE, MEASURED, STALE, LawFrames
from ._live_fit import FitLive
from ._live_reading import DISTURBED, HIDDEN, NO_CURRENT, SATURATED, Readings, ValidityRule
from ._measured import constants_of
from ._tuning import (
    ALIKE,
    COMPLETE_SHORT,
    COUPLED,
    EVALUATIONS,
    HIDDEN_MARGIN,
    LEAST,
    MOST_BESIDE,
    MOST_HIDDEN,
    OFTEN,
    OPEN,
    SHEET_EVALUATIONS,
    SIGMAS,
)


class LawLive:
    """Live recovery of boards whose circuits state a :class:`..readouts.PortLaw`."""

    def __init__(self, known: KnownBoard, rule: ValidityRule, least_ohm: float) -> None:
        """For a board with a converter, whose cells have at least so many ohm, shorts apart."""
        board, (to_driver, to_end, column_lead) = known.board, known.wires
        self._board, self._sheet = known.sliced, known.whole if board.continuous else None
        self._rule, self._turn, self._shape = rule, board.transpose, board.shape
        wire = column_lead + to_end.mean(axis=0)
        law = board.circuit.port_law(known.sliced, wire)
        assert law is not None
        self._hidden = hidden = known.cut_off | np.isinf(board.series_ohms)
        self._shorted, self._shunt = known.shorted, known.shunt
        self._some_hidden = bool(hidden.any() and not hidden.all())
        self._most_hidden = 1.0 / least_ohm if least_ohm else inf  # S
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
        lead = to_driver.mean(axis=1)
        segments = np.where(np.isfinite(board.row_ohms), board.row_ohms, 0.0)
        shared = np.where(np.isfinite(known.lines.row), known.lines.row, 0.0)
        for ohms in (lead, segments, shared):  # a complete short leaves a row no drive
            ohms[self._shorted.any(axis=1)] = 0.0
        shorts = np.where(self._shorted, 1.0 / (to_driver + COMPLETE_SHORT), 0.0)
        self._half_step = adc_error(board)
        beside_end = to_end - to_end.mean(axis=0)
        self._law = Law(
            *(law, lead, segments, wire, beside_end),
            *(hidden, shorts, self._half_step),
            one_by_one=one_by_one,
            floating=board.floating,
            virtual_ground=board.circuit.virtual_ground,
        )
        # Bounds are wide behind followers, which leave other answers beside shorts only, and of columns in groups.
        wide = known.exact and (board.circuit.drives_idle_lines or board.shared_by < board.shape[1])
        several = several_answers(board) and not wide
        self._answers = Answers(known, least_ohm) if several else None
        self._enclosure = Enclosure(board, self._law, shared, to_driver, to_end, known.least_short)
        self._model = known.model
        exact = board.plain and not (board.floating or self._law.has_leads or board.column_ohms.any())
        self._fit = None
        small = board.shape[0] * board.shape[1] <= MOST_BESIDE
        mixes = (board.circuit.mixes_cells and self._answers is None) or not self._tells
        # Bounds on all answers do not count bridges.
        fits = (bool(board.bridges) and self._answers is None) or (mixes and small)
        if fits:
            self._fit = FitLive(known, rule, least_ohm)
        self._last_fit = self._fit
        if known.exact and small and self._answers is None and not fits:
            self._last_fit = FitLive(known, rule, least_ohm)
        no_reading = np.zeros(board.shape, dtype=np.int8)
        no_reading[self._shorted.any(axis=1, keepdims=True) | self._shorted.any(axis=0)] = DISTURBED
        no_reading[hidden | self._shorted] = HIDDEN
        self._no_reading, self._present = no_reading, ~(hidden | self._shorted)
        self._frames = self._kernel(known, exact, beside_end, no_reading, fits=fits and not exact)
        evaluations = SHEET_EVALUATIONS if board.continuous else EVALUATIONS
        self._factors = None if exact else Factors(self._frames.kept, self._law, self._law_of_model, evaluations)
        self.usual: Callable[[Readings], Measurement | None] | None = None
        if self._tells and self._answers is None and not board.bridges:
            self.usual = self._measure
        self._impossible = 0

    def _kernel(
        self, known: KnownBoard, exact: bool, beside_end: FloatArray, no_reading: NDArray[np.int8], *, fits: bool
    ) -> LawFrames:
        """What measures the frames."""
        board, law, (to_driver, to_end, column_lead) = known.board, self._law, known.wires
        assert board.adc is not None
        random = (0.5 + abs(board.adc.inl_steps)) * board.adc.step
        constants = constants_of(
            board,
            self._rule,
            random=random,
            shared=self._half_step - random,
            alike=1.0 if board.circuit.has_amplifiers else ALIKE,
            scales_columns=not (board.circuit.has_amplifiers or board.transposed),
            mixes=law.has_potential,
            has_leads=law.has_leads,
            factors=not exact,
            faulty=self._faulty,
            encloses=board.plain,
            several=self._answers is not None,
            fits=fits,
        )
        farthest = np.abs(beside_end).max(axis=0)
        return LawFrames(
            law,
            self._enclosure,
            constants,
            farthest / np.maximum(law.behind, farthest + LEAST),
            no_reading,
            wires=np.abs(to_driver - law.lead[:, None]) + np.abs(beside_end),
            whole_wires=to_driver + to_end + column_lead,
            shunt=self._shunt,
            series=board.series_ohms,
        )

    def _measure(self, frame: Readings) -> Measurement | None:
        """The measurement of a frame for which the factors hold; else None."""
        if self._factors is not None and not self._factors.hold:
            return None
        measured, came, _ = self._frames(self._in_lines(frame), known=True)
        return measured if came == MEASURED else None

    def _in_lines(self, frame: Readings) -> Readings:
        """The frame in line coordinates; readings at a limit of complete shorts say nothing."""
        if not self._board.transposed and frame.limited is None and frame.under_range is None:
            return frame
        frame = frame.in_lines(self._turn)
        if self._shorted.any():
            limited, under_range = (
                None if cells is None else cells & ~self._shorted for cells in (frame.limited, frame.under_range)
            )
            frame = frame._replace(limited=limited, under_range=under_range)
        return frame

    @np.errstate(all="ignore")
    def __call__(self, frame: Readings) -> Measurement:
        """As :class:`.LiveRecovery`."""
        frame, fit, factors = self._in_lines(frame), self._fit, self._factors
        bridged = bool(self._board.bridges)  # no law of single lines holds
        # An output at a limit does not hold its line, nor what a bridge or hidden cells join with it.
        held = not self._unheld(frame)
        if (bridged or not self._tells) and not held:
            return self._nothing(frame)
        if not self._tells:
            return self._nothing(frame) if fit is None else fit.read(frame)
        if self._answers is not None:
            error = self._half_step + SIGMAS * frame.noise
            answers = self._answers(frame.volts, error, frame.limited, frame.under_range)
            self._frames.low[...], self._frames.high[...] = answers
            by_ends = self._answers.by_ends(frame.volts, frame.limited, frame.under_range)
            self._frames.by_ends[...] = by_ends / error
        known = factors is not None and factors.hold
        measured, came, opens = self._frames(frame, known=known)
        self._impossible = self._impossible + 1 if came == IMPOSSIBLE else 0
        if self._impossible > OFTEN:
            raise SolverError("no cell resistances give these readings; check that the design is that of the board")
        if came == MEASURED and not bridged:
            return measured
        by_law = self._frames.by_law
        if (opens or bridged) and fit is not None and held and factors is not None and self._frames.lone():
            return fit.read(frame, by_law.copy())
        if bridged:
            return self._nothing(frame)
        if came != STALE:
            measured, came, _ = self._frames(frame, known=known, whole=True)
        if came == MEASURED:
            return measured
        assert factors is not None
        counted = self._present
        for unknown in (frame.limited, frame.under_range):
            counted = counted if unknown is None else counted & ~unknown
        by_law, off = by_law.copy(), self._frames.linear + self._frames.others
        cells, left, settled = factors(by_law, self._frames.relative, off, counted, self._rule.limit)
        if not settled and self._last_fit is not None and held and self._frames.lone():
            return self._last_fit.read(frame, cells)
        if settled and float(factors.kept.coupling.max()) > COUPLED:
            left = np.maximum(left, self._frames.linear * self._misfit(frame, cells, counted))
        if self._some_hidden and settled:
            self._frames.by_hidden[...] = self._of_hidden(cells)
        self._frames.found[...], self._frames.left[...] = cells, left if settled else 0.0
        return self._frames(frame, known=factors.known, whole=True, renewed=True, settled=settled)[0]

    def _unheld(self, frame: Readings) -> bool:
        """Whether an output of the frame may stand at a limit, so that it does not hold its column."""
        nowhere = np.zeros(0, dtype=np.bool_)
        return self._enclosure.unheld(
            *(nowhere if cells is None else cells for cells in (frame.limited, frame.under_range))
        )

    def _misfit(self, frame: Readings, cells: FloatArray, counted: BoolArray) -> float:
        """Largest difference of the model's readings at ``cells`` (N, M) in S from those ``counted``, over their error.

        Where lines join columns, steps of the factors may be short far from where they end; readings tell.
        """
        apart = np.abs(frame.volts - self._volts(np.maximum(cells, OPEN)))[counted]
        return float(apart.max(initial=0.0)) / (self._half_step + SIGMAS * frame.noise)

    def _of_hidden(self, cells: FloatArray) -> FloatArray:
        """Relative change (N, M) of ``cells`` in S over all conductances of those behind a named break."""
        assert self._factors is not None
        usual = self._law_of_model(np.maximum(cells, OPEN))
        change = np.zeros(self._shape)
        for hidden in (OPEN, min(self._most_hidden, MOST_HIDDEN * float(np.median(cells[~self._hidden])))):
            try:
                moved = self._law_of_model(np.maximum(cells, OPEN), hidden)
            except (SolverError, np.linalg.LinAlgError):
                return np.full(self._shape, inf)
            change = np.fmax(change, np.abs(moved - usual) / np.maximum(np.abs(usual), OPEN))
        # As in the factors, a cell changes by more than what the law makes of it where lines take most of a drive.
        grown: FloatArray = HIDDEN_MARGIN * change * np.maximum(self._factors.kept.rho, 1.0) ** 2
        return grown

    def _law_of_model(self, conductance: FloatArray, hidden: float | None = None) -> FloatArray:
        """What the laws make of the readings of cells (N, M) in S in the full model, in S."""
        return self._law(self._volts(conductance, hidden))

    def _volts(self, conductance: FloatArray, hidden: float | None = None) -> FloatArray:
        """Readings in V of cells (N, M) in S in the full model.

        Cells behind a break conduct ``hidden`` S; None: as the median of the others.
        """
        own = conductance
        if self._faulty:
            own = np.maximum(cell_alone(self._board, conductance, self._shunt), OPEN)
        if self._some_hidden:  # cells behind a break tie other lines to each other, whatever they are
            own = np.where(self._hidden, np.median(own[~self._hidden]) if hidden is None else hidden, own)
        cells = 1.0 / own
        return self._model(cells) if self._sheet is None else read_exactly(self._sheet, cells)[0].volts

    def _nothing(self, frame: Readings) -> Measurement:
        """A frame that determines no cell."""
        reason = np.where(self._no_reading == HIDDEN, HIDDEN, DISTURBED)
        for cells, why in (frame.limited, SATURATED), (frame.under_range, NO_CURRENT):
            if cells is not None:
                reason[cells & (reason == DISTURBED)] = why
        nothing = Measurement.unknown(self._no_reading.T.shape if self._board.transposed else self._shape)
        nothing.reason[...] = self._turn(reason)
        return nothing
