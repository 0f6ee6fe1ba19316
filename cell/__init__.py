"""The piezoresistive cell: pressure to resistance, and back."""

from ._cell import ESTIMATORS, Cell
from .estimation import Estimator
from .identification import (
    CalibrationResult,
    Layout,
    Recording,
    Role,
    calibrate,
    calibration_figure,
    calibration_record,
    calibration_text,
    check_protocol,
    check_resistances,
    checked_recording,
    estimate_recording,
    learned_from_model,
    load_recording,
    protocol_load,
    protocol_text,
    read_files,
    read_recording,
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
)

Cell.learned_from_model = staticmethod(learned_from_model)

__all__ = [
    "ESTIMATORS",
    "AsymmetricModel",
    "CalibrationResult",
    "Cell",
    "ContactModel",
    "Estimator",
    "Forward",
    "Layout",
    "M10Model",
    "PaperModel",
    "Percolation",
    "Recording",
    "Role",
    "calibrate",
    "calibration_figure",
    "calibration_record",
    "calibration_text",
    "check_protocol",
    "check_resistances",
    "checked_recording",
    "drifted_rest_resistance",
    "estimate_recording",
    "load_recording",
    "protocol_load",
    "protocol_text",
    "read_files",
    "read_recording",
    "recovery_branches",
]
