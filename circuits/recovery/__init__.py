"""From readings back to cells: the circuit model inverted, with how far each cell can be off."""

from ._live import live_recovery
from ._live_reading import LiveReading, LiveRecovery, Reason, ValidityRule
from ._recover import Conditioning, Recoverer, Recovery, Status, conditioning, recover

__all__ = [
    "Conditioning",
    "LiveReading",
    "LiveRecovery",
    "Reason",
    "Recoverer",
    "Recovery",
    "Status",
    "ValidityRule",
    "conditioning",
    "live_recovery",
    "recover",
]
