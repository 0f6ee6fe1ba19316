"""Inverting (transimpedance) amplifiers on all columns: the zero-potential method (paper, VII and figure 15).

**Finite gain.** We eliminate the amplifier's output. Its column then ends in the resistance Rref / (1 + A) in series
with the source (A E - Rref Ib) / (1 + A), where E = Vref + Vos. No indefinite matrix arises, and no digits are lost
with A = 1e12.

**Saturation.** If the output is at a supply limit S, the column has lost the virtual ground. It then ends in the
resistance Rref in series with the source S - Rref Ib. Finding the outputs that saturate is a linear complementarity
problem with a P-matrix, which principal pivoting solves (Murty, Linear Complementarity, Linear and Nonlinear
Programming, chapter 4).
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...errors import SolverError
from .._parts import Parts
from .._tuning import ROUNDS
from ..solvers import IDEAL_WIRE, LARGEST_PART
from ._adjoint import SensitivityGroup
from ._circuit import Alone, Reading
from ._ends import EndParts, Ends, column_currents, terminate
from ._terminated import SignArray, Terminated


class InvertingAmplifier(Terminated):
    """An inverting amplifier on each column; idle rows at the reference, or open."""

    name = "inverting-amplifier"
    virtual_ground = True

    def ends_of(self, board: Parts, parts: EndParts, state: SignArray | None = None) -> Ends:
        reference, slack, offset, bias, level = parts
        share, lift = 1.0 / (1.0 + slack), reference * bias
        inverse = slack * share
        linear = Ends(
            resistance=reference * inverse,
            source=share * offset - inverse * (level + lift),
            output=share * (level + offset + lift),
            slope=-share * reference,
        )
        if state is None or not state.any():
            return linear
        limit = np.where(state < 0, *board.supply)
        limited = Ends(reference, source=limit - level - lift, output=limit, slope=np.zeros_like(reference))
        return Ends(*(np.where(state == 0, *both) for both in zip(linear, limited, strict=True)))

    def read(self, board: Parts, ports: FloatArray) -> Reading:
        volts, saturated, magnitude, relative, _ = super().read(board, ports)
        low, high = board.supply
        saturated = (volts < low) | (volts > high)
        if self.columns_one_by_one(board):  # one amplifier at a time: its limited output is the nearest limit
            magnitude, volts = np.where(saturated, 0.0, magnitude), np.clip(volts, low, high)
        elif saturated.any():
            frames = ports.reshape(-1, *ports.shape[-2:])
            parts = [part.reshape(-1, *board.shape) for part in (volts, saturated, magnitude)]
            for frame in np.flatnonzero(parts[1].any(axis=(1, 2))).tolist():
                of_frame = Reading(*(part[frame] for part in parts))
                *limited, own, _ = self._read_saturated(board.member(frame), frames[frame], of_frame)
                for part, instead in zip(parts, limited, strict=True):
                    part[frame] = instead
                relative = max(relative, own)
        return Reading(volts, saturated, magnitude, relative)

    def _read_saturated(self, board: Parts, ports: FloatArray, unlimited: Reading) -> Reading:
        """One frame with saturated outputs; those of each scan step by principal pivoting."""
        rows, columns = board.shape
        low, high = board.supply
        # The differential input must exceed these volts to hold an output at a limit; a missing one is never reached.
        at_low, at_high = (
            np.where(np.isinf(board.gain), 0.0, end / board.gain) if isfinite(end) else 0.0 for end in (low, high)
        )
        volts, magnitude = unlimited.volts.copy(), unlimited.magnitude.copy()
        state = (volts > high).astype(np.int8) - (volts < low).astype(np.int8)
        pending: BoolArray = np.atleast_1d(state.any(axis=1))
        relative = 0.0
        for attempt in range(ROUNDS + 4 * columns):
            patterns, which = np.unique(state, axis=0, return_inverse=True)
            for number, pattern in enumerate(patterns):
                steps = np.flatnonzero((which.ravel() == number) & pending)
                if not len(steps):
                    continue
                ends = self.ends_of(board, EndParts.of(board), pattern)
                network = terminate(ports, rows + board.pulled, ends.resistance + board.column_lead)
                every = column_currents(board, network, ends.source)
                currents, relative = every.value[steps], max(relative, float(every.relative))
                magnitude[steps] = np.abs(ends.slope) * every.magnitude[steps]
                volts[steps] = ends.output + ends.slope * currents
                wanted = (volts[steps] > high).astype(np.int8) - (volts[steps] < low).astype(np.int8)
                # An output stays at its limit while the amplifier's input still drives it outwards.
                input_volts = board.offset - (ends.source + ends.resistance * currents)
                stays = ((pattern > 0) & (input_volts >= at_high)) | ((pattern < 0) & (input_volts <= at_low))
                wanted = np.where(pattern == 0, wanted, np.where(stays, pattern, 0)).astype(np.int8)
                if attempt >= ROUNDS:
                    first = np.argmax(wanted != pattern, axis=1)[:, None] == np.arange(columns)
                    wanted = np.where(first, wanted, pattern).astype(np.int8)
                pending[steps] = (wanted != pattern).any(axis=1)
                state[steps] = wanted
            if not pending.any():
                return Reading(volts, state != 0, magnitude, relative)
        raise SolverError("no consistent set of saturated outputs was found; check supply and reference_voltage")

    def undetermined(self, board: Parts, rows: IntArray, columns: IntArray) -> BoolArray | None:
        """Outputs of ideal amplifiers whose input is connected to a row driver by 0 ohm, while that driver is idle.

        Driver and amplifier then hold the same potential, and the split of the column's current between them is
        undetermined.
        """
        if board.floating:
            return None
        joined = rows[:, None] == columns
        outputs: BoolArray = joined.any(axis=0) & ~joined
        return outputs if outputs.any() else None

    def in_the_limit(self, board: Parts, cells: FloatArray, volts: FloatArray) -> FloatArray:
        """Limits of outputs as the conductances that stand for ideal wires and shorts grow to infinity.

        The output of an ideal amplifier on a shorted cell with ideal lines is infinite. We recognise it by a current
        far above that through a conductance of LARGEST_PART. No current leaks over an ideal line: signals smaller than
        the largest signal by the square of IDEAL_WIRE are such leaks, and become 0.
        """
        signal = volts - board.level
        largest = 1e3 * LARGEST_PART * np.prod(board.shape) * abs(board.drive) * board.reference
        finite = np.abs(signal) <= largest
        least = IDEAL_WIRE**-2 * np.max(np.abs(signal), axis=(-2, -1), keepdims=True, where=finite, initial=0.0)
        leaked = np.abs(signal) < least
        return np.where(finite, np.where(leaked, board.level, volts), np.copysign(np.inf, signal))

    @property
    def inverts(self) -> bool:
        return True

    def delivered(self, board: Parts, group: SensitivityGroup, row_current: FloatArray) -> FloatArray:
        """The current of a column's end, less the bias current, through the reference resistor."""
        delivered: FloatArray = (group.lead_current[..., 0, :] - board.bias)[..., group.columns]
        return delivered

    def alone(self, board: Parts) -> Alone:
        return Alone(-board.drive * board.reference, 0.0)
