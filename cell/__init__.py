"""The piezoresistive cell: pressure to resistance, and back."""

from ._calibrate import CalibrationResult, calibrate, estimate_recording
from ._cell import ESTIMATORS, Cell
from ._estimator import Estimator
from ._forward import Forward
from ._material import drifted_rest_resistance, sensitivity
from ._models import AsymmetricModel, ContactModel, M10Model, PaperModel
from ._percolation import Percolation
from ._protocol import check_protocol, protocol_load, protocol_text
from ._recording import Recording, check_times, checked_recording
from ._recovery_curve import recovery_branches
from ._report import calibration_figure, calibration_record, calibration_text
from ._static import equilibrium_curve

__all__ = [
    "ESTIMATORS",
    "AsymmetricModel",
    "CalibrationResult",
    "Cell",
    "ContactModel",
    "Estimator",
    "Forward",
    "M10Model",
    "PaperModel",
    "Percolation",
    "Recording",
    "calibrate",
    "calibration_figure",
    "calibration_record",
    "calibration_text",
    "check_protocol",
    "check_times",
    "checked_recording",
    "drifted_rest_resistance",
    "equilibrium_curve",
    "estimate_recording",
    "protocol_load",
    "protocol_text",
    "recovery_branches",
    "sensitivity",
]
