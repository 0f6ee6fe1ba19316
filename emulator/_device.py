"""The virtual device: board, clock, line and scheduled faults. The device takes time as an argument and reads no clock.

Two times occur. *Board time* is what the scene is written in and what ticks count. *Line time* is the host's: a board
whose clock is fast by 100 ppm reaches its tick at 10 s after 9.999 s of line time. Both are in us.
"""

from __future__ import annotations

import numpy as np

from ._board import Board
from ._faults import Line, may_lose
from ._line import Transmission
from ._scene import Scene
from ._tuning import BAUD_TOLERANCE, PIECE
from .firmware import FirmwareInService

LONGEST_SPLIT = 7
"""bytes that a line with the fault split-bytes delivers at a time, at most"""


LivingBoard = Board | FirmwareInService
"""the model of a board, or the program of a real one"""


class Device:
    """Everything at the far end of a port."""

    def __init__(
        self,
        scene: Scene,
        board: LivingBoard,
        *,
        seed: int = 0,
        capacity: int | None = None,
        handshake_bytes: float = PIECE,
    ) -> None:
        """Switch the device on.

        Args:
            scene: line, clock and faults.
            board: what is at the other end of the line.
            seed: for the line's faults and the jitter.
            capacity: bytes of the transmit buffer; None: those of a microcontroller.
            handshake_bytes: on the line, from which on the handshake line stops the board.

        """
        self.board = board
        self._handshake_bytes = handshake_bytes
        if capacity is None:
            rows, columns = scene.skin.design.array.shape
            capacity = 8192 + 8 * rows * columns
        self.transmission = Transmission(scene.line, capacity)
        self.dropped = 0
        """frames that found no room in the transmit buffer"""
        self._line = Line(scene.line, seed, scene.link_fault)
        self._clock = scene.clock
        self._baud_rate = scene.line.baud_rate
        self._random = np.random.default_rng([seed, 2])
        self._noise = np.random.default_rng([seed, 3])
        self.may_lose = may_lose(scene.line, scene.link_fault)
        """whether a packet may fail to arrive"""
        self._over = False
        """no time passes any more, so a stall would not end"""
        self._line_us = 0.0
        """latest line time at which something was sent"""
        self._behind_us = 0.0

    @property
    def next_us(self) -> float:
        """Line time of the next tick."""
        return self._behind_us + self.board.next_us / (1.0 + self._clock.drift_ppm / 1e6)

    @property
    def time_s(self) -> float:
        """Board time of the next tick in s."""
        return self.board.next_us / 1e6

    def fall_behind(self, delay_us: float) -> None:
        """Let all ticks to come be due later: who runs the device cannot keep up."""
        self._behind_us += delay_us

    def tick(self, *, host_present: bool) -> None:
        """Live through the next tick and send what the board has to say; without a host nobody hears it."""
        now_us, time_s = self.next_us, self.time_s
        reset = self._line.begun("reset", time_s)
        if reset is not None:
            self.reset(reset.text, now_us, boots_for_s=reset.duration_s or 0.0)
        scanning = self.board.wants_tick
        self.board.clear_to_send = len(self.transmission) < self._handshake_bytes
        packets = self.board.tick()
        if not host_present:
            return
        if self._clock.jitter_s:
            now_us += abs(self._random.normal(scale=1e6 * self._clock.jitter_s))
        if not self._send(packets, now_us) and scanning:
            self.board.overrun = True
            self.dropped += 1

    def say_over(self, now_us: float) -> bool:
        """Tell the host that no frame follows; the line may lose this, too. False: the buffer had no room."""
        self._over = True
        return self._send([self.board.farewell()], now_us)

    def reset(self, text: str, now_us: float, *, boots_for_s: float = 0.0) -> None:
        """Start the board anew: text of its boot loader, another boot id, numbers and time from 0."""
        self.board.reset(boots_for_us=round(1e6 * boots_for_s))
        self.transmission.offer(text.encode(), max(now_us, self._line_us))

    def receive(self, data: bytes, now_us: float) -> None:
        """Take bytes of the host and send the answers for which there is room."""
        self.board.receive(data)
        if self.transmission.ready(now_us, PIECE):
            self._send(self.board.answers(), now_us)

    def advance(self, now_us: float) -> None:
        """Let the bytes on the line travel until ``now_us``."""
        stalled = not self._over and self._line.active("stall", self.time_s) is not None
        self.transmission.advance(now_us, stalled=stalled)

    def arrived(self) -> bytes:
        """Bytes for the host to read now; tell :meth:`Transmission.taken` how many of them were taken."""
        waiting = bytes(self.transmission.host)
        if waiting and self._line.active("split-bytes", self.time_s) is not None:
            return waiting[: int(self._random.integers(1, LONGEST_SPLIT + 1))]
        return waiting

    def as_sampled(self, data: bytes, baud_rate: int | None) -> bytes:
        """What a host that samples the UART at ``baud_rate`` makes of bytes; None: at the right one.

        A receiver whose rate is off by more than a few percent samples bits of its neighbours: noise.
        """
        right = self._baud_rate
        if right is None or baud_rate is None or abs(baud_rate / right - 1.0) < BAUD_TOLERANCE:
            return data
        return self._noise.bytes(len(data))

    def steal(self) -> None:
        """A second program on the same port reads now and then: what it gets, the first one never sees."""
        waiting = len(self.transmission.host)
        if not waiting or self._line.active("second-host", self.time_s) is None:
            return
        if self._random.random() < 0.5:
            self.transmission.taken(int(self._random.integers(1, waiting + 1)))

    def unplugged(self) -> bool:
        """Whether the cable is out now."""
        return self._line.active("unplug", self.time_s) is not None

    def new_name(self) -> str | None:
        """The name under which the device appears when it is plugged in again; None: the old one."""
        fault = self._line.active("unplug", self.time_s)
        return None if fault is None else fault.name

    def _send(self, packets: list[bytes], now_us: float) -> bool:
        """Send packets, all or none."""
        delivered = b"".join(self._line.carry(packet, self.time_s) for packet in packets)
        self._line_us = max(now_us, self._line_us)
        return not delivered or self.transmission.offer(delivered, self._line_us)
