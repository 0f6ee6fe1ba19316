"""A virtual ohmskin board: a scene of contacts to bytes on a pty or TCP port, and the truth beside them."""

from ._board import Board
from ._contacts import Contact
from ._line import Line, TransmitBuffer
from ._ports import Port, PtyPort, TcpPort
from ._run import ClockName, Outcome, Stop, emulate, running, stop_on_signals
from ._scene import BoardSettings, Scene, SkinSettings
from ._shapes import Bump, Disc, Image, Point, Rectangle
from ._skin import EmulatedSkin, FrameBlock, Sample
from ._spread import shares, spread
from ._truth import TruthFile

__all__ = [
    "Board",
    "BoardSettings",
    "Bump",
    "ClockName",
    "Contact",
    "Disc",
    "EmulatedSkin",
    "FrameBlock",
    "Image",
    "Line",
    "Outcome",
    "Point",
    "Port",
    "PtyPort",
    "Rectangle",
    "Sample",
    "Scene",
    "SkinSettings",
    "Stop",
    "TcpPort",
    "TransmitBuffer",
    "TruthFile",
    "emulate",
    "running",
    "shares",
    "spread",
    "stop_on_signals",
]
