"""Boards drawn in KiCad: an exported netlist to a design with questions, and a design to a netlist and a parts list."""

from ._board import Board
from ._export import parts_list, to_netlist
from ._import import Imported, differences, import_design
from ._layout import COLUMNS, ROWS, shape_of_layout
from ._netlist import Netlist, Part, parse_netlist, read_netlist

__all__ = [
    "COLUMNS",
    "ROWS",
    "Board",
    "Imported",
    "Netlist",
    "Part",
    "differences",
    "import_design",
    "parse_netlist",
    "parts_list",
    "read_netlist",
    "shape_of_layout",
    "to_netlist",
]
