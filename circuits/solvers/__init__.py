"""Solvers for resistor grids. Their inputs are conductances and lines only, not designs, amplifiers or converters.

========================  ==============================================================================================
:mod:`._elimination`      Kron reduction (Schur complements) in positive arithmetic, with a bound on its rounding errors
:mod:`._dissection`       nested dissection of plain grids, for whole frames and batches of frames
:mod:`._network`          nested dissection of any resistor network: bridged lines, continuous sheets
:mod:`._ports`            a grid's port conductances and transfer conductances by the two above
:mod:`._attenuation`      the first term of a Neumann series, with a certificate
:mod:`._exact`            transfer conductances, with a bound on each one's rounding error
========================  ==============================================================================================
"""

from ._attenuation import Attenuated, Wires, attenuate
from ._elimination import ULP, Rounded, eliminate_leading, inverted
from ._exact import entrywise, exact_transfer, series_conductance
from ._network import Element, Network, reduce
from ._ports import Lines, has_ideal_lines, port_conductances
from ._siemens import siemens
from ._tuning import IDEAL_WIRE, LARGEST_PART, LEAST_OHM

__all__ = [
    "IDEAL_WIRE",
    "LARGEST_PART",
    "LEAST_OHM",
    "ULP",
    "Attenuated",
    "Element",
    "Lines",
    "Network",
    "Rounded",
    "Wires",
    "attenuate",
    "eliminate_leading",
    "entrywise",
    "exact_transfer",
    "has_ideal_lines",
    "inverted",
    "port_conductances",
    "reduce",
    "series_conductance",
    "siemens",
]
