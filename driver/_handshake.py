"""A board's identity and description, checked against limits before anything is computed from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from ..cell import Cell
from ..circuits import Design
from ..common.config import parse
from ..common.events import SignalSafeEvent
from ..errors import InputError, ProtocolError
from ..wire import Description, Family, FramePacket, Identity, Layout, board_protocol, write_description

S = TypeVar("S", Design, Cell)

MOST_CELLS = 256 * 256
"""the inverse of a larger array takes more than seconds and gigabytes"""
MOST_CONTINUOUS_CELLS = 32 * 32
"""limit for a continuous sheet, which is divided into finer pieces for computing"""
MOST_FINE_PIECES = 512 * 512


class Handshake:
    """All that is known of the board: from its packets, or given by the caller instead."""

    def __init__(self, family: Family, port_name: str, design: Design | None, cell: Cell | None) -> None:
        self.family = family
        self.port_name = port_name
        self.identity: Identity | None = None
        self.identified = SignalSafeEvent()
        """set when the board has identified itself; the description may come before that"""
        self.description: Description | None = None
        self._given = design, cell
        self._both_given = design is not None and cell is not None
        self.has_sent_frames = False
        """whether the board has sent a frame, so that its size is known"""
        self.must_identify = False
        """whether to wait for the serial number, too, if the family has one: another board must not be accepted"""

    @property
    def serial_number(self) -> str:
        """The board's serial number; empty if the board does not send one."""
        return "" if self.identity is None else self.identity.serial_number

    @property
    def complete(self) -> bool:
        """Whether everything is known that the board will send."""
        if self.must_identify and self.family.has_description and self.identity is None:
            return False
        if self.description is not None or not self.family.has_description:
            return True
        if self._both_given:
            # Nothing else is needed, but the board's first packet shows whether the design has its size.
            return self.identity is not None or self.has_sent_frames
        return self.identity is not None and not self.identity.description_bytes

    def as_bytes(self) -> bytes:
        """The board's identity and description, in packets of its family."""
        board, known, described = board_protocol(self.family), self.identity, self.description
        said = b"" if known is None else board.identify(known)
        if described is not None:
            text = write_description(described.design, described.cell)
            said += b"".join(board.describe(text, sequence=0, time_us=0, boot_id=described.boot_id or 0))
        return said

    def add(self, event: Identity | Description | FramePacket) -> None:
        """Take a packet.

        Raises:
            ProtocolError: the packet contradicts an earlier one, or exceeds the limits.
            InputError: the given design does not match this board: another size, or another converter.

        """
        if isinstance(event, FramePacket):
            self._check_given(event.rows, event.columns)
            self.has_sent_frames = True
            return
        difference = self.difference(event)
        if difference:
            raise ProtocolError(f"{self.port_name}: {difference}; open the skin again")
        if isinstance(event, Identity):
            self._check_given(event.rows, event.columns, event.adc_bits)
            self.identity = event
            self.identified.set()
            return
        self.description = event

    def _check_given(self, rows: int, columns: int, adc_bits: int | None = None) -> None:
        """Compare the board with the given design, if any; InputError."""
        design = self._given[0]
        if design is None:
            return
        if (rows, columns) != design.array.shape:
            board, given = f"{rows} x {columns} cells", "{} x {}".format(*design.array.shape)
        elif adc_bits is not None and design.adc is not None and adc_bits != design.adc.bits:
            board, given = f"a converter of {adc_bits} bits", f"one of {design.adc.bits}"
        else:
            return
        raise InputError(f"{self.port_name}: the board has {board}, the design that was given has {given}")

    def difference(self, event: Identity | Description) -> str:
        """Difference between the board that sent this and the board from before; empty if there is none."""
        if isinstance(event, Description):
            before = self.description
            same = before is None or (before.design, before.cell) == (event.design, event.cell)
            return "" if same or None not in self._given else "the board describes itself differently than before"
        known = self.identity
        if known is None:
            return ""
        if event.serial_number != known.serial_number:
            return f"board {event.serial_number} is there; expected {known.serial_number}"
        if (event.rows, event.columns, event.adc_bits) != (known.rows, known.columns, known.adc_bits):
            return f"a board of {event.rows} x {event.columns} cells is there; expected {known.rows} x {known.columns}"
        return ""

    def design(self) -> Design | Layout:
        """The design of the readout: as given, as described, or the usual one of the family; else the array alone.

        Raises:
            InputError: the board should describe its design, and does not.
            ProtocolError: the description is not valid.

        """
        given = self._given[0]
        if given is not None:
            return given
        if self.description is not None and self.description.design is not None:
            design = self._parsed("design", self.description.design, Design)
            _check_size(design, self.port_name)
            return design
        if self.family.design is not None:
            return parse(self.family.design, Design, source=f"design of {self.family.name}")
        if self.family.has_description:
            raise InputError(f"{self.port_name}: the board does not describe its readout; pass design=Design.load(...)")
        return self.family.layout

    def cell(self) -> Cell | None:
        """The cell: as given or as described; None if neither is known. Raises ProtocolError."""
        given = self._given[1]
        if given is not None or self.description is None or self.description.cell is None:
            return given
        return self._parsed("cell", self.description.cell, Cell)

    def _parsed(self, key: str, tables: Mapping[str, Any], kind: type[S]) -> S:
        try:
            return parse(tables, kind, source=key)
        except InputError as error:
            raise self.refused(error) from error

    def refused(self, error: Exception) -> ProtocolError:
        """The error for a description that cannot be used."""
        return ProtocolError(f"{self.port_name}: the board describes itself wrongly: {error}")


def _check_size(design: Design, name: str) -> None:
    rows, columns = design.array.shape
    continuous = design.array.sheet == "continuous"
    most = MOST_CONTINUOUS_CELLS if continuous else MOST_CELLS
    fine = rows * columns * design.sheet.divisions**2 if continuous else 0
    if rows * columns > most or fine > MOST_FINE_PIECES:
        sheet = "a continuous sheet" if continuous else "an array"
        raise ProtocolError(
            f"{name}: the board describes {sheet} of {rows} x {columns} cells; at most {most} are driven"
        )
