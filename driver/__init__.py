"""The host end: a port to counts, ohms and kPa.

::

    with Skin.open("/dev/ttyACM0") as skin:
        for frame in skin:
            print(frame.pressure)
"""

from ._port import BAUDRATE, BytePort, SerialPort
from ._reading import CountReader, Reading
from ._skin import Frame, Skin

__all__ = ["BAUDRATE", "BytePort", "CountReader", "Frame", "Reading", "SerialPort", "Skin"]
