"""Readings in time: settling after a row switch, stability of the amplifiers, and noise."""

from ._transient import Transient

__all__ = ["Transient"]
