"""Frames lost on the line, because it cannot carry them."""

from __future__ import annotations

from ...circuits import Requirement
from .._dut import DesignUnderTest
from .._hardware import Readings
from .._outcome import Measurement
from .._quantity import DOWN, UP, Quantity, Shipped
from .._units import engineering
from .latency import frame_on_the_line
from .settling_error import rate_of


def lost_frames(dut: DesignUnderTest, requirement: Requirement, method: str) -> Measurement:
    rate = rate_of(dut, requirement)
    transfer, length = frame_on_the_line(dut)
    carried = min(1.0 / transfer, rate)
    return Measurement(
        100 * (1.0 - carried / rate),
        "%",
        where=f"{length} bytes per frame: the line carries {engineering(1.0 / transfer, 'Hz')}",
        confidence="from the packet's length and the bit rate; an undisturbed line",
    )


def _measured(dut: DesignUnderTest, readings: Readings) -> Measurement:
    sent = len(readings.volts) + readings.lost
    return Measurement(100 * readings.lost / sent, "%", where=f"{readings.lost} of {sent} frames")


QUANTITY = Quantity(
    name="lost_frames",
    title="Frames lost on the line",
    unit="%",
    says="Share of frames that the line cannot carry, %.",
    compute=lost_frames,
    shipped=(Shipped(17, "The line carries every frame.", max=0.0),),
    mended_by=(("operation.frame_rate", DOWN), ("operation.baudrate", UP)),
    measured=_measured,
)
