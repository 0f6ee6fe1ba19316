"""The line to the host: latency from a press to the frame that shows it, and frames that the line cannot carry."""

from __future__ import annotations

import numpy as np

from ...circuits import Requirement
from ...wire import FramePacket, encode
from .._dut import DesignUnderTest
from .._hardware import Readings
from .._outcome import Measurement, NotRun
from .._quantity import DOWN, UP, Quantity, Shipped
from .._units import engineering
from .settling import rate_of

BITS_PER_BYTE = 10
"""a start bit, eight data bits, a stop bit"""


def _frame_on_the_line(dut: DesignUnderTest) -> tuple[float, int]:
    """s that one frame occupies the line, and its bytes."""
    baudrate = dut.design.operation.baudrate
    if baudrate is None:
        raise NotRun("missing: operation.baudrate")
    counts = np.full(dut.design.array.shape, 0x0101, dtype=np.uint16)
    length = len(encode(FramePacket.of(counts, sequence=1, time_us=1)))
    return length * BITS_PER_BYTE / baudrate, length


def _latency(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    period = 1.0 / rate_of(dut, requirement)
    transfer, length = _frame_on_the_line(dut)
    if transfer > period:
        return Measurement(np.inf, "s", where=f"a frame of {length} bytes takes {engineering(transfer, 's')} to send")
    return Measurement(
        2 * period + transfer,
        "s",
        where="a press just after its cell was read",
        confidence="upper bound without the operating system's own delays",
        text=[f"Up to one frame until the cell is read again, one for its scan, {engineering(transfer, 's')} to send."],
    )


def _lost_frames(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    rate = rate_of(dut, requirement)
    transfer, length = _frame_on_the_line(dut)
    return Measurement(
        100 * (1.0 - min(1.0 / transfer, rate) / rate),
        "%",
        where=f"{length} bytes per frame: the line carries {engineering(1.0 / transfer, 'Hz')}",
        confidence="from the packet's length and the bit rate; an undisturbed line",
    )


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    sent = len(readings.volts) + readings.lost
    return Measurement(100 * readings.lost / sent, "%", where=f"{readings.lost} of {sent} frames")


QUANTITIES = (
    Quantity(
        name="latency",
        title="Latency",
        unit="s",
        says="From a press to the frame that shows it at the host: a whole scan, and the transfer, s.",
        compute=_latency,
        shipped=(Shipped(16, "The host sees a press in time.", max=0.1),),
        mended_by=(("operation.frame_rate", UP), ("operation.baudrate", UP)),
    ),
    Quantity(
        name="lost_frames",
        title="Frames lost on the line",
        unit="%",
        says="Share of frames that the line cannot carry, %.",
        compute=_lost_frames,
        shipped=(Shipped(17, "The line carries every frame.", max=0.0),),
        mended_by=(("operation.frame_rate", DOWN), ("operation.baudrate", UP)),
        measured=_measured,
    ),
)
