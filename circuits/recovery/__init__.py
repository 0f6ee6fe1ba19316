"""From readings back to cells: the circuit model inverted, with how far each cell can be off."""

from ._recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover

__all__ = ["Conditioning", "Recoverer", "Recovery", "Status", "conditioning", "recover"]
