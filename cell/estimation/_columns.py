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
from ._filter import Estimates, Watch, expects
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
    shared: Row,
    held: Row,
    known: Row,
    recent: Row,
    low: Row,
    high: Row,
    var: Row,
    off: Row,
    spread: Row,
) -> None:
    """Take what columns share out of readings between ``low`` and ``high`` (n,), and add what stays to ``var`` (n,).

    ``shared`` (n,): signed standard deviation h of the shared error; ``held`` (n,): the most of it that lasts, half a
    step; ``recent`` (columns,): mean of late z; ``off`` and ``spread`` (n,): scratch.
    """
    columns, t = recent.size, steps[0]
    for i in range(shared.size):
        spread[i] = 0.0
        if known[i] > 0.0 and shared[i] != 0.0:
            mean, expected = expects(cells[i], watches[i], t)
            width = high[i] - low[i]
            spread[i] = expected + var[i] + width * width * (1.0 / 12.0)
            most = CLIPPED * math.sqrt(spread[i] + shared[i] * shared[i])
            off[i] = min(max(0.5 * (low[i] + high[i]) - mean, -most), most)
    for k in range(columns):
        precision, told = 1.0, 0.0
        for i in range(k, shared.size, columns):
            if spread[i] > 0.0:
                precision += shared[i] * shared[i] / spread[i]
                told += shared[i] * off[i] / spread[i]
        recent[k] += WHITE * (told / precision - recent[k])
        loaded = abs(told / precision) > RARE
        for i in range(k, shared.size, columns):
            if spread[i] > 0.0:
                others = precision - shared[i] * shared[i] / spread[i]
                z = (told - shared[i] * off[i] / spread[i]) / others
                lasting = shared[i] * recent[k] * (1.0 - 1.0 / others)
                move = 0.0 if loaded else shared[i] * z - lasting + min(max(lasting, -held[i]), held[i])
                low[i] -= move
                high[i] -= move
                var[i] += shared[i] * shared[i] * (1.0 if loaded else 1.0 / others + WHITE / (2.0 - WHITE))
