"""Scales of readings: how a conductance becomes r, the number that models of cells describe.

The choice of a scale is part of what is known of a cell. Carbon-filled silicone is described by r = R/R0 - 1. Velostat
and other cells whose resistance falls under load follow a model with memory on a logarithmic scale, r = ln(R0/R)/span.
Electrodes that touch conduct in parallel with the cell at rest, so that their scale begins at the conductance at rest,
G0. That may be far below what a board resolves: a conductance g, a small part of that under full scale, stands for it,
so that noise and ADC steps are small in r = g/(G - G0 + g) - 1, which falls under load as R/R0 - 1 does.
"""

from __future__ import annotations

import math

from ...common.compiled import Record, Records, loop, zeros

RATIO, LOGARITHM, CONTACT = range(3)
BELOW = 0.1
"""least r on scales of cells whose resistance falls under load: at rest their resistance may be anything above R0"""


class Scale(Record):
    """Turns conductances of cells with their own R0 into r."""

    kind: float
    unit: float
    """span of a :data:`LOGARITHM`; 1/g in ohm, of a :data:`CONTACT`"""
    falls: float
    """1: a load lowers the resistance"""
    open_at_rest: float
    """1: a cell at rest may read no current; otherwise a cell that does is not connected"""


def scale_of(kind: int, *, unit: float = 1.0, falls: bool = True, open_at_rest: bool = True) -> Records[Scale]:
    """(1,) the scale of these properties."""
    made = zeros(Scale, 1)
    made[0] = float(kind), unit, float(falls), float(open_at_rest)
    return made


@loop
def scaled(scale: Scale, rest_ohm: float, conductance: float) -> tuple[float, float]:
    """r of a conductance in S, and dr/dG; NaN or infinite where no cell has such a one."""
    if scale.kind == RATIO:
        if conductance == 0.0:
            return math.inf, math.inf
        ratio = 1.0 / (conductance * rest_ohm)
        return ratio - 1.0, -ratio * ratio * rest_ohm
    if scale.kind == LOGARITHM:
        if not conductance > 0.0:
            return math.nan, math.nan
        return max(math.log(rest_ohm * conductance) / scale.unit, -BELOW), 1.0 / (scale.unit * conductance)
    contact = (conductance + 1.0 / scale.unit - 1.0 / rest_ohm) * scale.unit
    if conductance == 0.0 or not contact > 0.0:  # no contact conducts so
        return math.nan, math.nan
    ratio = 1.0 / contact
    return ratio - 1.0, -scale.unit * ratio * ratio
