"""The boards around the chip: from port registers to the row that is selected and the column that is read."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Wiring(ABC):
    """The digital part of one board, after the pin table in docs/hardware.md."""

    rows: int
    columns: int

    def __init__(self) -> None:
        self._registers: dict[str, tuple[int, int]] = {}
        """output and direction of each port; both are 0 after a reset"""

    def port_written(self, port: str, output: int, direction: int) -> None:
        """Follow a port register; resistors pull undriven select lines to "not selected"."""
        self._registers[port] = (output, direction)

    @abstractmethod
    def selected(self) -> frozenset[int]:
        """Rows that are pulled to ground now; ``rows`` stands for the row of reference resistors."""

    @abstractmethod
    def column(self, channel: int) -> int | None:
        """The column that leads to an ADC channel; None: nothing does."""

    def _level(self, port: str) -> int:
        """Levels of the output pins; undriven ones are low."""
        output, direction = self._registers.get(port, (0, 0))
        return output & direction


class DirectWiring(Wiring):
    """Board 4 x 4: PD4 to PD7 and PB0 switch rows and reference resistors, ADC0 to ADC3 read the columns."""

    rows = 4
    columns = 4

    def selected(self) -> frozenset[int]:
        rows = self._level("D") >> 4
        found = {row for row in range(self.rows) if rows >> row & 1}
        if self._level("B") & 1:
            found.add(self.rows)
        return frozenset(found)

    def column(self, channel: int) -> int | None:
        return channel if channel < self.columns else None


class ShiftedWiring(Wiring):
    """Board 16 x 16: two 74HC595 switch the rows, a CD74HC4067 leads one column to ADC0.

    PD4 data, PD5 shift clock, PD6 latch, PD7 output enable (low); PC1 reference resistors; PB0 to PB3 column address.
    """

    rows = 16
    columns = 16
    _DATA, _SHIFT, _LATCH, _DISABLE = 1 << 4, 1 << 5, 1 << 6, 1 << 7

    def __init__(self) -> None:
        super().__init__()
        self._shifted = self._latched = 0

    def port_written(self, port: str, output: int, direction: int) -> None:
        """Shift and latch at rising edges."""
        before = self._level("D")
        super().port_written(port, output, direction)
        rising = self._level("D") & ~before
        if rising & self._SHIFT:
            self._shifted = (self._shifted << 1 | bool(self._level("D") & self._DATA)) & 0xFFFF
        if rising & self._LATCH:
            self._latched = self._shifted

    def selected(self) -> frozenset[int]:
        _, driven = self._registers.get("D", (0, 0))
        enabled = driven & self._DISABLE and not self._level("D") & self._DISABLE
        rows = {row for row in range(self.rows) if self._latched >> row & 1} if enabled else set()
        if self._level("C") & 2:
            rows.add(self.rows)
        return frozenset(rows)

    def column(self, channel: int) -> int | None:
        return self._level("B") & 15 if channel == 0 else None
