"""Ends of lines as small networks: their cards, their equations, and their sections of DESIGN.toml.

=====================  =================================================================
:mod:`._cards`         SPICE elements as values
:mod:`._equations`     modified nodal analysis, and the exact law of a linear end
:mod:`._line_ends`     the ends of all lines of a board
:mod:`._nodal`         Newton's method for all ends and the grid's ports together
:mod:`._spice`         their cards for ngspice
:mod:`._sections`      ``[row_end]``, ``[column_end]``, ``[crosspoint]``, ``[reference]``, ``[scan]``
=====================  =================================================================
"""

from ._cards import GROUND, Card, Statement, statements
from ._equations import CELL, LINE, OUT, ROW
from ._line_ends import OPEN_OHM, REF, Columns, LineEnds, Network, Rows, amplifier
from ._nodal import Solution, System, alone, inverted_nodes, solve, step_system
from ._sections import ColumnEnd, Crosspoint, Event, Reference, RowEnd, Scan
from ._spice import join, spice_cards

__all__ = [
    "CELL",
    "GROUND",
    "LINE",
    "OPEN_OHM",
    "OUT",
    "REF",
    "ROW",
    "Card",
    "ColumnEnd",
    "Columns",
    "Crosspoint",
    "Event",
    "LineEnds",
    "Network",
    "Reference",
    "RowEnd",
    "Rows",
    "Scan",
    "Solution",
    "Statement",
    "System",
    "alone",
    "amplifier",
    "inverted_nodes",
    "join",
    "solve",
    "spice_cards",
    "statements",
    "step_system",
]
