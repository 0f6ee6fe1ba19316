"""The virtual board: ticks in, packets out, and a host's commands in between. No clock and no I/O.

What it does with a command depends on nothing but whether it streams:

====================  =====================  ======================
state                 START                  STOP
====================  =====================  ======================
streaming             streaming              stopped
stopped               streaming              stopped
====================  =====================  ======================

DESCRIBE is answered in both. Ticks pass in both: the skin lives on, but a stopped board does not scan it.
"""

from __future__ import annotations

from collections.abc import Callable

from .. import __version__
from ..wire import Command, Decoder, DescriptionPacket, Flag, FramePacket, Order, encode
from ._scene import Scene
from ._skin import EmulatedSkin, Sample

DESCRIPTION_PERIOD_US = 1_000_000


class Board:
    """A board that reads ``scene`` at its frame rate. ``record`` is told of every frame that it scans."""

    def __init__(self, scene: Scene, *, seed: int = 0, record: Callable[[Sample], None] | None = None) -> None:
        self.scene = scene
        self.streaming = True
        self.orders = 0
        """START and STOP commands taken so far"""
        self.overrun = False
        """set by the sender when it had to drop a frame: the next one says so"""
        self._record = record
        self._skin = EmulatedSkin(scene, seed)
        self._sequence = 0
        self._next_description_us = 0
        self._commands = Decoder()

    @property
    def next_us(self) -> int:
        """When the next tick is due, in us since the start."""
        return self._skin.next_us

    def tick(self) -> list[bytes]:
        """Live through the next tick; the packets to send, each one whole."""
        time_us = self.next_us
        block, frame = self._skin.read()
        packets = []
        if time_us >= self._next_description_us:
            self._next_description_us += DESCRIPTION_PERIOD_US
            packets.append(self._describe(time_us))
        if self.streaming:
            if self._record is not None:
                self._record(block.sample(frame, self._sequence))
            flags, self.overrun = Flag.OVERRUN if self.overrun else Flag.NONE, False
            packets.append(
                encode(FramePacket.of(block.counts[frame], sequence=self._sequence, time_us=time_us, flags=flags))
            )
            self._sequence = (self._sequence + 1) % 2**32
        return packets

    def receive(self, data: bytes) -> list[bytes]:
        """Take bytes from the host; the packets that answer them. What is no command is ignored."""
        answers = []
        for event in self._commands.feed(data):
            match event:
                case Command(order=Order.DESCRIBE):
                    answers.append(self._describe(self.next_us))
                case Command(order=order):
                    self.streaming = order is Order.START
                    self.orders += 1
        return answers

    def _describe(self, time_us: int) -> bytes:
        return encode(
            DescriptionPacket(
                self._sequence,
                time_us,
                serial_number=self.scene.board.serial_number,
                firmware=f"ohmskin emulator {__version__}",
                design=self.scene.skin.design.model_dump(),
                cell=self.scene.skin.cell.model_dump(),
            )
        )
