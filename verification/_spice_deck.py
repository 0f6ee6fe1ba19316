"""A SPICE deck with the real parts of a readout: capacitors, one-pole amplifiers with their swing, noise sources."""

from __future__ import annotations

from ..arrays import FloatArray
from ..circuits import Design
from ..circuits.spice import netlist


def dynamic_netlist(design: Design, cells: FloatArray, row: int) -> str:
    """The netlist of one scan step."""
    return netlist(design, cells, row)
