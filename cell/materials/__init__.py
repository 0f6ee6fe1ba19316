"""Material models of piezoresistive cells: parameters of each kind, and forward models (pressure to resistance).

======================  =======================================================================================
:mod:`._models`         the parameters, as sections of CELL.toml; the resistance under a pressure held for long
:mod:`._lag`            exact discretisation of first-order lags, the building blocks of all dynamic models
:mod:`._steps`          steps of each model as kernels
:mod:`._forward`        forward models of arrays of cells
:mod:`._simulate`       whole recordings of many cells; random loads and noise
:mod:`._material`       mixtures with more or less carbon black; temperature, ageing
======================  =======================================================================================
"""

from . import _lag as lag
from . import _simulate as simulate
from ._forward import M10_PARAMETERS, Forward, as_m10, make_forward, resistance_of, resistance_on_logarithm
from ._lag import ByStep
from ._material import Percolation, drifted_rest_resistance
from ._models import (
    AsymmetricModel,
    ContactModel,
    M10Model,
    Model,
    PaperModel,
    equilibrium_curve,
    equilibrium_gain,
)
from ._simulate import smoothed, smoothing_s, white_noise

__all__ = [
    "M10_PARAMETERS",
    "AsymmetricModel",
    "ByStep",
    "ContactModel",
    "Forward",
    "M10Model",
    "Model",
    "PaperModel",
    "Percolation",
    "as_m10",
    "drifted_rest_resistance",
    "equilibrium_curve",
    "equilibrium_gain",
    "lag",
    "make_forward",
    "resistance_of",
    "resistance_on_logarithm",
    "simulate",
    "smoothed",
    "smoothing_s",
    "white_noise",
]
