"""SPICE: netlists of every scan step, and ngspice as an independent judge: its library in this process, its command."""

from ._dynamic import DynamicReading, dynamic_netlist, dynamic_reading
from ._netlist import Deck, netlist
from ._ngspice import command_available, run_command, run_control
from ._pyspice import library_available, run_library
from ._scan import spice_scan

__all__ = [
    "Deck",
    "DynamicReading",
    "command_available",
    "dynamic_netlist",
    "dynamic_reading",
    "library_available",
    "netlist",
    "run_command",
    "run_control",
    "run_library",
    "spice_scan",
]
