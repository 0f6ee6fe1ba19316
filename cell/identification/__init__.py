"""System identification: from a recording to the parameters of a cell and to the estimator that suits it.

====================  ==========================================================================================
:mod:`._calibrate`    the whole of a calibration; :mod:`._report` prints and draws what it found
:mod:`._recording`    recordings and their checks; :mod:`._protocol`: which presses to apply
:mod:`._identify`     every kind of cell in :mod:`._kinds` fitted to a recording
:mod:`._training`     learned estimators, from the recording and from simulated cells
:mod:`._choice`       which estimator becomes the default, by its errors on the :mod:`._folds`
====================  ==========================================================================================
"""

from ._calibrate import CalibrationResult, calibrate, estimate_recording
from ._protocol import check_protocol, protocol_load, protocol_text
from ._recording import Recording, check_resistances, check_times, checked_recording
from ._recovery_curve import recovery_branches
from ._report import calibration_figure, calibration_record, calibration_text

__all__ = [
    "CalibrationResult",
    "Recording",
    "calibrate",
    "calibration_figure",
    "calibration_record",
    "calibration_text",
    "check_protocol",
    "check_resistances",
    "check_times",
    "checked_recording",
    "estimate_recording",
    "protocol_load",
    "protocol_text",
    "recovery_branches",
]
