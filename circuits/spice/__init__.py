"""SPICE: netlists of every scan step, and ngspice as an independent judge.

:mod:`._ngspice` is the only module that imports PySpice (GPL, extra ``spice``), and only when it is used.
"""

from ._dynamic import DynamicReading, dynamic_netlist, dynamic_reading
from ._netlist import Deck, DeckWriter, frame_deck, netlist, step_deck
from ._ngspice import available, command_available, command_scan, run_command, run_control, run_library, spice_scan

__all__ = [
    "Deck",
    "DeckWriter",
    "DynamicReading",
    "available",
    "command_available",
    "command_scan",
    "dynamic_netlist",
    "dynamic_reading",
    "frame_deck",
    "netlist",
    "run_command",
    "run_control",
    "run_library",
    "spice_scan",
    "step_deck",
]
