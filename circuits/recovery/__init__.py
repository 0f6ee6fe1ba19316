"""From readings back to cells: the circuit model inverted, with how far each cell can be off."""

from ._live import LiveReading, LiveRecovery, live_recovery
from ._recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover

__all__ = [
    "Conditioning",
    "LiveReading",
    "LiveRecovery",
    "Recoverer",
    "Recovery",
    "Status",
    "conditioning",
    "live_recovery",
    "recover",
]
