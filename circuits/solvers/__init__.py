"""Solvers for resistor grids. Their inputs are conductances and lines only, not designs, amplifiers or converters.

========================  ==============================================================================================
:mod:`._elimination`      Kron reduction (Schur complements) in positive arithmetic, with a bound on its rounding errors
:mod:`._dissection`       nested dissection of plain grids, for whole frames and batches of frames
:mod:`._network`          nested dissection of any resistor network: bridged lines, continuous sheets
:mod:`._ports`            a grid's port conductances and transfer conductances by the two above
:mod:`._banded`           banded Cholesky factorisation, for small grids
:mod:`._ladders`          ladder networks (single lines with their cells) by continued fractions
:mod:`._attenuation`      the first term of a Neumann series in closed form, with a certificate
:mod:`._sequence`         sequences of frames, by interpolation of the error of attenuation, with a certificate
:mod:`._exact`            transfer conductances by the fastest exact method
========================  ==============================================================================================
"""

from ._attenuation import Attenuated, Wires, attenuate
from ._elimination import ULP, Rounded, eliminate_leading, inverted
from ._exact import entrywise, exact_transfer, series_conductance
from ._network import Element, Network, reduce
from ._ports import IDEAL_WIRE, LARGEST_PART, Lines, has_ideal_lines, port_conductances
from ._sequence import SequenceTransfer, sequence_transfer
from ._siemens import siemens

__all__ = [
    "IDEAL_WIRE",
    "LARGEST_PART",
    "ULP",
    "Attenuated",
    "Element",
    "Lines",
    "Network",
    "Rounded",
    "SequenceTransfer",
    "Wires",
    "attenuate",
    "eliminate_leading",
    "entrywise",
    "exact_transfer",
    "has_ideal_lines",
    "inverted",
    "port_conductances",
    "reduce",
    "sequence_transfer",
    "series_conductance",
    "siemens",
]
