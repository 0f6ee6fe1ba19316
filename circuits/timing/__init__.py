"""Readings in time: settling after a row switch, stability of the amplifiers, and noise."""

from ._noise import Noise, noise
from ._settling import Settling, Stability, stability

__all__ = ["Noise", "Settling", "Stability", "noise", "stability"]
