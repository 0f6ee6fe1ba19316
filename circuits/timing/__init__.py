"""Readings in time: settling after a row switch, stability of the amplifiers, transients, and noise."""

from ._events import EventScan
from ._noise import Noise, noise
from ._settling import Settling, Stability, stability
from ._transient import Transient

__all__ = ["EventScan", "Noise", "Settling", "Stability", "Transient", "noise", "stability"]
