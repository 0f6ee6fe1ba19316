"""Diagnosis of an installation and its serial ports: what is there, what is missing, and what to type to mend it."""

from ._finding import Finding, State
from ._installation import examine_installation
from ._listening import examine_traffic, judge
from ._serial import System, examine_device, examine_ports

__all__ = [
    "Finding",
    "State",
    "System",
    "examine_device",
    "examine_installation",
    "examine_ports",
    "examine_traffic",
    "judge",
]
