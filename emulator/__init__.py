"""A virtual ohmskin board: a scene of contacts to bytes on a serial link, and the truth beside them."""

import serial

from ._board import Board
from ._contacts import Contact
from ._device import Device
from ._faults import Line
from ._hand import Hand
from ._line import Transmission
from ._line_settings import ClockSettings, LineSettings, LinkFault
from ._plan import Plan, PlannedEffect, plan
from ._ports import PairPort, Port, PtyPort, Rfc2217Port, TcpPort
from ._run import EngineName, Options, emulate, running
from ._scene import DEMO, BoardSettings, Scene, SkinSettings, load_scenes
from ._score import Recording, Score, Truth, score, score_text
from ._service import ClockName, Outcome, Stop, stop_on_signals
from ._shapes import Bump, Disc, Image, Point, Rectangle
from ._skin import EmulatedSkin, FrameBlock, Sample
from ._spread import shares, spread
from ._truth import TruthFile

__all__ = [
    "DEMO",
    "Board",
    "BoardSettings",
    "Bump",
    "ClockName",
    "ClockSettings",
    "Contact",
    "Device",
    "Disc",
    "EmulatedSkin",
    "EngineName",
    "FrameBlock",
    "Hand",
    "Image",
    "Line",
    "LineSettings",
    "LinkFault",
    "Options",
    "Outcome",
    "PairPort",
    "Plan",
    "PlannedEffect",
    "Point",
    "Port",
    "PtyPort",
    "Recording",
    "Rectangle",
    "Rfc2217Port",
    "Sample",
    "Scene",
    "Score",
    "SkinSettings",
    "Stop",
    "TcpPort",
    "Transmission",
    "Truth",
    "TruthFile",
    "emulate",
    "load_scenes",
    "plan",
    "running",
    "score",
    "score_text",
    "shares",
    "spread",
    "stop_on_signals",
]

# pyserial looks for the handler of ohmskin:// URLs in the packages of this list.
if __name__ not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append(__name__)
