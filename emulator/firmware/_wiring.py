"""The boards around the chip: from port registers to the row that is selected and the column that is read."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

_NO_PINS = (0, 0)  # output and direction registers after a reset


class Wiring(Protocol):
    """The digital part of one board, after the pin table in docs/hardware.md."""

    rows: int
    columns: int

    def port_written(self, port: str, output: int, direction: int) -> None:
        """Follow a port register; resistors pull undriven select lines to "not selected"."""
        ...

    def selected(self) -> frozenset[int]:
        """Rows that are pulled to ground now; ``rows`` stands for the row of reference resistors."""
        ...

    def column(self, channel: int) -> int | None:
        """The column that leads to an ADC channel; None: nothing does."""
        ...


@dataclass
class _Pins:
    """Levels of the output pins; undriven ones are low."""

    registers: dict[str, tuple[int, int]] = field(default_factory=dict)

    def write(self, port: str, output: int, direction: int) -> None:
        self.registers[port] = (output, direction)

    def level(self, port: str) -> int:
        output, direction = self.registers.get(port, _NO_PINS)
        return output & direction

    def driven(self, port: str) -> int:
        return self.registers.get(port, _NO_PINS)[1]


class DirectWiring:
    """Board 4 x 4: PD4 to PD7 and PB0 switch rows and reference resistors, ADC0 to ADC3 read the columns."""

    rows = 4
    columns = 4

    def __init__(self) -> None:
        self._pins = _Pins()

    def port_written(self, port: str, output: int, direction: int) -> None:
        """See :class:`Wiring`."""
        self._pins.write(port, output, direction)

    def selected(self) -> frozenset[int]:
        """See :class:`Wiring`."""
        rows = self._pins.level("D") >> 4
        found = {row for row in range(self.rows) if rows >> row & 1}
        if self._pins.level("B") & 1:
            found.add(self.rows)
        return frozenset(found)

    def column(self, channel: int) -> int | None:
        """See :class:`Wiring`."""
        return channel if channel < self.columns else None


class ShiftedWiring:
    """Board 16 x 16: two 74HC595 switch the rows, a CD74HC4067 leads one column to ADC0.

    PD4 data, PD5 shift clock, PD6 latch, PD7 output enable (low); PC1 reference resistors; PB0 to PB3 column address.
    """

    rows = 16
    columns = 16
    _DATA, _SHIFT, _LATCH, _DISABLE = 1 << 4, 1 << 5, 1 << 6, 1 << 7

    def __init__(self) -> None:
        self._pins = _Pins()
        self._shifted = 0
        self._latched = 0

    def port_written(self, port: str, output: int, direction: int) -> None:
        """See :class:`Wiring`. Shift and latch at rising edges."""
        before = self._pins.level("D")
        self._pins.write(port, output, direction)
        rising = self._pins.level("D") & ~before
        if rising & self._SHIFT:
            self._shifted = (self._shifted << 1 | bool(self._pins.level("D") & self._DATA)) & 0xFFFF
        if rising & self._LATCH:
            self._latched = self._shifted

    def selected(self) -> frozenset[int]:
        """See :class:`Wiring`."""
        enabled = self._pins.driven("D") & self._DISABLE and not self._pins.level("D") & self._DISABLE
        rows = {row for row in range(self.rows) if self._latched >> row & 1} if enabled else set()
        if self._pins.level("C") & 2:
            rows.add(self.rows)
        return frozenset(rows)

    def column(self, channel: int) -> int | None:
        """See :class:`Wiring`."""
        return self._pins.level("B") & 15 if channel == 0 else None
