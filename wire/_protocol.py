"""Sans-I/O protocol objects, as in h11: one pair for each family of boards.

Bytes go in and events come out; orders go in and bytes come out. The *host* end turns a board's bytes into events and a
host's orders into bytes. The *board* end is its mirror image, which the emulator uses. Neither reads a clock or touches
a port.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ._packets import BadCommand, Command, Event, FramePacket, Identity, Order, Reply, SelfTest


@dataclass(frozen=True)
class Layout:
    """What a host must know beforehand of a board whose packets do not say it."""

    rows: int
    columns: int
    adc_bits: int


@dataclass(frozen=True)
class Family:
    """One family of boards: the facts about its format, and how to make its two protocol objects."""

    name: str
    """as in ``Skin.open(port, board=name)``"""
    summary: str
    """one line for a list of families"""
    host: Callable[[Family, Layout], HostProtocol]
    board: Callable[[Family, Layout], BoardProtocol]
    layout: Layout
    """the family's usual array and converter; the native family takes any"""
    baud_rate: int
    has_sequence: bool
    """frames carry numbers, so that lost frames can be counted; otherwise losses are unknown"""
    has_device_time: bool
    """frames carry the board's time; otherwise only the host's time of arrival is known"""
    has_description: bool
    """the board describes its own circuit; otherwise ``design`` is assumed"""
    polled: bool = False
    """the board sends a frame only when asked: the host sends ``request(Order.ONE_FRAME)`` for each"""
    repeat_start_s: float | None = None
    """time after which START is sent again, to a board that stops when it hears nothing; None: once is enough"""
    dtr: bool | None = None
    """level to set on the control line DTR before the port is opened; None: leave the default"""
    rts: bool | None = None
    """level to set on the control line RTS before the port is opened; None: leave the default"""
    design: Mapping[str, Any] | None = field(default=None, compare=False)
    """tables of DESIGN.toml for the family's usual circuit, where the board does not describe it; None: not known"""
    tables: Mapping[str, Any] | None = field(default=None, compare=False)
    """tables of the BOARD.toml that describes the format, for recordings; None: the format is a module's"""
    files: Mapping[str, Path] = field(default_factory=dict, compare=False)
    """files of the board's circuit (``design``) and material (``cell``), where BOARD.toml names them"""


class HostProtocol(ABC):
    """The host's end of the line."""

    commands = 0
    """number of the last order, which the board's reply repeats; 0: the family's orders have no numbers, nor replies"""

    def __init__(self, family: Family, layout: Layout) -> None:
        self.family = family
        self.layout = layout

    @abstractmethod
    def feed(self, data: bytes, received_at: float) -> list[Event]:
        """Take bytes of the board.

        Args:
            data: any number of bytes, cut anywhere.
            received_at: when they came, in s on the caller's clock, for formats that only pauses between frames divide.

        Returns:
            The events that the bytes complete, in order. Nothing is raised: bytes that are no packet are
            :class:`~ohmskin.wire.Corrupt` events.

        """

    def request(self, order: Order, *, period_us: int = 0) -> bytes:
        """The bytes that give ``order`` to the board; empty where the family has no such order.

        Args:
            order: what the board shall do.
            period_us: us between two frames, for RATE only.

        """
        return b""


class BoardProtocol(ABC):
    """The board's end of the line: the mirror image of :class:`HostProtocol`."""

    def __init__(self, family: Family, layout: Layout) -> None:
        self.family = family
        self.layout = layout

    @abstractmethod
    def feed(self, data: bytes) -> list[Command | BadCommand]:
        """Take bytes of the host; the commands that they complete, in order. Noise is ignored."""

    @abstractmethod
    def frame(self, frame: FramePacket) -> bytes:
        """The bytes of one frame, as this family sends it."""

    def identify(self, identity: Identity) -> bytes:
        """The bytes that tell who the board is; empty where the family has no such packet."""
        return b""

    def describe(self, text: bytes, *, sequence: int, time_us: int, boot_id: int) -> list[bytes]:
        """The packets that carry a description; none where the family has no such packet.

        Args:
            text: from :func:`~ohmskin.wire.write_description`.
            sequence: number that the next frame will have.
            time_us: us since the board started.
            boot_id: of the board.

        """
        return []

    def self_test(self, result: SelfTest) -> bytes:
        """The bytes of a self-test's result; empty where the family has no such packet."""
        return b""

    def reply(self, reply: Reply) -> bytes:
        """The bytes that answer a command; empty where the family answers none."""
        return b""
