"""Latency and lost frames of the link, from the length of a packet and the line's bit rate."""

from __future__ import annotations

import numpy as np

from ..circuits import Requirement
from ..wire import FramePacket, encode
from ._dynamic import rate_of
from ._outcome import Measurement, NotRun
from ._subject import Subject
from ._units import engineering

BITS_PER_BYTE = 10
"""a start bit, eight data bits, a stop bit"""


def _frame_seconds(subject: Subject) -> tuple[float, int]:
    """s that one frame occupies the line, and its bytes."""
    baudrate = subject.design.operation.baudrate
    if baudrate is None:
        raise NotRun("missing: operation.baudrate")
    counts = np.full(subject.design.array.shape, 0x0101, dtype=np.uint16)
    length = len(encode(FramePacket.of(counts, sequence=1, time_us=1)))
    return length * BITS_PER_BYTE / baudrate, length


def latency(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """From a press to the frame that shows it at the host: a whole scan, and the transfer, s."""
    period = 1.0 / rate_of(subject, requirement)
    transfer, length = _frame_seconds(subject)
    if transfer > period:
        return Measurement(np.inf, "s", where=f"a frame of {length} bytes takes {engineering(transfer, 's')} to send")
    return Measurement(
        2 * period + transfer,
        "s",
        where="a press just after its cell was read",
        confidence="upper bound without the operating system's own delays",
        text=[f"Up to one frame until the cell is read again, one for its scan, {engineering(transfer, 's')} to send."],
    )


def lost_frames(subject: Subject, requirement: Requirement, method: str) -> Measurement:
    """Share of frames that the line cannot carry, %."""
    rate = rate_of(subject, requirement)
    transfer, length = _frame_seconds(subject)
    carried = min(1.0 / transfer, rate)
    return Measurement(
        100 * (1.0 - carried / rate),
        "%",
        where=f"{length} bytes per frame: the line carries {engineering(1.0 / transfer, 'Hz')}",
        confidence="from the packet's length and the bit rate; an undisturbed line",
    )
