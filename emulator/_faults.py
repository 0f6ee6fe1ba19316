"""Fault injection on the link: seeded noise, and faults that the scene schedules. No clock and no I/O."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import BoolArray
from ._line_settings import BYTE_FAULTS, PACKET_FAULTS, LineSettings, LinkFault

Bytes = NDArray[np.uint8]


def may_lose(settings: LineSettings, faults: Sequence[LinkFault]) -> bool:
    """Whether a packet may fail to arrive."""
    return bool(settings.packet_loss or settings.bit_errors or settings.baud_rate is not None or faults)


class Line:
    """What happens to a line, and to packets on their way, by the settings of a scene. A seed gives the same faults."""

    def __init__(self, settings: LineSettings, seed: int, faults: Sequence[LinkFault] = ()) -> None:
        """Prepare the line.

        Args:
            settings: noise that is always there.
            seed: of the random numbers, which are apart from those of the converter's noise.
            faults: what goes wrong besides.

        """
        self._settings = settings
        self._faults = [Recurring(fault) for fault in faults]
        self._random = np.random.default_rng([seed, 1])

    def active(self, kind: str, time_s: float) -> LinkFault | None:
        """A fault of this kind that is going on, or None."""
        return next((one.fault for one in self._faults if one.fault.kind == kind and one.fault.active(time_s)), None)

    def begun(self, kind: str, time_s: float) -> LinkFault | None:
        """A fault of this kind that has begun since the last call, or None."""
        return next((one.fault for one in self._faults if one.fault.kind == kind and one.has_begun(time_s)), None)

    def carry(self, packet: bytes, time_s: float = 0.0) -> bytes:
        """The packet as the line delivers it: lost (empty), damaged, or as it is.

        Args:
            packet: the bytes that the board sends.
            time_s: board time, by which scheduled faults go.

        """
        if self._settings.packet_loss and self._random.random() < self._settings.packet_loss:
            return b""
        if self._settings.bit_errors:
            bits = np.unpackbits(np.frombuffer(packet, dtype=np.uint8))
            bits ^= self._random.random(len(bits)) < self._settings.bit_errors
            packet = np.packbits(bits).tobytes()
        for one in self._faults:
            if packet and one.fault.kind in BYTE_FAULTS + PACKET_FAULTS:
                packet = self._inject(one, packet, time_s)
        return packet

    def _inject(self, recurring: Recurring, packet: bytes, time_s: float) -> bytes:
        fault = recurring.fault
        if fault.probability is not None:
            if not fault.active(time_s):
                return packet
            size = 1 if fault.kind in PACKET_FAULTS else len(packet)
            hit = self._random.random(size) < fault.probability
        else:
            if not recurring.has_begun(time_s):
                return packet
            hit = np.zeros(len(packet), dtype=np.bool_)
            hit[self._random.permutation(len(packet))[: fault.count]] = True
        if not hit.any():
            return packet
        if fault.kind in PACKET_FAULTS:
            copies = 0 if fault.kind == "dropped-packets" else 2
            return packet * copies
        return self._damage(fault.kind, np.frombuffer(packet, dtype=np.uint8), hit)

    def _damage(self, kind: str, packet: Bytes, hit: BoolArray) -> bytes:
        """The packet with the bytes where ``hit`` is True damaged."""
        size = int(hit.sum())
        match kind:
            case "flipped-bits":
                damaged = packet.copy()
                damaged[hit] ^= (1 << self._random.integers(0, 8, size)).astype(np.uint8)
            case "dropped-bytes":
                damaged = packet[~hit]
            case "inserted-bytes":
                noise = self._random.integers(0, 256, size, dtype=np.uint8)
                damaged = np.insert(packet, np.flatnonzero(hit), noise)
            case _:
                damaged = np.repeat(packet, np.where(hit, 2, 1))
        return damaged.tobytes()


class Recurring:
    """A fault, and which of its occurrences have been dealt with."""

    def __init__(self, fault: LinkFault) -> None:
        self.fault = fault
        self._done = -1

    def has_begun(self, time_s: float) -> bool:
        """Whether the fault has begun, again perhaps, since the last time that this was so."""
        occurrence, done = self.fault.occurrence(time_s), self._done
        self._done = max(occurrence, done)
        return occurrence > done
