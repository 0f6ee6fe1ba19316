"""Calibration of the cells of a skin: rest resistance and gain of each cell from guided presses with known loads.

::

    watch = Watch(cell, Plan.make(shape, "each", [5.0, 10.0]), hold_s=3.0, rest_s=2.0)
    for frame in skin:
        for event in watch.feed(frame.device_time, frame.resistance):
            ...
    calibration = calibrate_cells(cell, watch.rest, watch.presses).calibration(design, cell, serial_number)

======================================================  ========================================================
:mod:`._plan`                                           which places, which loads
:mod:`._watch`, :mod:`._hold`, :mod:`._rest`            frames to presses: a state machine without I/O
:mod:`._fit`                                            presses to R0 and gain
:mod:`._verdict`                                        what is refused, and the calibration
:mod:`._progress`, :mod:`._reference`, :mod:`._guide`   the progress file; the reference sensor; the person at the skin
======================================================  ========================================================

The value, its file, and how it is applied are in :mod:`ohmskin.driver`.
"""

from ._fit import Fit, fit_cells
from ._guide import Guide
from ._plan import Plan
from ._presses import Press, Rest
from ._progress import Progress
from ._reference import Alignment, align, read_reference, with_reference
from ._verdict import Verdict, calibrate_cells
from ._watch import Event, HeldLongEnough, PressBegan, PressRefused, PressTaken, RestTaken, Watch

__all__ = [
    "Alignment",
    "Event",
    "Fit",
    "Guide",
    "HeldLongEnough",
    "Plan",
    "Press",
    "PressBegan",
    "PressRefused",
    "PressTaken",
    "Progress",
    "Rest",
    "RestTaken",
    "Verdict",
    "Watch",
    "align",
    "calibrate_cells",
    "fit_cells",
    "read_reference",
    "with_reference",
]
