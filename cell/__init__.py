"""The piezoresistive cell: pressure to resistance, and back."""

from ._cell import ESTIMATORS, Cell
from ._estimators import Estimate, Estimator
from ._forward import Forward
from ._models import AsymmetricModel, ContactModel, M10Model, PaperModel

__all__ = [
    "ESTIMATORS",
    "AsymmetricModel",
    "Cell",
    "ContactModel",
    "Estimate",
    "Estimator",
    "Forward",
    "M10Model",
    "PaperModel",
]
