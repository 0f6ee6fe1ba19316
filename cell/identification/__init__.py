"""System identification of a cell: a recording gives the parameters of its model, and the estimator that suits it.

====================  ==========================================================================================
:mod:`._calibrate`    the whole calibration; :mod:`._report` prints and draws the results
:mod:`._recording`    recordings and their checks; :mod:`._protocol`: the presses to apply
:mod:`._identify`     fits every kind of cell in :mod:`._kinds` to a recording
:mod:`._training`     trains estimators on the recording and on simulated cells
:mod:`._choice`       chooses the default estimator by cross-validation on the :mod:`._folds`
====================  ==========================================================================================
"""

from ._calibrate import CalibrationResult, calibrate, estimate_recording
from ._folds import folds
from ._identify import fits
from ._protocol import check_protocol, protocol_load, protocol_text
from ._recording import Recording, check_resistances, checked_recording, read_recording
from ._recovery_curve import recovery_branches
from ._rehearsal import READING_NOISE, rehearsed
from ._remarks import remarks
from ._report import calibration_figure, calibration_record, calibration_text

__all__ = [
    "READING_NOISE",
    "CalibrationResult",
    "Recording",
    "calibrate",
    "calibration_figure",
    "calibration_record",
    "calibration_text",
    "check_protocol",
    "check_resistances",
    "checked_recording",
    "estimate_recording",
    "fits",
    "folds",
    "protocol_load",
    "protocol_text",
    "read_recording",
    "recovery_branches",
    "rehearsed",
    "remarks",
]
