"""The host's end of the link: from a port to counts, ohms and kPa.

::

    with Skin.open("/dev/ttyACM0") as skin:
        for frame in skin:
            print(frame.pressure)
"""

from ..common.measurement import Measurement
from ._arrays import FRAME_GRIDS, FRAME_NUMBERS, stack, to_xarray
from ._calibration import Calibration
from ._contacts import Contact, ContactTracker
from ._discover import FoundBoard, discover
from ._frame import Frame
from ._frames import Delivery
from ._messages import MESSAGE_SCHEMAS, messages_of, points_of
from ._open import JoinedSkin, Skin
from ._options import SkinSettings
from ._port import BAUDRATE, Arrival, BytePort, SerialPort, SocketPort, open_port
from ._reading import CountReader
from ._recorder import Recorder
from ._recording import Recording
from ._replay import ReplayPort
from ._statistics import LinkStatistics
from ._tare import Tare

__all__ = [
    "BAUDRATE",
    "FRAME_GRIDS",
    "FRAME_NUMBERS",
    "MESSAGE_SCHEMAS",
    "Arrival",
    "BytePort",
    "Calibration",
    "Contact",
    "ContactTracker",
    "CountReader",
    "Delivery",
    "FoundBoard",
    "Frame",
    "JoinedSkin",
    "LinkStatistics",
    "Measurement",
    "Recorder",
    "Recording",
    "ReplayPort",
    "SerialPort",
    "Skin",
    "SkinSettings",
    "SocketPort",
    "Tare",
    "discover",
    "messages_of",
    "open_port",
    "points_of",
    "stack",
    "to_xarray",
]
