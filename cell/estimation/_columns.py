"""Quantisation that the cells of a column share: estimated from the other cells, and taken out of the readings.

On a divider whose idle rows are driven, steps of a few readings move all conductances of a column: a reading is
r + noise + h z, with one z for each column and frame. The filter predicts every reading, so that innovations of the
*other* cells of a column tell z (a scalar Kalman update for each cell, its own reading left out: it would take a part
of the cell's own load). Two laws keep loads out of z. An innovation counts up to :data:`CLIPPED` of its standard
deviations (Huber 1964). And what lasts is taken out up to the step itself only.

Noise that a column shares stays in: it is white, so that the filter averages it as noise of the cell, while a finger
that presses several cells of a column at once looks like it for as long as the filter lags.
"""

from __future__ import annotations

import math

from ...common.compiled import Records, Row, loop
from ._filter import Estimates, Reading, Watch, expects
from ._modes import Step

RARE = 2.5
"""z beyond which a load on the whole column is likelier, and nothing is taken out of the frame"""
CLIPPED = 3.0
"""standard deviations of an innovation"""
WHITE = 0.05
"""weight of a frame in the recent mean of a column's z"""


@loop
def share_each(
    cells: Records[Estimates],
    watches: Records[Watch],
    steps: Records[Step],
    recent: Row,
    readings: Records[Reading],
) -> None:
    """Take what columns share out of readings (n,), and add what stays to the variance of their noise.

    ``recent`` (columns,): mean of late z.
    """
    columns, t = recent.size, steps[0]
    for i in range(readings.size):
        reading = readings[i]
        reading.spread = 0.0
        if reading.known > 0.0 and reading.shared != 0.0:
            mean, expected = expects(cells[i], watches[i], t)
            width = reading.high - reading.low
            reading.spread = expected + reading.variance + width * width * (1.0 / 12.0)
            most = CLIPPED * math.sqrt(reading.spread + reading.shared * reading.shared)
            reading.off = min(max(0.5 * (reading.low + reading.high) - mean, -most), most)
    for k in range(columns):
        precision, moved = 1.0, 0.0
        for i in range(k, readings.size, columns):
            reading = readings[i]
            if reading.spread > 0.0:
                precision += reading.shared * reading.shared / reading.spread
                moved += reading.shared * reading.off / reading.spread
        recent[k] += WHITE * (moved / precision - recent[k])
        loaded = abs(moved / precision) > RARE
        for i in range(k, readings.size, columns):
            reading = readings[i]
            if reading.spread > 0.0:
                shared = reading.shared
                others = precision - shared * shared / reading.spread
                z = (moved - shared * reading.off / reading.spread) / others
                lasting = shared * recent[k] * (1.0 - 1.0 / others)
                move = 0.0 if loaded else shared * z - lasting + min(max(lasting, -reading.held), reading.held)
                reading.low -= move
                reading.high -= move
                reading.variance += shared * shared * (1.0 if loaded else 1.0 / others + WHITE / (2.0 - WHITE))
