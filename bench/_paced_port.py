"""A port in memory on simulated time: benchmarks of the driver without a line and without an operating system."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from time import process_time

from ..circuits import Design
from ..common.arrays import CodeArray
from ..driver import Arrival
from ..wire import FramePacket, Identity, board_protocol

_ROUNDING = 1e-6
"""of the sum of many times, in periods"""


class PacedPort:
    """A port in memory: the board says who it is, and packet k comes at ``k * period_s``.

    Frames are read only when their reader asks for them; the thread of the skin rests.
    """

    name = "memory"

    def __init__(
        self, packets: list[bytes], period_s: float, board: Design, *, clock: Callable[[], float] = process_time
    ) -> None:
        """``clock``: of the time that passes besides :meth:`work`, in s; processor time unless said otherwise."""
        self._packets, self._period_s = packets, period_s
        self._clock = clock
        self._began, self._worked_s = clock(), 0.0
        self._sent = 0
        self._handshake = _handshake(board)
        self._interrupted = threading.Event()

    def work(self, seconds: float) -> None:
        """Let time pass."""
        self._worked_s += seconds

    def now(self) -> float:
        return self._clock() - self._began + self._worked_s

    def wait(self, timeout_s: float) -> bool:
        if not self._handshake:
            self._interrupted.wait(max(timeout_s, 0.0))
        self._interrupted.clear()
        return bool(self._handshake)

    def read(self) -> Arrival:
        now = self.now()
        if self._handshake:
            said, self._handshake = self._handshake, b""
            return Arrival(said, now, 1e9 + now)
        come = min(int(now / self._period_s + _ROUNDING), len(self._packets))
        data = b"".join(self._packets[self._sent : come])
        self._sent = come
        return Arrival(data, now, 1e9 + now, more=False)

    def write(self, data: bytes) -> None:
        pass

    def interrupt(self) -> None:
        self._interrupted.set()

    def close(self) -> None:
        pass


def frame_packets(frames: Iterable[CodeArray], rate_hz: float) -> list[bytes]:
    """The packets of frames of counts (rows, columns) that follow each other at so many a second."""
    protocol = board_protocol("ohmskin")
    return [
        protocol.frame(FramePacket.of(counts, sequence=number, time_us=round(1e6 * number / rate_hz), boot_id=1))
        for number, counts in enumerate(frames)
    ]


def _handshake(board: Design) -> bytes:
    """The packet in which a board says its size and its converter's bits."""
    rows, columns = board.array.shape
    assert board.adc is not None
    return board_protocol("ohmskin").identify(
        Identity(
            sequence=0,
            time_us=0,
            rows=rows,
            columns=columns,
            adc_bits=board.adc.bits,
            streaming=True,
            period_us=1000,
            description_bytes=0,
            serial_number="",
            firmware="",
            boot_id=1,
        )
    )
