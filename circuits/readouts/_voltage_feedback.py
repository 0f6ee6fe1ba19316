"""Voltage feedback (equipotential method): a divider whose sensed column feeds a follower that drives all idle lines.

Idle rows and columns then stand at the potential of the sensed column, so that no current flows to them. The converter
reads the follower's output.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...common.arrays import BoolArray, FloatArray, IntArray
from .._parts import Parts, at_any, of_columns
from ..solvers import ULP, siemens
from ._adjoint import SensitivityGroup, TiedPorts
from ._circuit import Contradiction, Reading
from ._ends import sum_of_others, terminate
from ._port_law import PortLaw
from ._quick import QuickFields, QuickNetwork, behind_leads
from ._rounding import conductance_into_rows
from ._voltage_divider import VoltageDivider


class _Balance(NamedTuple):
    """Current balance of the sensed column, (..., N, M). Its one unknown is the potential V of the column's end."""

    driven: FloatArray
    """S between the selected row and the column"""
    idle: FloatArray
    """S between all idle lines and the column"""
    slope: FloatArray
    """S: total conductance at the column's end, with the follower eliminated"""
    relative: float

    @classmethod
    def of(cls, board: Parts, ports: FloatArray) -> _Balance:
        rows, _ = board.shape
        network, relative = terminate(ports, rows, board.column_lead)
        driven = network[..., :rows, rows:]
        idle = sum_of_others(driven) + network[..., rows:, rows:].sum(axis=-1)[..., None, :]
        return cls.between(board, driven, idle, float(relative.max(initial=0.0)))

    @classmethod
    def between(cls, board: Parts, driven: FloatArray, idle: FloatArray, relative: float) -> _Balance:
        """Balance for the conductances ``driven`` and ``idle`` in S, and their relative error."""
        slope = driven + idle * board.inverse_gain + siemens(board.reference)
        return cls(driven, idle, slope, relative)

    def column(self, board: Parts) -> FloatArray:
        """V of the sensed column's end against the reference."""
        current = self.driven * board.drive - board.bias + self.idle * board.follower_lift
        volts: FloatArray = current / self.slope
        return volts


class VoltageFeedback(VoltageDivider):
    """A load on the sensed column, and a follower that drives all idle lines."""

    name = "voltage-feedback"
    drives_idle_lines = True
    behind_the_load = "a follower drives all idle lines"

    def read(self, board: Parts, ports: FloatArray) -> Reading:
        """Output of the follower; every (row, column) pair is a measurement of its own.

        Let V and F be the potentials of the sensed column's end and of the follower, both against the reference. In the
        network behind the column leads, let Y be the conductance from the selected row to the column, and S the sum of
        the conductances from all idle lines to the column. Then ``Y (drive - V) + S (F - V) = V / Rref + Ib`` and
        ``F = A (V + Vos - F)``. After elimination of F, the coefficient of V contains S only as S / (1 + A): the
        follower reduces the effect of the idle lines by this factor. No large numbers are subtracted.
        """
        balance = _Balance.of(board, ports)
        column = balance.column(board)
        volts = board.loop_share * (board.level + column + board.offset)
        low, high = board.supply
        saturated = (volts < low) | (volts > high)
        # Currents into the column from the selected row and from the idle lines. Their rounding errors, too, are
        # multiplied by the gain from the follower's offset to its output.
        follower = np.abs(board.loop_share * board.offset) + np.abs(board.inverse_gain * board.level)
        from_row = balance.driven * (np.abs(board.drive - column) + ULP * np.abs(column))
        from_idle = balance.idle * (follower + board.inverse_gain * np.abs(column))
        magnitude = board.loop_share * (from_row + from_idle) / balance.slope
        return Reading(np.clip(volts, low, high), saturated, magnitude, balance.relative)

    def quick_outputs(self, board: Parts, network: QuickNetwork) -> FloatArray | None:
        driven, across = behind_leads(network, board.column_lead)
        balance = _Balance.between(board, driven, driven.sum(axis=0) - driven + across.sum(axis=0), 0.0)
        volts: FloatArray = board.loop_share * (board.level + balance.column(board) + board.offset)
        return volts

    def quick_fields(self, board: Parts, network: QuickNetwork) -> QuickFields | None:
        return None  # each reading has fields of its own: :meth:`sensitivity_groups`

    def port_law(self, board: Parts, wire: FloatArray) -> PortLaw | None:
        """Potentials against the follower's output, at which the idle lines stand."""
        per_volt, ones = 1.0 / board.loop_share, np.ones(board.shape[1])
        column = np.array([-board.level - board.offset, per_volt])  # of the column's end, against the reference
        current = column / board.reference
        current[0] += board.bias
        lifted = np.array([-board.offset, per_volt - 1.0])  # of the column's end above the follower
        drive = np.array([(board.drive + board.level) * ones, -ones])
        return PortLaw(current, lifted + wire * current, drive)

    def energy_bound(self, board: Parts, ports: FloatArray, relative: float) -> FloatArray:
        """Bound by the energies of two fields: 1 V at the sensed column alone, and the scan step itself.

        The energy of the first field is the column's conductance to all other lines. The energy norm of the second
        field is at most the sum of two norms: with the selected row alone, and with the column alone, raised above the
        potential of the idle lines.
        """
        balance = _Balance.of(board, ports)
        column = balance.column(board)
        above_idle = column - board.loop_share * (board.level + column + board.offset) + board.level
        own = np.sqrt(balance.driven + balance.idle)
        row = np.sqrt(conductance_into_rows(ports, board.shape[0], of_columns(board.column_lead)))[..., None]
        with np.errstate(invalid="ignore"):  # inf times 0 where a conductance is infinite
            field = row * np.abs(board.drive - column + above_idle) + own * np.abs(above_idle)
            error: FloatArray = board.loop_share * relative * own * field / balance.slope
        return error

    def ideal_inputs(self, board: Parts) -> BoolArray:
        """The follower holds every idle column."""
        ideal: BoolArray = np.isinf(siemens(board.column_lead))
        return ideal

    def contradiction(self, board: Parts, rows: IntArray, columns: IntArray) -> Contradiction | None:
        """Sources connected by 0 ohm: two row drivers; a driver and the follower; an ideal follower's output and input.

        In each step one row is driven by its driver and one column is sensed. The follower holds all other lines.
        """
        found = super().contradiction(board, rows, columns[:0])
        if found is not None:
            return found
        joined = rows[:, None] == columns
        several_rows, several_columns = (length > 1 for length in board.shape)
        # If a row and a column are joined, the follower holds the column while the row is driven, and the row while the
        # column is sensed. The latter is a contradiction only if the follower is ideal.
        ideal = at_any(np.isinf(board.gain), 1)
        joined &= several_columns | (several_rows & ideal)
        if joined.any():
            row, column = (int(place) for place in np.argwhere(joined)[0])
            return Contradiction(
                f"the driver of row {row} and the end of column {column}, which the follower drives in turn,",
                "array.column_lead",
            )
        for column, island in enumerate(columns):
            for other in np.flatnonzero(columns[:column] == island).tolist():
                if ideal[column] or ideal[other]:
                    return Contradiction(
                        f"the ends of columns {other} and {column}, which are the ideal follower's input and output,",
                        "array.column_lead, or readout.open_loop_gain a finite value",
                    )
        return None

    def delivered(self, board: Parts, group: SensitivityGroup, row_current: FloatArray) -> FloatArray:
        """The follower's current into all idle rows and columns."""
        idle_rows = row_current.sum(axis=-1) - row_current[np.arange(len(group.rows)), :, group.rows]
        into = -group.lead_current  # out of the columns' ends into the grid
        own = into[:, np.arange(len(group.columns)), group.columns]
        delivered: FloatArray = idle_rows + into.sum(axis=-1) - own
        return delivered

    def sensitivity_groups(self, board: Parts, ports: FloatArray, reading: Reading) -> Iterator[SensitivityGroup]:
        """Derivatives by the implicit function theorem, with the sensed column's potential V as unknown (:meth:`read`).

        The derivative of V's equation by a conductance equals that of the current into a column held at V, with the
        idle lines held at F. The derivative of V's equation by V itself is ``slope``.
        """
        rows, columns = board.shape
        inverse, share = board.inverse_gain, board.loop_share
        ties = TiedPorts.of(ports, np.concatenate([np.full(rows, np.inf), siemens(board.column_lead)]))
        column = reading.volts / share - board.level - board.offset
        follower = reading.volts - board.level
        behind = np.repeat(follower[..., None], rows + columns, axis=-1)
        every_row, every_column = np.arange(rows), np.arange(columns)
        behind[every_row, :, every_row] = board.drive
        behind[:, every_column, rows + every_column] = column
        forward = ties.potentials(behind)
        unit = np.zeros((columns, rows + columns))
        unit[every_column, rows + every_column] = 1.0
        field = ties.potentials(unit)
        back = ties.currents(field, unit)  # negative at the column itself
        driven = ties.currents(field, unit)[:, :rows].T  # Y from the selected row to the sensed column
        idle = -back[every_column, rows + every_column] - driven
        slope = driven + idle * inverse + siemens(board.reference)
        gain = np.where(reading.saturated, 0.0, share / slope)
        live = np.where(reading.saturated, 0.0, 1.0)
        above = board.level + column + board.offset
        names = ("reference_resistance", "inverse_gain", "offset_voltage", "bias_current")
        own = {name: np.zeros((rows, columns, columns)) for name in names}
        at = (slice(None), every_column, every_column)
        own["reference_resistance"][at] = gain * column / board.reference**2
        own["bias_current"][at] = -gain
        own["offset_voltage"][at] = gain * idle * share + live * share
        own["inverse_gain"][at] = -(gain * idle + live) * share**2 * above
        yield SensitivityGroup(
            rows=every_row,
            columns=every_column,
            forward=forward,
            adjoint=gain[..., None] * field,
            lead_current=ties.currents(forward, behind)[..., rows:],
            adjoint_lead_current=gain[..., None] * back[:, rows:],
            own_parts=lambda: own,
        )
