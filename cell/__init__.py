"""The piezoresistive cell: pressure to resistance, and back."""

from .cell import ESTIMATORS, Cell
from .estimators import Estimate, Estimator
from .forward import Forward
from .models import AsymmetricModel, ContactModel, M10Model, PaperModel

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
