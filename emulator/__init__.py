"""A virtual ohmskin board: a scene of contacts to bytes on a pty or TCP port, and the truth beside them."""

from .board import Board
from .line import Line, TransmitBuffer
from .ports import Port, PtyPort, TcpPort
from .run import ClockName, Outcome, Stop, emulate, running, stop_on_signals
from .scene import Bump, Contact, Disc, Rectangle, Scene
from .skin import EmulatedSkin, Sample
from .spread import shares, spread
from .truth import TruthFile

__all__ = [
    "Board",
    "Bump",
    "ClockName",
    "Contact",
    "Disc",
    "EmulatedSkin",
    "Line",
    "Outcome",
    "Port",
    "PtyPort",
    "Rectangle",
    "Sample",
    "Scene",
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
