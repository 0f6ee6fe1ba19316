"""Diagnosis of an installation and its serial ports: what is there, what is missing, and what to type to mend it.

For a board of no known family, :func:`examine_traffic` drafts the BOARD.toml from what the board sends."""

from ._draft import Draft, draft
from ._finding import Finding, State
from ._guess import Chunk
from ._installation import examine_installation
from ._listening import START_WORDS, Traffic, examine_traffic, has_baud_rate, judge
from ._serial import System, examine_device, examine_ports

__all__ = [
    "START_WORDS",
    "Chunk",
    "Draft",
    "Finding",
    "State",
    "System",
    "Traffic",
    "draft",
    "examine_device",
    "examine_installation",
    "examine_ports",
    "examine_traffic",
    "has_baud_rate",
    "judge",
]
