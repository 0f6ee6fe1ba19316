"""Serial transmission as a discrete-event model: transmit buffer, UART, USB bridge, host buffer. No clock and no I/O.

::

    board --offer--> transmit buffer --baud rate--> USB bridge --packet full or latency timer--> host buffer --> port

Times are in us and go forward. A board with a UART does not know whether anybody listens: what finds the host's buffer
full is lost, byte by byte. A board with USB of its own notices, and drops whole frames.
"""

from __future__ import annotations

from collections import deque
from math import inf

from ._line_settings import LineSettings
from ._tuning import SOON_S


class Transmission:
    """Bytes on their way from board to host."""

    def __init__(self, settings: LineSettings, capacity: int) -> None:
        """An empty line.

        Args:
            settings: of the line.
            capacity: bytes of the board's transmit buffer; a packet that finds the buffer empty always fits.

        """
        self._settings = settings
        self._capacity = settings.board_buffer or capacity
        self._us_per_byte = 1e7 / settings.baud_rate if settings.baud_rate else 0.0
        self._sending: deque[tuple[float, bytes]] = deque()
        """(us at which the first byte begins, bytes)"""
        self._free_us = 0.0
        """when the UART will have sent everything"""
        self._bridge = bytearray()
        self._bridge_since_us = 0.0
        """when the first byte of a partly filled USB packet came"""
        self.host = bytearray()
        """bytes that have arrived"""
        self.lost_bytes = 0
        """bytes that found the host's buffer full"""

    def __len__(self) -> int:
        return sum(len(data) for _, data in self._sending) + len(self._bridge) + len(self.host)

    def offer(self, packet: bytes, now_us: float) -> bool:
        """Send a packet; False, and nothing sent, when the transmit buffer has no room for all of it."""
        waiting = self._waiting(now_us)
        if waiting and waiting + len(packet) > self._capacity:
            return False
        if self._us_per_byte:
            start_us = max(now_us, self._free_us)
            self._free_us = start_us + len(packet) * self._us_per_byte
            self._sending.append((start_us, packet))
        else:
            self._to_bridge(packet, now_us)
        return True

    def ready(self, now_us: float, size: int) -> bool:
        """Whether the transmit buffer is empty or has room for ``size`` bytes."""
        waiting = self._waiting(now_us)
        return not waiting or waiting + size <= self._capacity

    def advance(self, now_us: float, *, stalled: bool = False) -> None:
        """Let the bytes travel on until ``now_us``; ``stalled``: the bridge passes nothing on meanwhile."""
        while self._sending:
            start_us, data = self._sending[0]
            size = min(len(data), int((now_us - start_us) / self._us_per_byte)) if now_us < inf else len(data)
            if size <= 0:
                break
            self._to_bridge(data[:size], start_us + self._us_per_byte)
            if size < len(data):
                self._sending[0] = (start_us + size * self._us_per_byte, data[size:])
                break
            self._sending.popleft()
        if not stalled:
            self._to_host(now_us)

    def next_us(self, now_us: float) -> float:
        """When something will arrive by itself, at the earliest."""
        due = inf
        if self._sending:
            due = min(self._free_us, now_us + 1e6 * SOON_S)
        if self._bridge:
            due = min(due, max(self._bridge_since_us + 1e6 * self._settings.latency_s, now_us))
        return due

    def taken(self, size: int) -> None:
        """The host has read the first ``size`` bytes that had arrived."""
        del self.host[:size]

    def clear(self, now_us: float) -> None:
        """Forget everything on its way: nobody is there to read it."""
        self._sending.clear()
        self._bridge.clear()
        self.host.clear()
        self._free_us = min(self._free_us, now_us)

    def _waiting(self, now_us: float) -> int:
        """Bytes in the board's transmit buffer."""
        if self._us_per_byte:
            # At the end of an emulation both times are infinite.
            return 0 if self._free_us <= now_us else int((self._free_us - now_us) / self._us_per_byte)
        return len(self._bridge) + len(self.host)

    def _to_bridge(self, data: bytes, first_us: float) -> None:
        if not self._bridge:
            self._bridge_since_us = first_us
        self._bridge += data
        if self._us_per_byte:
            beyond = len(self._bridge) - self._settings.host_buffer
            if beyond > 0:
                del self._bridge[-beyond:]
                self.lost_bytes += beyond

    def _to_host(self, now_us: float) -> None:
        packet = self._settings.usb_packet or 1
        size = len(self._bridge) // packet * packet
        if now_us >= self._bridge_since_us + 1e6 * self._settings.latency_s:
            size = len(self._bridge)
        if not size:
            return
        arriving = bytes(self._bridge[:size])
        del self._bridge[:size]
        # What is left has waited since about now: the timer runs anew with each USB packet.
        self._bridge_since_us = now_us
        if self._us_per_byte:
            room = max(self._settings.host_buffer - len(self.host), 0)
            self.lost_bytes += len(arriving) - len(arriving[:room])
            arriving = arriving[:room]
        self.host += arriving
