"""The way of the packets to the host, without I/O: a line that may spoil them, and the board's transmit buffer."""

from __future__ import annotations

import numpy as np

from ._scene import LineSettings


class Line:
    """What becomes of a packet on the line, by ``settings``; seeded, so that a run can be repeated."""

    def __init__(self, settings: LineSettings, seed: int) -> None:
        self._settings = settings
        # A stream apart from the ADC noise of the same seed.
        self._random = np.random.default_rng([seed, 1])

    def carry(self, packet: bytes) -> bytes:
        """The packet as the line delivers it: lost (empty), with flipped bits, or as it is."""
        if self._settings.packet_loss and self._random.random() < self._settings.packet_loss:
            return b""
        if not self._settings.bit_errors:
            return packet
        bits = np.unpackbits(np.frombuffer(packet, dtype=np.uint8))
        bits ^= self._random.random(len(bits)) < self._settings.bit_errors
        return np.packbits(bits).tobytes()


class TransmitBuffer:
    """Bytes on their way out: takes whole packets or none, gives them up as the port takes them."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        """bytes; a packet that finds the buffer empty always fits"""
        self._bytes = bytearray()

    def __len__(self) -> int:
        return len(self._bytes)

    def offer(self, packet: bytes) -> bool:
        """Queue a packet; False, and nothing queued, when there is no room for all of it."""
        if self._bytes and len(self._bytes) + len(packet) > self.capacity:
            return False
        self._bytes += packet
        return True

    def peek(self) -> bytes:
        """What waits to be sent, in order."""
        return bytes(self._bytes)

    def sent(self, size: int) -> None:
        """The first ``size`` bytes are out."""
        del self._bytes[:size]

    def clear(self) -> None:
        """Forget what waits: nobody is there to read it."""
        self._bytes.clear()
