"""The piezoresistive cell: pressure to resistance, and back."""

from ._cell import ESTIMATORS, Cell
from .estimation import Estimator
from .identification import (
    CalibrationResult,
    Recording,
    calibrate,
    calibration_figure,
    calibration_record,
    calibration_text,
    check_protocol,
    check_times,
    checked_recording,
    estimate_recording,
    protocol_load,
    protocol_text,
    recovery_branches,
)
from .materials import (
    AsymmetricModel,
    ContactModel,
    Forward,
    M10Model,
    PaperModel,
    Percolation,
    drifted_rest_resistance,
    equilibrium_curve,
    sensitivity,
)

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
