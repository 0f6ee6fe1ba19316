"""Inverting (transimpedance) amplifiers on all rows, columns driven: zero-potential method, the array transposed.

The columns are driven one at a time, and each row ends in an amplifier. Column j is driven behind its ``column_lead``,
from the end after row N - 1. Row i is sensed behind its ``row_lead``, at column 0. In line coordinates
(:mod:`.._parts`) this circuit is :class:`.InvertingAmplifier`.
"""

from __future__ import annotations

from ._inverting_amplifier import InvertingAmplifier


class RowAmplifier(InvertingAmplifier):
    """An inverting amplifier on each row; columns are driven, idle columns at the reference, or open."""

    name = "row-amplifier"
    senses = "rows"
