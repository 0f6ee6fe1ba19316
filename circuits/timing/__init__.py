"""Readings in time: settling after a row switch, stability of the amplifiers, transients, and noise."""

from ._events import EventScan
from ._noise import Noise, noise
from ._settling import BoardsInTime, Settling, Stability, stability, stability_of_boards
from ._transient import Transient

__all__ = [
    "BoardsInTime",
    "EventScan",
    "Noise",
    "Settling",
    "Stability",
    "Transient",
    "noise",
    "stability",
    "stability_of_boards",
]
