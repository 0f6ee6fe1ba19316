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

from collections.abc import Iterator
from math import inf, isfinite, isinf

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from ...errors import SolverError
from .._parts import Parts
from ..solvers import IDEAL_WIRE, LARGEST_PART
from ._adjoint import SensitivityGroup
from ._cards import CardWriter
from ._circuit import Alone, Reading
from ._ends import EndParts, Ends, column_currents, terminate
from ._port_law import PortLaw
from ._terminated import SignArray, Terminated

_MURTY_AFTER = 50  # rounds of pivoting all columns at once, before one column at a time, which cannot cycle
_LARGEST_SPICE_GAIN = 1e8  # of a voltage-controlled source: a larger one would multiply ngspice's rounding errors


class InvertingAmplifier(Terminated):
    """An inverting amplifier on each column; idle rows at the reference, or open."""

    name = "inverting-amplifier"
    virtual_ground = True
    in_populations = True

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
        volts, saturated, magnitude, cancelled, relative, _ = super().read(board, ports)
        low, high = board.supply
        saturated = (volts < low) | (volts > high)
        if self.columns_one_by_one(board):  # one amplifier at a time: its limited output is the nearest limit
            magnitude, cancelled = (np.where(saturated, 0.0, part) for part in (magnitude, cancelled))
            volts = np.clip(volts, low, high)
        elif saturated.any():
            frames = ports.reshape(-1, *ports.shape[-2:])
            parts = [part.reshape(-1, *board.shape) for part in (volts, saturated, magnitude, cancelled)]
            for frame in np.flatnonzero(parts[1].any(axis=(1, 2))):
                of_frame = Reading(*(part[frame] for part in parts))
                *limited, own, _ = self._read_saturated(board, frames[frame], of_frame)
                for part, instead in zip(parts, limited, strict=True):
                    part[frame] = instead
                relative = max(relative, own)
        return Reading(volts, saturated, magnitude, cancelled, relative)

    def _read_saturated(self, board: Parts, ports: FloatArray, unlimited: Reading) -> Reading:
        """One frame with saturated outputs; those of each scan step by principal pivoting."""
        rows, columns = board.shape
        low, high = board.supply
        # The differential input must exceed these volts to hold an output at a limit; a missing one is never reached.
        at_low, at_high = (
            np.where(np.isinf(board.gain), 0.0, end / board.gain) if isfinite(end) else 0.0 for end in (low, high)
        )
        volts, magnitude, cancelled = (
            part.copy() for part in (unlimited.volts, unlimited.magnitude, unlimited.cancelled)
        )
        state = (volts > high).astype(np.int8) - (volts < low).astype(np.int8)
        pending: BoolArray = np.atleast_1d(state.any(axis=1))
        relative = 0.0
        for attempt in range(_MURTY_AFTER + 4 * columns):
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
                cancelled[steps] = np.abs(ends.slope) * every.cancelled[steps]
                volts[steps] = ends.output + ends.slope * currents
                wanted = (volts[steps] > high).astype(np.int8) - (volts[steps] < low).astype(np.int8)
                # An output stays at its limit while the amplifier's input still drives it outwards.
                input_volts = board.offset - (ends.source + ends.resistance * currents)
                stays = ((pattern > 0) & (input_volts >= at_high)) | ((pattern < 0) & (input_volts <= at_low))
                wanted = np.where(pattern == 0, wanted, np.where(stays, pattern, 0)).astype(np.int8)
                if attempt >= _MURTY_AFTER:
                    first = np.argmax(wanted != pattern, axis=1)[:, None] == np.arange(columns)
                    wanted = np.where(first, wanted, pattern).astype(np.int8)
                pending[steps] = (wanted != pattern).any(axis=1)
                state[steps] = wanted
            if not pending.any():
                return Reading(volts, state != 0, magnitude, cancelled, relative)
        raise SolverError("no consistent set of saturated outputs was found; check supply and reference_voltage")

    def port_law(self, board: Parts, wire: FloatArray) -> PortLaw | None:
        if board.floating and self.columns_one_by_one(board) and board.idle_resistance.any():
            return None  # nothing holds the idle columns
        return PortLaw.of_ends(self.read_ends(board), wire, board.drive, floating=board.floating)

    def ideal_inputs(self, board: Parts) -> BoolArray:
        ideal: BoolArray = (board.column_lead == 0) & np.isinf(board.gain)
        return ideal

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
        current = np.broadcast_to(group.lead_current, (len(group.rows), 1, board.shape[1]))[:, 0]
        delivered: FloatArray = (current - board.bias)[:, group.columns]
        return delivered

    def alone(self, board: Parts) -> Alone:
        return Alone(-board.drive * board.reference, 0.0)

    def column_end(self, j: int) -> str:
        return f"minus_{j}"

    def output_node(self, writer: CardWriter, j: int) -> str:
        return f"out_{j}"

    def refuse_cards(self, writer: CardWriter) -> None:
        ends = [writer.name[self.column_end(j)] for j in range(writer.columns)]
        for j, end in enumerate(ends):
            if isinf(writer.board.gain[j]) and end in ends[:j] and end not in writer.drivers:
                raise SolverError(
                    f"columns {ends.index(end)} and {j} are joined by parts of 0 ohm, so that two ideal "
                    "amplifiers share one input; give readout.open_loop_gain a finite value"
                )

    def cards(self, writer: CardWriter) -> Iterator[str]:
        """One amplifier per column.

        An amplifier of finite gain is a voltage-controlled source with its feedback resistor. With a gain above 1e8 or
        infinite, or with a supply that limits its output, we write the amplifier as the equivalent that its column
        sees. This form is exactly equivalent, but contains no large number and has a slope that Newton's method can
        follow. With the current i out of the column, the gain A, the unlimited output
        ``wanted = A/(1+A) (v_plus - Rref i)``, and ``lack``, the supply limit minus ``wanted`` beyond that limit and 0
        within the supply::

            v_minus = A/(1+A) v_plus + i Rref/(1+A) + lack        v_out = v_minus - Rref i
        """
        if writer.one_by_one:
            yield from self._shared_amplifier(writer)
            return
        yield "* Inverting amplifiers, one per column."
        if writer.board.supply != (-inf, inf):
            yield "* lack_J: how far its supply keeps the output from the voltage that its feedback asks for."
        for j in range(writer.columns):
            yield from self._amplifier(writer, j)

    def _shared_amplifier(self, writer: CardWriter) -> Iterator[str]:
        """The equivalent of the amplifier at each column that is read, and its output."""
        yield "* One inverting amplifier behind a switch: what each column sees of it, and what it puts out then."
        ends, (low, high) = self.read_ends(writer.board), writer.board.supply
        parts = (part.tolist() for part in (ends.resistance, ends.source, ends.output, ends.slope))
        for j, (resistance, source, output, slope) in enumerate(zip(*parts, strict=True)):
            minus = writer.name[self.column_end(j)]
            if minus in writer.drivers or minus == writer.reference:
                raise SolverError(
                    f"column {j}'s amplifier sits directly on a driver or the reference (parts of 0 ohm); a netlist of "
                    "multiplexed columns cannot express that, give array.column_lead a resistance"
                )
            yield from writer.switched_end(j, minus, f"{source!r}+{resistance!r}*i(Vend_{j})")
            volts = f"{output!r}+{slope!r}*i(Vend_{j})"
            volts = f"min({volts},{high!r})" if high < inf else volts
            volts = f"max({volts},{low!r})" if low > -inf else volts
            yield f"Bout_{j} out_{j} {writer.ground} V = {volts}"

    def _amplifier(self, writer: CardWriter, j: int) -> Iterator[str]:
        board, reference = writer.board, writer.reference
        minus, out = writer.name[self.column_end(j)], f"out_{j}"
        gain, rref, vos, bias = writer.amplifier_parts(j)
        low, high = board.supply
        limited = low > -inf or high < inf
        if bias and minus != reference:
            yield f"Ibias_{j} {minus} {reference} DC {bias!r}"
        if not limited and gain <= _LARGEST_SPICE_GAIN:
            yield f"Voffset_{j} plus_{j} {reference} DC {vos!r}"
            yield f"Rref_{j} {minus} {out} {rref!r}"
            yield f"Eamplifier_{j} {out} {writer.ground} plus_{j} {minus} {gain!r}"
            return
        if minus in writer.drivers:
            yield f"* {minus} is held by a driver: the feedback cannot move it."
            yield f"Vamplifier_{j} {out} {writer.ground} DC {self._comparator(writer, j)!r}"
            yield f"Rref_{j} {minus} {out} {rref!r}"
            return
        # Vvirtual measures the column's current, which determines the potentials of the input and of the output.
        at, share = f"in_{j}", 1.0 if isinf(gain) else gain / (1.0 + gain)
        yield f"Vvirtual_{j} {minus} {at} DC 0"
        yield f"Hrref_{j} {out} {at} Vvirtual_{j} {-rref!r}"
        if limited:
            wanted = f"{share!r}*({board.level!r}+{vos!r}-{rref!r}*i(Vvirtual_{j}))"
            terms = [f"min({high!r}-{wanted},0)"] if high < inf else []
            terms += [f"max({low!r}-{wanted},0)"] if low > -inf else []
            yield f"Black_{j} {at} lack_{j} V = {'+'.join(terms)}"
            at = f"lack_{j}"
        if not isinf(gain):
            yield f"Hinput_{j} {at} plus_{j} Vvirtual_{j} {rref / (1.0 + gain)!r}"
            at = f"plus_{j}"
        offset = share * vos - board.level / (1.0 + gain)
        yield f"Voffset_{j} {at} {reference} DC {offset!r}"

    def _comparator(self, writer: CardWriter, j: int) -> float:
        """V: the output of amplifier j, whose inverting input sits on an ideal source."""
        end = writer.name[self.column_end(j)]
        gain, _, vos, _ = writer.amplifier_parts(j)
        low, high = writer.board.supply
        if writer.row is None:
            raise SolverError(
                f"column {j}'s amplifier sits directly on the driver of row {writer.drivers[end]}; "
                "a sweep over the rows cannot express that, a netlist for each row can"
            )
        difference = vos - (0.0 if end == writer.reference else writer.board.drive)
        output = gain * difference if difference else 0.0
        if isinf(gain) and (not difference or isinf(high if difference > 0 else low)):
            raise SolverError(
                f"column {j}'s ideal amplifier sits directly on the driver of a row (parts of 0 ohm), so that "
                "its output is not determined; give array.row_lead or the cell a resistance, or "
                "readout.open_loop_gain a finite value"
            )
        return min(max(output, low), high)
