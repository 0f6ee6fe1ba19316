"""Material models of piezoresistive cells: parameters of each kind, and forward models (pressure to resistance).

======================  =====================================================================================
:mod:`._models`         the parameters, as sections of CELL.toml
:mod:`._lag`            exact discretisation of first-order lags, the building blocks of all dynamic models
:mod:`._forward`        forward models, step by step
:mod:`._simulate`       the same for whole recordings of many cells; random loads and noise
:mod:`._equilibrium`    the resistance under a pressure held for long
:mod:`._material`       sensitivity, temperature, ageing
:mod:`._percolation`    mixtures with more or less carbon black
======================  =====================================================================================
"""

from . import _lag as lag
from . import _simulate as simulate
from ._equilibrium import equilibrium_curve, equilibrium_gain
from ._forward import M10_PARAMETERS, Forward, as_m10, make_forward, resistance_of, resistance_on_logarithm
from ._lag import ByStep
from ._material import drifted_rest_resistance
from ._models import AsymmetricModel, ContactModel, M10Model, Model, PaperModel
from ._percolation import Percolation
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
