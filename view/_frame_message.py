"""Binary layout of one frame on the WebSocket: a header, arrays of numbers per cell, and contacts. Little-endian.

=============  =============================  ====================================================================
offset         type                           content
=============  =============================  ====================================================================
0              uint32                         version of this layout, 3
4              uint32                         number of the frame, from 0 in the order of taking
8              uint16, uint16                 rows, columns; below, n = rows x columns
12             uint16, uint16                 number of contacts; flags, see :class:`Mark`
16             float64                        time in s since the first frame
24             float64                        time on the board's clock in s; NaN where the board has none
32             float64                        time in s since the epoch
40             float64                        age in s when the message was made; NaN for a recording
48             float64                        total force in N: pressure times area over all valid cells
56             float32 [n]                    pressure in kPa
...            float32 [n]                    standard deviation of the pressure in kPa
...            float32 [n]                    resistance in ohm
...            float32 [n]                    counts above those at rest
...            uint16 [n]                     counts
...            uint8 [n]                      why a cell is not valid: a ``Reason`` each, 0 for valid cells
...            (uint32, float32 [6]) each     contact: id; x, y and z in mm (z: NaN if flat); force in N; peak in kPa;
                                              area in mm^2
...            (uint32, uint32) each          to the end: id of a contact, and of another one that has run into it
=============  =============================  ====================================================================

Cells are in rows, as in ``Frame``. Missing numbers are NaN. ``view/page/frame-message.js`` reads this layout.
"""

from __future__ import annotations

import struct
from enum import IntFlag

import numpy as np

from ..driver import Frame

VERSION = 3
HEADER = struct.Struct("<IIHHHHddddd")
TOTAL_FORCE_AT = 48
"""place of the total force in a message"""
CONTACT = struct.Struct("<I6f")
JOINED = struct.Struct("<II")


class Mark(IntFlag):
    """What happened since the frame before."""

    OVERRUN = 1
    RECONNECTED = 2
    REBOOTED = 4
    ESTIMATOR_RESTARTED = 8


def pack_frame(frame: Frame, *, number: int, time_s: float, age_s: float = float("nan")) -> bytes:
    """The message of a frame.

    Args:
        frame: the frame; its contacts are computed, if they have not been yet.
        number: of the frame.
        time_s: on the page's time axis.
        age_s: since the frame's arrival; NaN for a recording.

    """
    rows, columns = frame.counts.shape
    contacts = frame.contacts
    marks = (
        Mark.OVERRUN * frame.overrun
        | Mark.RECONNECTED * frame.reconnected
        | Mark.REBOOTED * frame.rebooted
        | Mark.ESTIMATOR_RESTARTED * frame.estimator_restarted
    )
    device_time = float("nan") if frame.device_time is None else frame.device_time
    total_n = 1e-3 * float(
        np.sum(frame.geometry.areas_mm2 * frame.pressure, where=frame.valid & np.isfinite(frame.pressure))
    )
    times = time_s, device_time, frame.host_time, age_s
    header = HEADER.pack(VERSION, number, rows, columns, len(contacts), marks, *times, total_n)
    with np.errstate(over="ignore"):  # beyond float32 is infinite
        numbers = [
            np.asarray(values, dtype="<f4").tobytes()
            for values in (frame.pressure, frame.pressure_std, frame.resistance, frame.change)
        ]
    touched = [
        CONTACT.pack(
            one.id,
            one.x_mm,
            one.y_mm,
            float("nan") if one.z_mm is None else one.z_mm,
            one.force_n,
            one.peak_kpa,
            one.area_mm2,
        )
        for one in contacts
    ]
    joined = [JOINED.pack(one.id, other) for one in contacts for other in one.joined]
    counts, reason = np.asarray(frame.counts, dtype="<u2"), np.asarray(frame.reason, dtype="u1")
    return b"".join([header, *numbers, counts.tobytes(), reason.tobytes(), *touched, *joined])
