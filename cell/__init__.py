"""The piezoresistive cell: pressure to resistance, and back."""

from typing import TYPE_CHECKING, Any

from ._cell import ESTIMATORS, Calibrated, Cell
from .estimation import Estimator
from .materials import (
    AsymmetricModel,
    ContactModel,
    Forward,
    M10Model,
    PaperModel,
    Percolation,
    drifted_rest_resistance,
)

if TYPE_CHECKING:
    from .identification import (
        READING_NOISE,
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
        load_recording,
        protocol_load,
        protocol_text,
        read_files,
        recovery_branches,
        rehearsed,
    )
else:

    def __getattr__(name: str) -> Any:
        """What identifies cells, imported when it is asked for: a driver does not need it (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from . import identification

        return getattr(identification, name)


def _learned_from_model(cell: Cell) -> Calibrated:
    from .identification import learned_from_model

    return learned_from_model(cell)


Cell.learned_from_model = staticmethod(_learned_from_model)

__all__ = [
    "ESTIMATORS",
    "READING_NOISE",
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
    "recovery_branches",
    "rehearsed",
]
