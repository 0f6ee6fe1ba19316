"""System identification of a cell: a recording gives the parameters of its model, and the estimator that suits it.

====================  ==========================================================================================
:mod:`._calibrate`    the whole calibration; :mod:`._report` prints and draws the results
:mod:`._recording`    recordings and their checks; :mod:`._measured`: of any columns and units; :mod:`._protocol`: the
                      presses to apply
:mod:`._identify`     fits the :mod:`._kinds` of cell to a recording, by :mod:`._projection`
:mod:`._training`     trains the distilled estimator on the recording and on simulated cells; :mod:`._curves`: without
                      memory
:mod:`._held_out`     the choice among estimators and their deviations, by errors on the :mod:`._folds`
====================  ==========================================================================================
"""

from ._calibrate import CalibrationResult, calibrate, estimate_recording
from ._folds import folds
from ._from_model import learned_from_model
from ._identify import Task, find_drift, fits
from ._measured import Layout, Role, load_recording, read_files
from ._protocol import check_protocol, protocol_load, protocol_text
from ._recording import Recording, check_resistances, checked_recording
from ._recovery_curve import recovery_branches
from ._rehearsal import READING_NOISE, rehearsed
from ._remarks import remarks
from ._report import calibration_figure, calibration_record, calibration_text

__all__ = [
    "READING_NOISE",
    "CalibrationResult",
    "Layout",
    "Recording",
    "Role",
    "Task",
    "calibrate",
    "calibration_figure",
    "calibration_record",
    "calibration_text",
    "check_protocol",
    "check_resistances",
    "checked_recording",
    "estimate_recording",
    "find_drift",
    "fits",
    "folds",
    "learned_from_model",
    "load_recording",
    "protocol_load",
    "protocol_text",
    "read_files",
    "recovery_branches",
    "rehearsed",
    "remarks",
]
