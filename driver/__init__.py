"""The host end: a port to counts, ohms and kPa.

::

    with Skin.open("/dev/ttyACM0") as skin:
        for frame in skin:
            print(frame.pressure)
"""

from .port import BAUDRATE, BytePort, SerialPort
from .reading import Reading, read_counts
from .skin import Frame, Skin

__all__ = ["BAUDRATE", "BytePort", "Frame", "Reading", "SerialPort", "Skin", "read_counts"]
