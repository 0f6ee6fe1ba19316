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

from ._cards import DIODES, GROUND, OPAMP, Card, Statement, parse_cards, statements
from ._equations import CELL, LINE, OUT, ROW, Equations, PortLaw, float_of, port_law
from ._line_ends import OPEN_OHM, REF, Columns, LineEnds, Network, Rows, amplifier, is_bent
from ._nodal import Solution, System, alone, inverted_nodes, solve, step_system
from ._sections import ColumnEnd, Crosspoint, Event, Reference, RowEnd, Scan
from ._spice import join, spice_cards

__all__ = [
    "CELL",
    "DIODES",
    "GROUND",
    "LINE",
    "OPAMP",
    "OPEN_OHM",
    "OUT",
    "REF",
    "ROW",
    "Card",
    "ColumnEnd",
    "Columns",
    "Crosspoint",
    "Equations",
    "Event",
    "LineEnds",
    "Network",
    "PortLaw",
    "Reference",
    "RowEnd",
    "Rows",
    "Scan",
    "Solution",
    "Statement",
    "System",
    "alone",
    "amplifier",
    "float_of",
    "inverted_nodes",
    "is_bent",
    "join",
    "parse_cards",
    "port_law",
    "solve",
    "spice_cards",
    "statements",
    "step_system",
]
