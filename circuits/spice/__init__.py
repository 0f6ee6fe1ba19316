"""SPICE: netlists of every scan step, and the command ngspice as an independent judge."""

from ._dynamic import DynamicReading, dynamic_netlist, dynamic_reading
from ._netlist import Deck, DeckWriter, frame_deck, netlist, step_deck
from ._ngspice import command_available, command_scan, run_command, run_control

__all__ = [
    "Deck",
    "DeckWriter",
    "DynamicReading",
    "command_available",
    "command_scan",
    "dynamic_netlist",
    "dynamic_reading",
    "frame_deck",
    "netlist",
    "run_command",
    "run_control",
    "step_deck",
]
